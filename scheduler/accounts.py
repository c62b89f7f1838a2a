"""The accounts a second time, from the slices that a trace shows. Rule: nothing here is asked of the ledger.

A unit's timeline is cut into slices: a job, or idle for one cause. Whether it had a job and whether its process was up
follows from the recorded events and actions; why it had none is what the core noted of it after each step. What is held
of a run while it is cut is bounded by what it has in flight, however long it lasts.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator, Mapping
from heapq import heappop, heappush
from typing import Any, NamedTuple

from trilane.scheduler.events import (
    NEVER,
    Action,
    Dispatch,
    Event,
    Finish,
    Graph,
    JobDone,
    JobFailed,
    Kill,
    UnitDied,
    UnitReady,
)
from trilane.scheduler.ledger import ASSIGNED, BLOCKED, STARVED, THROTTLED, JobRecord
from trilane.scheduler.recording import Recording

BUSY = "busy"
PREEMPTED, OVERHEAD = "preempted", "overhead"
NAMES = {STARVED: "starved", BLOCKED: "blocked", THROTTLED: "throttled"}
CAUSES = (*NAMES.values(), PREEMPTED, OVERHEAD)
#: A unit that has neither a job nor a noted cause: its time is missing in the sums, which shows.
UNEXPLAINED = "unexplained"
LARGEST_DIFFERENCE = 0.001  # of the time, between the two computations


class IdleSlice(NamedTuple):
    """A piece of time in which no job ran on the unit. `preempted_ns`: how much of it the unit had no core."""

    unit: str
    cause: str
    begin_ns: int
    end_ns: int
    preempted_ns: int = 0


class Span(NamedTuple):
    """From the step in which the last unit got ready to the one that finished the run."""

    begin_ns: int
    end_ns: int


class Moment(NamedTuple):
    """A step of the scheduler, the (since, unit, account) that were noted after it, and the jobs whose end it heard."""

    now_ns: int
    events: tuple[Event, ...]
    actions: tuple[Action, ...]
    accounts: list[tuple[int, str, int]]
    jobs: list[JobRecord]


def in_order(recording: Recording, jobs: Iterable[JobRecord]) -> Iterator[Moment]:
    """The steps of a run that is in memory, each with what follows from it."""
    accounts = deque(recording.accounts)
    ended: dict[str, deque[JobRecord]] = {unit: deque() for unit in recording.graph.units}
    for job in sorted(jobs, key=lambda job: job.begin_ns):
        ended[job.unit].append(job)
    for now_ns, events, actions in recording.steps:
        moment = Moment(now_ns, events, actions, [], [])
        while accounts and accounts[0][0] <= now_ns:
            moment.accounts.append(accounts.popleft())
        for event in events:
            while type(event) is JobDone and ended[event.unit] and ended[event.unit][0].end_ns <= event.t_end_ns:
                moment.jobs.append(ended[event.unit].popleft())
        yield moment


class IdleCutter:
    """Cuts the idle time of a run into slices, while the run goes on or afterwards.

    To be told a `step`, then each `account` that was noted after it and each `job` whose end it heard, then the next
    step; after the last one `end`. What `step` and `end` hand back are the slices that are known by then, in the order
    of their ends.

    `span`: the time that the accounts are about; None until the run has finished, and of one in which not every unit
    got ready, which has no slices.
    """

    def __init__(self, graph: Graph) -> None:
        self.span: Span | None = None
        self._units = {unit: _UnitState(unit) for unit in graph.units}
        self._missing = set(graph.units)
        self._begin_ns: int | None = None
        self._now_ns = 0
        self._held: list[tuple[int, int, IdleSlice]] = []
        self._count = 0

    def step(self, now_ns: int, events: Iterable[Event], actions: Iterable[Action]) -> list[IdleSlice]:
        """The next step of the scheduler, with which the one before is complete."""
        slices = self._settle()
        self._now_ns = now_ns
        for event in events:
            self._hear(event)
        if self._begin_ns is None and not self._missing:
            self._begin_ns = now_ns
        for action in actions:
            _hear_action(self._units, action)
            if type(action) is Finish and self._begin_ns is not None:
                self.span = Span(self._begin_ns, now_ns)
        return slices

    def account(self, since_ns: int, unit: str, account: int) -> None:
        """From `since_ns` on the time of `unit` without a job goes to `account` (`trilane.scheduler.ledger`).

        That is the time of the last step, or of a release before it which that step did late.
        """
        state = self._units[unit]
        if account == ASSIGNED and since_ns < self._now_ns and self._begin_ns is not None:
            self._hold(state.note(since_ns, OVERHEAD))
        state.account = account

    def job(self, job: JobRecord) -> None:
        """A job whose end the last step heard; those of a unit come in the order in which it did them."""
        self._hold(self._units[job.unit].cut(job))

    def end(self) -> list[IdleSlice]:
        """The slices that are left, until the last step; nothing may be told after it."""
        if self._begin_ns is not None:
            for unit in self._units.values():
                self._hold(unit.note(self._now_ns, ""))
        return self._take(NEVER)

    def _hear(self, event: Any) -> None:
        unit = self._units.get(getattr(event, "unit", ""))
        if unit is not None:
            unit.hear(event)
            if type(event) is UnitReady:
                self._missing.discard(unit.name)

    def _settle(self) -> list[IdleSlice]:
        """Note what the last step left each unit with; the slices of all units that end before any that may follow."""
        if self._begin_ns is None:
            return []
        for unit in self._units.values():
            self._hold(unit.note(self._now_ns, unit.cause))
        return self._take(min(unit.cut_until_ns(self._now_ns) for unit in self._units.values()))

    def _hold(self, slices: Iterable[IdleSlice]) -> None:
        for piece in slices:
            self._count += 1
            heappush(self._held, (piece.end_ns, self._count, piece))

    def _take(self, until_ns: int) -> list[IdleSlice]:
        taken = []
        while self._held and self._held[0][0] <= until_ns:
            taken.append(heappop(self._held)[2])
        return taken


def slices_of(cutter: IdleCutter, recording: Recording, jobs: Iterable[JobRecord]) -> Iterator[IdleSlice]:
    """Tell `cutter` a whole run that is in memory; what it hands back."""
    for moment in in_order(recording, jobs):
        yield from cutter.step(moment.now_ns, moment.events, moment.actions)
        for since_ns, unit, account in moment.accounts:
            cutter.account(since_ns, unit, account)
        for job in moment.jobs:
            cutter.job(job)
    yield from cutter.end()


def idle_slices(recording: Recording, jobs: Iterable[JobRecord]) -> list[IdleSlice]:
    """The time of each unit in which none of `jobs` ran, cut where its cause changes, in the order of their ends.

    Of a run that is in memory; none of one that has no span.
    """
    cutter = IdleCutter(recording.graph)
    slices = list(slices_of(cutter, recording, jobs))
    return slices if cutter.span is not None else []


class ShareSums:
    """Adds up a run's jobs and idle slices, in any order."""

    def __init__(self) -> None:
        self._sums: dict[str, dict[str, int]] = {}

    def add_job(self, job: JobRecord) -> None:
        """One that has ended."""
        row = self._row(job.unit)
        row[PREEMPTED] += job.preempted_ns
        row[OVERHEAD] += job.asleep_ns
        row[BUSY] += job.end_ns - job.begin_ns - job.preempted_ns - job.asleep_ns

    def add_idle(self, piece: IdleSlice) -> None:
        """One that `IdleCutter` handed back."""
        row = self._row(piece.unit)
        row[PREEMPTED] += piece.preempted_ns
        row[piece.cause] += piece.end_ns - piece.begin_ns - piece.preempted_ns

    def shares(self, span: Span | None) -> dict[str, dict[str, float]]:
        """Of each unit that has a slice: the share of `busy` and of each cause in the time of the span.

        Empty for a run that has none.
        """
        if span is None:
            return {}
        total_ns = max(span.end_ns - span.begin_ns, 1)
        return {
            unit: {name: ns / total_ns for name, ns in row.items() if name != UNEXPLAINED}
            for unit, row in self._sums.items()
        }

    def _row(self, unit: str) -> dict[str, int]:
        return self._sums.setdefault(unit, dict.fromkeys((BUSY, *CAUSES, UNEXPLAINED), 0))


