"""Explains the past of a unit: divides its idle time into slices with causes, and each wait of a job into causes.

Rule: at any time a unit has a job, or is idle for one cause. The timeline (timeline.py) says whether the unit had a job
and whether its process was up. The accounts of the scheduler's ledger say why the unit had no job.

Every nanosecond from a job's `ready_ns` to its `begin_ns` has one cause, the first of this list that holds:
- busy: the unit did another job;
- lost: the unit did a job that was lost with the unit's process;
- down: the unit's process was down;
- overhead: the scheduler had not heard yet that the input was there;
- throttled: the unit's duty did not let it work yet;
- blocked: no output slot was free, the limit of frames in flight was reached, or late latching delayed the job;
- held: the policy or the order of frames held the job;
- preempted: the job was handed over, but the unit had no core;
- overhead: the job was handed over and on its way.

The history is bounded: it keeps the last `kept` jobs and changes of each unit. If a wait began before these, the cause
of its earlier part is `unknown`.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator
from heapq import heappop, heappush
from typing import Final, NamedTuple

from trilane.scheduler import ledger
from trilane.scheduler.events import NEVER, Job
from trilane.scheduler.ledger import NAMES, JobRecord

BUSY, PREEMPTED, OVERHEAD = "busy", ledger.PREEMPTED, ledger.OVERHEAD
THROTTLED, JOIN = NAMES[ledger.THROTTLED], NAMES[ledger.JOIN]
#: The cause of the time in which a unit has neither a job nor a noted cause. It is in no sum, so that a gap is visible.
UNEXPLAINED = "unexplained"
LOST, DOWN, HELD, UNKNOWN = "lost", "down", "held", "unknown"
#: The causes of a job's wait.
WAIT_CAUSES: Final = (BUSY, LOST, DOWN, THROTTLED, NAMES[ledger.BLOCKED], HELD, PREEMPTED, OVERHEAD, UNKNOWN)
#: The cause of a job's wait by the account of its unit, after the scheduler has heard of the job's input.
MEANING: Final = {**NAMES, ledger.ASSIGNED: OVERHEAD, ledger.STARVED: HELD, ledger.JOIN: HELD}
KEPT: Final = 4096

#: The stage and the frame of a job that has ended.
Key = tuple[str, int]


class Handed(NamedTuple):
    """A job that was handed to its unit and has not ended.

    `at_ns`: time of the hand-over.
    `heard_ns`: time at which the scheduler heard of the job's last input.
    `after`: keys of the jobs whose end the scheduler heard of in the step that handed this job over.
    """

    job: Job
    at_ns: int
    heard_ns: int
    after: tuple[Key, ...]


class IdleSlice(NamedTuple):
    """A time in which no job ran on the unit, for one cause.

    `cause`: OVERHEAD, UNEXPLAINED, or one of the names in `trilane.scheduler.ledger.NAMES`, such as JOIN.
    `preempted_ns`: part of this time in which the unit had no core.
    `late`: for JOIN, the stages whose output was missing when the slice began, joined by commas; else "".
    """

    unit: str
    cause: str
    begin_ns: int
    end_ns: int
    preempted_ns: int = 0
    late: str = ""


class UnitHistory:
    """The recent past of one unit.

    `kept`: number of last jobs, and of last changes of the cause of waits, that are kept to explain waits.
    `held`: jobs that were handed to the unit, the running job first.
    `account`: account of the ledger that gets the unit's time without a job.
    `late`: stages for whose output the unit waits, joined by commas, while `account` is JOIN.
    `is_up`: whether the unit's process is up and ready, and no kill is under way.
    `stopped_ns`: last time at which the unit's process was seen stopped by a signal; 0: never.
    `cut_ns`: time up to which the unit's time is already divided; no slice can end earlier from now on.
    """

    def __init__(self, name: str, kept: int = KEPT) -> None:
        self.name = name
        self.held: deque[Handed] = deque()
        self.account = ledger.STARVED
        self.late = ""
        self.is_up = self._is_ending = False
        self.stopped_ns = 0
        self._down_ns: int | None = None  # start of the time in which its process is down, after it was up
        self._jobs: deque[JobRecord] = deque(maxlen=kept)
        self._changes: deque[tuple[int, str]] = deque(maxlen=kept)
        self._idle_cause = self._idle_late = ""
        self.cut_ns = 0

    # its process

    def rise(self, now_ns: int) -> int | None:
        """Note that the process is up. Return the time in ns at which it went down; None for its first start.

        While a kill of the process is under way, note nothing and return None.
        """
        if self._is_ending:
            return None
        down_ns, self._down_ns, self.is_up = self._down_ns, None, True
        self._change(now_ns)
        return down_ns

    def fall(self, now_ns: int, *, is_gone: bool) -> None:
        """Note that the process is gone (`is_gone`), or that the scheduler kills it.

        If the process was up and had a job, the time since the hand-over of this job counts as lost.
        """
        if self.is_up:
            if self.held:
                self._lose(self.held[0].at_ns)
            self._down_ns = now_ns
        self.is_up, self._is_ending = False, not is_gone
        self._change(now_ns)

    def take(self, job: int) -> Handed | None:
        """Remove and return the job with the id `job`, which has ended; None if the job was lost with its process."""
        return self.held.popleft() if self.held and self.held[0].job.id == job else None

    # why its jobs waited

    def enter(self, now_ns: int, account: int) -> None:
        """From now on, book the unit's time without a job on `account`."""
        self.account = account
        self._change(now_ns)

    def explain(self, job: JobRecord, heard_ns: int) -> tuple[dict[str, int], JobRecord | None]:
        """Return (ns of the job's wait by cause, job that the unit did for the longest part of the wait).

        Causes with 0 ns are left out. The second value is None if the unit did no other job in the wait.

        `job`: next job of the unit that has ended.
        `heard_ns`: time at which the scheduler heard of the job's last input.
        """
        others = list(self._during(job.ready_ns, job.begin_ns))
        waits_ns = self._waits(job, heard_ns, others)
        self._jobs.append(job)

        def overlap_ns(other: JobRecord) -> int:
            return min(other.end_ns, job.begin_ns) - max(other.begin_ns, job.ready_ns)

        return waits_ns, max(others, key=overlap_ns, default=None)

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
        """The time in ns from which on all jobs and changes are kept; 0: all are kept."""
        firsts = [self._jobs[0].begin_ns] if len(self._jobs) == self._jobs.maxlen else []
        firsts += [self._changes[0][0]] if len(self._changes) == self._changes.maxlen else []
        return max(firsts, default=0)

    def _during(self, begin_ns: int, end_ns: int) -> Iterator[JobRecord]:
        """Yield the unit's jobs that ran at any time between two times, the latest first."""
        for job in reversed(self._jobs):
            if job.end_ns <= begin_ns:
                return
            if job.begin_ns < end_ns:
                yield job

    def _waits(self, job: JobRecord, heard_ns: int, others: list[JobRecord]) -> dict[str, int]:
        """Return the wait of `job` in ns by cause. `others`: the unit's jobs during the wait, the latest first."""
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
        """Add to `found` the ns of each cause, for a time in which the unit had neither this job nor another."""
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
        """Yield (cause, begin in ns, end in ns) of the parts of a time since the first kept change, latest first."""
        for since_ns, cause in reversed(self._changes):
            if since_ns < end_ns:
                yield cause, max(since_ns, begin_ns), end_ns
                end_ns = since_ns
            if since_ns <= begin_ns:
                return

    # its idle time

    @property
    def idle_cause(self) -> str:
        """The cause of the unit's idle time now: OVERHEAD while the unit has a job, or its process is not up."""
        return OVERHEAD if self.held or not self.is_up else NAMES.get(self.account, UNEXPLAINED)

    def note_idle(self, now_ns: int, cause: str) -> Iterator[IdleSlice]:
        """Set the cause of idle time from `now_ns` on. If the cause changes, yield the slice that ends now."""
        if cause != self._idle_cause:
            if self._idle_cause and now_ns > self.cut_ns:
                yield IdleSlice(self.name, self._idle_cause, self.cut_ns, now_ns, late=self._idle_late)
            self._idle_cause, self.cut_ns = cause, now_ns
            self._idle_late = self.late if cause == JOIN else ""

    def cut(self, job: JobRecord) -> Iterator[IdleSlice]:
        """Yield the idle slice, if any, between the unit's last job and this job.

        Only OVERHEAD is cut by jobs: the unit may have jobs while it lasts. Every other cause ends before the next job.
        """
        if self._idle_cause == OVERHEAD:
            if job.begin_ns > self.cut_ns:
                lost_ns = min(job.preempted_before_ns, job.begin_ns - self.cut_ns)
                yield IdleSlice(self.name, OVERHEAD, self.cut_ns, job.begin_ns, lost_ns)
            self.cut_ns = max(self.cut_ns, job.end_ns)


