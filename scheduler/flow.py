"""Moves frames through the slots. Rule: each frame leaves here once, counted as presented, dropped or lost.

Each change marks the units that it concerns as dirty (`mark_dirty`).

Several readers. The output of a stage waits in one slot for all its readers; nothing is copied. A line is the queue of
slots that wait for one reader. A stage with several inputs begins a frame when each input has the frame. Frames keep
their order on every edge, so this frame is then the oldest of each input's line.

Dropped everywhere. A frame that is dropped or lost leaves all lines, because a stage that joins branches would wait for
it in vain. A job that has begun the frame goes on, but its output is thrown away. A frame that one branch has begun is
not dropped as stale on another branch. Otherwise two branches would choose different frames, and hardly any pair would
meet.

Side work. The output of some stages is read only by inputs with `latest`, so no picture waits for it. If a stage of
side work leaves out a frame, the other stages still do the frame, and it does not count as dropped. A frame that is
dropped after it was presented does not count either.

A bypass leads frames past some stages of a chain. A frame on the bypass overtakes no other frame. The stage at which
the bypass begins says for each frame whether it skips (`JobDone.skips`). The slot of a frame that skips waits in the
second line of that stage's output edge, and goes back to that edge. The stage at which the bypass ends takes frames
from this line and from its own input edge, the oldest first. It takes a frame that skips only when no older frame is
still on its way to the stage.

A frame that skips relies on what an earlier frame, which did not skip, left at the bypass's end. The earlier frame may
be lost or dropped before it gets there, or the unit at the end may be started again. In these cases the next job of the
stage at which the bypass begins is `fresh`.
"""

from __future__ import annotations

from collections.abc import Mapping

from trilane.scheduler.events import Drop, DropCause, Graph, Job, Loss, packed, unpacked
from trilane.scheduler.ledger import Ledger
from trilane.scheduler.state import FrameState, Inlet, NewestInlet, SourceLine, StageState, UnitState, build, fates
from trilane.transport.slots import EdgeSlots

SKIPPING = 1  # line of the frames that skip, on the edge at which a bypass begins


class Bypass:
    """The bypass of a chain, from the stage `begin` to the stage `end`.

    `edge`: output edge of `begin`; it has the slots of the frames on the bypass.
    `must_be_fresh`: whether the next job of `begin` must be fresh (`Job.fresh`).
    `was_taken`: whether the last frame that `begin` has done took the bypass.
    """

    __slots__ = ("begin", "edge", "end", "must_be_fresh", "was_taken")

    def __init__(self, begin: StageState, end: StageState) -> None:
        assert begin.output is not None
        self.begin, self.end, self.edge = begin, end, begin.output
        end.bypassed, end.feeder = begin.output, None  # jobs of `end` read slots of two edges
        self.must_be_fresh = True  # no frame has come to `end` yet
        self.was_taken = False


def next_slot(stage: StageState, frames: Mapping[int, FrameState]) -> int:
    """Return the slot that a stage with one input takes next, numbered as in `Job.slot_in`; -1: none.

    `frames`: frames in flight by number, oldest first.
    """
    own, bypassed = stage.input, stage.bypassed
    assert own is not None
    if bypassed is None or not bypassed.lines[SKIPPING]:
        return own.ready[0] if own.ready else -1
    slot = bypassed.lines[SKIPPING][0]
    frame = bypassed.frame[slot]
    if own.ready:
        if own.frame[own.ready[0]] < frame:
            return own.ready[0]
    elif _is_on_way(stage, -1, frame, frames):
        return -1
    return own_slots(stage) + slot


def _is_on_way(stage: StageState, older: int, newer: int, frames: Mapping[int, FrameState]) -> bool:
    """Return whether a frame with a number between `older` and `newer` has yet to come to the stage."""
    return any(older < number < newer and state.position < stage.position for number, state in frames.items())


def own_slots(stage: StageState) -> int:
    """Return the number of slots of the stage's input edge; in `Job.slot_in`, the bypass's slots begin there."""
    assert isinstance(stage.input, EdgeSlots)
    return len(stage.input.state)


