"""The scheduler: which job runs where, and when. Rule: pure; it knows the time only from `step`, and does no I/O.

Each step takes events in, moves slots and frames, hands jobs to units that can hold one more, and answers with
actions and with the time at which it wants to be asked again. The same events give the same actions.
"""

from __future__ import annotations

from trilane.scheduler import watchdog
from trilane.scheduler.completion import earliest_completion_ns
from trilane.scheduler.events import (
    Action,
    Decision,
    Dispatch,
    Event,
    Finish,
    FrameRequest,
    Graph,
    Job,
    JobDone,
    JobFailed,
    Pinged,
    Pong,
    SchedulerStalled,
    SetDuty,
    Settings,
    Stop,
    UnitDied,
    UnitReady,
)
from trilane.scheduler.frame_source import Source
from trilane.scheduler.ledger import ASSIGNED, BLOCKED, STARVED, THROTTLED, Ledger
from trilane.scheduler.policy import Candidate, policy_named
from trilane.scheduler.state import FULL_DUTY, NEVER, FrameState, StageState, UnitState, build
from trilane.transport.slots import READING, EdgeSlots


class Core:
    """The state machine of one run. Raises ValueError for an unknown policy or edge."""

    def __init__(self, graph: Graph, settings: Settings) -> None:
        self.graph, self.settings = graph, settings
        self.policy = policy_named(settings.policy)
        if self.policy.paced and not (settings.period_ns or settings.arrivals_ns or settings.asked):
            raise ValueError(f"policy {settings.policy!r} needs a period, arrivals or somebody who asks")
        self.stages, self.units, self.edges = build(graph)
        self.stage_named = {stage.name: stage for stage in self.stages}
        self.ledger = Ledger(graph)
        self.source = Source(settings, self._drop_at_source)
        self.frames: dict[int, FrameState] = {}
        self.actions: list[Action] = []
        self.now_ns = 0
        self.started = self.finished = self.stopping = False
        limits = [limit for limit in (settings.in_flight, self.policy.in_flight) if limit]
        self._in_flight = min(limits, default=0)
        self._latency_position = self.stage_named[graph.latency_to].position
        self._leads = self.policy.lead_ns is not None
        self._drops = self.policy.newest or self.policy.drop_late
        self._latches = settings.latch_ns > 0 and len(self.stages) > 1
        self._estimates = self._leads or self.policy.drop_late or self._latches
        self._jobs = 0
        self.alarm_ns = 0
        self._touched: list[UnitState] = []
        self.touch = self._touched.append  # something changed for the unit: look at it in this step
        self._handlers = {
            UnitReady: self._on_ready,
            JobDone: self._on_done,
            JobFailed: self._on_failed,
            UnitDied: self._on_died,
            Pinged: self._on_pinged,
            Pong: self._on_beat,
            SchedulerStalled: self._on_away,
            SetDuty: self._on_duty,
            Stop: self._on_stop,
            FrameRequest: self._on_ask,
        }

    def step(self, now_ns: int, events: tuple[Event, ...] = ()) -> Decision:
        """Tell the core what happened and what time it is; times never go back."""
        self.now_ns = now_ns
        self.actions = []
        for event in events:
            self._handlers[type(event)](event)  # type: ignore[operator]
        if not self.finished and (now_ns >= self.alarm_ns or self._leads):
            watchdog.check_clocks(self)
        if self.started and not self.finished:
            if self._latches:
                self.touch(self.stages[0].unit)
            if now_ns >= self.source.due_ns and self.source.advance(now_ns):
                self.touch(self.stages[0].unit)
            self._assign()
            if not self.frames and self.source.exhausted:
                self.finish("stopped" if self.stopping else "done")
        return Decision(tuple(self.actions), None if self.finished else self._next_deadline())

    def reset_alarm(self) -> None:
        """A unit's clock was set: this step's answer looks at all of them again."""
        self.alarm_ns = 0

    def _set_alarm(self, at_ns: int) -> None:
        if at_ns < self.alarm_ns:
            self.alarm_ns = at_ns

    def finish(self, cause: str) -> None:
        self.finished = True
        self.ledger.close(self.now_ns)
        self.actions.append(Finish(cause))

    def lose(self, frame: int, cause: str) -> None:
        del self.frames[frame]
        self.ledger.lost[cause] += 1
        self.touch(self.stages[0].unit)

    # events

    def _on_ready(self, event: UnitReady) -> None:
        unit = self.units[event.unit]
        unit.alive, unit.starting_ns, unit.pinged_ns = True, None, 0
        unit.set_room(self.now_ns)
        self.reset_alarm()
        self.touch(unit)
        if not self.started and all(other.alive for other in self.units.values()):
            self.started = True
            self.ledger.start(self.now_ns)
            self.source.start(self.now_ns)

    def _on_done(self, event: JobDone) -> None:
        name, job_id, begin_ns, end_ns, pose_ns = event
        unit = self.units[name]
        if not unit.queue or unit.queue[0].id != job_id:
            return
        job = unit.queue.popleft()
        unit.head_since_ns, unit.pinged_ns = self.now_ns, 0
        unit.failures = 0
        stage, frame = self.stage_named[job.stage], self.frames[job.frame]
        service_ns = end_ns - begin_ns
        self.ledger.job(job, frame.ready_ns, begin_ns, end_ns)
        if self._estimates:
            stage.learn(service_ns)
        if unit.duty < FULL_DUTY:
            unit.hold_until_ns = end_ns + service_ns * (FULL_DUTY - unit.duty) // unit.duty
            unit.set_room(self.now_ns)
            self.reset_alarm()
        position = stage.position
        frame.ready_ns, frame.position = end_ns, position + 1
        if position == 0:
            frame.pose_ns = pose_ns
        if position == self._latency_position:
            frame.latency_ns = end_ns - frame.pose_ns
        self.touch(unit)
        self._pass_on(stage, job, end_ns)

    def _pass_on(self, stage: StageState, job: Job, end_ns: int) -> None:
        source, sink = stage.input, stage.output
        if source is not None:
            if not source.free:
                self.touch(self.stages[stage.position - 1].unit)
            source.release(job.slot_in)
        if sink is not None:
            replaced = sink.commit(job.slot_out)
            if replaced:
                self._drop_all(replaced, stage.position)
            if len(sink.ready) == 1 or self._drops:
                self.touch(self.stages[stage.position + 1].unit)
        else:
            frame = self.frames.pop(job.frame)
            self.ledger.presented(job.frame, end_ns, frame.latency_ns, frame.deadline_ns)
            self.touch(self.stages[0].unit)

    def _on_failed(self, event: JobFailed) -> None:
        unit = self.units[event.unit]
        if not unit.queue or unit.queue[0].id != event.job:
            return
        job = unit.queue.popleft()
        unit.head_since_ns, unit.pinged_ns = self.now_ns, 0
        watchdog.free_slots(self, job)
        self.lose(job.frame, f"failed:{job.stage}")
        self.touch(unit)
        self._on_stop(Stop())

    def _on_died(self, event: UnitDied) -> None:
        watchdog.on_died(self, self.units[event.unit])

    def _on_pinged(self, event: Pinged) -> None:
        self.units[event.unit].pinged_ns = self.now_ns
        self._set_alarm(self.now_ns + self.settings.hang_ns)

    def _on_beat(self, event: Pong) -> None:
        self.units[event.unit].pinged_ns = 0

    def _on_away(self, event: SchedulerStalled) -> None:
        for unit in self.units.values():
            watchdog.extend_deadlines(unit, event.ns)
        self.reset_alarm()

    def _on_duty(self, event: SetDuty) -> None:
        unit = self.units[event.unit]
        unit.duty = max(1, min(FULL_DUTY, event.permille))
        unit.set_room(self.now_ns)
        self.touch(unit)

    def _on_stop(self, _event: Stop) -> None:
        self.stopping = True
        self.source.stop()

    def _on_ask(self, event: FrameRequest) -> None:
        self.source.ask(event.frames, self.now_ns)
        self.touch(self.stages[0].unit)

    # choice

    def _assign(self) -> None:
        touched = self._touched
        for unit in touched:  # a dispatch may append to the list, also a unit that was looked at before
            while len(unit.queue) < unit.room:
                stage = self._choose(unit)
                if stage is None:
                    break
                self._dispatch(unit, stage)
        for unit in touched:
            state = ASSIGNED if unit.queue else self._idle_state(unit)
            if state != unit.state:
                unit.state = state
                self.ledger.enter(unit.name, self.now_ns, state)
        touched.clear()

    def ahead_ns(self, unit: UnitState) -> int:
        """When a unit that runs a job may be handed its next one."""
        if self.policy.lead_ns is None:
            return 0
        return unit.head_since_ns + self.stage_named[unit.queue[0].stage].estimate_ns - self.policy.lead_ns

    def _choose(self, unit: UnitState) -> StageState | None:
        if self._leads and unit.queue and self.now_ns < self.ahead_ns(unit):
            return None
        found: list[StageState] = []
        for stage in unit.stages:
            if self._drops:
                self._give_up(stage)
            source, sink = stage.input, stage.output
            if source is None:
                if self.source.is_empty or self._is_full() or self.now_ns < self._latch_from_ns():
                    continue
            elif not source.ready:
                continue
            if sink is None or sink.free or sink.can_claim():
                found.append(stage)
        if len(found) > 1:
            return self.stages[self.policy.choose([self._candidate(stage) for stage in found]).position]
        return found[0] if found else None

    def _latch_from_ns(self) -> int:
        """When the first stage may begin its next frame: not while one waits behind it, and just in time."""
        if not self._latches:
            return 0
        first, second = self.stages[0], self.stages[1]
        edge = first.output
        if edge is not None and len(edge.free) + edge.state.count(READING) < edge.rule.slots:
            return NEVER
        queue = second.unit.queue
        free_ns = second.unit.head_since_ns if queue else self.now_ns
        for job in queue:
            free_ns += self.stage_named[job.stage].estimate_ns
        return free_ns - first.estimate_ns - self.settings.latch_ns

    def _candidate(self, stage: StageState) -> Candidate:
        """The frame that the stage would do next."""
        edge = stage.input
        if edge is None:
            frame, release_ns = self.source.head(self.now_ns)
            return Candidate(frame, stage.position, self._deadline_from(release_ns))
        frame = edge.frame[edge.ready[0]]
        return Candidate(frame, stage.position, self.frames[frame].deadline_ns)

    def _is_full(self) -> bool:
        """Whether as many frames are in flight as may be."""
        return 0 < self._in_flight <= len(self.frames)

    def _give_up(self, stage: StageState) -> None:
        """Drop what waits for the stage and is stale or must be late."""
        edge, policy = stage.input, self.policy
        if edge is None:
            if not self._is_full():
                self._give_up_at_source()
            return
        if policy.newest:
            while len(edge.ready) > 1:
                self._drop_all([edge.drop(edge.ready[0])], stage.position - 1)
        if policy.drop_late:
            while edge.ready and self._is_late(self._candidate(stage)):
                self._drop_all([edge.drop(edge.ready[0])], stage.position - 1, "late")

    def _give_up_at_source(self) -> None:
        if self.policy.newest:
            self.source.keep_newest()
        if self.policy.drop_late:
            while self.source.queue and self._is_late(self._candidate(self.stages[0])):
                self.source.drop_head("late")

    def _is_late(self, waiting: Candidate) -> bool:
        """Whether the frame must miss its deadline.

        With nothing in flight the estimates alone are to blame; they are lowered, so that one slow measurement
        cannot drop every frame for ever.
        """
        if not waiting.deadline_ns:
            return False
        end_ns = earliest_completion_ns(self.now_ns, waiting.frame, waiting.position, self.stages, self.frames)
        if end_ns <= waiting.deadline_ns:
            return False
        if not self.frames:
            for later in self.stages:
                later.estimate_ns -= later.estimate_ns >> 4
            self.reset_alarm()
        return True

    def _deadline_from(self, release_ns: int) -> int:
        return release_ns + self.settings.deadline_ns if self.settings.deadline_ns else 0

    def _dispatch(self, unit: UnitState, stage: StageState) -> None:
        slot_in = slot_out = -1
        if stage.input is None:
            frame, release_ns = self.source.take(self.now_ns)
            self.frames[frame] = FrameState(release_ns, self._deadline_from(release_ns))
        else:
            slot_in = stage.input.ready[0]
            frame = stage.input.frame[slot_in]
            stage.input.take(slot_in)
        if stage.output:
            slot_out, evicted = stage.output.claim(frame)
            if evicted is not None:
                self._drop_all([evicted], stage.position, "stale" if stage.output.rule.mailbox else "pool")
        pool: EdgeSlots | None = stage.output or stage.input
        job = Job(self._jobs, unit.name, stage.name, frame, slot_in, slot_out, pool.epoch if pool else 0)
        self._jobs += 1
        if not unit.queue:
            unit.head_since_ns = self.now_ns
            self._set_alarm(self.now_ns + self.settings.hang_ns)
        unit.queue.append(job)
        self.actions.append(Dispatch(job))

    # counts

    def _drop_all(self, frames: list[int], edge: int, cause: str = "stale") -> None:
        for frame in frames:
            del self.frames[frame]
            self.ledger.dropped[f"{self.graph.edge_name(edge)}:{cause}"] += 1
            self.touch(self.stages[edge].unit)
            self.touch(self.stages[0].unit)

    def _drop_at_source(self, _frame: int, cause: str) -> None:
        self.ledger.dropped[f"source->{self.stages[0].name}:{cause}"] += 1

    def _idle_state(self, unit: UnitState) -> int:
        """Why a unit without a job has none."""
        if not unit.alive:
            return ASSIGNED
        found = STARVED
        for stage in unit.stages:
            if stage.input is None:
                if self.source.is_empty:
                    continue
                if self._is_full() or self.now_ns < self._latch_from_ns():
                    return BLOCKED
            elif not stage.input.ready:
                continue
            if stage.output and not stage.output.can_claim():
                return BLOCKED
            found = THROTTLED
        return found

    def _next_deadline(self) -> int | None:
        if self._leads or self.alarm_ns <= self.now_ns:
            self.alarm_ns = watchdog.next_alarm_ns(self)
        next_ns = self.source.due_ns
        if self.alarm_ns < next_ns:
            next_ns = self.alarm_ns
        if self._latches and not self.source.is_empty and self.now_ns < (latch_ns := self._latch_from_ns()) < next_ns:
            next_ns = latch_ns
        return None if next_ns == NEVER else next_ns