def second_accounts(recording: Recording, jobs: Iterable[JobRecord]) -> dict[str, dict[str, float]]:
    """The shares of a whole run that is in memory, as `ShareSums` has them."""
    cutter, sums, ended = IdleCutter(recording.graph), ShareSums(), list(jobs)
    for job in ended:
        sums.add_job(job)
    for piece in slices_of(cutter, recording, ended):
        sums.add_idle(piece)
    return sums.shares(cutter.span)


def largest_difference(units: Mapping[str, Mapping[str, Any]], second: Mapping[str, Mapping[str, float]]) -> float:
    """Between the `units` of a report and the second accounts, over every unit and share; 1 for a unit that lacks."""
    if units.keys() != second.keys():
        return 1.0
    found = (
        abs(share - second[unit][name])
        for unit, row in units.items()
        for name, share in ((BUSY, row["busy"]), *row["idle"].items())
        if share is not None
    )
    return max(found, default=0.0)


def compared(units: Mapping[str, Mapping[str, Any]], second: Mapping[str, Mapping[str, float]]) -> dict[str, Any]:
    """`accounts` of a report: the second accounts of a run beside its `units`, as the ledger reported them."""
    difference = largest_difference(units, second)
    return {"units": second, "largest_difference": difference, "agree": difference <= LARGEST_DIFFERENCE}


