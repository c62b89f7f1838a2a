"""The whole fit of tensor engines: all engines, what cross-validation says of each, and chips known by anchors only.

Rule: whatever is said of an error is of a row whose network no number had seen. A chip's numbers for an engine of which
there is no row of it are those of a relative, times what the two differ by where both are known; they are `assumed`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from trilane.arrays import F64
from trilane.hw_profiles.engine_layers import Layers
from trilane.hw_profiles.fit_engines import Fitted, LeftOut, cross_validate, fit_anchors, fit_engine
from trilane.hw_profiles.fit_priors import Prior
from trilane.hw_profiles.latency_rows import Latency, layers_of_rows, read_latencies
from trilane.hw_profiles.schema import ENGINES, EngineName

#: Of a normal distribution: 80 % lie within so many standard deviations. Intervals of 80 % are drawn so that they cover
#: COVERED of the left-out rows: a stranger is less like the networks of the fit than these are like each other.
NORMAL_80 = 1.2816
COVERED = 0.87
#: A chip of which no row is of the engine: its usual rows are minutes, or fell off the engine.
LEFT_ASIDE = ("865",)
#: A chip known by anchors -> the one before it. A chip without rows of an engine -> its closest relative that has them.
BEFORE = {"8elite5": "8elite"}
RELATIVE = {"xelite": "8gen2", "qcs6490": "sa8295p", "8elite5": "8elite"}
#: An engine -> the one in which a chip and its relative are compared in its place.
SIBLING: dict[EngineName, tuple[EngineName, ...]] = {
    "int8_tflite": ("int8_qnn_dlc",),
    "int8_qnn_dlc": ("int8_tflite",),
    "fp16_tflite": ("fp16_qnn_dlc", "int8_tflite", "int8_qnn_dlc"),
    "fp16_qnn_dlc": ("fp16_tflite", "int8_tflite", "int8_qnn_dlc"),
}
ASSUMED_SPREAD = 0.25


class Rate(NamedTuple):
    """One of a chip's six numbers. `kind`: of a profile's number."""

    value: float
    spread: float
    kind: str


@dataclass(frozen=True)
class EngineStudy:
    """One engine. `left_out`: of the cross-validation.

    `error`: the model's own for a network that is wholly unlike those of the fit, so that intervals cover COVERED.
    """

    fitted: Fitted
    left_out: tuple[LeftOut, ...]
    error: float

    @property
    def coverage(self) -> float:
        """Share of the left-out rows that lie in the interval around their prediction."""
        misses, unsure, unlike = misses_of(self.left_out)
        return float(np.mean(misses <= NORMAL_80 * np.hypot(unsure, self.error * unlike)))


@dataclass(frozen=True)
class Study:
    """All engines. `rates`: of each chip and engine, by key."""

    engines: Mapping[EngineName, EngineStudy]
    rates: Mapping[tuple[str, EngineName], Mapping[str, Rate]]

    @property
    def chips(self) -> tuple[str, ...]:
        return tuple(sorted({chip for chip, _ in self.rates}))


def misses_of(rows: Sequence[LeftOut]) -> tuple[F64, F64, F64]:
    """Absolute logarithms of predicted over published (rows,); what the numbers leave open; how unlike each is."""
    misses = [abs(math.log(row.predicted_ms / row.row.ms)) for row in rows]
    return np.array(misses), np.array([row.unsure for row in rows]), np.array([row.unlike for row in rows])


def own_error(rows: Sequence[LeftOut]) -> float:
    """The least error of the model, grown in proportion to how unlike a network is, with which intervals around `rows`
    cover COVERED of them.
    """
    misses, unsure, unlike = misses_of(rows)
    beyond = np.sqrt(np.maximum((misses / NORMAL_80) ** 2 - unsure**2, 0)) / unlike
    return float(np.quantile(beyond, COVERED))


def study_engines(folder: Path) -> Study:
    """Fit and cross-validate every engine of which `folder` has rows. Raises BadInputError."""
    rows = [row for row in read_latencies(folder) if row.chip not in LEFT_ASIDE]
    layers = layers_of_rows(folder, rows)
    engines = {}
    for engine in ENGINES:
        usual = [row for row in rows if row.engine == engine and not row.anchor]
        if usual:
            engines[engine] = study_engine(usual, layers)
    rates = {(chip, name): _known(study.fitted, chip) for name, study in engines.items() for chip in study.fitted.chips}
    for chip, before in BEFORE.items():
        for engine, study in engines.items():
            anchors = [row for row in rows if row.anchor and row.chip == chip and row.engine == engine]
            if anchors:
                rates[chip, engine] = _known(fit_anchors(study.fitted, before, anchors, layers), chip)
    return Study(engines, {**rates, **_assumed(rates, tuple(engines))})


def study_engine(rows: Sequence[Latency], layers: Mapping[str, Layers]) -> EngineStudy:
    """Fit and cross-validate one engine."""
    fitted = fit_engine(rows, layers)
    left_out = tuple(cross_validate(rows, layers, fitted.numbers))
    return EngineStudy(fitted, left_out, own_error(left_out))


def _known(fitted: Fitted, chip: str) -> dict[str, Rate]:
    return {key: Rate(*prior, "fitted") for key, prior in fitted.rates_of(chip).items()}


def _assumed(
    rates: Mapping[tuple[str, EngineName], Mapping[str, Rate]], engines: Sequence[EngineName]
) -> dict[tuple[str, EngineName], dict[str, Rate]]:
    """The numbers of chips for engines of which there is no row of them."""
    found = {}
    for chip, relative in RELATIVE.items():
        for engine in engines:
            other = next((e for e in SIBLING[engine] if {(chip, e), (relative, e)} <= rates.keys()), None)
            if (chip, engine) not in rates and other is not None and (relative, engine) in rates:
                ratio = {
                    key: rate.value / rates[relative, other][key].value for key, rate in rates[chip, other].items()
                }
                found[chip, engine] = {
                    key: Rate(rate.value * ratio[key], ASSUMED_SPREAD, "assumed")
                    for key, rate in rates[relative, engine].items()
                }
    return found


def middle(chips: Sequence[Mapping[str, Rate]]) -> dict[str, Prior]:
    """The geometric mean of chips' numbers; its spread is what the chips differ by, and what is open of each."""
    result = {}
    for key in chips[0]:
        logs = np.log([chip[key].value for chip in chips])
        open_ = np.mean([chip[key].spread ** 2 for chip in chips])
        result[key] = Prior(math.exp(logs.mean()), float(np.sqrt(logs.var() + open_)))
    return result