def side_of(stage: StageState, slot_in: int) -> tuple[EdgeSlots | SourceLine, int]:
    """Return (edge, slot on this edge) for a number as in `Job.slot_in`; the stage must have one input."""
    own = stage.input
    assert own is not None
    if stage.bypassed is None or slot_in < own_slots(stage):
        return own, slot_in
    return stage.bypassed, slot_in - own_slots(stage)


def stale_slot(stage: StageState, frames: Mapping[int, FrameState]) -> int:
    """Return the slot of the oldest frame that waits for the stage on the bypass, if this frame is stale; else -1.

    The slot is numbered as in `Job.slot_in`. The frame is stale if a newer waiting frame could be taken as early. A
    frame that skips may rely on an earlier frame that does not skip, and therefore never makes that frame stale.
    """
    own, bypassed = stage.input, stage.bypassed
    if own is None or bypassed is None or not bypassed.lines[SKIPPING]:
        return -1
    passing = bypassed.lines[SKIPPING]
    frame = bypassed.frame[passing[0]]
    newest = own.frame[own.ready[-1]] if own.ready else -1
    if newest > frame or (len(passing) > 1 and not _is_on_way(stage, frame, bypassed.frame[passing[1]], frames)):
        return own_slots(stage) + passing[0]
    return -1


