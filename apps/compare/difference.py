"""The difference of a statistic between runs, with its uncertainty. Rule: lack of knowledge widens the interval.

Two things make runs of one kind differ by chance. First, frames scatter and drift within a run. A jackknife over
stretches of frames measures this scatter [1]. Second, the state of the machine differs from run to run. Several runs on
each side show these differences, and the deviations in `rows.py` count as further runs. Both are joined as a conjugate
normal prior and its data, so Student's t applies [2, 3]. A change that a known cause explains is no difference.

[1] Künsch, Annals of Statistics 17 (1989).
[2] Gelman et al., Bayesian Data Analysis, section 3.2.
[3] Smyth, Statistical Applications in Genetics and Molecular Biology 3 (2004).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import StrEnum
from itertools import pairwise
from math import ceil, expm1, inf, log, log1p, sqrt
from typing import Any, Final, NamedTuple

import numpy as np

from trilane.arrays import F64, I64, Ints
from trilane.scheduler.stats import PERCENTILES, student_quantile, student_tails

LEAST_FRAMES: Final = 50
MOST_FRAMES: Final = 20_000
#: Stretches of a run's frames; the jackknife leaves out one at a time.
STRETCHES: Final = 16
#: Runs show the same frames if at least this share of each run's frames is in the other runs too.
ALIKE: Final = 0.8
NEGLIGIBLE: Final = 1e-9
#: The least change that matters: a share of the base or, for shares of the time, a difference of shares.
MATTERS: Final = 0.05
#: Function of values and weights that returns a statistic.
Reduce = Callable[[F64, F64], float]
#: Largest probability of any false rejection among figures that are tested together.
ALPHA = 0.01


class Finding(StrEnum):
    """The finding about the change of a figure.

    DIFFERS: the figure has changed. SAME: the change is certainly below `MATTERS`. UNKNOWN: neither is certain.
    """

    DIFFERS = "differs"
    SAME = "no difference"
    UNKNOWN = "cannot tell"


@dataclass(frozen=True)
class Series:
    """One figure of every frame of a run, in order.

    `frames`: (n,) numbers of the frames.
    `values`: (n,) figure of each frame; for a share, its numerator.
    `weights`: (n,) for a share, its denominator in the same unit; otherwise 1.
    """

    frames: I64
    values: F64
    weights: F64

    def at(self, places: Ints | slice) -> Series:
        """Return the part of the series at `places`: indices into its arrays, or a slice."""
        return Series(self.frames[places], self.values[places], self.weights[places])


class Chance(NamedTuple):
    """How much a figure differs between runs of one kind, beyond the scatter of their frames.

    In virtual time, runs do not differ, and the defaults hold.
    `relative`, `absolute`: two parts of the standard deviation of one run's figure. `relative` is a share of the
    figure, `absolute` is in its unit.
    `freedom`: degrees of freedom: the deviation counts as if it were the scatter of so many further runs.
    `explained`: largest change that a known cause explains, as a logarithm for a ratio, otherwise in the figure's unit.
    """

    relative: float = 0.0
    absolute: float = 0.0
    freedom: int = STRETCHES - 1
    explained: float = 0.0


class Difference(NamedTuple):
    """How far a statistic has changed from the base to the other side.

    `base`, `other`: value of each side, over all frames; for several runs, their arithmetic mean.
    `change`: change from `base` to `other`, as a share of the base if `is_ratio`, otherwise in the statistic's unit. If
    the runs show the same frames, it covers only the frames that all runs have. A ratio of several runs compares
    geometric means, so it may differ from `other` / `base` - 1.
    `low`, `high`: ends of the 95 % interval of `change`.
    `probability`: probability that runs of one kind differ, in either direction, by `change` less `explained` or more.
    `is_ratio`: whether `change` is a share of the base.
    `deviation`: standard deviation of the change, or of its logarithm if `is_ratio`.
    `freedom`: degrees of freedom of the deviation.
    `explained`: as in `Chance`.
    If the uncertainty is unknown, `low`, `high`, `probability` and `deviation` are None.
    """

    base: float
    other: float
    change: float
    low: float | None
    high: float | None
    probability: float | None
    is_ratio: bool
    deviation: float | None = None
    freedom: float = inf
    explained: float = 0.0

    def as_json(self) -> dict[str, Any]:
        """Return the keys of a difference in the output of `trilane compare --json`."""
        names = ("base", "other", "change", "low", "high", "is_ratio", "probability")
        return {name: getattr(self, name) for name in names}

    @property
    def effect(self) -> float:
        """The change on the scale of `deviation`: the logarithm of the ratio if `is_ratio`, otherwise `change`."""
        return log1p(self.change) if self.is_ratio else self.change

    def outcome(self, *, differs: bool, margin: float = MATTERS) -> Finding:
        """Return the finding about this difference.

        `differs`: whether the figure differs, by a test of all figures together.
        `margin`: the least change that matters, in the unit of `change`.
        """
        if differs:
            return Finding.DIFFERS
        if self.low is None or self.high is None or max(-self.low, self.high) > margin:
            return Finding.UNKNOWN
        return Finding.SAME


def _mean(values: F64, weights: F64) -> float:
    return float(values.sum() / weights.sum())


def _typical(values: F64, _: F64) -> float:
    """Return the mean of the middle half of `values`; weights do not count."""
    count = len(values)
    return float(np.sort(values)[count // 4 : count - count // 4].mean())


def _quantile(share: float) -> Reduce:
    """Return a function that computes a quantile of values, linear between ranks, as in the report.

    `share`: share of the values below the quantile.
    """
    return lambda values, _: float(np.quantile(values, share))


#: Names of the percentiles that comparisons have.
COMPARED: Final = ("p50", "p90", "p99")
#: Statistic -> function that computes it.
STATISTICS: Final[dict[str, Reduce]] = {
    "mean": _mean,
    "share": _mean,
    "typical": _typical,
    **{name: _quantile(PERCENTILES[name]) for name in COMPARED},
}


def difference(
    base: Sequence[Series], other: Sequence[Series], statistic: str, *, is_ratio: bool, chance: Chance
) -> Difference:
    """Return the change of a statistic between two sides, over the last `MOST_FRAMES` frames of each run.

    If the runs show the same frames (see `ALIKE`), each frame is compared with itself. Differences between the frames
    of a scene are then no scatter. If a run has too few frames for the statistic, the uncertainty is unknown.
    `base`, `other`: series of the figure in each run of a side.
    `statistic`: key of `STATISTICS`.
    `is_ratio`: whether the change is a share of the base. If the figure of any frame is 0 or less, the change is a
    plain difference in any case.
    `chance`: the `Chance` of the figure.
    """
    reduce = STATISTICS[statistic]
    sides = [[each.at(slice(-MOST_FRAMES, None)) for each in side] for side in (base, other)]
    values = [[_value(each, reduce) for each in side] for side in sides]
    runs = [each for side in sides for each in side]
    common = _common(runs)
    if common is not None:
        sides = [[each.at(np.isin(each.frames, common).nonzero()[0]) for each in side] for side in sides]
        runs = [each for side in sides for each in side]
    is_ratio = is_ratio and all(len(each.values) > 0 and float(each.values.min()) > 0 for each in runs)
    if min(len(each.values) for each in runs) < _least_frames(statistic):
        return unsure(*map(_average, values), is_ratio=is_ratio)
    scaled = [np.array([_left_out(each, reduce, is_ratio) for each in side]) for side in sides]
    if common is not None:
        within = _jackknife(scaled[1].mean(axis=0)[1:] - scaled[0].mean(axis=0)[1:])
    else:
        within = sum(_jackknife(row[1:]) / len(side) ** 2 for side in scaled for row in side)
    effects = [side[:, 0] for side in scaled]
    return settled(values, effects, within, chance, is_ratio=is_ratio)


def settled(
    values: Sequence[Sequence[float]], effects: Sequence[F64], within: float, chance: Chance, *, is_ratio: bool
) -> Difference:
    """Return the difference of two sides from the figures of their runs.

    `values`: figure of each run, as two sequences: base, other side.
    `effects`: the same figures on the scale of `Difference.deviation`: logarithms for a ratio.
    `within`: variance of the change on this scale, due to scatter within runs.
    `chance`: the `Chance` of the figure.
    `is_ratio`: whether the change is a share of the base.
    """
    first, second = (float(side.mean()) for side in effects)
    scale = 1.0 if is_ratio else max(abs(first), abs(second))
    share = sum(1 / len(side) for side in effects)
    known = share * ((chance.relative * scale) ** 2 + chance.absolute**2) + within
    seen = share * sum(float(((side - side.mean()) ** 2).sum()) for side in effects)
    freedom = chance.freedom + sum(len(side) - 1 for side in effects)
    deviation = sqrt((chance.freedom * known + seen) / freedom)
    return _told(tuple(map(_average, values)), second - first, deviation, freedom, chance.explained, is_ratio=is_ratio)


def combined(pairs: Sequence[Difference]) -> Difference:
    """Return one difference for all `pairs`, at least one.

    `base` and `other` are arithmetic means. The change is the mean of the effects: for ratios, the geometric mean. The
    deviation of this mean follows from the pairs' deviations, as if the pairs were independent. If the scatter of the
    pairs gives a larger deviation (Birge's ratio above 1), the larger deviation counts. The deviation is unknown if a
    pair has none, or if only some pairs are ratios.
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
    freedom = min(pair.freedom for pair in pairs) + len(pairs) - 1
    explained = sum(pair.explained for pair in pairs) / len(pairs)
    return _told((base, other), mean, max(within, between), freedom, explained, is_ratio=is_ratio)


def unsure(base: float, other: float, *, is_ratio: bool) -> Difference:
    """Return the difference of the value `other` from the value `base`, with unknown uncertainty.

    `is_ratio`: whether the change is a share of the base. If a value is 0 or less, the change is a plain difference in
    any case.
    """
    is_ratio = is_ratio and min(base, other) > 0
    return _told((base, other), log(other / base) if is_ratio else other - base, None, is_ratio=is_ratio)


def judged(base: float, other: float, deviation: float, *, is_ratio: bool) -> Difference:
    """Return the difference of the value `other` from the value `base`, with a known deviation.

    `deviation`: standard deviation of the change. If `is_ratio`, it belongs to the logarithm of the ratio.
    `is_ratio`: whether the change is a share of the base; both values must then be above 0.
    """
    return _told((base, other), log(other / base) if is_ratio else other - base, deviation, is_ratio=is_ratio)


def _told(
    values: tuple[float, ...],
    effect: float,
    deviation: float | None,
    freedom: float = inf,
    explained: float = 0.0,
    *,
    is_ratio: bool,
) -> Difference:
    """Return the difference of two values.

    `values`: value of the base, value of the other side.
    `effect`, `deviation`, `freedom`, `explained`, `is_ratio`: as in `Difference`; `deviation` is None if it is unknown.
    """
    base, other = values
    if deviation is None:
        return Difference(base, other, _change(effect, is_ratio), None, None, None, is_ratio)
    reach = student_quantile(freedom) * deviation + explained
    change, low, high = (_change(effect + sign * reach, is_ratio) for sign in (0, -1, 1))
    left = max(abs(effect) - explained, 0.0)
    probability = 1.0 if left < NEGLIGIBLE else student_tails(left / deviation if deviation else inf, freedom)
    return Difference(base, other, change, low, high, probability, is_ratio, deviation, freedom, explained)


def _change(effect: float, is_ratio: bool) -> float:
    return expm1(effect) if is_ratio else effect


def _least_frames(statistic: str) -> int:
    """Return the least number of frames for which the uncertainty of `statistic` is known.

    For a percentile, each stretch needs on average one frame beyond the percentile. Without such frames, the jackknife
    sees no scatter.
    """
    return max(LEAST_FRAMES, ceil(STRETCHES / (1 - PERCENTILES.get(statistic, 0.5))))


def _average(values: Sequence[float]) -> float:
    return sum(values) / len(values)


def _value(series: Series, reduce: Reduce) -> float:
    return reduce(series.values, series.weights) if len(series.values) else 0.0


def _common(runs: Sequence[Series]) -> I64 | None:
    """Return the numbers of the frames that all `runs` have.

    The result is None if these are fewer than the share `ALIKE` of the frames of the longest run.
    """
    common = runs[0].frames
    for each in runs[1:]:
        common = np.intersect1d(common, each.frames)
    return common if len(common) >= ALIKE * max(len(each.frames) for each in runs) else None


def _left_out(series: Series, reduce: Reduce, is_ratio: bool) -> F64:
    """Return a statistic of all frames, then of the frames without each stretch in turn, (1 + `STRETCHES`,) float64.

    `series`: figure of each frame.
    `reduce`: function that computes the statistic.
    `is_ratio`: whether to return logarithms.
    """
    edges = np.linspace(0, len(series.values), STRETCHES + 1).astype(int)
    places = np.arange(len(series.values))
    kept = [places, *(np.delete(places, slice(low, high)) for low, high in pairwise(edges))]
    values = np.array([reduce(series.values[these], series.weights[these]) for these in kept])
    return np.log(values) if is_ratio else values


def _jackknife(values: F64) -> float:
    """Return the variance of a statistic, or of its change between two sides, by the jackknife.

    `values`: (`STRETCHES`,) statistic or change; the value at index i is computed without the frames of stretch i.
    """
    return float((len(values) - 1) / len(values) * ((values - values.mean()) ** 2).sum())


def rejected(probabilities: Sequence[float], alpha: float = ALPHA) -> list[bool]:
    """Return, for each hypothesis "no difference", whether the hypothesis is rejected.

    The probability of any false rejection is at most `alpha`, even if the hypotheses depend on each other. The method
    is Holm, "A simple sequentially rejective multiple test procedure", Scandinavian Journal of Statistics 6 (1979).
    `probabilities`: probability of the observation under each hypothesis.
    `alpha`: largest probability of any false rejection.
    """
    order = sorted(range(len(probabilities)), key=probabilities.__getitem__)
    fallen = [False] * len(probabilities)
    for rank, place in enumerate(order):
        if probabilities[place] > alpha / (len(order) - rank):
            break
        fallen[place] = True
    return fallen
