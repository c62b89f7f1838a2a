"""Load patterns and verdicts: the query counts that MLPerf publishes, and what makes a result invalid."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from trilane.bench.lib.load import Load, bound_ms, queries_needed, tail, verdict


@pytest.mark.parametrize(("percentile", "late", "queries"), [(0.90, 1, 64), (0.95, 1, 130), (0.99, 1, 662)])
def test_query_counts_are_the_published_ones(percentile: float, late: int, queries: int) -> None:
    assert queries_needed(percentile, late) == queries


@given(st.integers(1, 400), st.integers(0, 30), st.floats(0.01, 0.5))
def test_tail_is_the_binomials(queries: int, late: int, share: float) -> None:
    direct = sum(math.comb(queries, k) * share**k * (1 - share) ** (queries - k) for k in range(min(late, queries) + 1))
    assert tail(queries, late, share) == pytest.approx(direct, rel=1e-9)


def test_a_bound_needs_queries_enough_and_leaves_out_as_many_as_loadgen() -> None:
    latencies = [float(n) for n in range(1, 113)]
    assert bound_ms(latencies[:63], 0.90) is None
    assert bound_ms(latencies, 0.90) == 110.0  # 112 queries: LoadGen's log says that 2 are left out


def test_a_short_run_and_too_few_queries_are_invalid() -> None:
    load = Load("single-stream", seconds=10)
    assert verdict(load, [5.0] * 64, 10.0) == []
    short, few = verdict(load, [5.0] * 63, 9.0)
    assert "expected 10 s" in short
    assert "expected 64" in few


@pytest.mark.parametrize(("late", "valid"), [(0, True), (1, True), (2, False)])
def test_a_server_may_be_late_as_often_as_its_queries_allow(late: int, valid: bool) -> None:
    latencies = [300.0] * late + [100.0] * (662 - late)
    reasons = verdict(Load("server", seconds=1, limit_ms=200), latencies, 2.0)
    assert (not reasons) == valid
    assert valid or "took longer than 200 ms" in reasons[0]