class IdleCutter:
    """Divides the idle time of `units` into slices, in the order of their ends, during a run or after it.

    For each step the caller calls `settle` and then `step`. After that it calls `account` for each account that the
    step changed, and `job` for each job whose end the scheduler heard of. The last call is `end`. `settle` and `end`
    return the slices that are complete.
    """

    def __init__(self, units: Iterable[UnitHistory]) -> None:
        self._units = tuple(units)
        self._now_ns: int | None = None  # time of the last step; None before the run's start
        self._held: list[tuple[int, int, IdleSlice]] = []
        self._count = 0

    def settle(self) -> list[IdleSlice]:
        """Note the state of each unit after the last step. Return the slices whose place in the order is now certain.

        No slice that comes later can end before these.
        """
        if self._now_ns is None:
            return []
        until_ns = NEVER
        for unit in self._units:
            self._hold(unit.note_idle(self._now_ns, unit.idle_cause))
            until_ns = min(until_ns, unit.cut_ns if unit.held else self._now_ns)
        return self._take(until_ns)

    def step(self, now_ns: int) -> None:
        """Note the time of the next step; called once the run has started."""
        self._now_ns = now_ns

    def account(self, since_ns: int, unit: UnitHistory, account: int) -> None:
        """Note that the unit's time goes to `account` from `since_ns` on.

        `since_ns`: time of the last step; or an earlier time, at which a frame was due that this step released late.
        """
        if account == ledger.ASSIGNED and self._now_ns is not None and since_ns < self._now_ns:
            self._hold(unit.note_idle(since_ns, OVERHEAD))

    def job(self, unit: UnitHistory, job: JobRecord) -> None:
        """Note a job whose end the scheduler heard of in the last step; a unit's jobs come in order of their ends."""
        self._hold(unit.cut(job))

    def end(self) -> list[IdleSlice]:
        """Return all slices up to the last step that were not returned yet; this is the last call."""
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
