"""The clock of a run on processes, with doubles on every side: what it hears becomes events, what it is told messages.

The time is set by the test; every wait, ping, standstill, booking and message is worked out from it.
"""

from __future__ import annotations

import signal
import threading
from collections import Counter
from collections.abc import Mapping
from types import SimpleNamespace
from typing import Any

import pytest

from trilane.errors import TrilaneError
from trilane.pipeline import realtime_clock
from trilane.pipeline.journal import Stopped, Worked
from trilane.pipeline.realtime_clock import RealtimeClock
from trilane.pipeline.result import Failure, RunLog
from trilane.pipeline.unit_processes import UnitMessage
from trilane.scheduler.core import Core
from trilane.scheduler.events import (
    NEVER,
    Abort,
    Dispatch,
    Finish,
    FrameRequest,
    Job,
    JobDone,
    JobFailed,
    Kill,
    Outcome,
    OutcomeKind,
    Pinged,
    Pong,
    SchedulerStalled,
    SetDuty,
    Settings,
    Start,
    Stop,
    UnitDied,
    UnitReady,
    chain,
)
from trilane.scheduler.ledger import JobRecord
from trilane.transport import messages
from trilane.transport.messages import Closed, Done, Failed, Ping, Ready, RunJob

MS = 1_000_000
START = 7_000 * MS
GRAPH = chain([("draw", "gpu"), ("mix", "gpu"), ("show", "cpu")], "double", "show")


class World:
    """Units, signals, requests and time, as `RealtimeClock` knows them; a wait takes as long as it may."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, **more: Any) -> None:
        self.now_ns, self.waits_ms = START, []
        self.said: list[Any] = []
        self.starters: list[str] = []
        self.starter_fails = False
        self.stopped: set[str] = set()
        self.watched: list[int] = []
        self.inbox: list[list[tuple[str, Any]]] = []
        self.places = {"draw": 0, "mix": 1, "show": 0}
        self.core_counts = {"gpu": 2, "cpu": 1}
        self.refuses: Exception | None = None
        self.interrupts: Any = SimpleNamespace(fd=50, count=0, continued=0, last=signal.SIGINT)
        monkeypatch.setattr(realtime_clock, "time", self)
        self.core = Core(GRAPH, Settings(9, **more.pop("settings", {})))
        self.log = RunLog()
        self.progress: list[tuple[int, int]] = []
        requests, governor = more.get("requests"), more.get("governor")
        self.clock = RealtimeClock(
            self.core, self, self.interrupts, self.log, requests, governor,  # type: ignore[arg-type]
            lambda *counts: self.progress.append(counts),
        )  # fmt: skip

    def monotonic_ns(self) -> int:
        return self.now_ns

    def monotonic(self) -> float:
        return self.now_ns / 1e9

    def watch(self, fd: int) -> None:
        self.watched.append(fd)

    def listen(self, timeout_ms: int) -> list[UnitMessage]:
        self.waits_ms.append(timeout_ms)
        found = self.inbox.pop(0) if self.inbox else []
        self.now_ns += 0 if found else timeout_ms * MS
        return [UnitMessage(*row) for row in found]

    def send(self, unit: str, message: Any) -> None:
        self.said.append((unit, message))

    def kill(self, unit: str) -> None:
        self.said.append(("kill", unit))

    def renew_starter(self) -> str:
        if self.starter_fails:
            raise OSError(12, "no memory")
        return self.starters.pop() if self.starters else ""

    def connected(self, unit: str) -> None:
        self.said.append(("connected", unit))

    def start(self, unit: str) -> None:
        if self.refuses is not None:
            raise self.refuses
        self.said.append(("start", unit))

    def why_ended(self, unit: str) -> str:
        return f"; it was {unit}"

    def begun(self) -> RealtimeClock:
        """The clock after its first wait, with the core's first jobs handed over: draw 0 and 1."""
        now_ns, events = self.clock.wait(NEVER)
        self.clock.perform(now_ns, self.core.step(now_ns, events).actions)
        self.said.clear()
        return self.clock


class FakeGovernor:
    def __init__(self) -> None:
        self.due_ns, self.asked = START + 30 * MS, []

    def begin(self, now_ns: int) -> list[SetDuty]:
        self.asked.append(("begin", now_ns))
        return [SetDuty("gpu", 700)]

    def tick(self, now_ns: int, busy_ns: Mapping[str, int]) -> list[SetDuty]:
        self.asked.append((now_ns, dict(busy_ns)))
        self.due_ns = now_ns + 1000 * MS
        return [SetDuty("gpu", 600)]


