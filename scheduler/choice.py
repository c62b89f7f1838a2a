"""Finds what could run next and what waits in vain. Rule: it only asks about the present state, and changes nothing."""

from __future__ import annotations

from collections.abc import Sequence

from trilane.scheduler.bypass import Bypass, next_slot, side_of
from trilane.scheduler.completion import earliest_completion_ns
from trilane.scheduler.events import NEVER, Settings
from trilane.scheduler.frame_source import Source
from trilane.scheduler.ledger import ASSIGNED, BLOCKED, STARVED, THROTTLED
from trilane.scheduler.policy import Candidate, Policy
from trilane.scheduler.state import FrameState, StageState, UnitState
from trilane.scheduler.unit_life import READY
from trilane.transport.slots import READING


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
        """Take what the choice depends on.

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
        """Whether the stage has a frame to take and a slot to put it in."""
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
        """Whether the number of frames in flight has reached its limit."""
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
        """Whether the frame that the stage would do next must miss its deadline."""
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
