"""Chooses what runs next, drops what waits in vain, and hands jobs to units.

Rule: only dirty units are looked at, in the order in which they were marked. `Choice` asks about the present state and
changes nothing.

A frame is dropped when the stage that it waits for is considered, and not before. The policy says which frames are
dropped: those that must be late, or those that a newer frame has made stale.

A frame must be late if even the earliest end of its last stage is past its deadline. That bound is never later than
the truth if service times stay what they were lately, so no frame is given up that could be in time. At every stage
older frames go first. So a frame begins at a stage after the older frames' work there, or after its own work at the
stages before, whichever ends later. With a bypass, a frame that has not come to its beginning is taken to do what the
last frame there did.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from trilane.scheduler.events import NEVER, Action, Dispatch, DropCause, Settings
from trilane.scheduler.flow import Bypass, Flow, next_slot, side_of, stale_slot
from trilane.scheduler.frame_source import Source
from trilane.scheduler.ledger import ASSIGNED, BLOCKED, STARVED, THROTTLED, Ledger
from trilane.scheduler.policy import Candidate, Policy
from trilane.scheduler.state import READY, FrameState, StageState, UnitState
from trilane.transport.slots import READING


def earliest_completion_ns(
    now_ns: int,
    frame: int,
    position: int,
    stages: Sequence[StageState],
    frames: Mapping[int, FrameState],
    bypass: tuple[int, int] = (0, 0),
) -> int:
    """Return the earliest end of the last stage of `frame`, in ns.

    It is now + max over s >= position of [ max(own work before s, work of older frames at s) + own work from s on ].

    `now_ns`: present time in ns.
    `frame`: number of the frame; frames with smaller numbers are older.
    `position`: position of its next stage in the chain.
    `stages`: stages of the chain, with the estimates of service times.
    `frames`: frames in flight, by number.
    `bypass`: positions of two stages; a frame that has yet to do the first skips the stages between them.
    """
    older = [0] * len(stages)
    for number, state in frames.items():
        if number < frame:
            older[state.position] += 1
    begin, end = bypass
    skipping = sum(older[: begin + 1])
    before, own, latest = sum(older[:position]), 0, 0
    rest = sum(stage.estimate_ns for stage in stages[position:] if position > begin or not begin < stage.position < end)
    for stage in stages[position:]:
        before += older[stage.position]
        is_skipped = begin < stage.position < end
        count = before - skipping if is_skipped else before
        backlog = count * stage.estimate_ns - _done_of_running(now_ns, stage) if count else 0
        latest = max(latest, max(own, backlog) + rest)
        if position > begin or not is_skipped:
            own += stage.estimate_ns
            rest -= stage.estimate_ns
    return now_ns + latest


def _done_of_running(now_ns: int, stage: StageState) -> int:
    """Return how much of the stage's running job is over in ns, by the estimate of its length."""
    queue = stage.unit.queue
    if not queue or queue[0].stage != stage.name:
        return 0
    return min(now_ns - stage.unit.head_since_ns, stage.estimate_ns)


class Choice:
    """A view of the core's own stages, source and frames."""

    def __init__(
        self,
        settings: Settings,
        policy: Policy,
        stages: list[StageState],
        source: Source,
        frames: dict[int, FrameState],
        bypass: Bypass | None,
    ) -> None:
        """Keep the parts of the run that the choice depends on.

        `settings`, `policy`: settings and policy of the run.
        `stages`: stages of the chain.
        `source`: source of its frames.
        `frames`: frames in flight, by number.
        `bypass`: bypass of the chain, or None.
        """
        self._bypass = bypass
        self._policy, self._stages, self._source, self._frames = policy, stages, source, frames
        self._stage_named = {stage.name: stage for stage in stages}
        self._deadline_ns, self._latch_ns = settings.deadline_ns, settings.latch_ns
        self._in_flight = min([limit for limit in (settings.in_flight, policy.in_flight) if limit], default=0)
        self.latches = settings.latch_ns > 0 and len(stages) > 1

    def can_begin(self, stage: StageState, now_ns: int) -> bool:
        """Return whether the stage has a frame to take and a slot to put it in."""
        source, sink = stage.input, stage.output
        if source is None:
            if self._source.is_empty or self.is_full() or (self.latches and now_ns < self.latch_from_ns(now_ns)):
                return False
        elif not source.ready and (stage.bypassed is None or next_slot(stage, self._frames) < 0):
            return False
        return sink is None or bool(sink.free) or sink.can_claim()

    def preferred(self, runnable: Sequence[StageState], now_ns: int) -> StageState:
        """Return the stage of `runnable` whose job the policy chooses for the unit."""
        return self._stages[self._policy.choose([self._candidate(stage, now_ns) for stage in runnable]).position]

    def is_full(self) -> bool:
        """Return whether the number of frames in flight has reached its limit."""
        return 0 < self._in_flight <= len(self._frames)

    def latch_from_ns(self, now_ns: int) -> int:
        """Return when the first stage may begin its next frame; only for a run that latches.

        The time is NEVER while one of its frames waits for the second stage. Otherwise it is so late that the first
        stage is expected to end `latch_ns` before the second stage's unit is free.
        """
        first, second = self._stages[0], self._stages[1]
        edge = first.output
        if edge is not None and len(edge.free) + edge.state.count(READING) < edge.rule.slots:
            return NEVER
        queue = second.unit.queue
        free_ns = second.unit.head_since_ns if queue else now_ns
        for job in queue:
            free_ns += self._stage_named[job.stage].estimate_ns
        return free_ns - first.estimate_ns - self._latch_ns

    def is_late(self, stage: StageState, now_ns: int) -> bool:
        """Return whether the frame that the stage would do next must miss its deadline."""
        waiting = self._candidate(stage, now_ns)
        if waiting.deadline_ns == NEVER:
            return False
        bypass = self._bypass
        ends = (bypass.begin.position, bypass.end.position) if bypass is not None and bypass.was_taken else (0, 0)
        end_ns = earliest_completion_ns(now_ns, waiting.frame, waiting.position, self._stages, self._frames, ends)
        return end_ns > waiting.deadline_ns

    def deadline_from_ns(self, release_ns: int) -> int:
        """Return the deadline of a frame that was released at `release_ns`, or NEVER."""
        return release_ns + self._deadline_ns if self._deadline_ns else NEVER

    def account_without_job(self, unit: UnitState, now_ns: int) -> int:
        """Return the account of the time of a unit whose queue is empty: why it has no job."""
        if unit.life != READY:
            return ASSIGNED
        account = STARVED
        for stage in unit.stages:
            if stage.input is None:
                if self._source.is_empty:
                    continue
                if self.is_full() or (self.latches and now_ns < self.latch_from_ns(now_ns)):
                    return BLOCKED
            elif not stage.input.ready and (stage.bypassed is None or next_slot(stage, self._frames) < 0):
                continue
            if stage.output and not stage.output.can_claim():
                return BLOCKED
            account = THROTTLED
        return account

    def _candidate(self, stage: StageState, now_ns: int) -> Candidate:
        """Return the frame that the stage would do next."""
        edge = stage.input
        if edge is None:
            frame, release_ns = self._source.head(now_ns)
            return Candidate(frame, stage.position, self.deadline_from_ns(release_ns))
        if stage.bypassed is None:
            slot = edge.ready[0]
        else:
            edge, slot = side_of(stage, next_slot(stage, self._frames))
        frame = edge.frame[slot]
        return Candidate(frame, stage.position, self._frames[frame].deadline_ns)


class _LateFrames:
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
        self._late = _LateFrames(policy, flow, source, choice)
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