class FakeRequests:
    def __init__(self) -> None:
        self.fd, self.is_open, self.answers = 51, threading.Event(), []
        self.waiting: list[Any] = []
        self.unanswered: list[Any] = []

    def tell_unanswered(self, causes: Mapping[str, int]) -> None:
        self.unanswered.append(dict(causes))

    def answered(self, frame: int) -> None:
        self.answers.append(frame)

    def events(self) -> list[Any]:
        events, self.waiting = self.waiting, []
        return events


def test_the_first_wait_says_that_the_units_are_ready_and_waits_for_nobody(monkeypatch: pytest.MonkeyPatch) -> None:
    governor, requests = FakeGovernor(), FakeRequests()
    world = World(monkeypatch, governor=governor, requests=requests, settings={"asked": True})
    assert world.watched == [50, 51]
    assert not requests.is_open.is_set()
    assert world.clock.wait(NEVER) == (START, (UnitReady("gpu"), UnitReady("cpu"), SetDuty("gpu", 700)))
    assert (world.waits_ms, governor.asked, requests.is_open.is_set()) == ([], [("begin", START)], True)
    assert World(monkeypatch).watched == [50]


def test_a_wait_ends_with_the_deadline_the_ping_or_the_governor(monkeypatch: pytest.MonkeyPatch) -> None:
    """The first wait pings the units without a job at once; then every 500 ms."""
    world = World(monkeypatch)
    clock = world.begun()
    assert clock.wait(NEVER) == (START, (Pinged("cpu"),))
    assert (world.waits_ms, world.said) == ([0], [("cpu", Ping())])
    assert clock.wait(START + 12 * MS + 1) == (START + 13 * MS, ())  # not before the deadline
    assert clock.wait(START) == (START + 13 * MS, ())
    world.core.step(world.now_ns, (Pinged("cpu"),))
    assert clock.wait(NEVER) == (START + 500 * MS, ())  # the CPU has not answered, and is not asked again
    assert world.waits_ms == [0, 13, 0, 487]
    world.core.step(world.now_ns, (Pong("cpu"),))
    assert clock.wait(NEVER) == (START + 1000 * MS, (Pinged("cpu"),))


def test_the_governor_is_asked_when_it_is_due(monkeypatch: pytest.MonkeyPatch) -> None:
    governor = FakeGovernor()
    world = World(monkeypatch, governor=governor)
    clock = world.begun()
    clock.wait(START)
    assert clock.wait(START + 29 * MS) == (START + 29 * MS, ())
    assert clock.wait(NEVER) == (START + 30 * MS, (SetDuty("gpu", 600),))
    assert governor.asked[1:] == [(START + 30 * MS, {"gpu": 0, "cpu": 0})]


@pytest.mark.parametrize(("gap_ms", "is_stalled"), [(750, False), (751, True)])
def test_a_step_that_comes_late_says_by_how_much(
    monkeypatch: pytest.MonkeyPatch, gap_ms: int, is_stalled: bool
) -> None:
    world = World(monkeypatch)
    clock = world.begun()
    clock.wait(START)
    world.now_ns += gap_ms * MS
    now_ns, events = clock.wait(START)
    assert now_ns == START + gap_ms * MS
    assert events == ((SchedulerStalled(gap_ms * MS),) if is_stalled else ()) + (Pinged("cpu"),)
    assert clock.wait(START) == (now_ns, ())


def test_a_signal_that_stopped_the_scheduler_is_told_with_its_time_and_frame(monkeypatch: pytest.MonkeyPatch) -> None:
    """Frame 0 is the oldest in flight. A process that merely had no core for so long was not stopped."""
    world = World(monkeypatch)
    clock = world.begun()
    for continued, said in ((0, 0), (1, 1), (1, 1), (2, 2)):
        clock.wait(world.now_ns)
        world.now_ns += 3100 * MS
        world.interrupts.continued = continued
        assert clock.wait(world.now_ns)[1][0] == SchedulerStalled(3100 * MS)
        text = "the scheduler itself was stopped by a signal for about 3.1 s, at frame 0"
        assert world.log.messages == [text] * said
    world.interrupts.continued = 3
    world.now_ns += 700 * MS  # no longer than a step may take
    clock.wait(world.now_ns)
    assert len(world.log.messages) == 2


