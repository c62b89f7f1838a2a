"""Student's t, Holm and differences, by hand and by simulations with a seed."""

from __future__ import annotations

from math import erfc, gamma, inf, log, pi, sqrt

import numpy as np
import pytest

from trilane.apps.compare.difference import (
    LEAST_FRAMES,
    STRETCHES,
    Chance,
    Difference,
    Finding,
    Series,
    combined,
    difference,
    judged,
    rejected,
    settled,
    unsure,
)
from trilane.arrays import F64
from trilane.scheduler.stats import student_quantile, student_tails

RUNS = 100


def series(values: F64, first: int = 0) -> Series:
    return Series(np.arange(first, first + len(values)), values, np.ones(len(values)))


def compared(base: Series, other: Series, statistic: str) -> Difference:
    return difference([base], [other], statistic, is_ratio=True, chance=Chance())


def autoregressive(generator: np.random.Generator, count: int, carried: float) -> F64:
    """Each value `carried` times its predecessor, and noise of deviation 1; from the middle of such a series on."""
    values, noise = np.zeros(count + 100), generator.normal(size=count + 100)
    for place in range(1, len(values)):
        values[place] = carried * values[place - 1] + noise[place]
    return values[100:]


@pytest.mark.parametrize("carried", [0.0, 0.6])
def test_intervals_hold_what_they_promise(carried: float) -> None:
    """Of two series of one mean, whose values depend on each other: 95 % of the intervals hold that it is the same."""
    generator = np.random.default_rng(11)
    held = 0
    for _ in range(RUNS):
        pair = [series(autoregressive(generator, 200, carried), first) for first in (0, 1000)]
        found = difference(pair[:1], pair[1:], "mean", is_ratio=False, chance=Chance())
        assert found.low is not None and found.high is not None
        held += found.low < 0 < found.high
    assert 0.92 <= held / RUNS <= 0.98


@pytest.mark.parametrize("freedom", [1, 2, 3, 4, 5, 9, 10, 30])
def test_students_t_is_the_integral_of_its_density(freedom: int) -> None:
    """By Simpson's rule over the density up to t, of which both tails are what is left."""
    t, steps = 2.3, 2000
    places = np.linspace(0, t, steps + 1)
    constant = gamma((freedom + 1) / 2) / (sqrt(freedom * pi) * gamma(freedom / 2))
    density = constant * (1 + places**2 / freedom) ** (-(freedom + 1) / 2)
    weights = np.where(np.arange(steps + 1) % 2, 4, 2)
    weights[[0, -1]] = 1
    inside = 2 * float(weights @ density) * t / steps / 3
    assert student_tails(t, freedom) == pytest.approx(1 - inside, abs=1e-9)


def test_students_quantiles_are_those_of_the_tables() -> None:
    wanted = {1: 12.706, 2: 4.303, 5: 2.571, 10: 2.228, 30: 2.042, inf: 1.960}
    assert {freedom: round(student_quantile(freedom), 3) for freedom in wanted} == wanted
    assert student_tails(inf, 5) == 0.0 == student_tails(40.0, inf)


def test_a_stretch_left_out_at_a_time_is_the_variance_of_the_mean() -> None:
    """Of a mean of equal stretches the jackknife is the variance of the stretches' means over their count, exactly."""
    values = np.random.default_rng(6).normal(10, 1, 64)
    of_stretches = values.reshape(STRETCHES, 4).mean(axis=1)
    found = difference([series(values)], [series(values[::-1], 900)], "mean", is_ratio=False, chance=Chance())
    assert found.deviation == pytest.approx(sqrt(2 * of_stretches.var(ddof=1) / STRETCHES))
    assert found.freedom == STRETCHES - 1


