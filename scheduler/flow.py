"""Frames on their way through the slots. Rule: a frame leaves here once: presented, dropped or lost, and counted so.

It moves frames and slots as it is told, and notes for which units that changed something (`mark_dirty`).
"""

from __future__ import annotations

from trilane.scheduler.causes import Drop, DropCause, Loss
from trilane.scheduler.events import Graph, Job
from trilane.scheduler.ledger import Ledger
from trilane.scheduler.state import FrameState, StageState, UnitState, build


class Flow:
    """Stages, units, edges and the frames in flight. Raises ValueError for an unknown edge.

    `dirty`: the units that a step must look at, in the order in which they were marked; a unit may be there twice.
    """

    def __init__(self, graph: Graph, ledger: Ledger, drops: bool) -> None:
        """`drops`: whether the policy drops waiting frames, so that each further one that waits matters."""
        self.stages, self.units, self.edges = build(graph)
        self.stage_named = {stage.name: stage for stage in self.stages}
        self.frames: dict[int, FrameState] = {}
        self.dirty: list[UnitState] = []
        self._graph, self._ledger, self._drops = graph, ledger, drops
        self._jobs = 0

    def mark_dirty(self, unit: UnitState) -> None:
        """Something has changed for the unit: this step looks at it."""
        self.dirty.append(unit)

    def admit(self, frame: int, release_ns: int, deadline_ns: int) -> None:
        """The frame is in flight from now on."""
        self.frames[frame] = FrameState(release_ns, deadline_ns)

    def begin(self, stage: StageState, frame: int) -> Job:
        """The stage's job for `frame`: one just admitted, or the oldest that waits for the stage."""
        source, sink = stage.input, stage.output
        slot_in = slot_out = -1
        if source is not None:
            slot_in = source.ready[0]
            source.take(slot_in)
        if sink is not None:
            slot_out, evicted = sink.claim(frame)
            if evicted is not None:
                self.drop([evicted], stage.position, DropCause.STALE if sink.rule.mailbox else DropCause.POOL)
        pool = sink or source
        epoch = pool.epoch if pool else 0
        job = tuple.__new__(Job, (self._jobs, stage.unit.name, stage.name, frame, slot_in, slot_out, epoch))
        self._jobs += 1
        return job

    def pass_on(self, stage: StageState, job: Job, end_ns: int) -> None:
        """The job is done: its frame waits for the next stage, or is presented."""
        source, sink = stage.input, stage.output
        if source is not None:
            if not source.free:
                self.mark_dirty(self.stages[stage.position - 1].unit)
            source.release(job.slot_in)
        if sink is not None:
            replaced = sink.commit(job.slot_out)
            if replaced:
                self.drop(replaced, stage.position, DropCause.STALE)
            if len(sink.ready) == 1 or self._drops:
                self.mark_dirty(self.stages[stage.position + 1].unit)
        else:
            frame = self.frames.pop(job.frame)
            self._ledger.presented(job.frame, end_ns, frame.latency_ns, frame.deadline_ns)
            self.mark_dirty(self.stages[0].unit)

    def drop(self, frames: list[int], edge: int, cause: DropCause) -> None:
        """Count frames whose slots on the edge behind stage `edge` were given to others."""
        for frame in frames:
            self._count_drop(frame, edge, cause)
            self.mark_dirty(self.stages[edge].unit)
            self.mark_dirty(self.stages[0].unit)

    def drop_oldest(self, stage: StageState, cause: DropCause) -> None:
        """Take the oldest frame that waits for the stage out of its slot."""
        if stage.input is not None:
            self.drop([stage.input.drop(stage.input.ready[0])], stage.position - 1, cause)

    def mark_lost(self, frame: int, loss: Loss) -> None:
        """Count a frame that was in flight as lost; its slots, if it had any, are another's business."""
        del self.frames[frame]
        self._ledger.lost[loss] += 1
        self.mark_dirty(self.stages[0].unit)

    def reclaim(self, unit: UnitState, loss: Loss) -> None:
        """Give the slots of a unit whose process is gone back to their edges, under a new epoch.

        The frame that it worked on is lost; what it only held is done again, or lost when it held its first stage.
        """
        jobs = list(unit.queue)
        unit.queue.clear()
        for job in jobs[:1]:
            self.free_slots(job)
            self.mark_lost(job.frame, loss)
        for job in reversed(jobs[1:]):
            self._put_back(job, loss)
        for stage in unit.stages:
            for edge in (stage.input, stage.output):
                if edge is not None:
                    edge.epoch += 1

    def free_slots(self, job: Job) -> None:
        """Both slots of a job that will not end are free again."""
        stage = self.stage_named[job.stage]
        if stage.input:
            stage.input.release(job.slot_in)
            self.mark_dirty(self.stages[stage.position - 1].unit)
        if stage.output:
            stage.output.abandon(job.slot_out)
            self.mark_dirty(stage.unit)

    def _put_back(self, job: Job, loss: Loss) -> None:
        """The job's frame waits for its stage again."""
        stage = self.stage_named[job.stage]
        if stage.output:
            stage.output.abandon(job.slot_out)
        if stage.input is None:
            self.mark_lost(job.frame, loss)
            return
        for frame in stage.input.give_back(job.slot_in):
            self._count_drop(frame, stage.position - 1, DropCause.STALE)
        self.mark_dirty(self.stages[stage.position - 1].unit)

    def _count_drop(self, frame: int, edge: int, cause: DropCause) -> None:
        del self.frames[frame]
        self._ledger.dropped[Drop(self._graph.edge_name(edge), cause)] += 1
