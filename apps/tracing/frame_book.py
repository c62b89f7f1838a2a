"""Which frames are where, by the records of a journal alone. Rule: nothing is decided here; the scheduler did.

A frame waits before the first stage from its release on, before another stage from the step in which the scheduler
heard that the stage before had ended, until it is handed to a unit, dropped or lost. Frames overtake nobody, so that
those which are dropped where several wait are the oldest, but for one that is turned away before the first stage.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator, Mapping
from itertools import pairwise
from typing import NamedTuple

from trilane.pipeline.journal import Begun, Counted, Stepped
from trilane.scheduler.causes import DropCause, OutcomeKind
from trilane.scheduler.events import (
    Dispatch,
    Event,
    Finish,
    FrameRequest,
    Job,
    JobDone,
    JobFailed,
    Stop,
    UnitDied,
    UnitReady,
)

UNKNOWN = -1  # of a frame that is gone, and nobody knows which it was


class Presented(NamedTuple):
    """A frame that went through. `end_ns`: of its last job."""

    frame: int
    release_ns: int
    end_ns: int


class Gone(NamedTuple):
    """A frame that was not presented. `frame`: UNKNOWN where it cannot be told. `cause`: as in the report."""

    frame: int
    release_ns: int
    at_ns: int
    kind: str
    cause: str


class FrameBook:
    """Fed the records of one run. `hear` is called with every frame that leaves it, in order.

    `waiting`: of each stage the frames that wait before it, the oldest first. `released_ns`: of each that waits or
    is in flight. `in_flight`: those that have begun. `start_ns`: when the last unit got ready; None before.
    """

    def __init__(self, begun: Begun, hear: Callable[[Presented | Gone], None]) -> None:
        self._graph, self._settings, self._hear = begun.graph, begun.settings, hear
        stages = [stage.name for stage in begun.graph.stages]
        self._first, self._last = stages[0], stages[-1]
        self._after = dict(pairwise(stages))
        self.waiting: dict[str, deque[int]] = {stage: deque() for stage in stages}
        self.released_ns: dict[int, int] = {}
        self.in_flight: set[int] = set()
        self._waits_before: dict[int, str] = {}
        self._skipping: set[int] = set()
        self._open: dict[int, Job] = {}
        self._lost: deque[int] = deque()  # that have left, and for which no cause was counted yet
        self._counts: dict[tuple[str, str], int] = {}
        self._not_ready = set(begun.graph.units)
        self.start_ns: int | None = None
        self._next, self._end = 0, begun.settings.frames
        self._handlers: dict[type, Callable[[int, Event], None]] = {
            JobDone: self._on_done,
            JobFailed: self._on_failed,
            UnitDied: self._on_died,
            UnitReady: self._on_ready,
            FrameRequest: self._on_request,
            Stop: self._on_stop,
        }

    def step(self, step: Stepped) -> None:
        """What a step of the scheduler says of the frames."""
        for event in step.events:
            if (handler := self._handlers.get(type(event))) is not None:
                handler(step.now_ns, event)
        self._release(step.now_ns)
        for action in step.actions:
            if type(action) is Dispatch:
                self._on_dispatch(step.now_ns, action.job)
            elif type(action) is Finish and action.outcome.kind in (OutcomeKind.ABORTED, OutcomeKind.GAVE_UP):
                self._lose_all()

    def count(self, counted: Counted) -> None:
        """Frames that were lost or dropped since the last such record leave."""
        for cause, more in self._more("lost", counted.lost):
            for _ in range(more):
                self._leave(self._lost.popleft() if self._lost else UNKNOWN, counted.now_ns, "lost", cause)
        for cause, more in self._more("dropped", counted.dropped):
            for _ in range(more):
                self._leave(self._dropped(cause), counted.now_ns, "dropped", cause)

    def _more(self, kind: str, counts: Mapping[str, int]) -> Iterator[tuple[str, int]]:
        for cause, count in counts.items():
            more = count - self._counts.get((kind, cause), 0)
            self._counts[kind, cause] = count
            yield cause, more

    def _dropped(self, cause: str) -> int:
        """The frame that was dropped for `cause`, as `producer->consumer:kind`."""
        edge, _, kind = cause.rpartition(":")
        producer, _, consumer = edge.partition("->")
        waiting = self.waiting.get(consumer, ())
        is_bypass = (producer, consumer) == self._graph.bypass
        found = [frame for frame in waiting if (frame in self._skipping) == is_bypass]
        if not found:
            return UNKNOWN
        return found[-1] if kind == DropCause.QUEUE_FULL else found[0]

    def _leave(self, frame: int, at_ns: int, kind: str, cause: str) -> None:
        self._forget(frame)
        self._hear(Gone(frame, self.released_ns.pop(frame, at_ns), at_ns, kind, cause))

    def _release(self, now_ns: int) -> None:
        """Frames whose time has come wait before the first stage; without a rate none does."""
        settings = self._settings
        if self.start_ns is None or not (settings.period_ns or settings.arrivals_ns):
            return
        while self._next < self._end and (at_ns := self.start_ns + self._after_start_ns(self._next)) <= now_ns:
            self._wait_first(self._next, at_ns)
            self._next += 1

    def _after_start_ns(self, frame: int) -> int:
        arrivals = self._settings.arrivals_ns
        return arrivals[frame] if arrivals else frame * self._settings.period_ns

    def _wait_first(self, frame: int, at_ns: int) -> None:
        self._wait(frame, self._first)
        self.released_ns[frame] = at_ns

    def _on_dispatch(self, now_ns: int, job: Job) -> None:
        self._open[job.id] = job
        self._take(job.frame)
        if job.stage == self._first:
            self.released_ns.setdefault(job.frame, now_ns)
            self.in_flight.add(job.frame)

    def _on_done(self, _now_ns: int, event: Event) -> None:
        assert isinstance(event, JobDone)
        job = self._open.pop(event.job, None)
        if job is None:  # it was lost with the process that did it
            return
        if job.stage == self._last:
            self._forget(job.frame)
            self._hear(Presented(job.frame, self.released_ns.pop(job.frame), event.t_end_ns))
        elif event.skips and self._graph.bypass is not None:
            self._skipping.add(job.frame)
            self._wait(job.frame, self._graph.bypass[1])
        else:
            self._wait(job.frame, self._after[job.stage])

    def _wait(self, frame: int, stage: str) -> None:
        self.waiting[stage].append(frame)
        self._waits_before[frame] = stage

    def _take(self, frame: int) -> None:
        """It waits no longer."""
        if (stage := self._waits_before.pop(frame, None)) is not None:
            self.waiting[stage].remove(frame)

    def _forget(self, frame: int) -> None:
        self._take(frame)
        self.in_flight.discard(frame)
        self._skipping.discard(frame)

    def _on_failed(self, _now_ns: int, event: Event) -> None:
        assert isinstance(event, JobFailed)
        job = self._open.pop(event.job, None)
        if job is not None:
            self._lose(job.frame)
            self._on_stop(_now_ns, Stop())

    def _on_died(self, _now_ns: int, event: Event) -> None:
        """The frame that its unit worked on is lost; what it only held waits again, unless it was to begin."""
        assert isinstance(event, UnitDied)
        jobs = [job for job in self._open.values() if job.unit == event.unit]
        for place, job in enumerate(jobs):
            del self._open[job.id]
            if place == 0 or job.stage == self._first:
                self._lose(job.frame)
            else:
                self._wait(job.frame, job.stage)
                self.waiting[job.stage] = deque(sorted(self.waiting[job.stage]))

    def _on_ready(self, now_ns: int, event: Event) -> None:
        assert isinstance(event, UnitReady)
        self._not_ready.discard(event.unit)
        if self.start_ns is None and not self._not_ready:
            self.start_ns = now_ns

    def _on_request(self, now_ns: int, event: Event) -> None:
        assert isinstance(event, FrameRequest)
        for frame in range(self._next, min(self._next + event.frames, self._end)):
            self._wait_first(frame, now_ns)
            self._next += 1

    def _on_stop(self, _now_ns: int, _event: Event) -> None:
        """Nothing more is released, and what waits before the first stage is forgotten."""
        self._end = self._next
        for frame in list(self.waiting[self._first]):
            self._take(frame)
            del self.released_ns[frame]

    def _lose(self, frame: int) -> None:
        """The frame is no more; why, the next count says."""
        self._forget(frame)
        self._lost.append(frame)

    def _lose_all(self) -> None:
        for frame in sorted(self.in_flight):
            self._lose(frame)
