"""The time in which a run was held is added up, and said in its report."""

from __future__ import annotations

from trilane.pipeline.realtime_clock import HeldTime
from trilane.scheduler.events import Hold, Stop

S = 1_000_000_000


def test_a_run_that_was_never_held_says_nothing() -> None:
    held = HeldTime()
    held.hear(3 * S, [Stop(), Hold(-1)])
    assert (held.until(9 * S), held.sentence(9 * S)) == (0, "")


def test_steps_within_a_hold_do_not_end_it() -> None:
    """Held from 1 to 4 s with a step at 2, and from 6 s on."""
    held = HeldTime()
    for at_s, frames in ((1, 0), (2, 1), (4, -1), (6, 0)):
        held.hear(at_s * S, [Hold(frames)])
    assert [held.until(at_s * S) for at_s in (6, 8)] == [3 * S, 5 * S]
    assert held.sentence(8 * S).startswith("held for 5.0 s by who watched it: frame times")
