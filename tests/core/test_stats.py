"""Summaries of times against NumPy."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from trilane.scheduler.stats import (
    ema_range_ms,
    jitter_ms,
    median_interval,
    percentile,
    samples_needed,
    summary_ms,
)

TIMES = st.lists(st.integers(0, 10**12), min_size=1, max_size=60)


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
    row = ema_range_ms(values)
    assert min(values) / 1e6 - 1e-5 <= row["ema20_min"] <= row["ema20_max"] <= max(values) / 1e6 + 1e-5


def test_nothing_gives_zeros() -> None:
    assert percentile([], 0.5) == 0
    assert set(summary_ms([]).values()) == {0.0}
    assert ema_range_ms([]) == {"ema20_min": 0.0, "ema20_max": 0.0}
    assert jitter_ms([]) == jitter_ms([5]) == 0


@pytest.mark.parametrize(("share", "count"), [(0.5, 5), (0.9, 29), (0.95, 59), (0.99, 299)])
def test_the_samples_that_a_percentile_needs_are_wilks(share: float, count: int) -> None:
    """The known sizes; one fewer leaves more than 5 % that none of them exceeds the percentile."""
    assert samples_needed(share) == count
    assert share**count <= 0.05 < share ** (count - 1)


def test_jitter_is_the_mean_step() -> None:
    assert jitter_ms([10_000_000, 12_000_000, 9_000_000]) == 2.5


@pytest.mark.parametrize(("count", "rank"), [(1, 1), (5, 1), (6, 1), (8, 1), (9, 2), (20, 6), (100, 40)])
def test_the_interval_of_a_median_is_that_of_the_sign_test(count: int, rank: int) -> None:
    """Ranks as in the tables of the sign test for 95 %."""
    assert median_interval(range(count, 0, -1)) == (rank, count + 1 - rank)


def test_of_no_values_there_is_no_median() -> None:
    with pytest.raises(ValueError, match="no values"):
        median_interval([])
