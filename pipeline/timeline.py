"""Turns the journal of a run into frames, jobs, waits and idle time.

Rule: no other module interprets a journal's events. The timeline uses two parts of the scheduler. The source
(policy.py) says which frames are released and wait. The frame state (state.py) has a frame's sampling time and latency.

A frame waits before the first stage from its release on. It waits before another stage from the step in which the
scheduler heard that the frame's input there was ready. Where branches meet, all inputs have to be ready. The wait ends
when the frame is handed to a unit, dropped or lost. A track knows before which stages the frames wait (tracks.py).
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator, Mapping
from typing import Any, NamedTuple

from trilane.pipeline.journal import Accounted, Counted, Record, Stepped, Stopped, Worked
from trilane.pipeline.tracks import UNKNOWN, GoneFrame, track_of
from trilane.pipeline.unit_history import KEPT, Handed, IdleCutter, IdleSlice, Key, UnitHistory
from trilane.scheduler.events import (
    Action,
    Dispatch,
    Finish,
    Graph,
    Hold,
    JobDone,
    JobFailed,
    Kill,
    OutcomeKind,
    SchedulerStalled,
    Settings,
    UnitDied,
    UnitReady,
)
from trilane.scheduler.ledger import JOIN, JobRecord
from trilane.scheduler.state import FrameState, fates


class Presented(NamedTuple):
    """A frame that was presented.

    `frame`: its number.
    `release_ns`: time of its release.
    `end_ns`: end of its last job.
    `interval_ns`: time since the presentation of the frame before. None for the first frame, and if a viewer held the
    run in this time, because the frame was not slow then.
    `latency_ns`: time from its sampling to the end of the stage at which the latency ends; None if this stage did not
    do the frame.
    `skips`: whether it took the bypass.
    `rung`: rung of its work.
    """

    frame: int
    release_ns: int
    end_ns: int
    interval_ns: int | None
    latency_ns: int | None
    skips: bool
    rung: int

    @property
    def before_ns(self) -> int | None:
        """The time at which the frame before it was presented; None if `interval_ns` is None."""
        return None if self.interval_ns is None else self.end_ns - self.interval_ns


class Gone(NamedTuple):
    """A frame that was not presented.

    `frame`: its number; UNKNOWN if the journal does not show it.
    `release_ns`: time of its release.
    `at_ns`: time at which the frame was counted as lost or dropped.
    `kind`: `lost` or `dropped`.
    `cause`: key of the cause in the report.
    """

    frame: int
    release_ns: int
    at_ns: int
    kind: str
    cause: str


class EndedJob(NamedTuple):
    """A job whose end the scheduler has heard of. `handed`: the job. `event`: event with the job's times."""

    handed: Handed
    event: JobDone


class ExplainedJob(NamedTuple):
    """A job in the journal with its times, and the causes of its wait.

    `figures`: metrics of its stage for this job, by name.
    `waits_ns`: time in ns of each cause of its wait, without zeros; the sum is `job.begin_ns - job.ready_ns`.
    `behind`: job that its unit did for the longest part of the wait; None if the unit did no job in the wait.
    `after`: jobs whose end the scheduler heard of in the step that handed this job over.
    `presented`: frame that this job presented; None if it presented none.
    `rung`: rung of the frame's work.
    `skips`: whether the frame takes the bypass; only for a job of the stage at which the bypass begins, else False.
    `stopped_ns`: last time at which its unit was seen stopped by a signal; 0: never.
    """

    job: JobRecord
    figures: Mapping[str, float]
    waits_ns: Mapping[str, int]
    behind: JobRecord | None
    after: tuple[Key, ...]
    presented: Presented | None
    rung: int
    skips: bool
    stopped_ns: int = 0

    @property
    def key(self) -> Key:
        return self.job.stage, self.job.frame

    @property
    def cause(self) -> str:
        """The cause of the longest part of the job's wait; "" if the job did not wait."""
        return max(self.waits_ns, key=self.waits_ns.__getitem__, default="")


class Span(NamedTuple):
    """A part of the run, from `begin_ns` to `end_ns` of the run's clock."""

    begin_ns: int
    end_ns: int


class Down(NamedTuple):
    """A time in which a unit's process was down; it was up again at `end_ns`."""

    unit: str
    begin_ns: int
    end_ns: int


#: A fact that a record adds. An `EndedJob` comes from the step in which the scheduler heard of the job's end, an
#: `ExplainedJob` from the job's own record.
Fact = EndedJob | Presented | Gone | ExplainedJob | IdleSlice


