"""Runs several pipelines in virtual time on the same hardware, each with a scheduler (`Core`) of its own.

Rule: the `Core` of a pipeline decides which of the pipeline's jobs comes next. This module decides whose job a seat
takes when several pipelines have handed it one. It also decides the speed of jobs that run at the same time.

Theory of operation. Each pipeline has its own `Core` with its own policy, ledger and recording. Like applications on
one phone, the pipelines do not know of each other. Each unit of a pipeline has a *seat*: the hardware that does its
jobs. On a seat with turns one job runs at a time. The other jobs wait, and their units are preempted. On a *divided*
seat all jobs run at once, each with an equal share. An example is a core of this machine: the kernel switches between
the processes on the core. A unit does its own jobs in the order in which they were handed to it.

Turns. The first waiting job of each unit is a candidate, and a rule of `TURNS` chooses one. A running job is never
taken off its seat. Source of the rule `deadline`: Liu and Layland, Journal of the ACM 20 (1973).

At one instant, all events and all deadlines of the schedulers come first; each of them is a step of one `Core`. Jobs
begin after these steps, so that the choice sees every job that is ready at this instant. Running jobs change their
speed when other jobs begin or end. The work that is left of a job is kept as a whole number, in units of ns / `ONE`.

Accounts. If a job waits while another pipeline has its seat, this time counts as preempted before the job
(`JobDone.preempted_before_ns`). On a divided seat, the share of the other jobs counts as preempted within the job
(`preempted_ns`). A job that waits for memory counts as busy.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from heapq import heappop, heappush
from typing import Any, Final, NamedTuple

from trilane.scheduler.core import Core
from trilane.scheduler.events import NEVER, Dispatch, Event, Graph, Job, JobDone, Outcome, Settings, UnitReady
from trilane.scheduler.ledger import JobRecord
from trilane.scheduler.recording import Recording
from trilane.scheduler.stats import summary_ms
from trilane.scheduler.virtual import Service, Simulation, Skips, none_skips
from trilane.unexpected_value import UnexpectedValue

ROUND_ROBIN: Final = "round-robin"


class Waiting(NamedTuple):
    """A job that waits for a seat: the first waiting job of a unit.

    `behind`: number of pipelines whose turn comes before the turn of the job's pipeline. The pipeline that had the seat
    last has the largest number, and the pipeline after it has 0.
    `deadline_ns`: deadline of the job's frame, or NEVER.
    `order`: number that grows with each hand-over of a job to a unit.
    """

    behind: int
    deadline_ns: int
    order: int


#: Of the waiting jobs, the one with the least of these values comes next. With round-robin, waiting pipelines get one
#: job each, one after another. With deadline, jobs without a deadline come last: if the other pipelines keep the seat
#: busy, these jobs never run.
TURNS: Final[dict[str, Callable[[Waiting], tuple[int, ...]]]] = {
    ROUND_ROBIN: lambda job: (job.behind, job.order),
    "deadline": lambda job: (job.deadline_ns, job.behind, job.order),
}


#: The speed of a job that nothing slows; divisible by 1 to 10, so that equal shares of a core are exact.
ONE: Final = 2520 * 1024


@dataclass(frozen=True)
class Member:
    """One of the pipelines.

    `graph`, `settings`: graph and settings of its core.
    `service`: function that returns the service time of a job in ns, while no other pipeline uses the hardware.
    `seats`: name of each unit's seat, by the unit's name; a missing unit has the seat of its own name.
    `skips`: function that says which frames take the graph's bypass.
    `inputs`: events from outside, such as `Stop`, as pairs (t_ns, event).
    """

    graph: Graph
    settings: Settings
    service: Service
    seats: Mapping[str, str] = field(default_factory=dict)
    skips: Skips = none_skips
    inputs: tuple[tuple[int, Event], ...] = ()


@dataclass(frozen=True)
class Runs:
    """A job that runs. `member`: index of its pipeline in the list of members."""

    member: int
    stage: str
    unit: str
    seat: str
    frame: int


#: Function of (a running job, all other running jobs) that returns the first job's speed beside the others, above 0, in
#: units of 1 / ONE. The job's share of its seat is not part of this speed.
Speed = Callable[[Runs, Sequence[Runs]], int]


class _Waits(NamedTuple):
    """A job that was handed to its unit at `dispatch_ns`. `order`: number that grows with each hand-over."""

    job: Job
    order: int
    dispatch_ns: int


class _Running:
    """A job that runs.

    `left`: work that is left, in units of ns / ONE.
    `speed`: its present speed, in units of 1 / ONE.
    `held`: its present share of its seat, in units of 1 / ONE.
    `had`: its share of the seat, summed over the time so far, in units of ns / ONE.
    `preempted_before_ns`: time for which its unit waited for the seat. The wait begins with the hand-over or with the
    end of the unit's last job, whichever is later.
    """

    __slots__ = ("begin_ns", "had", "held", "left", "preempted_before_ns", "runs", "speed", "waited")

    def __init__(self, waited: _Waits, runs: Runs, begin_ns: int, service_ns: int, preempted_before_ns: int) -> None:
        self.waited, self.runs, self.begin_ns = waited, runs, begin_ns
        self.left, self.preempted_before_ns = service_ns * ONE, preempted_before_ns
        self.speed = self.held = ONE
        self.had = 0

    def end_ns(self, now_ns: int) -> int:
        """Return the time in ns at which the job ends if its speed stays; if no work is left, `now_ns`."""
        return now_ns - (-self.left // self.speed) if self.left > 0 else now_ns


class _Unit:
    """A unit of one pipeline. `queue`: its waiting jobs, the first handed over first."""

    __slots__ = ("is_running", "last_end_ns", "name", "queue", "seat")

    def __init__(self, name: str, seat: str) -> None:
        self.name, self.seat = name, seat
        self.queue: deque[_Waits] = deque()
        self.is_running = False
        self.last_end_ns = 0


class _Line:
    """A pipeline while it runs."""

    def __init__(self, number: int, member: Member, keep: bool) -> None:
        self.number, self.member = number, member
        self.core = Core(member.graph, member.settings)
        self.recording = Recording(member.graph, member.settings) if keep else None
        self.jobs: list[JobRecord] = []
        self.units = {name: _Unit(name, member.seats.get(name, name)) for name in member.graph.units}
        self.deadline_ns: int = NEVER
        self.bypass_begin = member.graph.bypass[0] if member.graph.bypass is not None else ""


class BesideDriver:
    """The driver of several `Core`s in virtual time. Equal inputs give equal runs."""

    def __init__(
        self,
        members: Sequence[Member],
        *,
        turns: str = ROUND_ROBIN,
        divided: Iterable[str] = (),
        speed: Speed | None = None,
        keep: bool = False,
    ) -> None:
        """Prepare a run of the pipelines `members`.

        `turns`: name of a rule of `TURNS`, for every seat that is not divided.
        `divided`: names of the divided seats.
        `speed`: function that returns a job's speed beside other jobs; None: a job is slowed only by its share of its
        seat.
        `keep`: whether to record the steps of each `Core`, and the jobs that end.

        Raises ValueError for an unknown policy, edge or rule of turns.
        """
        if turns not in TURNS:
            raise UnexpectedValue(f"turns {turns!r}", f"one of {', '.join(TURNS)}")
        self._turn, self._divided, self._speed = TURNS[turns], frozenset(divided), speed
        self.lines = [_Line(number, member, keep) for number, member in enumerate(members)]
        self._heap: list[tuple[int, int, int, Event]] = []
        self._running: list[_Running] = []
        self._last: dict[str, int] = {}
        self._now_ns = self._order = 0
        self._is_changed = False
        for line in self.lines:
            for unit in line.member.graph.units:
                self._push(0, line.number, UnitReady(unit))
            for at_ns, event in line.member.inputs:
                self._push(at_ns, line.number, event)

    def run(self) -> list[Outcome]:
        """Run until every `Core` finishes, and return how each ended, in the order of the members.

        Raises RuntimeError if nothing can ever happen again, or if a job takes longer than its pipeline's `hang_ns`.
        """
        while not all(line.core.finished for line in self.lines):
            self._advance(self._next_ns())
            while self._step_one():
                pass
            self._begin_jobs()
            if self._is_changed:
                self._set_speeds()
        return [line.core.outcome for line in self.lines if line.core.outcome is not None]

    def _next_ns(self) -> int:
        """Return the time in ns at which something happens next."""
        at_ns = min((line.deadline_ns for line in self.lines), default=NEVER)
        if self._heap:
            at_ns = min(at_ns, self._heap[0][0])
        for running in self._running:
            at_ns = min(at_ns, running.end_ns(self._now_ns))
        if at_ns >= NEVER:
            raise RuntimeError("the simulation stands still: no event and no deadline is left")
        return at_ns

    def _advance(self, now_ns: int) -> None:
        passed_ns, self._now_ns = now_ns - self._now_ns, now_ns
        if passed_ns:
            for running in self._running:
                running.left -= passed_ns * running.speed
                running.had += passed_ns * running.held

    def _step_one(self) -> bool:
        """Let one `Core` take a step for an event, an end or a deadline that is due; return False if nothing is."""
        now_ns = self._now_ns
        if self._heap and self._heap[0][0] <= now_ns:
            _, _, number, event = heappop(self._heap)
            self._step(self.lines[number], (event,))
            return True
        if ended := [running for running in self._running if running.left <= 0]:
            # Jobs that end at one time end in the order of their hand-over, so that equal inputs give equal runs.
            self._end(min(ended, key=lambda running: running.waited.order))
            return True
        for line in self.lines:
            if line.deadline_ns <= now_ns:
                self._step(line, ())
                return True
        return False

    def _step(self, line: _Line, events: tuple[Event, ...]) -> None:
        if line.core.finished:
            return
        actions, line.deadline_ns = line.core.step(self._now_ns, events)
        for action in actions:
            if type(action) is Dispatch:
                self._order += 1
                line.units[action.job.unit].queue.append(_Waits(action.job, self._order, self._now_ns))
            elif not line.core.finished:
                # A core kills only a unit that seems to hang, and in virtual time every job ends.
                raise RuntimeError(f"{action} of pipeline {line.number}: its hang_ns is shorter than a job takes")
        if line.recording is not None:
            line.recording.add(self._now_ns, events, actions, line.core)
        if line.core.outcome is not None:
            for unit in line.units.values():
                unit.queue.clear()

    def _end(self, running: _Running) -> None:
        """End a job: free its seat, and give its `Core` a `JobDone`."""
        self._running.remove(running)
        self._is_changed = True
        line, job, now_ns = self.lines[running.runs.member], running.waited.job, self._now_ns
        unit = line.units[job.unit]
        unit.is_running, unit.last_end_ns = False, now_ns
        begin_ns, before_ns = running.begin_ns, running.preempted_before_ns
        preempted_ns = now_ns - begin_ns - running.had // ONE
        if line.recording is not None and not line.core.finished:
            ready_ns = line.core.ready_ns(job) or 0
            cpu_ns = now_ns - begin_ns - preempted_ns
            times = (ready_ns, running.waited.dispatch_ns, begin_ns, now_ns, preempted_ns, 0, before_ns, cpu_ns)
            line.jobs.append(JobRecord(job.stage, job.unit, job.frame, *times))
        skips = job.stage == line.bypass_begin and line.member.skips(job.frame, job.fresh)
        done = JobDone(job.unit, job.id, begin_ns, now_ns, begin_ns, preempted_ns, 0, before_ns, skips)
        self._step(line, (done,))

    def _begin_jobs(self) -> None:
        """Begin all jobs that can begin: on a divided seat the first job of each unit, on any other seat one job."""
        waiting: dict[str, list[tuple[_Line, _Unit]]] = {}
        for line in self.lines:
            for unit in line.units.values():
                if unit.queue and not unit.is_running:
                    waiting.setdefault(unit.seat, []).append((line, unit))
        taken = {running.runs.seat for running in self._running}
        for seat, those in waiting.items():
            if seat in self._divided:
                for line, unit in those:
                    self._begin(line, unit)
            elif seat not in taken:
                self._begin(*self._next_in(seat, those))

    def _next_in(self, seat: str, those: Sequence[tuple[_Line, _Unit]]) -> tuple[_Line, _Unit]:
        last, count = self._last.get(seat, -1), len(self.lines)
        found: dict[Waiting, tuple[_Line, _Unit]] = {}
        for line, unit in those:
            job, order, _ = unit.queue[0]
            behind = (line.number - last - 1) % count
            found[Waiting(behind, line.core.deadline_ns(job), order)] = line, unit
        return found[min(found, key=self._turn)]

    def _begin(self, line: _Line, unit: _Unit) -> None:
        waited, now_ns = unit.queue.popleft(), self._now_ns
        job = waited.job
        unit.is_running = self._is_changed = True
        self._last[unit.seat] = line.number
        service_ns = line.member.service(job.stage, unit.name, job.frame, now_ns)
        runs = Runs(line.number, job.stage, unit.name, unit.seat, job.frame)
        # While its own earlier job ran, the unit did not wait for the seat.
        before_ns = now_ns - max(waited.dispatch_ns, unit.last_end_ns)
        self._running.append(_Running(waited, runs, now_ns, service_ns, before_ns))

    def _set_speeds(self) -> None:
        """Set the speeds of all running jobs, after a job has begun or ended."""
        self._is_changed = False
        if not self._divided and self._speed is None:
            return
        for running in self._running:
            seat = running.runs.seat
            running.held = ONE
            if seat in self._divided:
                running.held = ONE // sum(other.runs.seat == seat for other in self._running)
            running.speed = running.held
            if self._speed is not None:
                others = [other.runs for other in self._running if other is not running]
                # A job of speed 0 would never end.
                running.speed = max(1, running.held * self._speed(running.runs, others) // ONE)

    def _push(self, at_ns: int, number: int, event: Event) -> None:
        self._order += 1
        heappush(self._heap, (at_ns, self._order, number, event))


def simulate_beside(members: Sequence[Member], *, keep: bool = False, **driver: Any) -> list[Simulation]:
    """Run all `members` to their ends, and return a Simulation for each, in their order.

    Frames that still waited before the first stage at a `Stop` do not count as requested. Each report also has the key
    `response_ms`: a summary of the times from release to presentation of the frames with a deadline.

    `keep`, `driver`: arguments of BesideDriver, which also lists the errors.
    """
    beside = BesideDriver(members, keep=keep, **driver)
    outcomes = beside.run()
    return [
        Simulation(_report(line), line.recording, tuple(line.jobs), outcome, line.core.ledger.shown_ns)
        for line, outcome in zip(beside.lines, outcomes, strict=True)
    ]


def _report(line: _Line) -> dict[str, Any]:
    core, due_ns = line.core, line.member.settings.deadline_ns
    report = core.report(clock="virtual", requested=core.source.left)
    return {**report, "response_ms": summary_ms(late_ns + due_ns for late_ns in core.ledger.lateness_ns)}
