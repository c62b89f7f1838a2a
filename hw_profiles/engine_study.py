"""The whole fit of tensor engines: the numbers of every chip, their cross-validation, and tables and pictures of both.

Every stated error comes from rows whose network was left out of the fit. A chip without rows of an engine gets the
numbers of a related chip, times the ratio of the two chips' numbers on another engine. Such numbers are `assumed`. The
head of a chip's profile, the part before MARK, is written by hand and stays. This module writes everything from MARK
on.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from trilane.arrays import F64
from trilane.errors import BadInputError
from trilane.files import read_text
from trilane.hw_profiles.fit_engines import (
    ON_CHIP_MB,
    UNITS_OF_RATES,
    Fitted,
    Latency,
    LeftOut,
    Prior,
    cross_validate,
    fit_anchors,
    fit_engine,
    layers_of_rows,
    read_latencies,
)
from trilane.hw_profiles.governor import figure_for
from trilane.hw_profiles.operators import NAMES, Layers
from trilane.hw_profiles.schema import ENGINES, SHARE_TEXT, SIGMAS, EngineName
from trilane.writing import write_atomically

#: Share of the left-out rows that lie in their 80 % intervals by construction. It is more than 80 % because a user's
#: network differs more from the networks of the fit than these differ from each other.
COVERED = 0.87
#: Chips whose published times say nothing about the engine: the times are minutes, or layers ran on other units.
LEFT_ASIDE = ("865",)
#: The chip of the generation before, for a chip that has only anchors.
BEFORE = {"8elite5": "8elite"}
#: The closest relative that has rows of an engine, for a chip without such rows.
RELATIVE = {"xelite": "8gen2", "qcs6490": "sa8295p", "8elite5": "8elite"}
#: By engine: the engines on which a chip without rows of this engine is compared with its relative.
SIBLING: dict[EngineName, tuple[EngineName, ...]] = {
    "int8_tflite": ("int8_qnn_dlc",),
    "int8_qnn_dlc": ("int8_tflite",),
    "fp16_tflite": ("fp16_qnn_dlc", "int8_tflite", "int8_qnn_dlc"),
    "fp16_qnn_dlc": ("fp16_tflite", "int8_tflite", "int8_qnn_dlc"),
}
ASSUMED_SPREAD = 0.25

BEGIN, END = "<!-- errors: written by `trilane profiles fit-chips` -->", "<!-- end of errors -->"
#: The engine whose errors are shown by family and chip: INT8 under the phone's usual runtime.
USUAL: EngineName = "int8_tflite"
CLOSE = 0.15

#: The profile with the shared factors.
SHARED = "hexagon"
#: The profile of each chip.
PROFILE_OF = {
    "8gen1": "snapdragon-8-gen-1",
    "8gen2": "snapdragon-8-gen-2",
    "8gen3": "snapdragon-8-gen-3",
    "8elite": "snapdragon-8-elite",
    "8elite5": "snapdragon-8-elite-gen-5",
    "qcs6490": "qcs6490",
    "sa8295p": "sa8295p",
    "xelite": "snapdragon-x-elite",
}
HEXAGON_OF = {
    **{"8gen1": "v69", "8gen2": "v73", "8gen3": "v75", "8elite": "v79", "8elite5": "v81"},
    **{"qcs6490": "v68", "sa8295p": "v68", "xelite": "v73"},
}
#: Chips of the 888's generation; their mean is in the shared profile, for chips without rows.
V68 = ("qcs6490", "sa8295p")
MARK = "# From here on written by `trilane profiles fit-chips`."
VTCM = "VTCM of its generation"
#: Least share of a network's time that is written.
LEAST_SHARE = 0.001


class ChipRate(NamedTuple):
    """One of a chip's six rates on an engine.

    `spread`: its relative spread.
    `kind`: kind of the number in a profile.
    """

    value: float
    spread: float
    kind: str


@dataclass(frozen=True)
class EngineStudy:
    """The fit of one engine.

    `left_out`: rows of the cross-validation.
    `error`: relative error of the model itself for a network that is wholly unlike the networks of the fit. With this
    error, intervals cover the share COVERED of the rows.
    """

    fitted: Fitted
    left_out: tuple[LeftOut, ...]
    error: float

    @property
    def coverage(self) -> float:
        """Share of the left-out rows that lie in the interval around their prediction."""
        misses, unsure, unlike = misses_of(self.left_out)
        return float(np.mean(misses <= SIGMAS * np.hypot(unsure, self.error * unlike)))


@dataclass(frozen=True)
class Study:
    """The fits of all engines. `rates`: six rates of each pair (chip, engine), by the key of a profile."""

    engines: Mapping[EngineName, EngineStudy]
    rates: Mapping[tuple[str, EngineName], Mapping[str, ChipRate]]

    @property
    def chips(self) -> tuple[str, ...]:
        return tuple(sorted({chip for chip, _ in self.rates}))


def misses_of(rows: Sequence[LeftOut]) -> tuple[F64, F64, F64]:
    """Return three arrays (rows,): misses, relative errors from the spreads of the numbers, unlikeness of the networks.

    A miss is the absolute logarithm of predicted / published time. The unlikeness is `LeftOut.unlike`.
    """
    misses = [abs(math.log(row.predicted_ms / row.row.ms)) for row in rows]
    return np.array(misses), np.array([row.unsure for row in rows]), np.array([row.unlike for row in rows])


def own_error(rows: Sequence[LeftOut]) -> float:
    """Return the least `EngineStudy.error` with which intervals cover the share COVERED of `rows`.

    The error of a row is this error times the unlikeness of its network.
    """
    misses, unsure, unlike = misses_of(rows)
    beyond = np.sqrt(np.maximum((misses / SIGMAS) ** 2 - unsure**2, 0)) / unlike
    return float(np.quantile(beyond, COVERED))


def study_engines(folder: Path) -> Study:
    """Fit and cross-validate every engine for which `folder` has rows. Raises BadInputError."""
    rows = [row for row in read_latencies(folder) if row.chip not in LEFT_ASIDE]
    layers = layers_of_rows(folder, rows)
    engines = {}
    for engine in ENGINES:
        if usual := [row for row in rows if row.engine == engine and not row.anchor]:
            engines[engine] = study_engine(usual, layers)
    rates = {(chip, name): _known(study.fitted, chip) for name, study in engines.items() for chip in study.fitted.chips}
    for chip, before in BEFORE.items():
        for engine, study in engines.items():
            anchors = [row for row in rows if row.anchor and row.chip == chip and row.engine == engine]
            if anchors:
                rates[chip, engine] = _known(fit_anchors(study.fitted, before, anchors, layers), chip)
    return Study(engines, {**rates, **_assumed(rates, tuple(engines))})


def study_engine(rows: Sequence[Latency], layers: Mapping[str, Layers]) -> EngineStudy:
    """Fit and cross-validate one engine.

    `rows`: published times of the engine.
    `layers`: layers of each network, by name.
    """
    fitted = fit_engine(rows, layers)
    left_out = tuple(cross_validate(rows, layers, fitted.numbers))
    return EngineStudy(fitted, left_out, own_error(left_out))


def _known(fitted: Fitted, chip: str) -> dict[str, ChipRate]:
    return {key: ChipRate(*prior, "fitted") for key, prior in fitted.rates_of(chip).items()}


def _assumed(
    rates: Mapping[tuple[str, EngineName], Mapping[str, ChipRate]], engines: Sequence[EngineName]
) -> dict[tuple[str, EngineName], dict[str, ChipRate]]:
    """Return the assumed rates, by key, of each pair (chip, engine) without rows in `rates`."""
    found = {}
    for chip, relative in RELATIVE.items():
        for engine in engines:
            other = next((e for e in SIBLING[engine] if {(chip, e), (relative, e)} <= rates.keys()), None)
            if (chip, engine) not in rates and other is not None and (relative, engine) in rates:
                own, theirs = rates[chip, other], rates[relative, other]
                found[chip, engine] = {
                    key: ChipRate(rate.value * (own[key].value / theirs[key].value), ASSUMED_SPREAD, "assumed")
                    for key, rate in rates[relative, engine].items()
                }
    return found


def middle(chips: Sequence[Mapping[str, ChipRate]]) -> dict[str, Prior]:
    """Return the geometric mean of the rates of `chips`, by key.

    The spread of a mean contains the differences between the chips and the spread of each chip.
    """
    result = {}
    for key in chips[0]:
        logs = np.log([chip[key].value for chip in chips])
        open_ = np.mean([chip[key].spread ** 2 for chip in chips])
        result[key] = Prior(math.exp(logs.mean()), float(np.sqrt(logs.var() + open_)))
    return result


def errors_of(rows: Sequence[LeftOut]) -> dict[str, float]:
    """Return statistics of the relative errors of `rows`.

    They are the number of `rows`, `median` and `p90` of the absolute errors, `close` (share within 15 %), and `bias`
    (median with sign).
    """
    errors = np.array([row.error for row in rows])
    return {
        "rows": len(rows),
        "median": float(np.median(np.abs(errors))),
        "p90": float(np.quantile(np.abs(errors), 0.9)),
        "close": float(np.mean(np.abs(errors) <= CLOSE)),
        "bias": float(np.median(errors)),
    }


def as_markdown(study: Study) -> str:
    """Return two tables: the errors by engine, and the errors of USUAL by family and chip."""
    return "\n".join([*_by_engine(study), "", *_by_family(study.engines[USUAL].left_out)])


def _by_engine(study: Study) -> Iterator[str]:
    yield f"| engine | rows | median | p90 | within 15 % | in the {SHARE_TEXT} interval |"
    yield "|---|---|---|---|---|---|"
    for name, engine in study.engines.items():
        all_rows = errors_of(engine.left_out)
        shares = " | ".join(f"{100 * all_rows[key]:.0f} %" for key in ("median", "p90", "close"))
        yield f"| `{name}` | {all_rows['rows']:.0f} | {shares} | {100 * engine.coverage:.0f} % |"


def _by_family(rows: Sequence[LeftOut]) -> Iterator[str]:
    chips = sorted({row.row.chip for row in rows})
    yield f"| median error, `{USUAL}` | {' | '.join(chips)} | all |"
    yield "|---|" + "---|" * (len(chips) + 1)
    for family in [*sorted({row.row.family for row in rows}), ""]:
        of_family = [row for row in rows if family in ("", row.row.family)]
        cells = [_median([row for row in of_family if row.row.chip in of]) for of in (*([c] for c in chips), chips)]
        yield f"| {family or 'all'} | {' | '.join(cells)} |"


def _median(rows: Sequence[LeftOut]) -> str:
    return f"{100 * errors_of(rows)['median']:.0f} %" if rows else ""


def with_table(text: str, table: str, path: Path) -> str:
    """Return `text` with `table` between the lines BEGIN and END. Raises BadInputError if it has no such lines.

    `path`: file of the text, for the error.
    """
    before, begin, rest = text.partition(BEGIN)
    _, end, after = rest.partition(END)
    if not (begin and end):
        raise BadInputError(path, "no place for the table", f"a line {BEGIN} and a line {END}")
    return f"{before}{BEGIN}\n{table}\n{END}{after}"


def plot_errors(study: Study, path: Path) -> None:
    """Draw the predicted against the published time of each left-out row, by engine, on logarithmic axes.

    `path`: path of the file; its ending is one of `trilane.hw_profiles.governor.SUFFIXES`.
    Raises MissingPartError without Matplotlib, BadInputError for another ending or a file that cannot be written.
    """
    figure = figure_for(path, (6.4, 6))
    axes = figure.subplots()
    for name, engine in study.engines.items():
        rows = engine.left_out
        axes.plot([r.row.ms for r in rows], [r.predicted_ms for r in rows], ".", markersize=4, alpha=0.6, label=name)
    ends = np.array([0.1, 200.0])
    axes.plot(ends, ends, color="black", linewidth=0.8)
    for factor in (1 + CLOSE, 1 / (1 + CLOSE)):
        axes.plot(ends, factor * ends, color="black", linewidth=0.5, linestyle="--")
    axes.set(xscale="log", yscale="log", xlabel="published, ms", ylabel="predicted by a fit without the network, ms")
    axes.set_title("Networks that the fit has not seen; dashed: 15 %")
    axes.grid(alpha=0.3)
    axes.legend(loc="lower right", fontsize="small")
    with write_atomically(path) as draft:
        figure.savefig(draft, dpi=120)


def profile_texts(study: Study, folder: Path, command: str) -> dict[Path, str]:
    """Return the new text of each profile in `folder` that has numbers from `study`, by its path.

    `command`: source that each number states.
    Raises BadInputError for a chip's profile that does not exist.
    """
    written = {folder / f"{SHARED}.toml": list(_shared(study, command))}
    for chip in study.chips:
        if chip in PROFILE_OF:
            written[folder / f"{PROFILE_OF[chip]}.toml"] = list(_chip(study, chip, command))
    return {path: head_of(path) + "\n".join([MARK, *lines]) + "\n" for path, lines in written.items()}


def head_of(path: Path) -> str:
    """Return the part before MARK of the profile `path`. Raises BadInputError for a file that cannot be read."""
    return read_text(path, "a chip's profile, its head written by hand").partition(MARK)[0].rstrip() + "\n\n"


def _shared(study: Study, command: str) -> Iterator[str]:
    source = f"{command}, factors shared by all chips"
    for name, engine in study.engines.items():
        yield f"\n[units.dsp.engines.{name}]"
        yield f"element_bytes = {2 if name.startswith('fp16') else 1}"
        yield _number("on_chip_mb", ChipRate(ON_CHIP_MB["v68"], 0.1, "published"), VTCM)
        yield _number("error_fraction", ChipRate(engine.error, 0.3, "fitted"), _errors(engine))
        chips = [study.rates[chip, name] for chip in V68 if (chip, name) in study.rates]
        mean = {key: ChipRate(*prior, "fitted") for key, prior in middle(chips).items()}
        yield from _rates(name, mean, f"{command}, mean of the chips of Hexagon v68")
        yield f"\n[units.dsp.engines.{name}.seen]"
        for network, shares in engine.fitted.seen.items():
            stated = [
                f"{term} = {share:.3f}" for term, share in zip(NAMES, shares, strict=True) if share >= LEAST_SHARE
            ]
            yield f"{network} = {{ {', '.join(stated)} }}"
        yield f"\n[units.dsp.engines.{name}.factors]"
        numbers, spreads = engine.fitted.numbers.factors, engine.fitted.spreads.factors
        for term, value, spread in zip(NAMES, numbers, spreads, strict=True):
            if term not in UNITS_OF_RATES:
                yield _number(term, ChipRate(math.exp(value), float(spread), "fitted"), source)


def _errors(engine: EngineStudy) -> str:
    return f"cross-validation over networks, {len(engine.left_out)} rows: 87 % of them lie in their intervals"


def _chip(study: Study, chip: str, command: str) -> Iterator[str]:
    for name in study.engines:
        if (chip, name) in study.rates:
            yield f"\n[units.dsp.engines.{name}]"
            yield _number("on_chip_mb", ChipRate(ON_CHIP_MB[HEXAGON_OF[chip]], 0.1, "published"), VTCM)
            yield from _rates(name, study.rates[chip, name], command)


def _rates(name: EngineName, rates: Mapping[str, ChipRate], source: str) -> Iterator[str]:
    yield f"\n[units.dsp.engines.{name}.rates]"
    for key, rate in rates.items():
        yield _number(key, rate, source)


def _number(key: str, rate: ChipRate, source: str) -> str:
    stated = f'value = {rate.value:.4g}, kind = "{rate.kind}", spread = {rate.spread:.2g}'
    return f"{key} = {{ {stated}, source = {json.dumps(source)} }}"