def test_what_is_known_before_counts_as_so_many_runs() -> None:
    """One run a side: the prior alone, 0.1 for each. Of 3 and 2 runs, squares about the means of 2 and 0.5, with a

    share of 1/3 + 1/2: (5 x 0.01 + 2.5) / (5 + 3) of it.
    """
    chance = Chance(absolute=0.1, freedom=5)
    alone = settled([[1.0], [2.0]], [np.array([1.0]), np.array([2.0])], 0.0, chance, is_ratio=False)
    assert alone.deviation == pytest.approx(0.1 * sqrt(2)) and alone.freedom == 5
    assert alone.probability == pytest.approx(student_tails(1 / (0.1 * sqrt(2)), 5))
    sides = [np.array([1.0, 2.0, 3.0]), np.array([4.5, 5.5])]
    several = settled([side.tolist() for side in sides], sides, 0.0, chance, is_ratio=False)
    assert (several.base, several.other, several.change, several.freedom) == (2.0, 5.0, 3.0, 8)
    assert several.deviation == pytest.approx(sqrt((1 / 3 + 1 / 2) * (5 * 0.01 + 2.5) / 8))
    relative = settled([[8.0], [4.0]], [np.array([8.0]), np.array([4.0])], 0.02, Chance(0.1), is_ratio=False)
    assert relative.deviation == pytest.approx(sqrt(2 * 0.8**2 + 0.02))


def test_what_is_explained_is_no_chance() -> None:
    """A change of 0.7 of which 0.5 has another cause, with a deviation of 0.1 sqrt(2)."""
    chance = Chance(absolute=0.1, freedom=5, explained=0.5)
    effects = [np.array([0.0]), np.array([0.7])]
    found = settled([[1.0], [1.7]], effects, 0.0, chance, is_ratio=False)
    reach = student_quantile(5) * 0.1 * sqrt(2) + 0.5
    assert (found.low, found.high) == (pytest.approx(0.7 - reach), pytest.approx(0.7 + reach))
    assert found.probability == pytest.approx(student_tails(0.2 / (0.1 * sqrt(2)), 5))
    less = settled([[1.0], [1.4]], [np.array([0.0]), np.array([-0.4])], 0.0, chance, is_ratio=False)
    assert less.probability == 1.0


def test_a_figure_has_one_of_three_outcomes() -> None:
    """Within 5 % at both ends; beyond at one; not known; and what differs does so whatever its interval."""
    assert judged(1.0, 1.01, 0.01, is_ratio=True).outcome(differs=False) is Finding.SAME
    assert judged(1.0, 1.04, 0.01, is_ratio=True).outcome(differs=False) is Finding.UNKNOWN
    assert judged(1.0, 0.96, 0.01, is_ratio=True).outcome(differs=False) is Finding.UNKNOWN
    assert judged(1.0, 1.04, 0.01, is_ratio=True).outcome(differs=False, margin=0.1) is Finding.SAME
    assert unsure(1.0, 1.0, is_ratio=True).outcome(differs=False) is Finding.UNKNOWN
    assert judged(1.0, 1.01, 0.001, is_ratio=True).outcome(differs=True) is Finding.DIFFERS


def test_holms_steps() -> None:
    """0.05 / 4 = 0.0125, / 3 = 0.0167, / 2 = 0.025: 0.03 is above its limit, so 0.04 stays too, though below 0.05."""
    assert rejected([0.04, 0.001, 0.03, 0.012], 0.05) == [False, True, False, True]
    assert rejected([0.02, 0.02], 0.05) == [True, True]
    assert rejected([0.03, 0.03], 0.05) == [False, False]
    assert rejected([0.009]) == [True] and rejected([0.011]) == [False]
    assert rejected([]) == []


def test_a_ratio_and_a_difference_by_hand() -> None:
    found = judged(10.0, 12.0, 0.05, is_ratio=True)
    assert found.change == pytest.approx(0.2)
    assert found.low == pytest.approx(1.2 * np.exp(-1.959964 * 0.05) - 1)
    assert found.high == pytest.approx(1.2 * np.exp(1.959964 * 0.05) - 1)
    assert found.probability == pytest.approx(erfc(log(1.2) / 0.05 / sqrt(2)))
    assert judged(0.0, 3.0, 2.0, is_ratio=False)[2:5] == pytest.approx((3.0, -0.919928, 6.919928))


@pytest.mark.parametrize(("other", "probability"), [(5.0, 1.0), (5.1, 0.0)])
def test_without_any_noise_every_difference_is_one(other: float, probability: float) -> None:
    assert judged(5.0, other, 0.0, is_ratio=True).probability == probability


