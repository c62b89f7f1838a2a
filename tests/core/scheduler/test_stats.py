"""Summaries of times against NumPy."""

from __future__ import annotations

from fractions import Fraction
from math import comb, exp
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from trilane.scheduler.stats import (
    SPAN,
    FrameTimeSamples,
    Lateness,
    energy_score,
    median_interval,
    percentile,
    samples_needed,
    summary_ms,
)

TIMES = st.lists(st.integers(0, 10**12), min_size=1, max_size=60)


def row_of(values: list[int]) -> dict[str, Any]:
    times = FrameTimeSamples()
    for value in values:
        times.add(value)
    return times.row()


def score_of(late_ns: list[int]) -> float | None:
    lateness = Lateness()
    for each in late_ns:
        lateness.add(each)
    return lateness.real_time_score


@given(TIMES)
def test_a_summary_is_numpys(values: list[int]) -> None:
    row = summary_ms(values)
    assert row["mean"] == pytest.approx(np.mean(values) / 1e6, abs=1e-5)
    assert row["max"] == pytest.approx(max(values) / 1e6, abs=1e-5)
    assert row["samples"] == len(values)
    for rank in (50, 90, 95, 99):
        assert row[f"p{rank}"] == pytest.approx(np.percentile(values, rank) / 1e6, rel=1e-9, abs=1e-5)


@given(TIMES)
def test_an_exponential_average_stays_among_the_values(values: list[int]) -> None:
    row = row_of(values)
    assert min(values) / 1e6 - 1e-5 <= row["ema20_min"] <= row["ema20_max"] <= max(values) / 1e6 + 1e-5


def test_nothing_gives_zeros() -> None:
    assert percentile([], 0.5) == 0
    assert summary_ms([]) == dict.fromkeys(summary_ms([1]), 0.0)
    assert list(summary_ms([1])) == ["mean", "p50", "p90", "p95", "p99", "max", "samples"]
    assert (row_of([])["ema20_min"], row_of([])["ema20_max"]) == (0.0, 0.0)
    assert (row_of([])["jitter"], row_of([5])["jitter"]) == (None, None)


@pytest.mark.parametrize(("share", "count"), [(0.5, 5), (0.9, 29), (0.95, 59), (0.99, 299)])
def test_the_samples_that_a_percentile_needs_are_wilks(share: float, count: int) -> None:
    """The known sizes; one fewer leaves more than 5 % that none of them exceeds the percentile."""
    assert samples_needed(share) == count
    assert share**count <= 0.05 < share ** (count - 1)


def test_jitter_is_the_mean_step() -> None:
    assert row_of([10_000_000, 12_000_000, 9_000_000])["jitter"] == 2.5
    assert row_of([1_000_000, 1_000_001])["jitter"] == 1e-6


@pytest.mark.parametrize(("count", "rank"), [(1, 1), (5, 1), (6, 1), (8, 1), (9, 2), (20, 6), (100, 40)])
def test_the_interval_of_a_median_is_that_of_the_sign_test(count: int, rank: int) -> None:
    """Ranks as in the tables of the sign test for 95 %."""
    assert median_interval(range(count, 0, -1)) == (rank, count + 1 - rank)


def test_of_no_values_there_is_no_median() -> None:
    with pytest.raises(ValueError, match="no values"):
        median_interval([])


@pytest.mark.parametrize("confidence", [0.5, 0.8, 0.9, 0.95, 0.99])
def test_the_interval_of_a_median_is_that_of_the_binomial_distribution(confidence: float) -> None:
    """The largest k with P(B(n, 1/2) < k) <= (1 - confidence) / 2, summed in fractions; 1 where there is none."""
    for count in range(1, 40):
        below = [sum(Fraction(comb(count, i), 2**count) for i in range(k)) for k in range(count + 1)]
        rank = max([k for k in range(1, count + 1) if below[k] <= Fraction((1 - confidence) / 2)], default=1)
        assert median_interval(list(range(1, count + 1)), confidence) == (rank, count + 1 - rank)


@pytest.mark.parametrize("count", [1, 2, 19, 20, 21, 45])
def test_an_exponential_average_begins_with_the_first_value_and_counts_from_the_span_on(count: int) -> None:
    """Against the closed form: a(n) = (1-w)^n x(0) + sum of w (1-w)^(n-i) x(i), w = 2 / (span + 1)."""
    values = [(37 * i * i) % 101 * 1_000_000 for i in range(1, count + 1)]
    w = 2 / (SPAN + 1)
    averages = [
        (1 - w) ** n * values[0] + sum(w * (1 - w) ** (n - i) * values[i] for i in range(1, n + 1))
        for n in range(count)
    ]
    settled = averages[SPAN - 1 :] if count >= SPAN else averages[-1:]
    row = row_of(values)
    expected = (min(settled) / 1e6, max(settled) / 1e6)
    assert (row["ema20_min"], row["ema20_max"]) == pytest.approx(expected, abs=1e-6)


def test_scores_are_xrbenchs() -> None:
    assert score_of([]) is None
    assert score_of([0]) == 0.5
    assert score_of([100_000, -200_000]) == pytest.approx((1 / (1 + exp(1.5)) + 1 / (1 + exp(-3))) / 2)
    assert score_of([10**15]) == pytest.approx(0)
    assert score_of([-(10**15), 10**15]) == pytest.approx(0.5)
    assert [energy_score(mj) for mj in (0, 300, 1500, 1501)] == [1, 0.8, 0, 0]


def test_ranks_lie_between_values() -> None:
    assert [percentile([10, 20, 40], share) for share in (0, 0.25, 0.5, 0.75, 1)] == [10, 15, 20, 30, 40]
    assert [percentile([7], share) for share in (0, 0.5, 1)] == [7, 7, 7]
