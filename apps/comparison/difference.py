"""How much a statistic differs between runs, and how sure that is. Rule: what is not known widens the interval.

Two things make runs of one kind differ by chance. Frames scatter and drift within a run: a jackknife that leaves out
one stretch of frames at a time says how much (Künsch, Annals of Statistics 17 (1989)). A machine is another one in each
run: several runs a side show it, and what is known of machines before (`noise.py`) counts as so many more runs; by a
normal prior's conjugate, so that Student's t tells (Gelman et al., Bayesian Data Analysis, section 3.2; Smyth,
Statistical Applications in Genetics and Molecular Biology 3 (2004)). What is known to explain a part of a change is no
chance: up to that much counts as nothing.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import StrEnum
from functools import lru_cache
from itertools import pairwise
from math import atan, ceil, cos, erfc, expm1, inf, log, log1p, pi, sin, sqrt
from typing import Final, NamedTuple

import numpy as np

from trilane.arrays import F64, I64, Ints

LEAST_FRAMES: Final = 50
MOST_FRAMES: Final = 20_000
#: Of a run's frames, left out one at a time.
STRETCHES: Final = 16
#: Runs show the same frames where so many of each one's are the other's too.
ALIKE: Final = 0.8
NEGLIGIBLE: Final = 1e-9
#: A change that matters, as a share; of shares of the time, in these. Runs are alike where a figure changed by less.
MATTERS: Final = 0.05
CONFIDENCE: Final = 0.95

Reduce = Callable[[F64, F64], float]


class Outcome(StrEnum):
    """Of a figure. SAME: its change is surely below `MATTERS`. UNKNOWN: it may be more, and may be nothing."""

    DIFFERS = "differs"
    SAME = "no difference"
    UNKNOWN = "cannot tell"


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


class Chance(NamedTuple):
    """What makes a figure of two runs of one kind differ, beside their frames; nothing of runs in virtual time.

    `relative`, `absolute`: standard deviations of one run's figure, as a share of it and in its unit. `freedom`: how
    many runs that knowledge is worth. `explained`: how much of a change has another cause, as a logarithm of the ratio,
    or in the unit of what is no ratio.
    """

    relative: float = 0.0
    absolute: float = 0.0
    freedom: int = STRETCHES - 1
    explained: float = 0.0


class Difference(NamedTuple):
    """How far a statistic has changed.

    `base`, `other`: its values, each of all frames of its own run, whatever it is beside; of several runs a side their
    arithmetic mean. `change`, and its 95 % interval from `low` to `high`: of the other from the base, as a share of the
    base where `is_ratio`, else in the statistic's unit; of the frames that all runs have, and of several runs a side
    of their geometric means, so it need not be the ratio of the values. `probability`: of a change as large
    as this between runs of one kind. `low`, `high` and `probability` are None where it cannot be told. `deviation`: the
    standard deviation of the change, or of its logarithm where `is_ratio`, with so many degrees of `freedom`;
    `explained`: as in `Chance`.
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

    @property
    def effect(self) -> float:
        """What deviations are of: the logarithm of the ratio where `is_ratio`, else the change."""
        return log1p(self.change) if self.is_ratio else self.change

    def outcome(self, *, differs: bool, margin: float = MATTERS) -> Outcome:
        """`differs`: all figures of a comparison together. `margin`: a change that matters, as `change` has it."""
        if differs:
            return Outcome.DIFFERS
        if self.low is None or self.high is None or max(-self.low, self.high) > margin:
            return Outcome.UNKNOWN
        return Outcome.SAME


def _mean(values: F64, weights: F64) -> float:
    return float(values.sum() / weights.sum())


