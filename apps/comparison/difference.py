"""How much a statistic differs between two runs, and how sure that is. Rule: what is not known widens the interval.

Three things make two runs of one kind differ: their frames' scatter (a block bootstrap), the drift of a machine's speed
within the runs, carried on to the time between them (`slow_noise.py`), and what no run can know of itself (`noise.py`).
The first two overlap, so the larger counts; the third adds to it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from math import erfc, expm1, hypot, inf, log, log1p, sqrt
from typing import Final, NamedTuple

import numpy as np

from trilane.apps.comparison.blocks import block_length, draws
from trilane.apps.comparison.slow_noise import drift_variance
from trilane.arrays import F64, I64, Ints

SEED: Final = 20_260_101
LEAST_FRAMES: Final = 50
MOST_FRAMES: Final = 20_000
MOST_REPLICATES, LEAST_REPLICATES, MOST_VALUES = 200, 100, 2_000_000
Z_95: Final = 1.959964
#: Runs show the same frames where so many of each one's are the other's too.
ALIKE: Final = 0.8
NEGLIGIBLE: Final = 1e-9

Reduce = Callable[[F64, F64], F64]


@dataclass(frozen=True)
class Series:
    """One figure of every frame of a run, in order: `values`, (n,) float64, of the frames numbered `frames`, (n,).

    `weights`, (n,): what a share is a share of, in the unit of `values`; ones for what is none.
    """

    frames: I64
    values: F64
    weights: F64

    def at(self, places: Ints | slice) -> Series:
        """The frames at `places`."""
        return Series(self.frames[places], self.values[places], self.weights[places])


class Difference(NamedTuple):
    """How far a statistic has changed.

    `base`, `other`: its values, each of all frames of its own run, whatever it is beside; of several runs a side their
    arithmetic mean. `change`, and its 95 % interval from `low` to `high`: of the other from the base, as a share of the
    base where `is_ratio`, else in the statistic's unit; of the frames that both runs have, and of several pairs of runs
    the geometric mean of their ratios, so it need not be the ratio of the values. `probability`: of a change as large
    as this between runs of one kind. `low`, `high` and `probability` are None where it cannot be told. `deviation`: the
    standard deviation of the change, or of its logarithm where `is_ratio`.
    """

    base: float
    other: float
    change: float
    low: float | None
    high: float | None
    probability: float | None
    is_ratio: bool
    deviation: float | None = None

    @property
    def effect(self) -> float:
        """What deviations are of: the logarithm of the ratio where `is_ratio`, else the change."""
        return log1p(self.change) if self.is_ratio else self.change


def _mean(values: F64, weights: F64) -> F64:
    return np.asarray(values.sum(axis=-1) / weights.sum(axis=-1))


def _typical(values: F64, _: F64) -> F64:
    """The mean of the middle half."""
    count = values.shape[-1]
    return np.asarray(np.sort(values, axis=-1)[..., count // 4 : count - count // 4].mean(axis=-1))


def _quantile(share: float) -> Reduce:
    """Linear between ranks, as in the report."""

    def reduce(values: F64, _: F64) -> F64:
        ordered = np.sort(values, axis=-1)
        place = share * (ordered.shape[-1] - 1)
        low = int(place)
        above = ordered[..., min(low + 1, ordered.shape[-1] - 1)]
        return np.asarray(ordered[..., low] + (above - ordered[..., low]) * (place - low))

    return reduce


#: Statistic: how it is computed over the last axis. `typical` is the mean of the middle half of the values.
STATISTICS: Final[dict[str, Reduce]] = {
    "mean": _mean,
    "share": _mean,
    "typical": _typical,
    "p50": _quantile(0.5),
    "p90": _quantile(0.9),
    "p99": _quantile(0.99),
}


def difference(
    base: Series, other: Series, statistic: str, *, is_ratio: bool, relative: float = 0.0, absolute: float = 0.0
) -> Difference:
    """The change of `statistic` from `base` to `other`, of the last `MOST_FRAMES` frames of each.

    `relative`, `absolute`: standard deviations of what two runs of one kind differ by beside their scatter and drift,
    as a share of the statistic and in its unit. `is_ratio`: the change is a share of the base; where a value is zero
    it is not, and `absolute` counts. Frames that both runs have are compared frame with frame, so that what the scene
    asks of each does not count as scatter.
    """
    base, other = base.at(slice(-MOST_FRAMES, None)), other.at(slice(-MOST_FRAMES, None))
    reduce = STATISTICS[statistic]
    values = _value(base, reduce), _value(other, reduce)
    pair = _Pair.of(base, other, statistic, is_ratio)
    if min(len(pair.base.values), len(pair.other.values)) < LEAST_FRAMES:
        return unsure(*values, is_ratio=pair.is_ratio)
    first, second = pair.values()
    variance = max(pair.scatter_variance(), pair.drift_variance())
    between = relative if pair.is_ratio else hypot(relative * max(abs(first), abs(second)), absolute)
    effect = log(second / first) if pair.is_ratio else second - first
    return _told(values, effect, sqrt(variance + between**2), is_ratio=pair.is_ratio)


def combined(pairs: Sequence[Difference]) -> Difference:
    """One difference of several pairs of runs, which differ from pair to pair by more than each one's interval says.

    `base` and `other` are the arithmetic means of the runs' values, the change is the mean of the effects, of ratios
    so the geometric mean: with the deviation of the mean of independent pairs; where the pairs scatter more than that
    (Birge's ratio above 1), as much as they do. Where some pairs are ratios and others are none, nobody knows how sure
    the change of the means is. `pairs`: of runs that stand in one pair each; not empty.
    """
    base, other = (sum(getattr(pair, side) for pair in pairs) / len(pairs) for side in ("base", "other"))
    is_ratio = all(pair.is_ratio for pair in pairs)
    if any(pair.is_ratio != is_ratio for pair in pairs):
        return unsure(base, other, is_ratio=False)
    effects = np.array([pair.effect for pair in pairs])
    mean = float(effects.mean())
    deviations = [pair.deviation for pair in pairs if pair.deviation is not None]
    if len(deviations) < len(pairs):
        return _told((base, other), mean, None, is_ratio=is_ratio)
    within = sqrt(sum(value**2 for value in deviations)) / len(pairs)
    between = float(effects.std(ddof=1)) / sqrt(len(pairs)) if len(pairs) > 1 else 0.0
    return _told((base, other), mean, max(within, between), is_ratio=is_ratio)


def unsure(base: float, other: float, *, is_ratio: bool) -> Difference:
    """A difference of which nobody knows how sure it is."""
    is_ratio = is_ratio and min(base, other) > 0
    return _told((base, other), log(other / base) if is_ratio else other - base, None, is_ratio=is_ratio)


def judged(base: float, other: float, deviation: float, *, is_ratio: bool) -> Difference:
    """A difference whose standard deviation is known; where `is_ratio`, of the logarithm, and values are above 0."""
    return _told((base, other), log(other / base) if is_ratio else other - base, deviation, is_ratio=is_ratio)


def _told(values: tuple[float, float], effect: float, deviation: float | None, *, is_ratio: bool) -> Difference:
    """The difference of which the `effect` and its deviation are known; None: the deviation is not."""
    if deviation is None:
        return Difference(*values, _change(effect, is_ratio), None, None, None, is_ratio)
    change, low, high = (_change(effect + sign * Z_95 * deviation, is_ratio) for sign in (0, -1, 1))
    return Difference(*values, change, low, high, _probability(effect, deviation), is_ratio, deviation)


def _change(effect: float, is_ratio: bool) -> float:
    return expm1(effect) if is_ratio else effect


def _value(series: Series, reduce: Reduce) -> float:
    return float(reduce(series.values, series.weights)) if len(series.values) else 0.0


def _probability(effect: float, deviation: float) -> float:
    if abs(effect) < NEGLIGIBLE:
        return 1.0
    return erfc(abs(effect) / deviation / sqrt(2) if deviation else inf)


@dataclass(frozen=True)
class _Pair:
    """Two series, frame with frame where `is_paired`, and the statistic that is compared."""

    base: Series
    other: Series
    reduce: Reduce
    is_ratio: bool
    is_paired: bool

    @classmethod
    def of(cls, base: Series, other: Series, statistic: str, is_ratio: bool) -> _Pair:
        common, first, second = np.intersect1d(base.frames, other.frames, return_indices=True)
        is_paired = len(common) >= ALIKE * max(len(base.frames), len(other.frames), 1)
        if is_paired:
            base, other = base.at(first), other.at(second)
        positive = all(len(each.values) > 0 and float(each.values.min()) > 0 for each in (base, other))
        return cls(base, other, STATISTICS[statistic], is_ratio and positive, is_paired)

    def values(self) -> tuple[float, float]:
        return _value(self.base, self.reduce), _value(self.other, self.reduce)

    def scatter_variance(self) -> float:
        """Of the effect, by the frames' scatter alone."""
        if not self.is_paired:
            return sum(float(np.var(self._drawn(each, _length(each)))) for each in (self.base, self.other))
        length = _length(self.base, self.other)
        return float(np.var(self._drawn(self.other, length) - self._drawn(self.base, length)))

    def drift_variance(self) -> float:
        """Of the effect, by what changes slowly."""
        if self.is_paired:
            return drift_variance(
                len(self.base.values),
                lambda stretch: float(
                    self._scaled(self._at(self.other, stretch)) - self._scaled(self._at(self.base, stretch))
                ),
            )
        return sum(self._drift_of(each) for each in (self.base, self.other))

    def _drift_of(self, series: Series) -> float:
        return drift_variance(len(series.values), lambda stretch: float(self._scaled(self._at(series, stretch))))

    def _drawn(self, series: Series, length: int) -> F64:
        return self._scaled(self._at(series, _places(len(series.values), length)))

    def _at(self, series: Series, places: Ints | slice) -> F64:
        return self.reduce(series.values[places], series.weights[places])

    def _scaled(self, values: F64) -> F64:
        return np.log(values) if self.is_ratio else values


@lru_cache(maxsize=16)
def _places(count: int, length: int) -> Ints:
    """The same for all series of one length: their variances are taken apart, so they need not be independent."""
    replicates = int(np.clip(MOST_VALUES // count, LEAST_REPLICATES, MOST_REPLICATES))
    return draws(count, length, replicates, np.random.default_rng(SEED))


def _length(series: Series, other: Series | None = None) -> int:
    """Of blocks, by the series as shares of its mean, or by its difference from that of the `other`."""
    return block_length(_relative(series) if other is None else _relative(other) - _relative(series))


def _relative(series: Series) -> F64:
    """What each frame adds to the mean, or to the share, as a share of it; zeros where that is zero."""
    total = float(series.values.sum())
    if not total:
        return np.zeros(len(series.values))
    return np.asarray((series.values - series.weights * total / series.weights.sum()) * len(series.values) / total)