def test_what_nobody_knows_has_no_interval() -> None:
    assert unsure(2.0, 3.0, is_ratio=True) == Difference(2.0, 3.0, 0.5, None, None, None, True)
    assert unsure(0.0, 3.0, is_ratio=True).is_ratio is False
    few = series(np.ones(LEAST_FRAMES - 1))
    assert difference([few], [few], "mean", is_ratio=True, chance=Chance()).low is None


def test_frames_of_one_scene_are_compared_frame_with_frame() -> None:
    """What the scene asks of each frame varies by a factor of 3, and the other run takes 5 % longer for each."""
    generator = np.random.default_rng(2)
    asked = np.repeat(generator.uniform(1, 3, 30), 10)
    noise = [generator.lognormal(0, 0.01, 300) for _ in range(2)]
    paired = compared(series(asked * noise[0]), series(1.05 * asked * noise[1]), "typical")
    assert paired.low is not None and paired.high is not None
    assert 0.04 < paired.low < 0.05 < paired.high < 0.06
    apart = compared(series(asked * noise[0]), series(1.05 * asked * noise[1], 500), "typical")
    assert apart.low is not None and apart.low < 0


@pytest.mark.parametrize("statistic", ["p50", "p90", "p99"])
def test_percentiles_are_linear_between_ranks(statistic: str) -> None:
    values = np.random.default_rng(4).exponential(size=73)
    found = compared(series(values), series(values), statistic)
    assert found.base == pytest.approx(np.quantile(values, int(statistic[1:]) / 100))


def test_the_typical_time_leaves_the_ends_out() -> None:
    """Of 0 to 79, of which 20 are far off: the mean of 20 to 59 is 39.5."""
    values = np.concatenate([np.arange(60.0), np.full(20, 1e6)])
    found = difference([series(values)], [series(values + 1)], "typical", is_ratio=False, chance=Chance())
    assert (found.base, found.other) == (39.5, 40.5)


def test_several_pairs_are_as_sure_as_they_scatter() -> None:
    """Effects 1 and 3 with deviation 0.1 each: mean 2, deviation of the mean 1, not 0.07."""
    pairs = [judged(0.0, 1.0, 0.1, is_ratio=False), judged(0.0, 3.0, 0.1, is_ratio=False)]
    found = combined(pairs)
    assert (found.change, found.deviation) == (2.0, pytest.approx(1.0))
    alike = combined([pairs[0], pairs[0]])
    assert alike.deviation == pytest.approx(0.1 / sqrt(2))
    ratio = combined([judged(1.0, 2.0, 0.1, is_ratio=True), judged(4.0, 2.0, 0.1, is_ratio=True)])
    assert ratio.change == pytest.approx(0.0)
    assert combined([pairs[0], unsure(0.0, 1.0, is_ratio=False)]).probability is None


def test_values_of_several_runs_are_their_means_whichever_side_they_are_on() -> None:
    """Runs of 1 and 4, and of 8 and 2: means 2.5 and 5; ratios 8 and 1/2, so 2 in the geometric mean, or 1/2 back."""
    there = combined([judged(1.0, 8.0, 0.1, is_ratio=True), judged(4.0, 2.0, 0.1, is_ratio=True)])
    back = combined([judged(8.0, 1.0, 0.1, is_ratio=True), judged(2.0, 4.0, 0.1, is_ratio=True)])
    assert (there.base, there.other) == (back.other, back.base) == (2.5, 5.0)
    assert (there.change, back.change) == (pytest.approx(1.0), pytest.approx(-0.5))
    uneven = combined([unsure(1.0, 16.0, is_ratio=True), unsure(4.0, 4.0, is_ratio=True)])
    assert (uneven.base, uneven.other, uneven.change) == (2.5, 10.0, pytest.approx(3.0))
    mixed = combined([judged(1.0, 2.0, 0.1, is_ratio=True), judged(0.0, 3.0, 0.1, is_ratio=False)])
    assert mixed == unsure(0.5, 2.5, is_ratio=False)


def test_a_run_has_its_own_value_whatever_it_is_beside() -> None:
    """The base has 20 frames more than the other, of 5 ms; on the 100 that both have, the other takes twice as long."""
    base = series(np.concatenate([np.full(100, 2.0), np.full(20, 5.0)]))
    found = compared(base, series(np.full(100, 4.0)), "mean")
    assert (found.base, found.other) == (pytest.approx(2.5), 4.0)
    assert found.change == pytest.approx(1.0)
