"""Follows the frames in flight of a run by its journal, along a chain or through a graph.

For a graph, a second scheduler takes the run's events and decides about each frame. For a chain, only the jobs in the
journal decide, because the journal may come from an older scheduler. Frames of a chain do not overtake each other:
among frames that wait for the same stage, a drop takes the oldest.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from itertools import pairwise
from typing import Final, NamedTuple

from trilane.scheduler.core import Core
from trilane.scheduler.events import (
    NEVER,
    DropCause,
    Event,
    FrameRequest,
    Graph,
    Hold,
    Job,
    JobDone,
    Settings,
    Stop,
)
from trilane.scheduler.ledger import FrameLeft
from trilane.scheduler.policy import Source
from trilane.scheduler.state import FrameState

SOURCE: Final = "source"
UNKNOWN: Final = -1  # number of a frame that is gone, if the journal does not show which frame it is


class GoneFrame(NamedTuple):
    """A frame that was lost or dropped. `frame`: its number, or UNKNOWN. `release_ns`: time of its release."""

    frame: int
    release_ns: int


class ChainTrack:
    """Follows the frames of a chain by the jobs in the journal; its methods are called in the order of the journal.

    `frames`: frames in flight that are not yet presented, by number.
    """

    def __init__(self, graph: Graph, settings: Settings) -> None:
        names = [stage.name for stage in graph.stages]
        self.frames: dict[int, FrameState] = {}
        turned_away: dict[str, deque[tuple[int, int]]] = {cause: deque() for cause in DropCause}
        self._source = Source(settings, lambda frame, ns, cause: turned_away[cause].append((frame, ns)))
        self._turned_away = turned_away
        self._bypass, self._latency_to = graph.bypass, graph.latency_to
        self._from_release = graph.from_release
        self._first, self._last = names[0], names[-1]
        self._next = dict(pairwise(names))
        self._waiting: dict[str, list[int]] = {name: [] for name in names[1:]}
        self._heard_ns: dict[int, int] = {}

    def waiting(self, stage: str) -> list[int]:
        """Return the numbers of the frames that wait for a stage, the oldest first."""
        return [frame for frame, _ in self._source.queue] if stage == self._first else [*self._waiting[stage]]

    def step(self, now_ns: int, events: tuple[Event, ...]) -> None:
        """Note a step of the scheduler; called before the methods for its events and actions."""
        for event in events:
            if type(event) is FrameRequest:
                self._source.request(event.frames, now_ns)
            elif type(event) is Hold:
                self._source.hold(event.frames, now_ns)
            elif type(event) is Stop:
                self._source.stop()

    def start(self, now_ns: int) -> None:
        """Note that the last unit got ready, so that the run starts."""
        self._source.start(now_ns)

    def advance(self, now_ns: int) -> None:
        """Release the frames that are due; called after the methods for a step's events, and before its actions."""
        self._source.advance(now_ns)

    def stop(self) -> None:
        """Note that no more frames are released, because a job failed."""
        self._source.stop()

    @property
    def left(self) -> int:
        """The number of frames that were put in flight, or were dropped before that."""
        return self._source.left

    def begin(self, job: Job, now_ns: int) -> int:
        """Note that a job is handed to its unit. Return when, in ns, the scheduler heard of the job's last input."""
        if job.stage == self._first:
            self.frames[job.frame] = FrameState(self._take(job.frame, now_ns), NEVER, job.rung)
        elif job.frame in self._waiting[job.stage]:
            self._waiting[job.stage].remove(job.frame)
        return self._heard_ns.get(job.frame, 0)

    def end(self, job: Job, event: JobDone, now_ns: int) -> FrameState | None:
        """Note that a job has ended. Return the job's frame if the job presents it; else None."""
        self._heard_ns[job.frame] = now_ns
        frame = self._frame(job.frame, now_ns)
        # The scheduler's own record computes the latency, so that it is defined once.
        sampled_ns = None
        if job.stage == self._first:
            sampled_ns = frame.release_ns if self._from_release else event.t_sampled_ns
        frame.end_stage(sampled_ns, event.t_end_ns, job.stage == self._latency_to)
        frame.skips |= event.skips
        if job.stage == self._last:
            self._leave(job.frame, now_ns)
            return frame
        skips_to = self._bypass[1] if event.skips and self._bypass is not None else ""
        self._waiting[skips_to or self._next[job.stage]].append(job.frame)
        return None

    def give_back(self, job: Job) -> None:
        """Note that the frame of a job waits again, because the job's unit died."""
        self._waiting[job.stage].append(job.frame)
        self._waiting[job.stage].sort()

    def lose(self, frame: int, now_ns: int) -> GoneFrame:
        """Note that a frame is lost, and return it."""
        return GoneFrame(frame, self._leave(frame, now_ns))

    def lost_for(self, _cause: str, _now_ns: int) -> GoneFrame | None:
        """Return None: `lose` has returned the lost frames of a chain already."""
        return None

    def dropped_for(self, cause: str, now_ns: int) -> GoneFrame:
        """Return the next frame that was dropped for `cause`, a key of the report."""
        edge, _, kind = cause.rpartition(":")
        producer, _, consumer = edge.partition("->")
        if producer == SOURCE:
            queue = self._turned_away.get(kind) or self._source.queue
            return GoneFrame(*queue.popleft()) if queue else GoneFrame(UNKNOWN, now_ns)
        is_bypass = (producer, consumer) == self._bypass
        for frame in self._waiting.get(consumer, ()):
            if self._frame(frame, now_ns).skips == is_bypass:
                return GoneFrame(frame, self._leave(frame, now_ns))
        return GoneFrame(UNKNOWN, now_ns)

    def late(self, _unit: str) -> list[str]:
        """Return an empty list: no stage of a chain has several inputs."""
        return []

    def _frame(self, number: int, now_ns: int) -> FrameState:
        """Return the state of a frame in flight. If the journal lacks the frame's first job, make the state now."""
        if (frame := self.frames.get(number)) is None:
            frame = self.frames[number] = FrameState(now_ns, NEVER)
        return frame

    def _take(self, frame: int, now_ns: int) -> int:
        """Take the frame out of the source, and return its release time in ns."""
        for released in self._source.queue:
            if released[0] == frame:  # frames before it may still be here: drops of this step are counted after it
                self._source.queue.remove(released)
                return released[1]
        return self._source.take(now_ns)[1]

    def _leave(self, number: int, now_ns: int) -> int:
        """Remove the frame from all queues, and return its release time in ns; `now_ns` if it is not in flight."""
        for waiting in self._waiting.values():
            if number in waiting:
                waiting.remove(number)
        self._heard_ns.pop(number, None)
        frame = self.frames.pop(number, None)
        return now_ns if frame is None else frame.release_ns


