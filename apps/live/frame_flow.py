"""Where the frames of a run are, from its steps alone: waiting before a stage, in a job, presented or gone.

Rule: every frame is counted where the scheduler has it (scheduler/flow.py); how many were lost or dropped, and why, is
told by the journal's counts.
"""

from __future__ import annotations

from bisect import bisect_right
from collections import deque
from collections.abc import Iterator, Mapping
from itertools import pairwise
from typing import NamedTuple

from trilane.scheduler.events import (
    Action,
    Dispatch,
    Event,
    FrameRequest,
    Graph,
    Job,
    JobDone,
    JobFailed,
    Settings,
    Stop,
    UnitDied,
)

SOURCE = "source"
MOST_FOLLOWED = 4096


class Presented(NamedTuple):
    """A frame at its end. `interval_ns`: since the one before, None of the first. `latency_ns`: of its picture."""

    end_ns: int
    interval_ns: int | None
    latency_ns: int


class Held(NamedTuple):
    """A job that a unit has, and when it was handed to it."""

    job: Job
    since_ns: int


class Done(NamedTuple):
    """A job that has ended, and what ended it."""

    job: Job
    event: JobDone


class _Frame:
    """`sampled_ns`: of its pose. `latency_ns`: once known. `skips`: whether it takes the bypass."""

    __slots__ = ("latency_ns", "sampled_ns", "skips")

    def __init__(self) -> None:
        self.sampled_ns = self.latency_ns = 0
        self.skips = False


class FrameFlow:
    """Fed with the steps of a run, and with the counts that follow from them.

    `waiting`: frames before each stage but the first. `held`: the jobs of each unit, the running one first.
    `presented`, `skipped`, `taken`: frames that reached the end, took the bypass to it, were ever in flight.
    """

    def __init__(self, graph: Graph, settings: Settings) -> None:
        names = [stage.name for stage in graph.stages]
        self.waiting = dict.fromkeys(names, 0)
        self.held: dict[str, deque[Held]] = {unit: deque() for unit in graph.units}
        self.presented = self.skipped = self.taken = 0
        self._gone = 0
        self._dropped: Mapping[str, int] = {}
        self._settings = settings
        self._first, self._last, self._latency_to = names[0], names[-1], graph.latency_to
        self._next = dict(pairwise(names))
        self._bypass_end = graph.bypass[1] if graph.bypass is not None else ""
        self._frames: dict[int, _Frame] = {}
        self._last_end_ns: int | None = None
        self._asked = 0
        self._is_closed = self._is_over = False

    def step(self, now_ns: int, events: tuple[Event, ...], actions: tuple[Action, ...]) -> Iterator[Done | Presented]:
        """The jobs that this step ended, and the frames that it presented."""
        for event in events:
            if type(event) is JobDone:
                yield from self._end(event)
            elif type(event) is JobFailed:
                self._take(event.unit, event.job)
            elif type(event) is UnitDied:
                self._reclaim(event.unit)
            elif type(event) is FrameRequest:
                self._asked += event.frames
            elif type(event) is Stop:
                self._is_closed = True
        for action in actions:
            if type(action) is Dispatch:
                self._begin(now_ns, action.job)

    def count(self, lost: Mapping[str, int], dropped: Mapping[str, int]) -> None:
        """All frames lost and dropped until now, by the cause's key in the report."""
        for key, frames in dropped.items():
            edge = key.rpartition(":")[0]
            if not self._is_over and not edge.startswith(f"{SOURCE}->"):
                self.waiting[edge.partition("->")[2]] -= frames - self._dropped.get(key, 0)
        self._dropped = dict(dropped)
        self._gone = sum(lost.values()) + sum(dropped.values()) - self._dropped_at_source()

    def end(self) -> None:
        """The run is over: what was in flight is lost, and counted so."""
        self.waiting = dict.fromkeys(self.waiting, 0)
        for jobs in self.held.values():
            jobs.clear()
        self._is_closed = self._is_over = True

    @property
    def in_flight(self) -> int:
        """Frames that were taken and neither presented nor lost nor dropped."""
        return self.taken - self.presented - self._gone

    @property
    def not_begun(self) -> int:
        """Frames of the run that were never taken nor dropped before they could be."""
        return self._settings.frames - self.taken - self._dropped_at_source()

    def waiting_at_source(self, running_ns: int | None) -> int:
        """Released frames that no job has taken yet; 0 of a run without a rate.

        `running_ns`: how long all units have been ready; None where they have not been.
        """
        if self._is_closed:
            return 0
        settings = self._settings
        if settings.asked:
            released = self._asked
        elif settings.arrivals_ns:
            released = 0 if running_ns is None else bisect_right(settings.arrivals_ns, running_ns)
        elif settings.period_ns:
            released = 0 if running_ns is None else running_ns // settings.period_ns + 1
        else:
            return 0
        return max(min(released - settings.frames, 0) + self.not_begun, 0)

    def _dropped_at_source(self) -> int:
        return sum(frames for key, frames in self._dropped.items() if key.startswith(f"{SOURCE}->"))

    def _begin(self, now_ns: int, job: Job) -> None:
        self.held[job.unit].append(Held(job, now_ns))
        if job.stage != self._first:
            self.waiting[job.stage] -= 1
            return
        self.taken += 1
        self._frames[job.frame] = _Frame()
        if len(self._frames) > MOST_FOLLOWED:  # those that were lost or dropped stay until they are the oldest
            del self._frames[next(iter(self._frames))]

    def _end(self, event: JobDone) -> Iterator[Done | Presented]:
        job = self._take(event.unit, event.job)
        if job is None:
            return
        yield Done(job, event)
        frame = self._frames.get(job.frame) or _Frame()
        if job.stage == self._first:
            frame.sampled_ns = event.t_sampled_ns
        if job.stage == self._latency_to:
            frame.latency_ns = event.t_end_ns - frame.sampled_ns
        frame.skips |= event.skips
        if job.stage != self._last:
            self.waiting[self._bypass_end if event.skips else self._next[job.stage]] += 1
            return
        self._frames.pop(job.frame, None)
        self.presented += 1
        self.skipped += frame.skips
        interval_ns = None if self._last_end_ns is None else event.t_end_ns - self._last_end_ns
        self._last_end_ns = event.t_end_ns
        yield Presented(event.t_end_ns, interval_ns, frame.latency_ns)

    def _take(self, unit: str, job: int) -> Job | None:
        """The job that has ended; None for one that was lost with the process that did it."""
        jobs = self.held[unit]
        return jobs.popleft().job if jobs and jobs[0].job.id == job else None

    def _reclaim(self, unit: str) -> None:
        """The unit's process is gone: what it worked on is lost, what it only held waits again."""
        jobs = self.held[unit]
        for held in list(jobs)[1:]:
            if held.job.stage != self._first:
                self.waiting[held.job.stage] += 1
        jobs.clear()
