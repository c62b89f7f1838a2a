"""Blocks, drift, Holm and differences, by hand and by simulations with a seed."""

from __future__ import annotations

from math import erfc, log, log10, sqrt

import numpy as np
import pytest

from trilane.apps.comparison.blocks import block_length, draws
from trilane.apps.comparison.difference import (
    LEAST_FRAMES,
    Difference,
    Series,
    combined,
    difference,
    judged,
    unsure,
)
from trilane.apps.comparison.family import rejected
from trilane.apps.comparison.slow_noise import STRETCHES, drift_variance
from trilane.arrays import F64

RUNS = 100


def series(values: F64, first: int = 0) -> Series:
    return Series(np.arange(first, first + len(values)), values, np.ones(len(values)))


def autoregressive(generator: np.random.Generator, count: int, carried: float) -> F64:
    """Each value `carried` times its predecessor, and noise of deviation 1; from the middle of such a series on."""
    values, noise = np.zeros(count + 100), generator.normal(size=count + 100)
    for place in range(1, len(values)):
        values[place] = carried * values[place - 1] + noise[place]
    return values[100:]


def test_blocks_follow_each_other_and_go_on_at_the_beginning() -> None:
    """Of 7 values in blocks of 3: two whole ones and the first value of a third."""
    places = draws(7, 3, 50, np.random.default_rng(1))
    assert places.shape == (50, 7)
    steps = np.diff(places, axis=1) % 7
    assert (steps[:, [0, 1, 3, 4]] == 1).all()
    assert len(np.unique(places[:, 0])) == 7 and len(np.unique(places[:, 6])) == 7
    assert (draws(4, 1, 3, np.random.default_rng(1)) < 4).all()


@pytest.mark.parametrize("values", [np.ones(100), np.arange(5.0), np.full(60, 0.1)])
def test_what_does_not_vary_or_is_short_is_drawn_singly(values: F64) -> None:
    assert block_length(values) == 1


def test_blocks_are_as_long_as_the_series_remembers() -> None:
    """By the formula for what is half of its predecessor, with 1000 values: (6 (c / (1 - c^2))^2 n)^(1/3) = 13.9."""
    generator = np.random.default_rng(5)
    lengths = {
        carried: np.mean([block_length(autoregressive(generator, 1000, carried)) for _ in range(20)])
        for carried in (0.0, 0.5, 0.9)
    }
    assert lengths[0.0] < 4 < lengths[0.5] < lengths[0.9]
    assert lengths[0.5] == pytest.approx(13.9, rel=0.35)
    assert block_length(autoregressive(generator, 100, 0.99)) <= 30


@pytest.mark.parametrize(("carried", "count"), [(0.3, 400), (0.7, 400), (0.5, 150)])
def test_blocks_by_a_second_computation(carried: float, count: int) -> None:
    """Politis and White (2004), section 3.2, value by value: the flat-top window is 1 up to half its width."""
    values = autoregressive(np.random.default_rng(9), count, carried)
    mean = sum(values) / count
    lags = [sum((values[t] - mean) * (values[t + k] - mean) for t in range(count - k)) / count for k in range(60)]
    limit, run = 2 * sqrt(log10(count) / count), 5
    last = next(m for m in range(50) if all(abs(lags[m + k] / lags[0]) < limit for k in range(1, run + 1)))
    width = 2 * last
    window = [1.0 if k <= width / 2 else 2 * (1 - k / width) for k in range(width + 1)]
    g = 2 * sum(window[k] * k * lags[k] for k in range(1, width + 1))
    density = lags[0] + 2 * sum(window[k] * lags[k] for k in range(1, width + 1))
    assert block_length(values) == round((2 * g**2 / (4 / 3 * density**2)) ** (1 / 3) * count ** (1 / 3))