class _UnitState:
    """Which jobs a unit holds and whether its process is up; of its idle slice that goes on, how far it is cut."""

    def __init__(self, name: str) -> None:
        self.name = name
        self.account = STARVED
        self.is_up = False
        self.jobs: set[int] = set()
        self._cause = ""
        self._cut_ns = 0

    @property
    def cause(self) -> str:
        """Of its time now: overhead while it has a job or its process is not up."""
        return OVERHEAD if self.jobs or not self.is_up else NAMES.get(self.account, UNEXPLAINED)

    def hear(self, event: Any) -> None:
        if type(event) in (JobDone, JobFailed):
            self.jobs.discard(event.job)
        elif type(event) is UnitReady:
            self.is_up = True
        elif type(event) is UnitDied:
            self.jobs.clear()
            self.is_up = False

    def note(self, now_ns: int, cause: str) -> Iterator[IdleSlice]:
        """From now on its time has this cause; what is left of the slice before, if that had another."""
        if cause != self._cause:
            if self._cause and now_ns > self._cut_ns:
                yield IdleSlice(self.name, self._cause, self._cut_ns, now_ns)
            self._cause, self._cut_ns = cause, now_ns

    def cut(self, job: JobRecord) -> Iterator[IdleSlice]:
        """The piece between the job before and this one; only of a slice of overhead, for in others it has no job."""
        if self._cause == OVERHEAD:
            if job.begin_ns > self._cut_ns:
                lost_ns = min(job.preempted_before_ns, job.begin_ns - self._cut_ns)
                yield IdleSlice(self.name, OVERHEAD, self._cut_ns, job.begin_ns, lost_ns)
            self._cut_ns = max(self._cut_ns, job.end_ns)

    def cut_until_ns(self, now_ns: int) -> int:
        """No slice that may still come ends before this: those between jobs that it holds, or later than now."""
        return self._cut_ns if self.jobs else now_ns


def _hear_action(units: Mapping[str, _UnitState], action: Action) -> None:
    if type(action) is Dispatch:
        units[action.job.unit].jobs.add(action.job.id)
    elif type(action) is Kill:
        units[action.unit].is_up = False
