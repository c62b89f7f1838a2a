"""Why jobs that were ready did not begin: each wait cut into causes, from the records of a journal.

Rule: every ns from a job's `ready_ns` to its `begin_ns` has one cause, the first of these that holds: the unit did
another job; it was at one that was lost with its process, or that was down; the scheduler had not heard yet that the
input was there (overhead); the unit's cap held it; no output slot was free, or enough frames were in flight; the policy
or the order of frames held it; and, from the moment in which the job was handed over, the unit had no core, or the job
was on its way (overhead). What is kept is bounded: a wait that reaches further back than `KEPT` jobs or changes of its
unit is `unknown` there.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Collection, Iterator, Mapping
from typing import Any, Final, NamedTuple

from trilane.errors import BadInputError
from trilane.pipeline.journal import Accounted, Record, Stepped, Worked
from trilane.scheduler.accounts import NAMES
from trilane.scheduler.events import Dispatch, Graph, Job, JobDone, JobFailed, Kill, UnitDied, UnitReady
from trilane.scheduler.ledger import ASSIGNED, STARVED, JobRecord

BUSY, LOST, DOWN, THROTTLED, BLOCKED = "busy", "lost", "down", "throttled", "blocked"
HELD, PREEMPTED, OVERHEAD, UNKNOWN = "held", "preempted", "overhead", "unknown"
CAUSES = (BUSY, LOST, DOWN, THROTTLED, BLOCKED, HELD, PREEMPTED, OVERHEAD, UNKNOWN)
#: What the account of a unit without this job means for the job, once the scheduler has heard of its input.
MEANING = {**NAMES, ASSIGNED: OVERHEAD, STARVED: HELD}
KEPT: Final = 4096

#: A job that is over: its stage and its frame.
Key = tuple[str, int]


class ExplainedJob(NamedTuple):
    """A job that has ended, and why it waited.

    `figures`: what its stage reported of it.
    `waits_ns`: cause to ns, those that are not 0; they sum to `job.begin_ns - job.ready_ns`.
    `behind`: the job that its unit did the longest in that time, None without one.
    `after`: the jobs whose end the scheduler heard of in the step in which it handed this job over.
    `sampled_ns`: when the frame's pose was sampled, 0 but of the first stage.
    `rung`: of the frame's work. `skips`: the frame takes the bypass, said by the stage at which that begins.
    """

    job: JobRecord
    figures: Mapping[str, float]
    waits_ns: Mapping[str, int]
    behind: JobRecord | None
    after: tuple[Key, ...]
    sampled_ns: int
    rung: int
    skips: bool

    @property
    def key(self) -> Key:
        return self.job.stage, self.job.frame

    @property
    def cause(self) -> str:
        """Of most of its wait; "" where it did not wait."""
        return max(self.waits_ns, key=self.waits_ns.__getitem__, default="")


class Down(NamedTuple):
    """A unit's process was down; it was up again at `end_ns`."""

    unit: str
    begin_ns: int
    end_ns: int


class _Handed(NamedTuple):
    """A job that its unit has. `heard_ns`: when the scheduler heard of its input; `after`: as of an ExplainedJob."""

    job: Job
    dispatch_ns: int
    heard_ns: int
    after: tuple[Key, ...]


