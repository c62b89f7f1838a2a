"""How well a chip is met from a handful of own rows. Each chip in turn is left out of the whole fit, factors included.

    python tests/support/own_rows.py ../shared/data/chips

prints the table of docs/decisions/own-rows.md. A chip begins at the numbers of its neighbour, as found without it. Five
of its rows are drawn; the other rows of the same engine are predicted. In brackets: five rows of several engines.
"""

from __future__ import annotations

import copy
import math
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from statistics import median
from typing import Any, NamedTuple

import numpy as np

from trilane.hw_profiles.calibrate import OwnRow, _EngineRow, _solve, calibrate_tables, on_chip, with_numbers
from trilane.hw_profiles.engine_study import LEAST_SHARE, LEFT_ASIDE, PROFILE_OF, EngineStudy, study_engine
from trilane.hw_profiles.fit_engines import UNITS_OF_RATES, Latency, layers_of_rows, read_latencies
from trilane.hw_profiles.graph_file import read_graph
from trilane.hw_profiles.network_time import Interval, interval, price
from trilane.hw_profiles.operators import NAMES, RATES
from trilane.hw_profiles.profile_files import load_tables, parse_profile
from trilane.hw_profiles.schema import ENGINES, EngineName, Profile, corners_of
from trilane.units import BURST

#: A chip -> the nearest older one, of which users have a profile; the oldest begin at the next younger one.
NEIGHBOUR = {
    "8elite": "8gen3",
    "8gen3": "8gen2",
    "8gen2": "8gen1",
    "8gen1": "sa8295p",
    "qcs6490": "sa8295p",
    "sa8295p": "8gen1",
    "xelite": "8gen2",
}
FIVE, DRAWS, SEED = 5, 40, 20_261_127


class Met(NamedTuple):
    """A row that was left out, beside its predictions before and after the fit to five others.

    `stated`: the interval after the fit without the unit's `error_scale`.
    """

    ms: float
    before: tuple[float, Interval]
    after: tuple[float, Interval]
    stated: Interval


class Draw(NamedTuple):
    """Five rows of `engine` (None: of several), and the rows that were predicted."""

    engine: EngineName | None
    rows: tuple[Met, ...]


def latencies(folder: Path) -> list[Latency]:
    return [row for row in read_latencies(folder) if row.chip not in LEFT_ASIDE and not row.anchor]


def own_row(folder: Path, row: Latency) -> OwnRow:
    precision, runtime = row.engine.split("_", 1)
    work = read_graph(folder / "networks" / f"{row.network}.onnx").work
    return OwnRow(row.network, row.network, work, row.ms, "dsp", precision, runtime)  # type: ignore[arg-type]


def tables_without(folder: Path, chip: str) -> tuple[dict[str, Any], Path]:
    """The tables of the neighbour of `chip`, with all numbers fitted to the rows of the other chips alone."""
    rows, start = [row for row in latencies(folder) if row.chip != chip], NEIGHBOUR[chip]
    layers = layers_of_rows(folder, rows)
    data, path = load_tables(PROFILE_OF[start])
    data = copy.deepcopy(data)
    engines = data["units"]["dsp"]["engines"]
    for name in ENGINES:
        study = study_engine([row for row in rows if row.engine == name], layers)
        if start in study.fitted.chips:
            engines[name] |= _engine(study, start)
        else:
            engines.pop(name, None)
    return data, path


def _engine(study: EngineStudy, chip: str) -> dict[str, Any]:
    numbers, spreads = study.fitted.numbers.factors, study.fitted.spreads.factors
    return {
        "error_fraction": _fitted(study.error, 0.3),
        "rates": {key: _fitted(*prior) for key, prior in study.fitted.rates_of(chip).items()},
        "seen": {
            network: {name: float(share) for name, share in zip(NAMES, shares, strict=True) if share >= LEAST_SHARE}
            for network, shares in study.fitted.seen.items()
        },
        "factors": {
            name: _fitted(math.exp(value), spread)
            for name, value, spread in zip(NAMES, numbers, spreads, strict=True)
            if name not in UNITS_OF_RATES
        },
    }


def _fitted(value: float, spread: float) -> dict[str, Any]:
    return {"value": float(value), "spread": float(spread), "kind": "fitted", "source": "without the chip"}


def predicted(profile: Profile, row: OwnRow) -> tuple[float, Interval]:
    chip = on_chip(profile, row)
    time = price(chip, row.work, row.unit, corners_of(chip, BURST))
    return time.total_ms, interval(chip, row.work, time)


