"""Moves frames through the slots. Rule: each frame leaves here once, counted as presented, dropped or lost.

It moves frames and slots on request, and notes which units each change concerns (`mark_dirty`).

A bypass is the way past some stages. A frame on it overtakes none, and its slot goes back to the edge that it came
from. The stage at which the bypass begins says of each frame whether it skips (`JobDone.skips`). The slot of such a
frame waits in `EdgeSlots.passing` of the edge behind that stage, for the stage at which the bypass ends. That stage
takes frames from two sides. It takes the oldest frame, and a frame that skips only when no older frame is still before
it.

A frame that skips relies on what a frame that did not skip left at the bypass's end. Such a frame may be lost or
dropped before it gets there, or the unit at the end may be started again. Then the next job at the bypass's begin is
`fresh`.
"""

from __future__ import annotations

from collections.abc import Mapping

from trilane.scheduler.events import Drop, DropCause, Graph, Job, Loss
from trilane.scheduler.ledger import Ledger
from trilane.scheduler.state import FrameState, StageState, UnitState, build
from trilane.transport.slots import EdgeSlots


class Bypass:
    """The way past the stages between `begin` and `end`; a frame that takes it has its slot on `edge`, behind `begin`.

    `must_be_fresh`: whether the next job of `begin` must be fresh.
    `was_taken`: whether the last frame that `begin` did skipped.
    """

    __slots__ = ("begin", "edge", "end", "must_be_fresh", "was_taken")

    def __init__(self, begin: StageState, end: StageState) -> None:
        assert begin.output is not None
        self.begin, self.end, self.edge = begin, end, begin.output
        end.bypassed = begin.output
        self.must_be_fresh = True
        self.was_taken = False


def next_slot(stage: StageState, frames: Mapping[int, FrameState]) -> int:
    """Return the slot that a stage with an input takes next, as `Job.slot_in` counts; -1: none.

    `frames`: frames in flight by number, oldest first.
    """
    own, bypassed = stage.input, stage.bypassed
    assert own is not None
    if bypassed is None or not bypassed.passing:
        return own.ready[0] if own.ready else -1
    slot = bypassed.passing[0]
    frame = bypassed.frame[slot]
    if own.ready:
        if own.frame[own.ready[0]] < frame:
            return own.ready[0]
    elif _is_older_before(stage, frame, frames):
        return -1
    return len(own.state) + slot


def _is_older_before(stage: StageState, frame: int, frames: Mapping[int, FrameState]) -> bool:
    """Return whether an older frame than `frame` has not come to `stage` yet."""
    for number, state in frames.items():
        if number >= frame:
            return False
        if state.position < stage.position:
            return True
    return False


def side_of(stage: StageState, slot_in: int) -> tuple[EdgeSlots, int]:
    """Return the edge and the slot that `slot_in` of a job of `stage` refers to; the stage must have an input."""
    own = stage.input
    assert own is not None
    if stage.bypassed is None or slot_in < len(own.state):
        return own, slot_in
    return stage.bypassed, slot_in - len(own.state)


def stale_slot(stage: StageState, frames: Mapping[int, FrameState]) -> int:
    """Return the slot of the oldest frame that waits to skip to the stage if that frame is stale; else -1.

    The frame is stale if a newer waiting frame could go as soon. A frame that did not skip is not stale for one that
    does, which may need it. The slot counts as `Job.slot_in` does.
    """
    own, bypassed = stage.input, stage.bypassed
    if own is None or bypassed is None or not bypassed.passing:
        return -1
    slot = bypassed.passing[0]
    frame = bypassed.frame[slot]
    newest = own.frame[own.ready[-1]] if own.ready else -1
    if newest > frame or (len(bypassed.passing) > 1 and not _parts(stage, frame, bypassed, frames)):
        return len(own.state) + slot
    return -1


def _parts(stage: StageState, frame: int, bypassed: EdgeSlots, frames: Mapping[int, FrameState]) -> bool:
    """Return whether a frame between the two oldest that wait to skip is still on its way to the stage."""
    newer = bypassed.frame[bypassed.passing[1]]
    return any(frame < number < newer and state.position < stage.position for number, state in frames.items())


