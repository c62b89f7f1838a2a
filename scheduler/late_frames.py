"""Drops frames that wait in vain: those that must be late, and those that a newer frame has made stale.

Rule: a frame is dropped when the stage that it waits for is considered, and not before. The policy says which of the
two kinds are dropped.
"""

from __future__ import annotations

from trilane.scheduler.bypass import next_slot, stale_slot
from trilane.scheduler.causes import DropCause
from trilane.scheduler.choice import Choice
from trilane.scheduler.flow import Flow
from trilane.scheduler.frame_source import Source
from trilane.scheduler.policy import Policy
from trilane.scheduler.state import StageState


class LateFrames:
    """Drops waiting frames of a run.

    `policy`: policy that says which frames are dropped.
    `flow`, `source`: where frames wait.
    `choice`: knows whether a frame must be late.
    """

    def __init__(self, policy: Policy, flow: Flow, source: Source, choice: Choice) -> None:
        self._policy, self._flow, self._source, self._choice = policy, flow, source, choice

    def drop(self, stage: StageState, now_ns: int) -> None:
        """Drop the frames that wait for the stage and are stale or must be late."""
        edge = stage.input
        if edge is None:
            if not self._choice.is_full():
                self._drop_at_source(stage, now_ns)
            return
        if self._policy.newest:
            while len(edge.ready) > 1:
                self._flow.drop_waiting(stage, edge.ready[0], DropCause.STALE)
            while stage.bypassed is not None and (slot := stale_slot(stage, self._flow.frames)) >= 0:
                self._flow.drop_waiting(stage, slot, DropCause.STALE)
        if self._policy.drop_late:
            while (slot := next_slot(stage, self._flow.frames)) >= 0 and self._choice.is_late(stage, now_ns):
                self._flow.drop_waiting(stage, slot, DropCause.LATE)

    def _drop_at_source(self, first: StageState, now_ns: int) -> None:
        if self._policy.newest:
            self._source.keep_newest()
        if self._policy.drop_late:
            while self._source.queue and self._choice.is_late(first, now_ns):
                if not self._flow.frames:  # nothing is in its way, so only the estimates make it late
                    for stage in self._flow.stages:
                        stage.lower_estimate()
                self._source.drop_late_head()