class Flow:
    """Stages, units, edges and the frames in flight. Raises ValueError as `build` does.

    `dirty`: units that a step must look at, in the order in which they were marked; a unit may appear twice.
    `bypass`: bypass of the chain, or None.
    `rung`: rung of the work of frames that are admitted from now on.
    `gone`: frames that were dropped or lost while jobs worked on them, by number, until these jobs end.
    `aside`: number of frames in flight that are presented already, so that only side work is left.
    `source_lines`: pairs (stage without inputs, line of its waiting frames). It is empty if only one stage has no
    inputs, and takes its frames from the source itself.
    """

    def __init__(self, graph: Graph, ledger: Ledger, drops: bool) -> None:
        """Begin with no frame in flight.

        `drops`: whether the policy drops waiting frames, so that each further waiting frame matters.
        """
        self.stages, self.units, self.edges = build(graph)
        self.stage_named = {stage.name: stage for stage in self.stages}
        self.frames: dict[int, FrameState] = {}
        self.gone: dict[int, FrameState] = {}
        self.dirty: list[UnitState] = []
        self.is_chain = graph.is_chain
        self._ledger, self._drops = ledger, drops
        self._jobs = self._admitted = self.aside = 0
        self.rung = 0
        self._count = len(self.stages)
        self._all = (1 << self._count) - 1
        self._ends = sum(stage.bit for stage in self.stages if stage.output is None)
        self._every = any(stage.period > 1 for stage in self.stages)
        roots = [stage for stage in self.stages if not stage.before]
        self._root_units = [stage.unit for stage in roots]
        self.source_lines = [(each, each.input) for each in roots if isinstance(each.input, SourceLine)]
        self.main = sum(stage.bit for stage in self.stages if stage.is_main)
        self._written: dict[tuple[int, int], FrameState] = {}  # frame of each slot behind a stage with newest readers
        self.bypass: Bypass | None = None
        if graph.bypass is not None:
            begin, end = graph.bypass
            self.bypass = Bypass(self.stage_named[begin], self.stage_named[end])

    def mark_dirty(self, unit: UnitState) -> None:
        """Note that something has changed for the unit, so that this step looks at it."""
        self.dirty.append(unit)

    def admit(self, frame: int, release_ns: int, deadline_ns: int) -> None:
        """Put the frame in flight. `release_ns`: time of its release. `deadline_ns`: its deadline, or NEVER."""
        todo = self.next_todo() if self._every else self._all
        self.frames[frame] = FrameState(release_ns, deadline_ns, self.rung, self._admitted, todo, self._count)
        self._admitted += 1
        for stage, line in self.source_lines:
            if todo & stage.bit:
                line.ready.append(frame)
            self.mark_dirty(stage.unit)
        if not todo:
            self._leave(frame)

    def next_todo(self) -> int:
        """Return the bits of the stages that the next frame in flight has to do."""
        if not self._every:
            return self._all
        return sum(stage.bit for stage in self.stages if not self._admitted % stage.period)

    def begin(self, stage: StageState, frame: int, slot_in: int, now_ns: int) -> Job:
        """Take the slots that the stage needs for `frame`, and return the job.

        `frame`: frame that was just admitted, or waits for the stage.
        `slot_in`: slot in which the frame waits, numbered as in `Job.slot_in`; it matters only in a chain.
        """
        source, sink, state = stage.input, stage.output, self.frames[frame]
        slot_out = -1
        if not self.is_chain:
            slot_in = self._take_all(stage, state, now_ns)
            state.begun |= stage.bit
            state.jobs += 1
        elif stage.bypassed is not None:
            edge, slot = side_of(stage, slot_in)
            edge.take(slot, SKIPPING if edge is stage.bypassed else 0)
        elif source is not None:
            source.take(slot_in)
        if sink is not None:
            if self.is_chain:
                slot_out, evicted = sink.claim(frame)
            else:
                slot_out, evicted = sink.claim(frame, lambda other: self.must_stay(stage, other))
            if evicted is not None:
                self.drop([evicted], stage, DropCause.STALE if sink.rule.mailbox else DropCause.POOL)
        pool = sink or source
        epoch = pool.epoch if pool else 0
        bypass, fresh = self.bypass, False
        if bypass is not None and stage is bypass.begin:
            fresh, bypass.must_be_fresh = bypass.must_be_fresh, False
        job = Job(self._jobs, stage.unit.name, stage.name, frame, slot_in, slot_out, epoch, fresh, state.rung)
        self._jobs += 1
        return job

    def _take_all(self, stage: StageState, state: FrameState, now_ns: int) -> int:
        """Take the slots of all inputs of a stage, and return them `packed`."""
        for inlet in stage.inlets:
            if inlet.producer is None:
                inlet.edge.take(inlet.waiting[0])
        slots = []
        for side in stage.slots_of:
            if isinstance(side, Inlet):
                slots.append(side.waiting[0])
                side.edge.take(slots[-1], side.line)
                continue
            held = side.edge.newest[side.reader]
            slots.append(-1)
            if held >= 0:
                newest = self._written[side.producer.position, held]
                age_ns = now_ns - newest.sampled_ns
                if not 0 < side.max_age_ns < age_ns:  # an older frame counts as absent
                    slots[-1] = side.edge.take_newest(side.reader)
                    self._ledger.newest(side.producer.name, age_ns, state.number - newest.number)
        return packed(slots)

    def must_stay(self, behind: StageState, frame: int) -> bool:
        """Return whether a frame behind a stage must not be replaced, because another branch has begun it.

        If only side work waits for the frame there, a newer frame may replace it: the side work leaves it out.
        """
        state = self.frames[frame]
        return self._is_awaited(behind, state) and bool(state.begun & self.main & ~(behind.before | behind.bit))

    def _is_awaited(self, behind: StageState, state: FrameState) -> bool:
        """Return whether a reader of the stage `behind` has yet to begin a frame. Readers of side work do not count."""
        waiting = state.todo & ~state.begun & self.main
        return any(waiting & reader.bit for reader in behind.readers)

    def is_held(self, before: StageState, frame: int) -> bool:
        """Return whether another branch has begun a frame that waits for the stage `before`; it is not stale then."""
        return bool(self.frames[frame].begun & self.main & ~before.before)

    def pass_on(self, stage: StageState, job: Job, end_ns: int) -> None:
        """Note that the job is done at `end_ns`: its frame waits for the next stages, or is presented.

        If the frame was dropped or lost meanwhile, only free the job's slots.
        """
        self.dirty.append(stage.unit)
        state = self.frames.get(job.frame)
        if state is None:
            self.free_slots(job)
            return
        feeder, source = stage.feeder, stage.input
        if feeder is not None and source is not None:  # most jobs: `_release` takes longer
            if not source.free:
                self.dirty.append(feeder)
            source.release(job.slot_in)
        elif job.slot_in >= 0:
            self._release(stage, job)
        state.todo ^= stage.bit
        sink = stage.output
        if not self.is_chain:
            state.jobs -= 1
        if sink is None:
            self._present(job.frame, state, end_ns)
        elif self.is_chain:
            self._commit_to_next(stage, sink, job, state, end_ns)
        else:
            self._commit(stage, sink, job.slot_out, state, end_ns)
            if not state.todo:
                self._leave(job.frame)

    def _commit_to_next(self, stage: StageState, sink: EdgeSlots, job: Job, state: FrameState, end_ns: int) -> None:
        """Let the job's output slot wait for the next stage of a chain, or for the stage at which the bypass ends."""
        state.position = place = stage.position + 1
        state.ready_ns[place] = end_ns
        bypass = self.bypass
        if bypass is not None and stage is bypass.begin and self._take_bypass(bypass, job):
            return
        replaced = sink.commit(job.slot_out)
        if replaced:
            self.drop(replaced, stage, DropCause.STALE)
        # Behind another waiting frame, this one matters only to a policy that drops frames.
        if len(sink.ready) == 1 or self._drops:
            self.dirty.append(self.stages[place].unit)

    def _commit(self, stage: StageState, sink: EdgeSlots, slot: int, state: FrameState, end_ns: int) -> None:
        """Let the output slot wait for the readers that have yet to do its frame."""
        readers = [(line, reader) for line, reader in enumerate(stage.readers) if state.todo & reader.bit]
        if sink.newest:
            self._written[stage.position, slot] = state
        replaced = sink.commit(slot, [line for line, _ in readers], lambda other: self.must_stay(stage, other))
        for _, reader in readers:
            state.ready_ns[reader.position] = max(state.ready_ns[reader.position], end_ns)
            self.mark_dirty(reader.unit)
        if sink.newest:
            self.mark_dirty(stage.unit)  # the newest frame before it may have left its slot
        if replaced:
            self.drop(replaced, stage, DropCause.STALE)

    def _present(self, frame: int, state: FrameState, end_ns: int) -> None:
        """Note that a stage without readers has done the frame. The last of these stages presents the frame."""
        if state.todo & self._ends:
            return
        state.is_presented = True
        self._ledger.presented(
            frame, end_ns, state.latency_ns, state.deadline_ns, state.skips, state.rung, state.release_ns
        )
        if state.todo:
            self.aside += 1
        else:
            del self.frames[frame]
        self.mark_roots_dirty()

    def _leave(self, frame: int) -> None:
        """Take a frame out of flight after its last stage; if it was not presented, it counts as dropped."""
        state = self.frames.pop(frame)
        if state.is_presented:
            self.aside -= 1
            return
        ends = [stage.name for stage in self.stages if stage.output is None]
        self._ledger.drop(frame, state.release_ns, Drop(",".join(ends), DropCause.EVERY))
        self.mark_roots_dirty()

    def mark_roots_dirty(self) -> None:
        """Mark the units of the stages without inputs as dirty, because another frame may be put in flight."""
        self.dirty += self._root_units

    def _take_bypass(self, bypass: Bypass, job: Job) -> bool:
        """Return whether the job's frame takes the bypass; if so, it now waits for the stage at the bypass's end."""
        frame = self.frames[job.frame]
        bypass.was_taken = frame.skips
        if bypass.was_taken:
            between = self.stages[frame.position : bypass.end.position]
            frame.todo &= ~sum(stage.bit for stage in between)
            frame.ready_ns[bypass.end.position] = frame.ready_ns[frame.position]
            frame.position = bypass.end.position
            self.drop(bypass.edge.commit(job.slot_out, (SKIPPING,)), bypass.begin, DropCause.STALE)
            self.mark_dirty(bypass.end.unit)
        return bypass.was_taken

    def _release(self, stage: StageState, job: Job) -> None:
        """Free the slots that a job has read."""
        if stage.bypassed is not None:
            edge, slot = side_of(stage, job.slot_in)
            if not edge.free:
                self.mark_dirty(self._producer(stage, edge).unit)
            edge.release(slot)
        else:
            for side, slot in zip(stage.slots_of, unpacked(job.slot_in, len(stage.slots_of)), strict=True):
                if slot >= 0 and side.producer is not None:
                    self.mark_dirty(side.producer.unit)
                    side.edge.release(slot)

    def _producer(self, stage: StageState, edge: EdgeSlots | SourceLine) -> StageState:
        """Return the stage that fills `edge`: the input edge of `stage`, which has one input, or its bypassed edge."""
        if edge is not stage.input and self.bypass is not None:
            return self.bypass.begin
        producer = stage.inlets[0].producer
        assert producer is not None
        return producer

    def drop(self, frames: list[int], behind: StageState, cause: DropCause, before: StageState | None = None) -> None:
        """Drop and count frames that waited behind a stage. A frame that only side work awaits is just left out there.

        `behind`: stage that wrote the frames.
        `before`: stage for which the frames waited; None: all readers of the stage `behind`.
        """
        for frame in frames:
            self._count_drop(frame, behind, before, cause)
            self.mark_dirty(behind.unit)
            self.mark_roots_dirty()

    def drop_waiting(self, stage: StageState, slot_in: int, cause: DropCause) -> None:
        """Drop the frame that waits for the stage in `slot_in` (numbered as in `Job.slot_in`), and count the drop.

        A stage of side work only leaves the frame out, which does not count as a drop.
        """
        edge, slot = side_of(stage, slot_in)
        if self.is_chain:
            assert isinstance(edge, EdgeSlots)
            self.drop([edge.drop(slot)], self._producer(stage, edge), cause)
            return
        frame = edge.frame[slot]
        if not stage.is_main:
            self._leave_out(stage, frame)
        else:
            self.drop([frame], stage.inlets[0].producer or stage, cause, stage)

    def _leave_out(self, stage: StageState, frame: int) -> None:
        """Let a stage of side work, and all stages that depend on it, leave out a frame."""
        state = self.frames.get(frame)
        if state is None or not state.todo & ~state.begun & stage.bit:
            return
        for each in self.stages:
            if each is stage or each.before & stage.bit:
                state.todo &= ~each.bit
                for inlet in each.inlets:
                    inlet.edge.pass_by(frame, inlet.line)
        if not state.todo:
            self._leave(frame)
        self._mark_all_dirty()

    def mark_lost(self, frame: int, loss: Loss) -> None:
        """Take a frame out of flight; if it was not presented, count it as lost. Its slots are not freed here."""
        state = self.frames.pop(frame)
        if state.is_presented:
            self.aside -= 1
        else:
            self._ledger.lose(frame, state.release_ns, loss)
        self._forget(frame, state)
        self.mark_roots_dirty()
        self._tell_bypass(state)

    def reclaim(self, unit: UnitState, loss: Loss) -> None:
        """Give back the slots of a unit whose process is gone, and begin a new epoch of its edges.

        `fates` says which of the unit's frames are lost; the other frames wait for their stages again.
        `loss`: reason that the lost frames get.
        """
        judged = fates(unit.queue, {stage.name for stage in unit.stages if stage.input is None})
        unit.queue.clear()
        for job, is_lost in (*judged[:1], *reversed(judged[1:])):  # the last first: each frame goes to its line's head
            if is_lost or job.frame in self.gone:
                self.free_slots(job)
                if job.frame in self.frames:
                    self.mark_lost(job.frame, loss)
            else:
                self._put_back(job)
        for stage in unit.stages:
            for edge in (*(side.edge for side in stage.slots_of), stage.output, stage.bypassed):
                if edge is not None:
                    edge.epoch += 1
            if stage.bypassed is not None and self.bypass is not None:
                self.bypass.must_be_fresh = True

    def free_slots(self, job: Job) -> None:
        """Free all slots of a job whose frame does not go on."""
        stage = self.stage_named[job.stage]
        if job.slot_in >= 0:
            self._release(stage, job)
        for side in stage.slots_of:
            if side.producer is not None:
                self.mark_dirty(side.producer.unit)
        if stage.output:
            stage.output.abandon(job.slot_out)
            self.mark_dirty(stage.unit)
        self._end_job(job)

    def _end_job(self, job: Job) -> None:
        """Note that no unit holds the job any more; a frame that is gone is forgotten with its last job."""
        if not self.is_chain:
            state = self.frames.get(job.frame) or self.gone[job.frame]
            state.jobs -= 1
            if not state.jobs:
                self.gone.pop(job.frame, None)

    def _put_back(self, job: Job) -> None:
        """Let the job's frame wait for its stage again."""
        stage = self.stage_named[job.stage]
        if stage.output:
            stage.output.abandon(job.slot_out)
        self._end_job(job)
        self.frames[job.frame].begun &= ~stage.bit
        if job.fresh and self.bypass is not None:
            self.bypass.must_be_fresh = True
        if stage.bypassed is not None:
            edge, slot = side_of(stage, job.slot_in)
            producer = self._producer(stage, edge)
            self._give_back(edge, slot, SKIPPING if edge is not stage.input else 0, producer)
        else:
            self._give_back_all(stage, job)

    def _give_back_all(self, stage: StageState, job: Job) -> None:
        """Put the job's frame back into every line from which the job took it."""
        for inlet in stage.inlets:
            if inlet.producer is None:
                inlet.edge.give_back(job.frame)
        slots = unpacked(job.slot_in, len(stage.slots_of)) if stage.joins else [job.slot_in]
        for side, slot in zip(stage.slots_of, slots, strict=True):
            if isinstance(side, NewestInlet):
                if slot >= 0:
                    side.edge.release(slot)
            elif side.producer is not None:
                self._give_back(side.edge, slot, side.line, side.producer)
        if not self.is_chain:
            self._mark_all_dirty()

    def _give_back(self, edge: EdgeSlots | SourceLine, slot: int, line: int, producer: StageState) -> None:
        keeps = None if self.is_chain else lambda frame: self.must_stay(producer, frame)
        for frame in edge.give_back(slot, line, keeps):
            self._count_drop(frame, producer, None, DropCause.STALE)
        self.mark_dirty(producer.unit)

    def _count_drop(self, frame: int, behind: StageState, before: StageState | None, cause: DropCause) -> None:
        state, bypass = self.frames[frame], self.bypass
        if before is None and not self.is_chain and not self._is_awaited(behind, state):
            for reader in behind.readers:
                self._leave_out(reader, frame)
            return
        del self.frames[frame]
        if bypass is not None and state.skips and behind is bypass.begin:
            readers = bypass.end.name
        elif before is not None:
            readers = before.name
        else:
            readers = ",".join(reader.name for reader in behind.readers)
        writer = "source" if behind is before else behind.name
        if state.is_presented:
            self.aside -= 1
        else:
            self._ledger.drop(frame, state.release_ns, Drop(f"{writer}->{readers}", cause))
        self._forget(frame, state)
        self._tell_bypass(state)

    def _forget(self, frame: int, state: FrameState) -> None:
        """Remove a dropped or lost frame from all lines; in a chain, do nothing: it has left its only line already."""
        if self.is_chain:
            return
        if state.jobs:
            self.gone[frame] = state
        for stage in self.stages:
            for inlet in stage.inlets:
                inlet.edge.pass_by(frame, inlet.line)
        self._mark_all_dirty()

    def _mark_all_dirty(self) -> None:
        for unit in self.units.values():
            self.mark_dirty(unit)

    def _tell_bypass(self, gone: FrameState) -> None:
        """Update the bypass after a frame in flight was dropped or lost."""
        bypass = self.bypass
        if bypass is None:
            return
        if not gone.skips and gone.position <= bypass.end.position:
            bypass.must_be_fresh = True
        if gone.skips or bypass.edge.lines[SKIPPING]:
            self.mark_dirty(bypass.end.unit)  # the frame waited there, or a frame that waits there waited for it
