"""What a unit did, and why it did nothing: its idle time in slices, and each wait of a job cut into causes.

Rule: a unit's time is a job or idle for one cause. Whether it had a job and whether its process was up, the timeline
says (timeline.py); why it had none is what the core noted of it after each step.

Every ns from a job's `ready_ns` to its `begin_ns` has one cause, the first of these that holds: the unit did another
job; it was at one that was lost with its process, or that was down; the scheduler had not heard yet that the input was
there (overhead); the unit's cap held it; no output slot was free, or enough frames were in flight; the policy or the
order of frames held it; and, from the moment in which the job was handed over, the unit had no core, or the job was on
its way (overhead). What is kept is bounded: a wait that reaches further back than `kept` jobs or changes of its unit is
`unknown` there.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator
from heapq import heappop, heappush
from typing import Final, NamedTuple

from trilane.scheduler import ledger
from trilane.scheduler.events import NEVER, Job
from trilane.scheduler.ledger import JobRecord

BUSY, PREEMPTED, OVERHEAD = "busy", "preempted", "overhead"
THROTTLED = "throttled"
#: Why a unit without a job has none, by the ledger's account.
NAMES: Final = {ledger.STARVED: "starved", ledger.BLOCKED: "blocked", ledger.THROTTLED: THROTTLED}
#: Why a unit is idle.
IDLE_CAUSES: Final = (*NAMES.values(), PREEMPTED, OVERHEAD)
#: A unit that has neither a job nor a noted cause: its time is missing in the sums, which shows.
UNEXPLAINED = "unexplained"
LOST, DOWN, HELD, UNKNOWN = "lost", "down", "held", "unknown"
#: Why a job waits.
WAIT_CAUSES: Final = (BUSY, LOST, DOWN, THROTTLED, NAMES[ledger.BLOCKED], HELD, PREEMPTED, OVERHEAD, UNKNOWN)
#: What the account of a unit without this job means for the job, once the scheduler has heard of its input.
MEANING: Final = {**NAMES, ledger.ASSIGNED: OVERHEAD, ledger.STARVED: HELD}
KEPT: Final = 4096

#: A job that is over: its stage and its frame.
Key = tuple[str, int]


class Handed(NamedTuple):
    """A job that its unit has.

    `at_ns`: when it was handed over. `heard_ns`: when the scheduler heard of its input.
    `after`: the jobs whose end the scheduler heard of in the step in which it handed this job over.
    """

    job: Job
    at_ns: int
    heard_ns: int
    after: tuple[Key, ...]


class IdleSlice(NamedTuple):
    """A piece of time in which no job ran on the unit. `preempted_ns`: how much of it the unit had no core."""

    unit: str
    cause: str
    begin_ns: int
    end_ns: int
    preempted_ns: int = 0


class UnitHistory:
    """One unit. `kept`: its last jobs and changes that are remembered to explain waits.

    `held`: the jobs that it has, the running one first. `account`: of its time without a job (the ledger's).
    `is_up`: whether its process is there and ready, and is not to be ended.
    """

    def __init__(self, name: str, kept: int = KEPT) -> None:
        self.name = name
        self.held: deque[Handed] = deque()
        self.account = ledger.STARVED
        self.is_up = self._is_ending = False
        self._down_ns: int | None = None  # since when, after it was up
        self._jobs: deque[JobRecord] = deque(maxlen=kept)
        self._changes: deque[tuple[int, str]] = deque(maxlen=kept)
        self._idle_cause = ""
        self._cut_ns = 0

    # its process

    def rise(self, now_ns: int) -> int | None:
        """Its process is up; since when it was down, None where it was not up before. One to be ended stays so."""
        if self._is_ending:
            return None
        down_ns, self._down_ns, self.is_up = self._down_ns, None, True
        self._change(now_ns)
        return down_ns

    def fall(self, now_ns: int, *, is_gone: bool) -> None:
        """Its process is gone, or is to be ended; with it goes what it did between jobs since it had the first."""
        if self.is_up:
            if self.held:
                self._lose(self.held[0].at_ns)
            self._down_ns = now_ns
        self.is_up, self._is_ending = False, not is_gone
        self._change(now_ns)

    def take(self, job: int) -> Handed | None:
        """The job that has ended; None for one that was lost with the process that did it."""
        return self.held.popleft() if self.held and self.held[0].job.id == job else None

    # why its jobs waited

    def enter(self, now_ns: int, account: int) -> None:
        """From now on its time without a job goes to `account`."""
        self.account = account
        self._change(now_ns)

    def explain(self, job: JobRecord, heard_ns: int) -> tuple[dict[str, int], JobRecord | None]:
        """The wait of its next job by cause, those that are not 0, and the job that it did the longest in that time.

        `heard_ns`: when the scheduler heard of the job's input.
        """
        others = list(self._during(job.ready_ns, job.begin_ns))
        waits_ns = self._waits(job, heard_ns, others)
        self._jobs.append(job)
        return waits_ns, max(others, key=lambda other: _overlap(other, job), default=None)

    def _change(self, now_ns: int) -> None:
        cause = MEANING[self.account] if self.is_up else DOWN
        if not self._changes or self._changes[-1][1] != cause:
            self._changes.append((now_ns, cause))

    def _lose(self, since_ns: int) -> None:
        while self._changes and self._changes[-1][0] >= since_ns:
            self._changes.pop()
        self._changes.append((since_ns, LOST))

    @property
    def _known_from_ns(self) -> int:
        """Since when everything is kept; 0: since ever."""
        firsts = [self._jobs[0].begin_ns] if len(self._jobs) == self._jobs.maxlen else []
        firsts += [self._changes[0][0]] if len(self._changes) == self._changes.maxlen else []
        return max(firsts, default=0)

    def _during(self, begin_ns: int, end_ns: int) -> Iterator[JobRecord]:
        """Its jobs that ran in a piece of time, the last first."""
        for job in reversed(self._jobs):
            if job.end_ns <= begin_ns:
                return
            if job.begin_ns < end_ns:
                yield job

    def _waits(self, job: JobRecord, heard_ns: int, others: list[JobRecord]) -> dict[str, int]:
        """`others`: its jobs in the time of the wait, the last first."""
        found = dict.fromkeys(WAIT_CAUSES, 0)
        known_ns = min(max(self._known_from_ns, job.ready_ns), job.begin_ns)
        found[UNKNOWN] = known_ns - job.ready_ns
        end_ns, preemptible_ns = job.begin_ns, job.preempted_before_ns
        for begin_ns, other in [*((max(other.end_ns, known_ns), other) for other in others), (known_ns, None)]:
            on_way_ns = max(end_ns - max(begin_ns, job.dispatch_ns), 0)
            lost_ns = min(preemptible_ns, on_way_ns)
            preemptible_ns -= lost_ns
            found[PREEMPTED] += lost_ns
            found[OVERHEAD] += on_way_ns - lost_ns
            self._add_not_handed(found, begin_ns, min(end_ns, job.dispatch_ns), heard_ns)
            end_ns = min(end_ns, begin_ns)
            if other is not None:
                busy_from_ns = min(max(other.begin_ns, known_ns), end_ns)
                found[BUSY] += end_ns - busy_from_ns
                end_ns = busy_from_ns
        return {cause: ns for cause, ns in found.items() if ns}

    def _add_not_handed(self, found: dict[str, int], begin_ns: int, end_ns: int, heard_ns: int) -> None:
        """Of a piece of time before a job was handed over, in which the unit did no other."""
        if end_ns <= begin_ns:
            return
        explained_ns = 0
        for cause, since_ns, until_ns in self._causes(begin_ns, end_ns):
            unheard_ns = 0 if cause in (LOST, DOWN) else max(min(until_ns, heard_ns) - since_ns, 0)
            found[OVERHEAD] += unheard_ns
            found[cause] += until_ns - since_ns - unheard_ns
            explained_ns += until_ns - since_ns
        found[OVERHEAD] += end_ns - begin_ns - explained_ns

    def _causes(self, begin_ns: int, end_ns: int) -> Iterator[tuple[str, int, int]]:
        """(cause, begin, end) over a piece of time, the last first; what was before the first change has none."""
        for since_ns, cause in reversed(self._changes):
            if since_ns < end_ns:
                yield cause, max(since_ns, begin_ns), end_ns
                end_ns = since_ns
            if since_ns <= begin_ns:
                return

    # its idle time

    @property
    def idle_cause(self) -> str:
        """Of its time now: overhead while it has a job or its process is not up."""
        return OVERHEAD if self.held or not self.is_up else NAMES.get(self.account, UNEXPLAINED)

    @property
    def cut_until_ns(self) -> int:
        """No slice that may still come ends before this while the unit has a job."""
        return self._cut_ns

    def note_idle(self, now_ns: int, cause: str) -> Iterator[IdleSlice]:
        """From now on its idle time has this cause; what is left of the slice before, if that had another."""
        if cause != self._idle_cause:
            if self._idle_cause and now_ns > self._cut_ns:
                yield IdleSlice(self.name, self._idle_cause, self._cut_ns, now_ns)
            self._idle_cause, self._cut_ns = cause, now_ns

    def cut(self, job: JobRecord) -> Iterator[IdleSlice]:
        """The piece between the job before and this one; only of a slice of overhead, for in others it has no job."""
        if self._idle_cause == OVERHEAD:
            if job.begin_ns > self._cut_ns:
                lost_ns = min(job.preempted_before_ns, job.begin_ns - self._cut_ns)
                yield IdleSlice(self.name, OVERHEAD, self._cut_ns, job.begin_ns, lost_ns)
            self._cut_ns = max(self._cut_ns, job.end_ns)


class IdleCutter:
    """Cuts the idle time of `units` into slices, while a run goes on or afterwards, in the order of their ends.

    To be told each step before its events are, then each `account` that was noted after it and each `job` whose end it
    heard; after the last one `end`. What `step` and `end` hand back are the slices that are known by then.
    """

    def __init__(self, units: Iterable[UnitHistory]) -> None:
        self._units = tuple(units)
        self._now_ns: int | None = None  # of the last step; None before the run's start
        self._held: list[tuple[int, int, IdleSlice]] = []
        self._count = 0

    def settle(self) -> list[IdleSlice]:
        """Before the next step: note what the last one left each unit with; slices that end before any to come."""
        if self._now_ns is None:
            return []
        until_ns = NEVER
        for unit in self._units:
            self._hold(unit.note_idle(self._now_ns, unit.idle_cause))
            until_ns = min(until_ns, unit.cut_until_ns if unit.held else self._now_ns)
        return self._take(until_ns)

    def step(self, now_ns: int) -> None:
        """The time of the next step, once the run has started."""
        self._now_ns = now_ns

    def account(self, since_ns: int, unit: UnitHistory, account: int) -> None:
        """From `since_ns` on the time of `unit` without a job goes to `account`.

        That is the time of the last step, or of a release before it which that step did late.
        """
        if account == ledger.ASSIGNED and self._now_ns is not None and since_ns < self._now_ns:
            self._hold(unit.note_idle(since_ns, OVERHEAD))

    def job(self, unit: UnitHistory, job: JobRecord) -> None:
        """A job whose end the last step heard; those of a unit come in the order in which it did them."""
        self._hold(unit.cut(job))

    def end(self) -> list[IdleSlice]:
        """The slices that are left, until the last step; nothing may be told after it."""
        if self._now_ns is not None:
            for unit in self._units:
                self._hold(unit.note_idle(self._now_ns, ""))
        return self._take(NEVER)

    def _hold(self, slices: Iterable[IdleSlice]) -> None:
        for piece in slices:
            self._count += 1
            heappush(self._held, (piece.end_ns, self._count, piece))

    def _take(self, until_ns: int) -> list[IdleSlice]:
        taken = []
        while self._held and self._held[0][0] <= until_ns:
            taken.append(heappop(self._held)[2])
        return taken


def _overlap(other: JobRecord, job: JobRecord) -> int:
    """How long `other` ran while `job` waited."""
    return min(other.end_ns, job.begin_ns) - max(other.begin_ns, job.ready_ns)
