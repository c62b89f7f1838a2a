"""The figures of `bench dashboard` from turns and frames that are known."""

from __future__ import annotations

import pytest

from trilane.bench.dashboard import Turn, _rate, _row, measure
from trilane.errors import BadInputError

S = 1_000_000_000


def turn(variant: str, begin_s: float, server_s: float = 0.0, pictures: int = 0) -> Turn:
    return Turn(variant, int(begin_s * S), int((begin_s + 2) * S), server_s, pictures)


def test_a_rate_is_that_between_the_first_and_the_last_frame_of_the_turn() -> None:
    ends = [int(s * S) for s in (0.9, 1.1, 1.5, 1.9, 2.9, 3.1)]
    assert _rate(turn("page", 1.0), ends) == pytest.approx(3 / 1.8)
    assert _rate(turn("page", 10.0), ends) == 0.0
    assert _rate(turn("page", 2.95), ends) == 0.0  # one frame has no rate


def test_each_turn_is_compared_with_nobody_in_its_round() -> None:
    turns = [
        turn(variant, 6 * number + 2 * place, 0.1 * place * (number + 1), 10 * place)
        for number in range(3)
        for place, variant in enumerate(("nobody", "server", "page"))
    ]
    rates = [100.0, 99.0, 98.0, 50.0, 50.0, 48.0, 80.0, 78.0, 80.0]
    row = _row("page", turns, rates)
    assert (row["fps"], row["ratio"], row["low"], row["high"]) == (80.0, 0.98, 0.96, 1.0)
    assert row["server_cpu"] == pytest.approx(0.4 / 2) and row["pictures"] == pytest.approx(10.0)
    assert (_row("nobody", turns, rates)["ratio"], _row("server", turns, rates)["fps"]) == (1.0, 78.0)


def test_turns_that_are_too_short_are_refused() -> None:
    with pytest.raises(BadInputError, match="expected at least 1"):
        measure(seconds=0.5)
