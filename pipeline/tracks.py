"""Where the frames in flight of a run are, by what its journal says: along a chain, or through a graph.

Rule: a track decides nothing. It knows the rules by which the scheduler moves frames (docs/decisions/graph-core.md),
and finds out which frame a count in the journal means. Where several frames were dropped in one step, for several
causes or from several sources, it names the oldest. Frames do not overtake each other: where several wait, the oldest
are dropped.
"""

from __future__ import annotations

from collections import deque
from itertools import pairwise
from typing import Final, NamedTuple, Protocol

from trilane.scheduler.events import NEVER, DropCause, Graph, Job, JobDone
from trilane.scheduler.frame_source import Source
from trilane.scheduler.state import FrameState, SourceLine, StageState, build

UNKNOWN: Final = -1  # the number of a frame that is gone and cannot be told from others
MOST_AHEAD: Final = (
    1024  # frames that a source without a rate gives before one that is taken; more are a broken journal
)


class Gone(NamedTuple):
    """A frame that left the track unpresented. `frame`: its number, or UNKNOWN; `release_ns`: time of its release."""

    frame: int
    release_ns: int


class Track(Protocol):
    """Takes what happens to the frames of a run, in order.

    `frames`: frames in flight, by number.
    """

    frames: dict[int, FrameState]

    def settle(self) -> None:
        """Note that all that the last step dropped or lost was counted; called before the next step."""

    def begin(self, job: Job, now_ns: int) -> int:
        """Note that a job is handed out, and return when the scheduler heard that the job's input was there."""

    def end(self, job: Job, event: JobDone, now_ns: int) -> FrameState | None:
        """Note that a job has ended; return its frame if that is presented by it."""

    def give_back(self, job: Job, now_ns: int) -> Gone | None:
        """Note that a unit died before it began the job; return its frame if that is lost."""

    def lose(self, frame: int, now_ns: int) -> Gone | None:
        """Note that a frame is lost; return it if the scheduler counts it."""

    def dropped(self, edge: str, cause: str, now_ns: int) -> Gone:
        """Return the frame that was dropped at `edge`, written as `producer->consumer`."""

    def waiting(self, stage: str) -> list[int]:
        """Return the frames that wait for a stage, the oldest first."""

    def late(self, unit: str) -> list[str]:
        """Return the stages whose work is not there, for the oldest frame of which a stage of the unit has others."""

    def stop(self) -> None:
        """Note that the source is about to forget the frames that wait in it."""