class _Unit:
    """The last jobs of a unit, and what its time was between them."""

    def __init__(self, kept: int) -> None:
        self.jobs: deque[JobRecord] = deque(maxlen=kept)
        self.changes: deque[tuple[int, str]] = deque(maxlen=kept)
        self.account = STARVED
        self.is_up = False
        self.down_ns: int | None = None  # since when, after it was up

    def note(self, now_ns: int) -> None:
        cause = MEANING[self.account] if self.is_up else DOWN
        if not self.changes or self.changes[-1][1] != cause:
            self.changes.append((now_ns, cause))

    def fall(self, now_ns: int, handed_ns: int | None) -> None:
        """Its process is gone, and with it what it did between jobs since `handed_ns`, when it was handed the first."""
        if handed_ns is not None and self.is_up:
            while self.changes and self.changes[-1][0] >= handed_ns:
                self.changes.pop()
            self.changes.append((handed_ns, LOST))
        if self.is_up:
            self.down_ns = now_ns
        self.is_up = False
        self.note(now_ns)

    @property
    def known_from_ns(self) -> int:
        """Since when everything is kept; 0: since ever."""
        firsts = [kept[0] for kept in (self.jobs, self.changes) if len(kept) == kept.maxlen]
        return max((first.begin_ns if isinstance(first, JobRecord) else first[0] for first in firsts), default=0)

    def causes(self, begin_ns: int, end_ns: int) -> Iterator[tuple[str, int, int]]:
        """(cause, begin, end) over a piece of time, the last first; what was before the first change has none."""
        for since_ns, cause in reversed(self.changes):
            if since_ns < end_ns:
                yield cause, max(since_ns, begin_ns), end_ns
                end_ns = since_ns
            if since_ns <= begin_ns:
                return

    def during(self, begin_ns: int, end_ns: int) -> Iterator[JobRecord]:
        """Its jobs that ran in a piece of time, the last first."""
        for job in reversed(self.jobs):
            if job.end_ns <= begin_ns:
                return
            if job.begin_ns < end_ns:
                yield job


class Waits:
    """Takes the records of a journal in order; `add` gives back the job that a record ends, with its wait explained.

    `add` raises BadInputError for a unit or a stage that the graph lacks.

    `graph`: of the run. `kept`: jobs and changes of each unit that are remembered.
    `downs`: the last times in which a unit was down after its start, in the order of their ends.
    """

    def __init__(self, graph: Graph, kept: int = KEPT) -> None:
        self._kept = kept
        self._stages = tuple(stage.name for stage in graph.stages)
        self.downs: deque[Down] = deque(maxlen=kept)
        self._units = {unit: _Unit(kept) for unit in graph.units}
        self._handed: dict[int, _Handed] = {}
        self._ended: dict[Key, tuple[_Handed, JobDone]] = {}
        self._heard_ns: dict[int, int] = {}

    def add(self, record: Record) -> ExplainedJob | None:
        if isinstance(record, Stepped):
            self._step(record)
        elif isinstance(record, Accounted):
            unit = self._unit(record.unit)
            unit.account = record.account
            unit.note(record.now_ns)
        elif isinstance(record, Worked):
            return self._explain(record)
        return None

    def _unit(self, name: str) -> _Unit:
        _check(name, self._units, "unit")
        return self._units[name]

    def _step(self, step: Stepped) -> None:
        now_ns, events, actions = step
        after = []
        for event in events:
            if isinstance(event, JobDone):
                after += self._end(event, now_ns)
            elif isinstance(event, JobFailed):
                self._handed.pop(event.job, None)
            elif isinstance(event, UnitReady):
                self._rise(event.unit, now_ns)
            elif isinstance(event, UnitDied):
                self._fall(event.unit, now_ns)
        for action in actions:
            if isinstance(action, Dispatch):
                heard_ns = self._heard_ns.get(action.job.frame, 0)
                self._handed[action.job.id] = _Handed(action.job, now_ns, heard_ns, tuple(after))
            elif isinstance(action, Kill):
                self._fall(action.unit, now_ns)

    def _end(self, event: JobDone, now_ns: int) -> list[Key]:
        handed = self._handed.pop(event.job, None)
        if handed is None:
            return []  # it was lost with the process that did it
        key = handed.job.stage, handed.job.frame
        self._ended[key] = handed, event
        self._heard_ns[handed.job.frame] = now_ns
        _limit(self._ended, self._kept)  # of frames that were lost or dropped nobody says which
        _limit(self._heard_ns, self._kept)
        return [key]

    def _rise(self, name: str, now_ns: int) -> None:
        unit = self._unit(name)
        if unit.down_ns is not None:
            self.downs.append(Down(name, unit.down_ns, now_ns))
        unit.is_up, unit.down_ns = True, None
        unit.note(now_ns)

    def _fall(self, name: str, now_ns: int) -> None:
        own = [handed for handed in self._handed.values() if handed.job.unit == name]
        self._unit(name).fall(now_ns, min((handed.dispatch_ns for handed in own), default=None))
        for handed in own:
            del self._handed[handed.job.id]

    def _explain(self, worked: Worked) -> ExplainedJob:
        job = worked.job
        unit = self._unit(job.unit)
        _check(job.stage, self._stages, "stage")
        handed, done = self._ended.pop((job.stage, job.frame), (None, None))
        heard_ns = handed.heard_ns if handed is not None else 0
        others = list(unit.during(job.ready_ns, job.begin_ns))
        waits_ns = _waits(unit, job, heard_ns, others)
        behind = max(others, key=lambda other: _overlap(other, job), default=None)
        unit.jobs.append(job)
        after, rung = (handed.after, handed.job.rung) if handed is not None else ((), 0)
        sampled_ns, skips = (done.t_sampled_ns, done.skips) if done is not None else (0, False)
        return ExplainedJob(job, worked.figures, waits_ns, behind, after, sampled_ns, rung, skips)