@pytest.mark.parametrize("carried", [0.0, 0.6])
def test_intervals_hold_what_they_promise(carried: float) -> None:
    """Of two series of one mean, whose values depend on each other: 95 % of the intervals hold that it is the same."""
    generator = np.random.default_rng(11)
    held = 0
    for _ in range(RUNS):
        pair = [series(autoregressive(generator, 200, carried), first) for first in (0, 1000)]
        found = difference(*pair, "mean", is_ratio=False)
        assert found.low is not None and found.high is not None
        held += found.low < 0 < found.high
    assert 0.92 <= held / RUNS <= 0.98


def test_drift_goes_on_and_scatter_does_not() -> None:
    """Independent values: from 1 / n, their mean's variance, to 8 / n, that of the stretches that are looked at.

    Four speeds, one after the other, of variance 1: of 7 pairs of neighbouring eighths 3 differ, by a square of 2 in
    the mean, and half of that stays at any time scale.
    """
    generator = np.random.default_rng(3)
    count, tries = 800, 60
    quiet = np.mean([_drift(generator.normal(size=count)) for _ in range(tries)])
    assert 1 / count < quiet < 8 / count
    levels = np.repeat(generator.normal(size=(tries, 4)), count // 4, axis=1)
    assert np.mean([_drift(row) for row in levels]) == pytest.approx(3 / 7, rel=0.4)
    assert _drift(np.ones(count)) == 0.0


def _drift(values: F64) -> float:
    return drift_variance(len(values), lambda stretch: float(values[stretch].mean()))


def test_drift_by_hand() -> None:
    """Stretches of one value that alternate: 2 at the shortest time, 0 at the next, so nothing is left."""
    values = np.tile([1.0, -1.0], STRETCHES // 2)
    assert drift_variance(STRETCHES, lambda stretch: float(values[stretch].mean())) == 0.0


def test_holms_steps() -> None:
    """0.05 / 4 = 0.0125, / 3 = 0.0167, / 2 = 0.025: 0.03 is above its limit, so 0.04 stays too, though below 0.05."""
    assert rejected([0.04, 0.001, 0.03, 0.012]) == [False, True, False, True]
    assert rejected([0.02, 0.02]) == [True, True]
    assert rejected([0.03, 0.03]) == [False, False]
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
    assert difference(few, few, "mean", is_ratio=True).low is None


def test_frames_of_one_scene_are_compared_frame_with_frame() -> None:
    """What the scene asks of each frame varies by a factor of 3, and the other run takes 5 % longer for each."""
    generator = np.random.default_rng(2)
    asked = np.repeat(generator.uniform(1, 3, 30), 10)
    noise = [generator.lognormal(0, 0.01, 300) for _ in range(2)]
    paired = difference(series(asked * noise[0]), series(1.05 * asked * noise[1]), "typical", is_ratio=True)
    assert paired.low is not None and paired.high is not None
    assert 0.04 < paired.low < 0.05 < paired.high < 0.06
    apart = difference(series(asked * noise[0]), series(1.05 * asked * noise[1], 500), "typical", is_ratio=True)
    assert apart.low is not None and apart.low < 0


@pytest.mark.parametrize("statistic", ["p50", "p90", "p99"])
def test_percentiles_are_linear_between_ranks(statistic: str) -> None:
    values = np.random.default_rng(4).exponential(size=73)
    found = difference(series(values), series(values), statistic, is_ratio=True)
    assert found.base == pytest.approx(np.quantile(values, int(statistic[1:]) / 100))


def test_the_typical_time_leaves_the_ends_out() -> None:
    """Of 0 to 79, of which 20 are far off: the mean of 20 to 59 is 39.5."""
    values = np.concatenate([np.arange(60.0), np.full(20, 1e6)])
    found = difference(series(values), series(values + 1), "typical", is_ratio=False)
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
    found = difference(base, series(np.full(100, 4.0)), "mean", is_ratio=True)
    assert (found.base, found.other) == (pytest.approx(2.5), 4.0)
    assert found.change == pytest.approx(1.0)