class Timeline:
    """Takes the records of a run in order: `add` returns the facts of a record, and `end` the last idle slices.

    `graph`, `settings`: graph and settings of the run.
    `waits`: whether to explain the waits of jobs; this takes longer than all other work.
    `idle`: whether to return idle time as slices, in the order of their ends.
    `kept`: number of last jobs, and of last changes, of each unit that are kept to explain waits.

    `units`: recent past of each unit, by name.
    `start_ns`: time at which the last unit became ready, so that the run started; None before.
    `is_over`: whether the run is over.
    `span`: time from the start of the run to the step that finished the run. None before this step, and for a run that
    never started.
    `presented`: number of presented frames.
    `skipped`: number of presented frames that took the bypass.
    `downs`: latest times in which a unit was down after its start, in the order of their ends.
    `stalls`: latest times in which the scheduler itself did not run, in order.
    """

    def __init__(
        self, graph: Graph, settings: Settings, *, waits: bool = False, idle: bool = False, kept: int = KEPT
    ) -> None:
        self._explains, self._kept = waits, kept
        self.units = {unit: UnitHistory(unit, kept if waits else 0) for unit in graph.units}
        self.start_ns: int | None = None
        self.span: Span | None = None
        self.is_over = False
        self.presented = self.skipped = 0
        self.downs: deque[Down] = deque(maxlen=kept)
        self.stalls: deque[Span] = deque(maxlen=kept)
        self._track = track_of(graph, settings)
        self._first = graph.stages[0].name
        self._lost: deque[GoneFrame] = deque()  # lost frames whose cause was not counted yet
        self._counts: dict[tuple[str, str], int] = {}
        self._requested = settings.frames
        self._ended: dict[Key, tuple[Handed, JobDone, Presented | None]] = {}
        self._last_end_ns: int | None = None
        self._is_held = self._was_held = False
        self._now_ns = 0
        self._cutter = IdleCutter(self.units.values()) if idle else None
        self._handlers: dict[type, Callable[[Any], None]] = {
            JobFailed: self._on_failed,
            UnitReady: self._on_ready,
            UnitDied: self._on_died,
            Hold: self._on_hold,
            SchedulerStalled: lambda event: self.stalls.append(Span(self._now_ns - event.ns, self._now_ns)),
        }

    def add(self, record: Record) -> list[Fact]:
        """Take the next record of the run, and return the facts that it adds.

        The first record, `Begun`, must be left out: `graph` and `settings` come from it.
        """
        if isinstance(record, Stepped):
            return self._step(record)
        if isinstance(record, Counted):
            return [*self._count(record)]
        if isinstance(record, Accounted):
            self._account(record)
        elif isinstance(record, Stopped):
            self.units[record.unit].stopped_ns = record.now_ns
        elif isinstance(record, Worked):
            return self._work(record)
        return []

    def end(self) -> list[IdleSlice]:
        """Return the idle slices up to the last step; called after the last record."""
        return self._cutter.end() if self._cutter is not None else []

    def waiting(self, stage: str) -> list[int]:
        """Return the numbers of the frames that wait before `stage`, the oldest first.

        Before the first stage, these are released frames.
        """
        return self._track.waiting(stage)

    @property
    def frames(self) -> Mapping[int, FrameState]:
        """The frames in flight, by number."""
        return self._track.frames

    @property
    def not_begun(self) -> int:
        """The number of the run's frames that were neither put in flight nor dropped before that."""
        return self._requested - self._track.left

    # records

    def _step(self, step: Stepped) -> list[Fact]:
        facts: list[Fact] = [*self._cutter.settle()] if self._cutter is not None else []
        if self.is_over:
            return facts
        self._now_ns = step.now_ns
        self._track.step(step.now_ns, step.events)
        after: list[Key] = []
        for event in step.events:
            if type(event) is JobDone:  # most events
                facts += self._end(event, after)
            elif (handler := self._handlers.get(type(event))) is not None:
                handler(event)
        if self.start_ns is not None:
            self._track.advance(step.now_ns)
            if self._cutter is not None:
                self._cutter.step(step.now_ns)
        for action in step.actions:
            self._act(action, tuple(after))
        return facts

    def _act(self, action: Action, after: tuple[Key, ...]) -> None:
        if type(action) is Dispatch:
            heard_ns = self._track.begin(action.job, self._now_ns)
            self.units[action.job.unit].held.append(Handed(action.job, self._now_ns, heard_ns, after))
        elif type(action) is Kill:
            self.units[action.unit].fall(self._now_ns, is_gone=False)
        elif type(action) is Finish:
            self._finish(action.outcome.kind)

    def _account(self, accounted: Accounted) -> None:
        now_ns, name, account = accounted
        unit = self.units[name]
        if self._cutter is not None:
            self._cutter.account(now_ns, unit, account)
        unit.enter(now_ns, account)
        unit.late = ",".join(self._track.late(name)) if account == JOIN else ""

    def _work(self, worked: Worked) -> list[Fact]:
        job = worked.job
        unit = self.units[job.unit]
        if self._cutter is not None:
            self._cutter.job(unit, job)
        if not self._explains:
            return []
        handed, event, presented = self._ended.pop((job.stage, job.frame), (None, None, None))
        waits_ns, behind = unit.explain(job, handed.heard_ns if handed is not None else 0)
        after, rung = (handed.after, handed.job.rung) if handed is not None else ((), 0)
        skips = event is not None and event.skips
        return [ExplainedJob(job, worked.figures, waits_ns, behind, after, presented, rung, skips, unit.stopped_ns)]

    def _count(self, counted: Counted) -> Iterator[Gone]:
        """Yield the frames that were lost or dropped since the last record of this kind."""
        for kind, counts, gone in (
            ("lost", counted.lost, self._lost_for),
            ("dropped", counted.dropped, self._track.dropped_for),
        ):
            for cause, count in counts.items():
                for _ in range(count - self._counts.get((kind, cause), 0)):
                    yield Gone(*gone(cause, counted.now_ns), counted.now_ns, kind, cause)
                self._counts[kind, cause] = count

    def _lost_for(self, cause: str, now_ns: int) -> GoneFrame:
        """Return the frame that was lost next. `cause`: key of the cause in the report."""
        if (gone := self._track.lost_for(cause, now_ns)) is not None:
            return gone
        return self._lost.popleft() if self._lost else GoneFrame(UNKNOWN, now_ns)

    # jobs and frames

    def _end(self, event: JobDone, after: list[Key]) -> Iterator[Fact]:
        """Note the end of a job, add its key to `after`, and yield the facts that follow."""
        handed = self.units[event.unit].take(event.job)
        if handed is None:
            return
        job = handed.job
        after.append((job.stage, job.frame))
        frame = self._track.end(job, event, self._now_ns)
        yield EndedJob(handed, event)
        presented = None
        if frame is not None:
            yield (presented := self._present(job.frame, frame, event.t_end_ns))
        if self._explains:
            self._ended[job.stage, job.frame] = handed, event, presented
            # a job whose frame was lost meanwhile has no record and would stay for ever
            if len(self._ended) > self._kept:
                del self._ended[next(iter(self._ended))]

    def _present(self, number: int, frame: FrameState, end_ns: int) -> Presented:
        self.presented += 1
        self.skipped += frame.skips
        interval_ns = None if self._last_end_ns is None or self._was_held else end_ns - self._last_end_ns
        self._last_end_ns, self._was_held = end_ns, self._is_held
        latency_ns = frame.latency_ns if frame.latency_ns >= 0 else None
        return Presented(number, frame.release_ns, end_ns, interval_ns, latency_ns, frame.skips, frame.rung)

    def _on_hold(self, event: Hold) -> None:
        self._is_held, self._was_held = event.frames >= 0, True

    def _on_failed(self, event: JobFailed) -> None:
        handed = self.units[event.unit].take(event.job)
        if handed is not None:
            self._lose(handed.job.frame)
            self._track.stop()

    def _on_ready(self, event: UnitReady) -> None:
        down_ns = self.units[event.unit].rise(self._now_ns)
        if down_ns is not None:
            self.downs.append(Down(event.unit, down_ns, self._now_ns))
        if self.start_ns is None and all(unit.is_up for unit in self.units.values()):
            self.start_ns = self._now_ns
            self._track.start(self._now_ns)

    def _on_died(self, event: UnitDied) -> None:
        """Note that the unit's process is down, and what becomes of the frames of the unit's jobs.

        The function `fates` decides which of these frames are lost. The other frames wait for their stage again.
        """
        unit = self.units[event.unit]
        unit.fall(self._now_ns, is_gone=True)
        for job, is_lost in fates([handed.job for handed in unit.held], {self._first}):
            if is_lost:
                self._lose(job.frame)
            else:
                self._track.give_back(job)
        unit.held.clear()

    def _finish(self, kind: OutcomeKind) -> None:
        """Note that the run is over. If it was aborted or a unit was given up, the frames in flight are lost.

        Frames that this step has dropped are counted by a record after the step.
        """
        self.is_over = True
        if self.start_ns is not None:
            self.span = Span(self.start_ns, self._now_ns)
        if kind in (OutcomeKind.ABORTED, OutcomeKind.GAVE_UP):
            for frame in sorted(self._track.frames):
                self._lose(frame)
        for unit in self.units.values():
            unit.held.clear()

    def _lose(self, frame: int) -> None:
        """Note that the frame is lost; the next `Counted` record has the cause."""
        if (gone := self._track.lose(frame, self._now_ns)) is not None:
            self._lost.append(gone)