class Flow:
    """Stages, units, edges and the frames in flight. Raises ValueError for an unknown edge.

    `dirty`: units that a step must look at, in the order in which they were marked; a unit may appear twice.
    `bypass`: bypass of the chain, or None.
    `rung`: rung of the work of frames that are admitted from now on.
    """

    def __init__(self, graph: Graph, ledger: Ledger, drops: bool) -> None:
        """Begin with no frame in flight.

        `drops`: whether the policy drops waiting frames, so that each further waiting frame matters.
        """
        self.stages, self.units, self.edges = build(graph)
        self.stage_named = {stage.name: stage for stage in self.stages}
        self.frames: dict[int, FrameState] = {}
        self.dirty: list[UnitState] = []
        self._graph, self._ledger, self._drops = graph, ledger, drops
        self._jobs = 0
        self.rung = 0
        self.bypass: Bypass | None = None
        if graph.bypass is not None:
            begin, end = graph.bypass
            self.bypass = Bypass(self.stage_named[begin], self.stage_named[end])

    def mark_dirty(self, unit: UnitState) -> None:
        """Note that something has changed for the unit, so that this step looks at it."""
        self.dirty.append(unit)

    def admit(self, frame: int, release_ns: int, deadline_ns: int) -> None:
        """Put the frame in flight."""
        self.frames[frame] = FrameState(release_ns, deadline_ns, self.rung)

    def begin(self, stage: StageState, frame: int, slot_in: int) -> Job:
        """Return the stage's job for `frame`, which was just admitted or waits for the stage in `slot_in`."""
        source, sink = stage.input, stage.output
        slot_out = -1
        if source is not None:
            if stage.bypassed is None:
                source.take(slot_in)
            else:
                edge, slot = side_of(stage, slot_in)
                edge.take(slot)
        if sink is not None:
            slot_out, evicted = sink.claim(frame)
            if evicted is not None:
                self.drop([evicted], stage.position, DropCause.STALE if sink.rule.mailbox else DropCause.POOL)
        pool = sink or source
        epoch = pool.epoch if pool else 0
        bypass, fresh = self.bypass, False
        if bypass is not None and stage is bypass.begin:
            fresh, bypass.must_be_fresh = bypass.must_be_fresh, False
        slots = (slot_in, slot_out, epoch, fresh, self.frames[frame].rung)
        job = Job(self._jobs, stage.unit.name, stage.name, frame, *slots)
        self._jobs += 1
        return job

    def pass_on(self, stage: StageState, job: Job, end_ns: int) -> None:
        """Note that the job is done: its frame waits for the next stage, or is presented."""
        source, sink, bypass = stage.input, stage.output, self.bypass
        if source is not None:
            if stage.bypassed is None:
                if not source.free:
                    self.mark_dirty(self.stages[stage.position - 1].unit)
                source.release(job.slot_in)
            else:
                self._release(stage, job.slot_in)
        if sink is not None:
            if bypass is not None and stage is bypass.begin and self._take(bypass, job):
                return
            replaced = sink.commit(job.slot_out)
            if replaced:
                self.drop(replaced, stage.position, DropCause.STALE)
            if len(sink.ready) == 1 or self._drops:
                self.mark_dirty(self.stages[stage.position + 1].unit)
        else:
            frame = self.frames.pop(job.frame)
            self._ledger.presented(job.frame, end_ns, frame.latency_ns, frame.deadline_ns, frame.skips, frame.rung)
            self.mark_dirty(self.stages[0].unit)

    def _take(self, bypass: Bypass, job: Job) -> bool:
        """Return whether the frame takes the bypass; if so, it waits for the stage at the bypass's end."""
        bypass.was_taken = self.frames[job.frame].skips
        if bypass.was_taken:
            self.drop(bypass.edge.commit(job.slot_out, skips=True), bypass.begin.position, DropCause.STALE)
            self.mark_dirty(bypass.end.unit)
        return bypass.was_taken

    def _release(self, stage: StageState, slot_in: int) -> None:
        """Free the slot from which the stage at a bypass's end took its frame."""
        edge, slot = side_of(stage, slot_in)
        if not edge.free:
            self.mark_dirty(self._producer(stage, edge).unit)
        edge.release(slot)

    def _producer(self, stage: StageState, edge: EdgeSlots) -> StageState:
        """Return the stage that fills `edge`, from which `stage` takes frames."""
        if edge is not stage.input and self.bypass is not None:
            return self.bypass.begin
        return self.stages[stage.position - 1]

    def drop(self, frames: list[int], edge: int, cause: DropCause) -> None:
        """Drop frames whose slots on the edge behind stage `edge` were given to others, and count them."""
        for frame in frames:
            self._count_drop(frame, edge, cause)
            self.mark_dirty(self.stages[edge].unit)
            self.mark_dirty(self.stages[0].unit)

    def drop_waiting(self, stage: StageState, slot_in: int, cause: DropCause) -> None:
        """Drop the frame that waits for the stage in `slot_in`, and free its slot."""
        edge, slot = side_of(stage, slot_in)
        self.drop([edge.drop(slot)], self._producer(stage, edge).position, cause)

    def mark_lost(self, frame: int, loss: Loss) -> None:
        """Count a frame in flight as lost; its slots, if it has any, are not freed here."""
        state = self.frames.pop(frame)
        self._ledger.lost[loss] += 1
        self.mark_dirty(self.stages[0].unit)
        self._tell_bypass(state)

    def reclaim(self, unit: UnitState, loss: Loss) -> None:
        """Give the slots of a unit whose process is gone back to their edges, under a new epoch.

        The frame that the unit worked on is lost. Its other frames wait again, but those for the chain's first stage
        are lost.
        """
        jobs = list(unit.queue)
        unit.queue.clear()
        for job in jobs[:1]:
            self.free_slots(job)
            self.mark_lost(job.frame, loss)
        for job in reversed(jobs[1:]):
            self._put_back(job, loss)
        for stage in unit.stages:
            for edge in (stage.input, stage.output, stage.bypassed):
                if edge is not None:
                    edge.epoch += 1
            if stage.bypassed is not None and self.bypass is not None:
                self.bypass.must_be_fresh = True

    def free_slots(self, job: Job) -> None:
        """Free both slots of a job that will not end."""
        stage = self.stage_named[job.stage]
        if stage.input:
            edge, slot = side_of(stage, job.slot_in)
            edge.release(slot)
            self.mark_dirty(self._producer(stage, edge).unit)
        if stage.output:
            stage.output.abandon(job.slot_out)
            self.mark_dirty(stage.unit)

    def _put_back(self, job: Job, loss: Loss) -> None:
        """Let the job's frame wait for its stage again."""
        stage = self.stage_named[job.stage]
        if stage.output:
            stage.output.abandon(job.slot_out)
        if stage.input is None:
            self.mark_lost(job.frame, loss)
            return
        if job.fresh and self.bypass is not None:
            self.bypass.must_be_fresh = True
        edge, slot = side_of(stage, job.slot_in)
        producer = self._producer(stage, edge)
        for frame in edge.give_back(slot, skips=edge is not stage.input):
            self._count_drop(frame, producer.position, DropCause.STALE)
        self.mark_dirty(producer.unit)

    def _count_drop(self, frame: int, edge: int, cause: DropCause) -> None:
        state, bypass = self.frames.pop(frame), self.bypass
        name = self._graph.edge_name(edge)
        if bypass is not None and state.skips and edge == bypass.begin.position:
            name = f"{bypass.begin.name}->{bypass.end.name}"
        self._ledger.dropped[Drop(name, cause)] += 1
        self._tell_bypass(state)

    def _tell_bypass(self, gone: FrameState) -> None:
        """Update the bypass after a frame in flight was dropped or lost."""
        bypass = self.bypass
        if bypass is None:
            return
        if not gone.skips and gone.position <= bypass.end.position:
            bypass.must_be_fresh = True
        if gone.skips or bypass.edge.passing:
            self.mark_dirty(bypass.end.unit)  # the frame waited there, or what waits there may have waited for it alone
