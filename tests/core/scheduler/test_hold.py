"""A run that is held, stepped and let go on: which frames are released when, worked out by hand."""

from __future__ import annotations

import pytest

from trilane.scheduler.core import Core
from trilane.scheduler.events import NEVER, Dispatch, Event, Finish, Hold, JobDone, Settings, Stop, UnitReady, chain
from trilane.scheduler.recording import Recording, replay

MS = 1_000_000
GRAPH = chain([("draw", "u")], "single", "draw")


class Run:
    """One stage on one unit; `step` answers with the frames that are handed out."""

    def __init__(self, settings: Settings) -> None:
        self.core = Core(GRAPH, settings)
        self.recording = Recording(GRAPH, settings)
        self.held: list[int] = []
        self.next_ns = 0

    def step(self, t_ms: int, *events: Event) -> list[int]:
        actions, self.next_ns = self.core.step(t_ms * MS, events)
        self.recording.add(t_ms * MS, events, actions, self.core)
        jobs = [action.job for action in actions if isinstance(action, Dispatch)]
        self.held += [job.id for job in jobs]
        self.is_over = any(isinstance(action, Finish) for action in actions)
        return [job.frame for job in jobs]

    def done(self, t_ms: int) -> list[int]:
        """The oldest job ends."""
        return self.step(t_ms, JobDone("u", self.held.pop(0), (t_ms - 1) * MS, t_ms * MS, (t_ms - 1) * MS))


def test_frames_that_are_taken_at_once_are_held_stepped_and_let_go() -> None:
    run = Run(Settings(10))
    assert run.step(0, UnitReady("u")) == [0, 1]  # one works, one is dispatched ahead
    assert run.step(1, Hold(0)) == []
    assert [run.done(2), run.done(3)] == [[], []]
    assert run.next_ns > 1000 * MS and not run.core.frames  # the watchdog alone looks
    assert run.step(9, Hold(1)) == [2]
    assert run.done(10) == []
    assert run.step(11, Hold(2)) == [3, 4]
    assert run.step(12, Hold(-1)) == []  # the unit has its two
    assert run.done(13) == [5]
    assert list(replay(run.recording)) == []
    assert run.done(14) == [6]
    assert run.core.ledger.presented_ns == [each * MS for each in (2, 3, 10, 13, 14)]
    report = run.core.ledger.report(clock="virtual", requested=10, not_begun=0)
    assert (report["frame_time_ms"]["samples"], report["frame_time_ms"]["max"], report["fps"]) == (1, 1.0, 1000.0)


def test_frames_that_are_let_go_before_the_units_are_ready_wait_for_them_without_being_asked_for() -> None:
    """A time in the past would be asked for again and again, until the last unit is ready."""
    run = Run(Settings(10, period_ns=10 * MS))
    assert run.step(1, Hold(0)) == [] and run.next_ns == NEVER
    assert run.step(2, Hold(-1)) == [] and run.next_ns == NEVER
    assert run.step(7, UnitReady("u")) == [0] and run.next_ns == 17 * MS


def test_frames_that_wait_for_units_have_their_timeout_when_the_run_begins() -> None:
    run = Run(Settings(10, period_ns=10 * MS, queue_timeout_ns=3 * MS))
    assert run.step(1, Hold(2)) == [] and run.next_ns == NEVER
    assert run.step(7, UnitReady("u")) == [] and run.next_ns > 1000 * MS  # both waited for 6 ms
    assert sum(run.core.ledger.dropped.values()) == 2


def test_a_rate_goes_on_from_the_moment_in_which_the_hold_ends() -> None:
    run = Run(Settings(10, period_ns=10 * MS))
    assert run.step(0, UnitReady("u")) == [0]
    run.done(1)
    assert run.step(5, Hold(0)) == [] and run.next_ns > 1000 * MS
    assert run.step(50) == []
    assert run.step(60, Hold(1)) == [1]
    run.done(61)
    assert run.step(100, Hold(-1)) == [2]
    assert run.next_ns == 110 * MS
    run.done(101)
    assert run.step(110) == [3]
    assert list(replay(run.recording)) == []


@pytest.mark.parametrize("settings", [Settings(10), Settings(10, period_ns=10 * MS)], ids=["at once", "at a rate"])
def test_a_held_run_is_stopped(settings: Settings) -> None:
    run = Run(settings)
    run.step(0, UnitReady("u"), Hold(0))
    while run.held:
        run.done(1)
    run.step(2, Stop())
    assert run.is_over and run.core.source.released <= 2


def test_no_more_frames_are_stepped_than_there_are() -> None:
    run = Run(Settings(3))
    run.step(0, UnitReady("u"), Hold(0))
    while run.held:
        run.done(1)
    assert (run.core.source.released, run.step(2, Hold(5)), run.core.source.released) == (0, [0, 1], 3)
    assert run.done(3) == [2]
    assert (run.done(4), run.is_over) == ([], False)
    assert (run.done(5), run.is_over) == ([], True)