class ChainTrack:
    """The frames of a chain."""

    def __init__(self, graph: Graph, source: Source) -> None:
        names = [stage.name for stage in graph.stages]
        self.frames: dict[int, FrameState] = {}
        self._source, self._bypass, self._latency_to = source, graph.bypass, graph.latency_to
        self._first, self._last = names[0], names[-1]
        self._next = dict(pairwise(names))
        self._waiting: dict[str, list[int]] = {name: [] for name in names[1:]}
        self._heard_ns: dict[int, int] = {}

    def waiting(self, stage: str) -> list[int]:
        return [frame for frame, _ in self._source.queue] if stage == self._first else [*self._waiting[stage]]

    def settle(self) -> None:
        """Do nothing: a stage of a chain leaves out no frame that goes on elsewhere."""

    def begin(self, job: Job, now_ns: int) -> int:
        if job.stage == self._first:
            self.frames[job.frame] = FrameState(self._take(job.frame, now_ns), NEVER, job.rung)
        elif job.frame in self._waiting[job.stage]:
            self._waiting[job.stage].remove(job.frame)
        return self._heard_ns.get(job.frame, 0)

    def end(self, job: Job, event: JobDone, now_ns: int) -> FrameState | None:
        self._heard_ns[job.frame] = now_ns
        frame = self._frame(job.frame, now_ns)
        # The scheduler's own record computes the latency, so that it is defined once.
        sampled_ns = event.t_sampled_ns if job.stage == self._first else None
        frame.end_stage(sampled_ns, event.t_end_ns, job.stage == self._latency_to)
        frame.skips |= event.skips
        if job.stage == self._last:
            self._leave(job.frame, now_ns)
            return frame
        skips_to = self._bypass[1] if event.skips and self._bypass is not None else ""
        self._waiting[skips_to or self._next[job.stage]].append(job.frame)
        return None

    def give_back(self, job: Job, now_ns: int) -> Gone | None:
        if job.stage == self._first:
            return self.lose(job.frame, now_ns)
        self._waiting[job.stage].append(job.frame)
        self._waiting[job.stage].sort()
        return None

    def lose(self, frame: int, now_ns: int) -> Gone:
        return Gone(frame, self._leave(frame, now_ns))

    def dropped(self, edge: str, cause: str, now_ns: int) -> Gone:  # noqa: ARG002 - a graph needs the cause
        producer, _, consumer = edge.partition("->")
        is_bypass = (producer, consumer) == self._bypass
        for frame in self._waiting.get(consumer, ()):
            if self._frame(frame, now_ns).skips == is_bypass:
                return Gone(frame, self._leave(frame, now_ns))
        return Gone(UNKNOWN, now_ns)

    def late(self, unit: str) -> list[str]:  # noqa: ARG002 - no stage of a chain joins anything
        return []

    def stop(self) -> None:
        """Do nothing: what waits in the source of a chain is not in flight."""

    def _frame(self, number: int, now_ns: int) -> FrameState:
        """Return a frame in flight; where the journal lacks its begin, make one that is known from now on."""
        if (frame := self.frames.get(number)) is None:
            frame = self.frames[number] = FrameState(now_ns, NEVER)
        return frame

    def _take(self, frame: int, now_ns: int) -> int:
        """Note that the frame is in flight from now on, and return its release time."""
        for released in self._source.queue:
            if released[0] == frame:  # others may come first: a frame dropped in this step is counted after it
                self._source.queue.remove(released)
                return released[1]
        return self._source.take(now_ns)[1]

    def _leave(self, number: int, now_ns: int) -> int:
        """Remove the frame from all queues, and return its release time."""
        for waiting in self._waiting.values():
            if number in waiting:
                waiting.remove(number)
        self._heard_ns.pop(number, None)
        frame = self.frames.pop(number, None)
        return now_ns if frame is None else frame.release_ns


