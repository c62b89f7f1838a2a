"""The frontier by comparing every pair, and knees by hand."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from trilane.apps.compare.frontier import SAME_DB, frontier, knees

#: Tenths of ms and of dB, so that ties and tolerances are met.
rows = st.lists(
    st.tuples(
        st.one_of(st.none(), st.integers(10, 16)),
        st.one_of(st.none(), st.integers(0, 3)),
        st.one_of(st.none(), st.sampled_from([20.0, 20.05, 20.25, 21.0])),
        st.sampled_from("ab"),
    ),
    max_size=12,
)


def entry(ms: float | None, around: float | None, db: float | None, group: str = "a") -> Any:
    low, high = (None, None) if ms is None or around is None else (ms - around, ms + around)
    return SimpleNamespace(frame_ms=ms, low_ms=low, high_ms=high, psnr_db=db, group=group)


def beats(one: Any, other: Any) -> bool:
    """The rule in words: better and no slower, or as good and surely quicker."""
    high = one.frame_ms if one.high_ms is None else one.high_ms
    low = other.frame_ms if other.low_ms is None else other.low_ms
    better, as_good = one.psnr_db > other.psnr_db + SAME_DB, one.psnr_db >= other.psnr_db - SAME_DB
    return one.group == other.group and ((better and one.frame_ms <= other.frame_ms) or (as_good and high < low))


@given(rows)
def test_the_frontier_is_what_nobody_beats(told: list[Any]) -> None:
    entries = [entry(*row) for row in told]
    known = [each for each in entries if each.frame_ms is not None and each.psnr_db is not None]
    expected = [each in known and not any(beats(other, each) for other in known) for each in entries]
    assert frontier(entries) == expected


@pytest.mark.parametrize(
    ("first", "second", "expected"),
    [
        ((10, 0.5, 30.0), (10.8, 0.5, 30.0), [True, True]),  # nobody can tell which is quicker
        ((10, 0.3, 30.0), (10.8, 0.3, 30.0), [True, False]),
        ((10, 0.3, 30.0), (10.8, 0.3, 30.09), [True, False]),  # nobody sees the better picture
        ((10, 0.3, 30.0), (10.8, 0.3, 30.2), [True, True]),
        ((10, 2.0, 31.0), (10.8, 2.0, 30.0), [True, False]),  # better, and no slower as far as anybody knows
        ((10, None, 30.0), (10, None, 30.0), [True, True]),
    ],
)
def test_a_difference_that_nobody_can_tell_beats_nothing(first: Any, second: Any, expected: list[bool]) -> None:
    assert frontier([entry(*first), entry(*second)]) == expected


def test_the_knee_is_farthest_above_the_line() -> None:
    """From (10, 30) to (20, 40) the points are 0.3, 0.6 - 0.2 and 0.9 - 0.8 above the line, on axes from 0 to 1."""
    told = [(10, 30), (11, 34), (12, 36), (18, 39), (20, 40), (19, 31), (30, 40)]
    assert knees([entry(ms, None, db) for ms, db in told]) == {"a": 2}


@pytest.mark.parametrize(
    "told",
    [[], [(10, 30)], [(10, 30), (20, 40)], [(10, 30), (15, 30), (20, 29)], [(10, 30), (18, 32), (20, 40)]],
    ids=["none", "one", "two", "one best", "below the line"],
)
def test_without_a_bend_there_is_no_knee(told: list[tuple[float, float]]) -> None:
    assert knees([entry(ms, None, db) for ms, db in told]) == {}


def test_each_group_has_its_own_knee() -> None:
    bend = [(10, 30), (11, 39), (20, 40)]
    entries = [entry(ms, None, db, group) for ms, db in bend for group in "ab"] + [entry(1, None, None)]
    assert knees(entries) == {"a": 2, "b": 3}
