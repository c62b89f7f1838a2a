"""The interval of a mean frame time: by hand, by Student's distribution, and by how often it holds the true mean."""

from __future__ import annotations

from math import gamma, pi, sqrt

import numpy as np
import pytest

from trilane.scheduler.events import Settings, chain
from trilane.scheduler.stats import fps_interval, frame_interval_ms, mean_interval, student_quantile
from trilane.scheduler.virtual import simulate

#: Five batches of ten frames with the means 10, 12, 11, 13, 14: mean 12, variance (4 + 0 + 1 + 1 + 4) / 4 = 2.5, so the
#: interval is 12 -+ 2.776445 sqrt(2.5 / 5) = 12 -+ 1.963243.
BY_HAND = [mean + side for mean in (10, 12, 11, 13, 14) for side in (-5, 5) * 5]
HALF = 1.963243


def test_five_batches_by_hand() -> None:
    assert mean_interval(BY_HAND) == pytest.approx((12 - HALF, 12 + HALF), abs=1e-6)


def test_the_order_counts_because_frames_depend_on_each_other() -> None:
    """The same values sorted: batch means of 5.8, 8.2, 12, 15.8, 18.2 as of a run that becomes slower."""
    low, high = mean_interval(sorted(BY_HAND)) or (0, 0)
    assert (low + high) / 2 == pytest.approx(12)
    assert high - low > 4 * HALF


def test_the_first_frames_that_fill_no_batch_count_for_the_mean_alone() -> None:
    """Four frames before five batches of ten: the mean is (4 x 39 + 50 x 12) / 54 = 14, the half width is the same."""
    assert mean_interval([39] * 4 + BY_HAND) == pytest.approx((14 - HALF, 14 + HALF), abs=1e-6)
    assert mean_interval(BY_HAND, 14) == pytest.approx((14 - HALF, 14 + HALF), abs=1e-6)  # of more than are given


@pytest.mark.parametrize("values", [[], [1.0], BY_HAND[:49], [1.0] * 40 + [1000.0] * 10])
def test_too_short_or_too_scattered_to_tell(values: list[float]) -> None:
    assert mean_interval(values) is None
    assert set(frame_interval_ms(None).values()) == {None}
    assert set(fps_interval(None).values()) == {None}


@pytest.mark.parametrize(("frames", "is_known"), [(50, False), (51, True)])
def test_of_51_frames_there_are_50_times_which_are_enough(frames: int, is_known: bool) -> None:
    """Five batches of ten; all are equal, so the interval is a point."""
    report = simulate(chain([("a", "u")], "double", "a"), Settings(frames), lambda *_: 2_000_000).report
    found = [report["frame_time_ms"][key] for key in ("mean_low", "mean_high")]
    assert found == ([2.0, 2.0] if is_known else [None, None])
    assert (report["fps_low"], report["fps_high"]) == ((500, 500) if is_known else (None, None))


def test_milliseconds_and_rate_are_of_the_same_interval() -> None:
    times_ns = [value * 1_000_000 for value in BY_HAND]
    interval = mean_interval(times_ns)
    assert frame_interval_ms(interval) == pytest.approx({"mean_low": 12 - HALF, "mean_high": 12 + HALF}, abs=1e-6)
    rates = {"fps_low": 1000 / (12 + HALF), "fps_high": 1000 / (12 - HALF)}
    assert fps_interval(interval) == pytest.approx(rates, abs=1e-5)


@pytest.mark.parametrize("freedom", range(4, 10))
def test_the_quantiles_are_students(freedom: int) -> None:
    """The density, integrated from 0 to the quantile, is 0.475."""
    t = np.linspace(0, student_quantile(freedom), 20_001)
    scale = gamma((freedom + 1) / 2) / (sqrt(freedom * pi) * gamma(freedom / 2))
    density = scale * (1 + t**2 / freedom) ** (-(freedom + 1) / 2)
    assert np.trapezoid(density, t) == pytest.approx(0.475, abs=1e-6)


def test_it_holds_the_true_mean_though_frames_follow_their_predecessors() -> None:
    """Autoregressive times, each half of the one before: batches of 30 leave the interval 2 % too narrow, which covers
    94.6 %; of 1000 runs, three standard deviations fewer are 924. As if they were independent, it would be 740."""
    rng, runs, frames = np.random.default_rng(5), 1000, 300
    times = np.zeros((runs, frames))
    times[:, 0] = rng.normal(0, sqrt(1 / (1 - 0.25)), runs)
    for frame in range(1, frames):
        times[:, frame] = 0.5 * times[:, frame - 1] + rng.normal(0, 1, runs)
    intervals = [mean_interval(list(row + 100)) for row in times]
    assert sum(each is not None and each[0] <= 100 <= each[1] for each in intervals) > 924