class GraphTrack:
    """Does for a graph what `ChainTrack` does for a chain: a second scheduler takes the run's events."""

    def __init__(self, graph: Graph, settings: Settings) -> None:
        self._core = Core(graph, settings)
        self._left: list[FrameLeft] = []
        self._core.ledger.left = self._left
        self._named = self._core.flow.stage_named
        self._heard_ns: dict[int, dict[int, int]] = {}  # by the frame's number and the stage's position
        self._gone: dict[str, deque[GoneFrame]] = {}
        self._presented: dict[int, FrameLeft] = {}

    @property
    def frames(self) -> Mapping[int, FrameState]:
        return {number: frame for number, frame in self._core.frames.items() if not frame.is_presented}

    def step(self, now_ns: int, events: tuple[Event, ...]) -> None:
        self._left.clear()
        self._core.step(now_ns, events)
        self._presented.clear()
        for left in self._left:
            self._heard_ns.pop(left.frame, None)
            if left.cause:
                self._gone.setdefault(left.cause, deque()).append(GoneFrame(left.frame, left.release_ns))
            else:
                self._presented[left.frame] = left

    def start(self, _now_ns: int) -> None:
        """Do nothing: the second scheduler has taken the event."""

    def advance(self, _now_ns: int) -> None:
        """Do nothing: the second scheduler has taken the event."""

    def stop(self) -> None:
        """Do nothing: the second scheduler has taken the event."""

    @property
    def left(self) -> int:
        return self._core.source.left

    def waiting(self, stage: str) -> list[int]:
        state = self._named[stage]
        frames = [state.input.frame[slot] for slot in state.waiting] if state.input is not None else []
        return [*frames, *(frame for frame, _ in self._core.source.queue)] if not state.before else frames

    def late(self, unit: str) -> list[str]:
        """Return the stages whose output the unit lacks for the oldest frame that has only some inputs."""
        stages = self._core.flow.stages
        for frame in self._core.frames.values():
            for stage in self._core.units[unit].stages:
                missing = [stages[place].name for place in stage.after if frame.todo >> place & 1]
                if frame.todo & ~frame.begun & stage.bit and 0 < len(missing) < len(stage.after):
                    return missing
        return []

    def begin(self, job: Job, now_ns: int) -> int:  # noqa: ARG002 - a chain needs the time
        heard = self._heard_ns.get(job.frame, {})
        return max((heard.get(place, 0) for place in self._named[job.stage].after), default=0)

    def end(self, job: Job, event: JobDone, now_ns: int) -> FrameState | None:
        if job.frame in self._core.frames:
            self._heard_ns.setdefault(job.frame, {})[self._named[job.stage].position] = now_ns
        left = self._presented.get(job.frame)
        if left is None or self._named[job.stage].output is not None or left.end_ns != event.t_end_ns:
            return None
        frame = FrameState(left.release_ns, NEVER, left.rung)
        frame.latency_ns = left.latency_ns
        return frame

    def give_back(self, _job: Job) -> None:
        """Do nothing, because the second scheduler has taken the event."""

    def lose(self, _frame: int, _now_ns: int) -> GoneFrame | None:
        """Return None: `lost_for` returns the lost frames of a graph."""
        return None

    def lost_for(self, cause: str, now_ns: int) -> GoneFrame:
        found = self._gone.get(cause)
        return found.popleft() if found else GoneFrame(UNKNOWN, now_ns)

    def dropped_for(self, cause: str, now_ns: int) -> GoneFrame:
        return self.lost_for(cause, now_ns)


Track = ChainTrack | GraphTrack


def track_of(graph: Graph, settings: Settings) -> Track:
    """Return a new track for a run with this graph and these settings."""
    return ChainTrack(graph, settings) if graph.is_chain else GraphTrack(graph, settings)