def _check(name: str, names: Collection[str], kind: str) -> None:
    if name not in names:
        raise BadInputError("the journal", f"{kind} {name!r}", f"one of its header: {', '.join(names)}")


def _limit(kept: dict[Any, Any], most: int) -> None:
    """Forget the oldest entry of a dict that has more than `most`."""
    if len(kept) > most:
        del kept[next(iter(kept))]


def _waits(unit: _Unit, job: JobRecord, heard_ns: int, others: list[JobRecord]) -> dict[str, int]:
    """The wait of `job` by cause. `others`: jobs of its unit in that time, the last first."""
    found = dict.fromkeys(CAUSES, 0)
    known_ns = min(max(unit.known_from_ns, job.ready_ns), job.begin_ns)
    found[UNKNOWN] = known_ns - job.ready_ns
    end_ns, preemptible_ns = job.begin_ns, job.preempted_before_ns
    for begin_ns, other in [*((max(other.end_ns, known_ns), other) for other in others), (known_ns, None)]:
        on_way_ns = max(end_ns - max(begin_ns, job.dispatch_ns), 0)
        lost_ns = min(preemptible_ns, on_way_ns)
        preemptible_ns -= lost_ns
        found[PREEMPTED] += lost_ns
        found[OVERHEAD] += on_way_ns - lost_ns
        _add_not_handed(found, unit, begin_ns, min(end_ns, job.dispatch_ns), heard_ns)
        end_ns = min(end_ns, begin_ns)
        if other is not None:
            busy_from_ns = min(max(other.begin_ns, known_ns), end_ns)
            found[BUSY] += end_ns - busy_from_ns
            end_ns = busy_from_ns
    return {cause: ns for cause, ns in found.items() if ns}


def _add_not_handed(found: dict[str, int], unit: _Unit, begin_ns: int, end_ns: int, heard_ns: int) -> None:
    """Of a piece of time before the job was handed over, in which its unit did no other."""
    if end_ns <= begin_ns:
        return
    explained_ns = 0
    for cause, since_ns, until_ns in unit.causes(begin_ns, end_ns):
        unheard_ns = 0 if cause in (LOST, DOWN) else max(min(until_ns, heard_ns) - since_ns, 0)
        found[OVERHEAD] += unheard_ns
        found[cause] += until_ns - since_ns - unheard_ns
        explained_ns += until_ns - since_ns
    found[OVERHEAD] += end_ns - begin_ns - explained_ns


def _overlap(other: JobRecord, job: JobRecord) -> int:
    """How long `other` ran while `job` waited."""
    return min(other.end_ns, job.begin_ns) - max(other.begin_ns, job.ready_ns)
