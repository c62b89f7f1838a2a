"""The accounts a second time, from the slices that a trace shows. Rule: nothing here is asked of the ledger.

A unit's timeline is cut into slices: a job, or idle for one cause. Whether it had a job and whether its process was up
follows from the recorded events and actions; why it had none is what the core noted of it after each step. The ledger
adds up as the run goes on, this file afterwards; where they differ, one of them is wrong.
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import pairwise
from typing import Any, NamedTuple

from trilane.scheduler.events import (
    Action,
    Dispatch,
    Finish,
    JobDone,
    JobFailed,
    Kill,
    UnitDied,
    UnitReady,
)
from trilane.scheduler.ledger import BLOCKED, STARVED, THROTTLED, JobRecord
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


def span_of(recording: Recording) -> Span | None:
    """The time that the accounts are about; None for a run in which not every unit got ready, or that has no end."""
    missing, begin_ns = set(recording.graph.units), None
    for now_ns, events, actions in recording.steps:
        if begin_ns is None:
            missing -= {event.unit for event in events if isinstance(event, UnitReady)}
            begin_ns = None if missing else now_ns
        if begin_ns is not None and any(isinstance(action, Finish) for action in actions):
            return Span(begin_ns, now_ns)
    return None


def idle_slices(recording: Recording, jobs: Sequence[JobRecord]) -> list[IdleSlice]:
    """The time of each unit in which none of `jobs` ran, in order, cut where its cause changes."""
    span = span_of(recording)
    if span is None:
        return []
    of_unit: dict[str, list[JobRecord]] = {unit: [] for unit in recording.graph.units}
    for job in sorted(jobs, key=lambda job: job.begin_ns):
        of_unit[job.unit].append(job)
    return [
        piece
        for unit, begin_ns, end_ns, cause in _causes(recording, span)
        for piece in _without_jobs(IdleSlice(unit, cause, begin_ns, end_ns), of_unit[unit])
    ]


def shares(span: Span, jobs: Iterable[JobRecord], idle: Iterable[IdleSlice]) -> dict[str, dict[str, float]]:
    """Of each unit that has a slice: the share of `busy` and of each cause in the time of the span."""
    total_ns = max(span.end_ns - span.begin_ns, 1)
    sums: dict[str, dict[str, int]] = {}
    for piece in idle:
        row = sums.setdefault(piece.unit, dict.fromkeys((BUSY, *CAUSES, UNEXPLAINED), 0))
        row[PREEMPTED] += piece.preempted_ns
        row[piece.cause] += piece.end_ns - piece.begin_ns - piece.preempted_ns
    for job in jobs:
        row = sums.setdefault(job.unit, dict.fromkeys((BUSY, *CAUSES, UNEXPLAINED), 0))
        row[PREEMPTED] += job.preempted_ns
        row[OVERHEAD] += job.asleep_ns
        row[BUSY] += job.end_ns - job.begin_ns - job.preempted_ns - job.asleep_ns
    return {
        unit: {name: ns / total_ns for name, ns in row.items() if name != UNEXPLAINED} for unit, row in sums.items()
    }


def second_accounts(recording: Recording, jobs: Sequence[JobRecord]) -> dict[str, dict[str, float]]:
    """`shares` of a whole run; empty for one that has no span."""
    span = span_of(recording)
    return {} if span is None else shares(span, jobs, idle_slices(recording, jobs))


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


def compared(units: Mapping[str, Mapping[str, Any]], recording: Recording, jobs: Sequence[JobRecord]) -> dict[str, Any]:
    """`accounts` of a report: the second accounts of a run beside its `units`, as the ledger reported them."""
    second = second_accounts(recording, jobs)
    difference = largest_difference(units, second)
    return {"units": second, "largest_difference": difference, "agree": difference <= LARGEST_DIFFERENCE}


def _causes(recording: Recording, span: Span) -> list[tuple[str, int, int, str]]:
    """(unit, begin, end, cause) over the span: overhead while the unit had a job or its process was not up."""
    units = {unit: _UnitState() for unit in recording.graph.units}
    noted: dict[int, list[tuple[str, int]]] = {}
    for now_ns, name, account in recording.accounts:
        noted.setdefault(now_ns, []).append((name, account))
    for now_ns, events, actions in recording.steps:
        for event in events:
            if (name := getattr(event, "unit", "")) in units:
                units[name].hear(event)
        for action in actions:
            _hear_action(units, action)
        for name, account in noted.get(now_ns, ()):
            units[name].account = account
        for unit in units.values():
            unit.note(max(now_ns, span.begin_ns))
    return [
        (name, begin_ns, end_ns, cause)
        for name, unit in units.items()
        for (begin_ns, cause), (end_ns, _) in pairwise([*unit.changes, (span.end_ns, "")])
        if end_ns > begin_ns
    ]


class _UnitState:
    """Which jobs a unit holds, whether its process is up, and what its time was when that changed."""

    def __init__(self) -> None:
        self.jobs: set[int] = set()
        self.is_up = False
        self.account = STARVED
        self.changes: list[tuple[int, str]] = []

    def hear(self, event: Any) -> None:
        if type(event) in (JobDone, JobFailed):
            self.jobs.discard(event.job)
        elif type(event) is UnitReady:
            self.is_up = True
        elif type(event) is UnitDied:
            self.jobs.clear()
            self.is_up = False

    def note(self, now_ns: int) -> None:
        cause = OVERHEAD if self.jobs or not self.is_up else NAMES.get(self.account, UNEXPLAINED)
        if not self.changes or self.changes[-1][1] != cause:
            self.changes.append((now_ns, cause))


def _hear_action(units: Mapping[str, _UnitState], action: Action) -> None:
    if type(action) is Dispatch:
        units[action.job.unit].jobs.add(action.job.id)
    elif type(action) is Kill:
        units[action.unit].is_up = False


def _without_jobs(idle: IdleSlice, jobs: Sequence[JobRecord]) -> Iterator[IdleSlice]:
    """The pieces of a slice between `jobs`, which are of its unit and in order; other causes have none."""
    if idle.cause != OVERHEAD:
        yield idle
        return
    begin_ns = idle.begin_ns
    for job in jobs[bisect_left(jobs, begin_ns, key=lambda job: job.begin_ns) :]:
        if job.begin_ns >= idle.end_ns:
            break
        if job.begin_ns > begin_ns:
            lost_ns = min(job.preempted_before_ns, job.begin_ns - begin_ns)
            yield idle._replace(begin_ns=begin_ns, end_ns=job.begin_ns, preempted_ns=lost_ns)
        begin_ns = max(begin_ns, job.end_ns)
    if begin_ns < idle.end_ns:
        yield idle._replace(begin_ns=begin_ns)