class GraphTrack:
    """The frames of a graph.

    The scheduler may put a frame in flight before any stage takes it. Such a frame is put in flight here when it is
    first heard of, in the same order.
    """

    def __init__(self, graph: Graph, source: Source) -> None:
        self._stages, _, _ = build(graph)
        self._named = {stage.name: stage for stage in self._stages}
        self.frames: dict[int, FrameState] = {}
        self._source, self._from_release, self._latency_to = source, graph.from_release, graph.latency_to
        self._all = sum(stage.bit for stage in self._stages)
        self._ends = sum(stage.bit for stage in self._stages if stage.output is None)
        self._main = sum(stage.bit for stage in self._stages if stage.is_main)
        self._is_fed = any(isinstance(stage.input, SourceLine) for stage in self._stages)
        self._admitted = 0
        self._running: set[tuple[str, int]] = set()
        self._heard_ns: dict[int, dict[int, int]] = {}  # of each frame, by the stage's position
        self._newest: dict[str, int] = {}  # the last frame behind each stage
        self._unshown: deque[Gone] = deque()
        self._forgotten: dict[int, int] = {}
        self._begun_aside: list[tuple[StageState, int]] = []

    def waiting(self, stage: str) -> list[int]:
        state = self._named[stage]
        found = [number for number, frame in self.frames.items() if self._waits(frame, state) and _has(frame, state)]
        return [*found, *(frame for frame, _ in self._source.queue)] if not state.before else found

    def settle(self) -> None:
        """Let side work leave out frames: it takes frames in order, so those before the one that it has begun."""
        for stage, begun in self._begun_aside:
            for number, older in [*self.frames.items()]:
                if number < begun and self._waits(older, stage):
                    self._leave_out(stage, number, older)
        self._begun_aside.clear()

    def begin(self, job: Job, now_ns: int) -> int:
        stage = self._named[job.stage]
        frame = self._frame(job, now_ns)
        if not stage.is_main:
            self._begun_aside.append((stage, job.frame))
        frame.begun |= stage.bit
        self._running.add((job.stage, job.frame))
        heard = self._heard_ns.get(job.frame, {})
        return max((heard.get(place, 0) for place in stage.after), default=0)

    def end(self, job: Job, event: JobDone, now_ns: int) -> FrameState | None:
        self._running.discard((job.stage, job.frame))
        frame, stage = self.frames.get(job.frame), self._named[job.stage]
        if frame is None:
            return None  # it was dropped or lost meanwhile
        self._heard_ns.setdefault(job.frame, {})[stage.position] = now_ns
        self._newest[job.stage] = job.frame
        sampled_ns = frame.release_ns if self._from_release else event.t_sampled_ns
        frame.end_stage(None if stage.before else sampled_ns, event.t_end_ns, job.stage == self._latency_to)
        frame.todo &= ~stage.bit
        is_presented = stage.output is None and not frame.todo & self._ends
        frame.is_presented |= is_presented
        if not frame.todo:
            self._leave(job.frame, frame)
        return frame if is_presented else None

    def give_back(self, job: Job, now_ns: int) -> Gone | None:
        self._running.discard((job.stage, job.frame))
        stage = self._named[job.stage]
        if stage.input is None:
            return self.lose(job.frame, now_ns)
        if frame := self.frames.get(job.frame):
            frame.begun &= ~stage.bit
        return None

    def lose(self, frame: int, now_ns: int) -> Gone | None:  # noqa: ARG002 - a chain needs the time
        self._running = {key for key in self._running if key[1] != frame}
        self._heard_ns.pop(frame, None)
        lost = self.frames.pop(frame, None)
        return None if lost is None or lost.is_presented else Gone(frame, lost.release_ns)

    def dropped(self, edge: str, cause: str, now_ns: int) -> Gone:
        if cause == DropCause.EVERY:
            return self._taken_by_none(now_ns)
        producer, _, readers = edge.partition("->")
        behind, before = (
            self._named.get(producer),
            [self._named[name] for name in readers.split(",") if name in self._named],
        )
        if behind is None or not before:
            return Gone(UNKNOWN, now_ns)
        while (found := self._chosen(behind, before, cause)) is None:
            if behind is not before[0] or not self._source.queue:
                return Gone(UNKNOWN, now_ns)
            self._admit(now_ns)  # it waited for a stage without inputs, so nothing was heard of it yet
        self._heard_ns.pop(found, None)
        return Gone(found, self.frames.pop(found).release_ns)

    def late(self, unit: str) -> list[str]:
        for frame in self.frames.values():
            for stage in self._stages:
                if stage.unit.name != unit or not self._waits(frame, stage):
                    continue
                missing = [place for place in stage.after if frame.todo >> place & 1]
                if 0 < len(missing) < len(stage.after):
                    return [self._stages[place].name for place in missing]
        return []

    def stop(self) -> None:
        if self._is_fed:
            self._forgotten |= dict(self._source.queue)

    def _chosen(self, behind: StageState, before: list[StageState], cause: str) -> int | None:
        """Return the frame that the scheduler drops behind one stage and before others; None where there is none."""
        for reader in reversed(before) if cause == DropCause.POOL else before:
            for number, frame in self.frames.items():
                if not self._waits(frame, reader) or (behind is not reader and frame.todo & behind.bit):
                    continue
                if cause == DropCause.LATE or self._may_drop(number, frame, behind, reader, cause):
                    return number
        return None

    def _may_drop(self, number: int, frame: FrameState, behind: StageState, reader: StageState, cause: str) -> bool:
        """Return whether a frame that waits is dropped for a newer one (`Flow.must_stay`, `Flow.is_held`)."""
        begun = frame.begun & self._main
        if cause == DropCause.STALE and _has(frame, reader) and not begun & ~reader.before:
            return True
        is_read = any((each.name, number) in self._running for each in behind.readers)
        is_held = behind.output is not None and bool(behind.output.newest) and self._newest.get(behind.name) == number
        return not is_read and not is_held and not begun & ~(behind.before | behind.bit)

    def _taken_by_none(self, now_ns: int) -> Gone:
        """Return the oldest frame that left without being presented."""
        self.settle()
        for number, frame in [*self.frames.items()]:
            # What was left of it is side work, which was left out before any further frame.
            if not self._unshown and not frame.is_presented and not frame.todo & (frame.begun | self._main):
                self._leave(number, frame)
        while not self._unshown:
            if self._source.is_empty:
                return Gone(UNKNOWN, now_ns)
            self._admit(now_ns)
        return self._unshown.popleft()

    def _frame(self, job: Job, now_ns: int) -> FrameState:
        """Return the frame of a job that begins; put it in flight, after those before it, where it is not yet."""
        if (frame := self.frames.get(job.frame)) is not None:
            return frame
        if not self._is_fed:  # earlier ones may be in the queue: a frame dropped in this step is counted after it
            released = next((each for each in self._source.queue if each[0] == job.frame), None)
            if released is not None:
                self._source.queue.remove(released)
            return self._put(job.frame, released[1] if released else self._source.take(now_ns)[1], job.rung)
        for _ in range(MOST_AHEAD):
            if self._source.is_empty or self._source.head(now_ns)[0] > job.frame:
                break
            self._admit(now_ns)
            if (frame := self.frames.get(job.frame)) is not None:
                return frame
        while self._forgotten and min(self._forgotten) < job.frame:
            oldest = min(self._forgotten)
            self._put(oldest, self._forgotten.pop(oldest))
        return self._put(job.frame, self._forgotten.pop(job.frame, now_ns), job.rung)

    def _admit(self, now_ns: int) -> None:
        self._put(*self._source.take(now_ns))

    def _put(self, number: int, release_ns: int, rung: int = 0) -> FrameState:
        """Put a frame in flight, and return it."""
        count = self._admitted
        self._admitted += 1
        todo = sum(stage.bit for stage in self._stages if not count % stage.period)
        frame = self.frames[number] = FrameState(release_ns, NEVER, rung, count, todo, len(self._stages))
        if not todo:
            self._leave(number, frame)
        return frame

    def _leave(self, number: int, frame: FrameState) -> None:
        """Note that nothing is left to do for a frame."""
        self.frames.pop(number, None)
        self._heard_ns.pop(number, None)
        if not frame.is_presented:
            self._unshown.append(Gone(number, frame.release_ns))

    def _leave_out(self, stage: StageState, number: int, frame: FrameState) -> None:
        """Note that a stage, and those that read it, leave out a frame."""
        for each in self._stages:
            if each is stage or each.before & stage.bit:
                frame.todo &= ~each.bit
        if not frame.todo:
            self._leave(number, frame)

    def _waits(self, frame: FrameState, stage: StageState) -> bool:
        """Whether a stage has yet to begin a frame."""
        return bool(frame.todo & stage.bit and not frame.begun & stage.bit)


def _has(frame: FrameState, stage: StageState) -> bool:
    """Whether all inputs of a stage have a frame."""
    return not frame.todo & stage.before


def track_of(graph: Graph, source: Source) -> Track:
    """Return the track of a run whose frames come from `source`."""
    return ChainTrack(graph, source) if graph.is_chain else GraphTrack(graph, source)