def test_a_unit_that_is_restarted_because_it_was_stopped_is_not_said_to_end_unexpectedly(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    world = World(monkeypatch)
    clock = world.begun()
    world.stopped = {"gpu"}
    clock.perform(START, (Kill("gpu"),))
    world.inbox = [[("gpu", None)], [("gpu", None)]]
    clock.wait(START)
    clock.wait(START)
    assert world.log.messages == [
        "unit gpu did not answer in time, because a signal has stopped it, and is restarted",
        "unit gpu has ended and is started again; it was gpu",
        "unit gpu ended unexpectedly and is started again; it was gpu",
    ]


def test_what_units_say_becomes_events_in_order(monkeypatch: pytest.MonkeyPatch) -> None:
    world = World(monkeypatch)
    clock = world.begun()
    clock.wait(START)
    world.said.clear()
    job_error = Failed(1, 3, "dark")
    world.inbox = [
        [("gpu", Done(0, 5, 9, 6, 1, 2, 3, 1, 7, 8, {})), ("cpu", messages.PongMessage()), ("cpu", Closed())],
        [("gpu", job_error), ("cpu", None), ("cpu", Ready(8)), ("gpu", Failed(-1, 1, "unbuilt"))],
    ]
    assert clock.wait(NEVER)[1] == (JobDone("gpu", 0, 5, 9, 6, 1, 2, 3, True), Pong("cpu"))
    assert clock.wait(NEVER)[1] == (JobFailed("gpu", 1), UnitDied("cpu"), UnitReady("cpu"))
    assert world.said == [("connected", "cpu")]
    assert world.log.failure == Failure("dark", 3)
    assert world.log.messages == ["dark", "unit cpu ended unexpectedly and is started again; it was cpu"]


def test_actions_become_messages(monkeypatch: pytest.MonkeyPatch) -> None:
    world = World(monkeypatch)
    job = Job(7, "gpu", "mix", 4, 1, 0, 3, True)
    world.clock.perform(START, (Dispatch(job), Kill("cpu"), Start("cpu"), Finish(Outcome(OutcomeKind.DONE))))
    assert world.said == [("gpu", RunJob(7, 1, 4, 1, 0, 3, START, 1)), ("kill", "cpu"), ("start", "cpu")]
    assert world.log.messages == ["unit cpu did not answer in time and is restarted"]


@pytest.mark.parametrize("error", [TrilaneError("no fork server"), OSError("no process")])
def test_a_unit_that_cannot_be_started_again_ends_the_run(monkeypatch: pytest.MonkeyPatch, error: Exception) -> None:
    world = World(monkeypatch)
    clock = world.begun()
    world.refuses = error
    clock.perform(START, (Start("gpu"),))
    assert world.log.failure == Failure(str(error), 1)
    assert clock.wait(NEVER) == (START, (Abort(),))
    assert world.waits_ms == []


def test_one_interrupt_stops_a_second_aborts(monkeypatch: pytest.MonkeyPatch) -> None:
    world = World(monkeypatch)
    clock = world.begun()
    clock.wait(START)
    world.interrupts.count = 1
    assert clock.wait(START)[1] == (Stop(),)
    assert clock.wait(START)[1] == ()
    assert world.log.messages == ["interrupted: the frames in flight are finished; interrupt again to end at once"]
    world.interrupts.count = 2
    assert clock.wait(START)[1] == (Abort(),)


def test_a_signal_that_nobody_typed_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    world = World(monkeypatch)
    clock = world.begun()
    world.interrupts.count, world.interrupts.last = 1, signal.SIGUSR1
    clock.wait(START)
    said = "interrupted by SIGUSR1: the frames in flight are finished; interrupt again to end at once"
    assert world.log.messages == [said]


def test_requests_are_heard_and_answered_when_their_frame_is_presented(monkeypatch: pytest.MonkeyPatch) -> None:
    requests = FakeRequests()
    world = World(monkeypatch, requests=requests, settings={"asked": True})
    clock = world.begun()
    requests.waiting = [FrameRequest(1)]
    now_ns, events = clock.wait(START)
    assert events == (FrameRequest(1), Pinged("gpu"), Pinged("cpu"))
    for number, unit in ((0, "gpu"), (1, "gpu"), (2, "cpu")):
        decision = world.core.step(now_ns, events)
        clock.perform(now_ns, decision.actions)
        assert requests.answers == []
        world.inbox = [[(unit, Done(number, 1, 2, 1 if number == 0 else 0, 0, 0, 0, 0, 1, 0, {}))]]
        now_ns, events = clock.wait(START)
    assert requests.answers == [0]


def test_frames_that_will_not_come_are_told_at_the_next_wait(monkeypatch: pytest.MonkeyPatch) -> None:
    requests = FakeRequests()
    world = World(monkeypatch, requests=requests, settings={"asked": True})
    clock = world.begun()
    clock.wait(START)
    assert requests.unanswered == []
    ledger = world.core.ledger
    monkeypatch.setattr(type(ledger), "lost_by_cause", {"died:gpu": 1})
    monkeypatch.setattr(type(ledger), "dropped_by_cause", {"draw->mix:stale": 2})
    for counts in ("dropped", "lost"):
        monkeypatch.setattr(ledger, counts, {"any": 1})
        clock.wait(START)
        monkeypatch.setattr(ledger, counts, {})
    assert requests.unanswered == [{"draw->mix:stale": 2, "died:gpu": 1}] * 2


def test_a_frame_that_nobody_asked_for_is_presented_all_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    world = World(monkeypatch, settings={"policy": "sequential"})
    clock = world.begun()
    for number, unit in ((0, "gpu"), (1, "gpu"), (2, "cpu")):
        world.inbox = [[(unit, Done(number, 1, 2, 1 if number == 0 else 0, 0, 0, 0, 0, 1, 0, {}))]]
        now_ns, events = clock.wait(START)
        clock.perform(now_ns, world.core.step(now_ns, events).actions)
    assert [worked.job.stage for worked in clock.ended() if worked is not None] == ["draw", "mix", "show"]
    assert world.core.ledger.presented_frames == [0]


def test_every_job_that_ended_is_booked_with_its_times_and_figures(monkeypatch: pytest.MonkeyPatch) -> None:
    """draw 0 and draw 1 were handed over at the start; draw 1 ends after its frame was lost, and leaves its figures.

    The GPU has two cores: in the 1 ns from the run's begin to its first job it cannot have had more than 2 ns of CPU
    time, in the 3 ns between its jobs 5 are possible.
    """
    world = World(monkeypatch)
    clock = world.begun()
    released = world.core.frames[0].ready_ns[0]
    world.inbox = [[("gpu", Done(0, START + 1, START + 9, START + 2, 3, 2, 1, 0, 4, 99, {"area": 3.0}))]]
    clock.wait(START)
    job = JobRecord("draw", "gpu", 0, released, START, START + 1, START + 9, 3, 2, 1, 4)
    assert clock.ended() == [Worked(job, {"area": 3.0})]
    del world.core.frames[1]
    world.inbox = [[("gpu", Done(1, START + 12, START + 20, 0, 0, 0, 0, 0, 16, 5, {"area": 4.0, "new": 1.0}))]]
    clock.wait(START)
    assert (clock.waiting, clock.ended()) == (1, [None])
    assert (clock.waiting, clock.ended()) == (0, [])
    assert clock.metrics == {"draw": {"area": 7.0, "new": 1.0}}
    assert clock.reported == {"draw": Counter(area=2, new=1)}
    of_stages = {stage: [*each.kept] for stage, each in clock.cpu.stage_ns.items()}
    assert (of_stages, clock.cpu.in_jobs_ns, clock.cpu.between_ns) == ({"draw": [4, 16]}, {"gpu": 20}, {"gpu": 7})


def test_a_fork_server_that_had_to_be_replaced_is_told_with_the_next_ping(monkeypatch: pytest.MonkeyPatch) -> None:
    """One that cannot be replaced now is looked at again with the ping that follows."""
    world = World(monkeypatch)
    clock = world.begun()
    world.starters, world.starter_fails = ["it was stopped"], True
    for fails in (True, False, False):
        world.starter_fails = fails
        world.now_ns += 500 * MS
        clock.wait(world.now_ns)
        assert world.log.messages == ([] if fails else ["it was stopped and is replaced"])


def test_a_unit_that_was_stopped_is_told_with_its_time(monkeypatch: pytest.MonkeyPatch) -> None:
    """Seen at the second ping and no more at the fourth, half a second apart each."""
    world = World(monkeypatch)
    clock = world.begun()
    for stopped, said in (
        ((), []),
        (("gpu",), []),
        (("gpu",), []),
        ((), ["for about 1.0 s"]),
        ((), ["for about 1.0 s"]),
    ):
        world.stopped = set(stopped)
        world.now_ns += 500 * MS
        clock.wait(world.now_ns)
        assert world.log.messages == [f"unit gpu was stopped by a signal {text}" for text in said]
    assert (clock.stopped(), clock.stopped()) == ([Stopped(START + 1000 * MS, "gpu")], [])


def test_progress_is_shown_ten_times_a_second_and_at_the_end(monkeypatch: pytest.MonkeyPatch) -> None:
    world = World(monkeypatch)
    clock = world.begun()
    assert world.progress == [(0, 9)]
    world.now_ns += 99 * MS
    clock.wait(world.now_ns)
    assert len(world.progress) == 1
    world.now_ns += 2 * MS
    clock.wait(world.now_ns)
    assert len(world.progress) == 2
    world.core.ledger.presented(0, START, 1, NEVER)
    clock.finish()
    assert world.progress[2:] == [(1, 9)]