def _typical(values: F64, _: F64) -> float:
    """The mean of the middle half."""
    count = len(values)
    return float(np.sort(values)[count // 4 : count - count // 4].mean())


def _quantile(share: float) -> Reduce:
    """Linear between ranks, as in the report."""
    return lambda values, _: float(np.quantile(values, share))


#: Statistic: how it is computed. `typical` is the mean of the middle half of the values.
STATISTICS: Final[dict[str, Reduce]] = {
    "mean": _mean,
    "share": _mean,
    "typical": _typical,
    "p50": _quantile(0.5),
    "p90": _quantile(0.9),
    "p99": _quantile(0.99),
}


def difference(
    base: Sequence[Series], other: Sequence[Series], statistic: str, *, is_ratio: bool, chance: Chance
) -> Difference:
    """The change of `statistic` from the runs `base` to the runs `other`, of the last `MOST_FRAMES` frames of each.

    `is_ratio`: the change is a share of the base; where a value is zero it is not. Frames that all runs have are
    compared frame with frame, so that what the scene asks of each does not count as scatter.
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
    """The difference of two sides, of whose runs the figures are `values`, and `effects` on the scale of deviations.

    `within`: variance of the change by what scatters within the runs.
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
    """One difference of several pairs, which may differ from pair to pair by more than each one's interval says.

    `base` and `other` are the arithmetic means of the values, the change is the mean of the effects, of ratios so the
    geometric mean: with the deviation of the mean of independent pairs; where the pairs scatter more than that (Birge's
    ratio above 1), as much as they do. Where some pairs are ratios and others are none, nobody knows how sure the
    change of the means is. `pairs`: not empty.
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
    """A difference of which nobody knows how sure it is."""
    is_ratio = is_ratio and min(base, other) > 0
    return _told((base, other), log(other / base) if is_ratio else other - base, None, is_ratio=is_ratio)


def judged(base: float, other: float, deviation: float, *, is_ratio: bool) -> Difference:
    """A difference whose standard deviation is known; where `is_ratio`, of the logarithm, and values are above 0."""
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
    """The difference of which the `effect` and its deviation are known; None: the deviation is not."""
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
    """For a percentile so many that, in the mean, each stretch has a frame beyond it: the jackknife lives on these."""
    share = int(statistic[1:]) / 100 if statistic in ("p50", "p90", "p99") else 0.5
    return max(LEAST_FRAMES, ceil(STRETCHES / (1 - share)))


def _average(values: Sequence[float]) -> float:
    return sum(values) / len(values)


def _value(series: Series, reduce: Reduce) -> float:
    return reduce(series.values, series.weights) if len(series.values) else 0.0


def _common(runs: Sequence[Series]) -> I64 | None:
    """The frames that all `runs` have; None where these are not most of each one's."""
    common = runs[0].frames
    for each in runs[1:]:
        common = np.intersect1d(common, each.frames)
    return common if len(common) >= ALIKE * max(len(each.frames) for each in runs) else None


def _left_out(series: Series, reduce: Reduce, is_ratio: bool) -> F64:
    """(1 + `STRETCHES`,): the statistic of all frames, and without each stretch of them; of a ratio its logarithm."""
    edges = np.linspace(0, len(series.values), STRETCHES + 1).astype(int)
    places = np.arange(len(series.values))
    kept = [places, *(np.delete(places, slice(low, high)) for low, high in pairwise(edges))]
    values = np.array([reduce(series.values[these], series.weights[these]) for these in kept])
    return np.log(values) if is_ratio else values


def _jackknife(values: F64) -> float:
    """Variance of a statistic, by its `values` without each stretch."""
    return float((len(values) - 1) / len(values) * ((values - values.mean()) ** 2).sum())


@lru_cache(maxsize=4096)
def student_tails(t: float, freedom: float) -> float:
    """The probability that Student's t with a whole number of degrees of `freedom`, or inf, is beyond ±`t`.

    Abramowitz and Stegun, Handbook of Mathematical Functions, 26.7.3 and 26.7.4.
    """
    if freedom == inf or t == inf:
        return erfc(t / sqrt(2))
    angle, odd = atan(t / sqrt(freedom)), int(freedom) % 2
    term = cos(angle) if odd else 1.0
    total = term if freedom > 1 else 0.0
    for count in range(2 + odd, int(freedom) - 1, 2):
        term *= cos(angle) ** 2 * (count - 1) / count
        total += term
    inside = 2 / pi * (angle + sin(angle) * total) if odd else sin(angle) * total
    return max(1 - inside, 0.0)


@lru_cache(maxsize=256)
def student_quantile(freedom: float) -> float:
    """What Student's t exceeds, above or below, with the probability 1 - `CONFIDENCE`; by bisection."""
    low, high = 0.0, 1e3
    for _ in range(80):
        middle = (low + high) / 2
        low, high = (middle, high) if student_tails(middle, freedom) > 1 - CONFIDENCE else (low, middle)
    return low