class Judged:
    """A chip that was left out: its rows by engine, and the tables that a fit to five of them begins at."""

    def __init__(self, folder: Path, chip: str) -> None:
        self.data, self.path = tables_without(folder, chip)
        self.profile = parse_profile(self.data, self.path)
        known = self.profile.units["dsp"].engines
        own = [row for row in latencies(folder) if row.chip == chip and row.engine in known]
        self.rows: dict[EngineName, list[OwnRow]] = {}
        for row in own:
            self.rows.setdefault(row.engine, []).append(own_row(folder, row))

    def draws(self, rng: np.random.Generator, count: int) -> Iterator[Draw]:
        """Yield `count` draws of each engine, then as many of five rows of all engines together."""
        together = [row for rows in self.rows.values() for row in rows]
        for engine, rows in [*self.rows.items(), (None, together)]:
            for _ in range(count):
                yield Draw(engine, self._met(rows, rng))

    def _met(self, rows: Sequence[OwnRow], rng: np.random.Generator) -> tuple[Met, ...]:
        order = [rows[place] for place in rng.permutation(len(rows))]
        found = calibrate_tables(self.data, self.path, order[:FIVE])
        plain = {key: number for key, number in found.numbers.items() if not key.endswith("error_scale")}
        moved, stated = (parse_profile(tables, self.path) for tables in (found.data, with_numbers(self.data, plain)))
        return tuple(
            Met(row.ms, predicted(self.profile, row), predicted(moved, row), predicted(stated, row)[1])
            for row in order[FIVE:]
        )

    def floor(self) -> float:
        """The median error of the same model when it is fitted to all rows of an engine, these rows themselves."""
        engines, errors = list(self.profile.units["dsp"].engines), []
        for engine, rows in self.rows.items():
            priced = [_EngineRow(self.profile, row) for row in rows]
            first = len(RATES) * engines.index(engine)
            best = _solve(priced, engines)[0][first : first + len(RATES)]
            errors += [abs(row.predict(best)[0] / row.ms - 1) for row in priced]
        return median(errors)


def median_error(rows: Sequence[Met], *, after: bool) -> float:
    return median(abs((row.after if after else row.before)[0] / row.ms - 1) for row in rows)


def cover(rows: Sequence[Met], of: str) -> float:
    """The share of `rows` in an interval: `before`, `stated` or `after`."""
    return float(np.mean([_interval(row, of).low_ms <= row.ms <= _interval(row, of).high_ms for row in rows]))


def half_width(rows: Sequence[Met], of: str) -> float:
    """The median of how far an interval's upper end is above its middle."""
    return median(math.sqrt(_interval(row, of).high_ms / _interval(row, of).low_ms) - 1 for row in rows)


def _interval(row: Met, of: str) -> Interval:
    return {"before": row.before[1], "stated": row.stated, "after": row.after[1]}[of]


def evaluated(folder: Path, chip: str, count: int = DRAWS) -> tuple[list[Draw], float]:
    """The draws of a chip, and its floor."""
    judged = Judged(folder, chip)
    return list(judged.draws(np.random.default_rng([SEED, list(NEIGHBOUR).index(chip)]), count)), judged.floor()


def _cells(chip: str, draws: Sequence[Draw], floor: float) -> Iterator[str]:
    of_engine = [draw.rows for draw in draws if draw.engine is not None]
    alone = [row for rows in of_engine for row in rows]
    together = [row for draw in draws if draw.engine is None for row in draw.rows]
    halves = [median_error(rows, after=True) <= median_error(rows, after=False) / 2 for rows in of_engine]
    yield f"{chip}, from {NEIGHBOUR[chip]}"
    yield f"{100 * median_error(alone, after=False):.1f} %"
    yield f"{100 * median_error(alone, after=True):.1f} % ({100 * median_error(together, after=True):.1f} %)"
    yield f"{100 * floor:.1f} %"
    yield f"{100 * float(np.mean(halves)):.0f} %"
    for of in ("stated", "after"):
        yield f"{100 * cover(alone, of):.0f} % ({100 * cover(together, of):.0f} %)"
        yield f"{100 * half_width(alone, of):.0f} %"


def main() -> None:
    for chip in NEIGHBOUR:
        print("|", " | ".join(_cells(chip, *evaluated(Path(sys.argv[1]), chip))), "|", flush=True)


if __name__ == "__main__":
    main()
