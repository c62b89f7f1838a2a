"""Hands jobs to units. Rule: only dirty units are looked at, in the order in which they were marked."""

from __future__ import annotations

from trilane.scheduler.bypass import next_slot, side_of
from trilane.scheduler.choice import Choice
from trilane.scheduler.events import Action, Dispatch
from trilane.scheduler.flow import Flow
from trilane.scheduler.frame_source import Source
from trilane.scheduler.late_frames import LateFrames
from trilane.scheduler.ledger import ASSIGNED, STARVED, Ledger
from trilane.scheduler.policy import Policy
from trilane.scheduler.state import StageState, UnitState


class Assignment:
    """Fills the queues of the units of a run."""

    def __init__(
        self, policy: Policy, hang_ns: int, flow: Flow, source: Source, choice: Choice, ledger: Ledger
    ) -> None:
        """Take the parts of the run.

        `policy`: policy that says which frames are given up, and how far ahead jobs are handed out.
        `hang_ns`: longest time of a job in ns.
        `flow`, `source`: frames in flight and frames to come, which this class moves.
        `choice`: what could run next.
        `ledger`: ledger for the reasons why units have no job.
        """
        self._hang_ns = hang_ns
        self._flow, self._source, self._choice, self._ledger = flow, source, choice, ledger
        self._lead_ns = policy.lead_ns
        self._first_unit = flow.stages[0].unit
        self._late = LateFrames(policy, flow, source, choice)
        self._drops = policy.newest or policy.drop_late

    def assign(self, now_ns: int, released_ns: int, actions: list[Action]) -> None:
        """Hand jobs to the dirty units, as `Dispatch` in `actions`, until each is full or has nothing to run.

        `released_ns`: time at which the first frame of this step's release was due, else now. A unit without input
        until then has waited for the scheduler since.
        """
        dirty = self._flow.dirty
        for unit in dirty:  # a dispatch may append to it, even a unit looked at before
            while len(unit.queue) < unit.queue_capacity:
                stage = self._next_stage(unit, now_ns)
                if stage is None:
                    break
                self._dispatch(unit, stage, now_ns, actions)
        for unit in dirty:
            account = ASSIGNED if unit.queue else self._choice.account_without_job(unit, now_ns)
            if account != unit.account:
                is_late = unit.account == STARVED and account == ASSIGNED and unit is self._first_unit
                unit.account, unit.account_ns = account, released_ns if is_late else now_ns
                self._ledger.enter(unit.name, unit.account_ns, account)
        dirty.clear()

    def _next_stage(self, unit: UnitState, now_ns: int) -> StageState | None:
        if self._lead_ns and unit.queue and now_ns < unit.expected_end_ns() - self._lead_ns:
            return None
        runnable: list[StageState] = []
        for stage in unit.stages:
            if self._drops:
                self._late.drop(stage, now_ns)
            if self._choice.can_begin(stage, now_ns):
                runnable.append(stage)
        if len(runnable) > 1:
            return self._choice.preferred(runnable, now_ns)
        return runnable[0] if runnable else None

    def _dispatch(self, unit: UnitState, stage: StageState, now_ns: int, actions: list[Action]) -> None:
        edge = stage.input
        slot_in = -1
        if edge is None:
            frame, release_ns = self._source.take(now_ns)
            self._flow.admit(frame, release_ns, self._choice.deadline_from_ns(release_ns))
        elif stage.bypassed is None:
            slot_in = edge.ready[0]
            frame = edge.frame[slot_in]
        else:
            slot_in = next_slot(stage, self._flow.frames)
            edge, slot = side_of(stage, slot_in)
            frame = edge.frame[slot]
        job = self._flow.begin(stage, frame, slot_in)
        if not unit.queue:
            unit.head_since_ns = now_ns
            unit.deadline_ns = now_ns + self._hang_ns
        unit.queue.append(job)
        actions.append(Dispatch(job))
