"""The scheduler (which job runs where, and when), and the loop that every driver runs.

Rule: the core is pure. It knows the time only from `step`, and does no I/O. A driver runs a core against real or
simulated units. One loop (`run_loop`) serves all drivers, which differ only in their `Clock`.

Theory of operation. A driver calls `step` with the time and the events since the last step. The core answers with
actions to do now and with the time at which it wants to be asked again. The same steps give the same answers, so a run
can be replayed from its times and events. One step does five things, in this order:
- Each event changes the state of slots, frames and units.
- When the alarm has gone off, a unit whose deadline has passed is killed or started again. A unit whose pause for its
  duty is over may work again.
- The source releases the frames that are due.
- Every dirty unit is handed jobs until its queue is full or nothing can run.
- If no frame is in flight and none is to come, the run is finished.

Slots. Between two stages lies an edge with a fixed number of slots (transport/slots.py). A job holds its input slot and
its output slot from dispatch until it is done. Therefore a stage can begin only when a frame waits before it and a slot
is free behind it. This alone holds back the stages before a slow stage.

Bypass. A frame may skip the stages between two stages of a chain, if the first of these two stages says so. The frame
keeps its slot, waits in it for the second stage, and overtakes no other frame (flow.py).

Dirty units. A step looks only at dirty units. A unit becomes dirty when its job ends, a frame comes to one of its
stages, or a slot becomes free behind one. A change of its life or duty makes it dirty too. Code that changes one of
these calls `mark_dirty`. A dispatch may make a unit dirty that this step has already looked at; the step then looks at
it again.

The alarm is a time before which no unit's deadline passes and no unit's pause ends (`next_alarm_ns`). A new alarm is
computed from all units only after the old one has gone off or was reset. An event that moves a deadline to a later time
does not change the alarm, so the alarm may go off too early.

Dispatch ahead and lead. A unit holds its next job while another job runs, so that no message delay lies between the
two. A policy with a lead hands the next job over only `lead_ns` before the running job should end. Late latching delays
the first stage, so that its sample is still new when the second stage can take it.
"""

from __future__ import annotations

from typing import Any, Protocol

from trilane.scheduler.assignment import Assignment, Choice
from trilane.scheduler.events import (
    NEVER,
    Abort,
    Action,
    Decision,
    Drop,
    DropCause,
    Event,
    Finish,
    FrameRequest,
    Graph,
    Hold,
    Job,
    JobDone,
    JobFailed,
    Kill,
    Loss,
    LossKind,
    Outcome,
    OutcomeKind,
    Pinged,
    Pong,
    SchedulerStalled,
    SetDuty,
    Settings,
    StageAlone,
    Start,
    Stop,
    UnitDied,
    UnitReady,
)
from trilane.scheduler.flow import Flow
from trilane.scheduler.ledger import Books, Ledger
from trilane.scheduler.policy import Source, WorkLadder, policy_named
from trilane.scheduler.state import (
    FULL_DUTY,
    KILL,
    LOOK,
    READY,
    RESUME,
    START,
    STARTING,
    STOPPING,
    DeadlinePassed,
    FrameState,
    StageState,
    UnitState,
    back_off_ns,
    next_alarm_ns,
    verdict,
)


class Core:
    """The state machine of one run. `books`: settings of the ledger; None: the default settings.

    Raises ValueError for an unknown policy or edge, and for settings that do not fit the policy or the graph.
    """

    def __init__(self, graph: Graph, settings: Settings, books: Books | None = None) -> None:
        self.graph, self.settings = graph, settings
        self.policy = policy = policy_named(settings.policy)
        if policy.paced and not (settings.period_ns or settings.arrivals_ns or settings.asked):
            raise ValueError(f"policy {settings.policy!r} needs a period, arrivals or frame requests")
        self.ledger = Ledger(graph, books)
        self.source = Source(settings, self._count_drop_at_source)
        self.flow = Flow(graph, self.ledger, policy.newest or policy.drop_late)
        self.stages, self.units, self.frames = self.flow.stages, self.flow.units, self.flow.frames
        self.bypass = self.flow.bypass
        self.choice = Choice(settings, policy, self.source, self.flow)
        self.assignment = Assignment(policy, settings.hang_ns, self.flow, self.source, self.choice, self.ledger)
        self.actions: list[Action] = []
        self.now_ns = self.alarm_ns = 0
        self.started = self.finished = self.stopping = False
        self.outcome: Outcome | None = None
        self._stage_named = self.flow.stage_named
        self._latency_stage = self._stage_named[graph.latency_to]
        if not graph.is_chain and (settings.latch_ns or settings.works):
            raise ValueError("latching and a ladder of work need a chain of stages")
        self._hang_ns, self._lead_ns, self._latches = settings.hang_ns, policy.lead_ns, self.choice.latches
        self._estimates = self._lead_ns > 0 or policy.drop_late or self._latches
        self.ladder: WorkLadder | None = None
        if settings.works:
            if not settings.period_ns:
                raise ValueError("a ladder of work needs a period")
            lengths = (settings.period_ns, settings.deadline_ns)
            self.ladder = WorkLadder(self.stages, settings.works, settings.follow, *lengths)
        self._handlers = {
            UnitReady: self._on_ready,
            JobFailed: self._on_failed,
            UnitDied: self._on_died,
            Pinged: self._on_pinged,
            Pong: self._on_pong,
            SchedulerStalled: self._on_stalled,
            SetDuty: self._on_duty,
            StageAlone: self._on_alone,
            Stop: self._on_stop,
            FrameRequest: self._on_request,
            Hold: self._on_hold,
            Abort: self._on_abort,
        }

    def step(self, now_ns: int, events: tuple[Event, ...] = ()) -> Decision:
        """Take the events and the time, and return the actions to carry out and the time of the next step.

        `now_ns`: time in ns; must not decrease from step to step.
        `events`: events since the last step. Those after the finish are ignored.

        Raises KeyError for an unknown unit or stage, and UnitLifeError for an event that cannot happen to a unit now.
        Raises ValueError for a frame that skips where no bypass begins, and for a rung that the ladder does not have.
        """
        self.now_ns = now_ns
        self.actions = []
        for event in events:
            if self.finished:
                break
            if type(event) is JobDone:  # most events: the table takes longer
                self._on_done(event)
            else:
                self._handlers[type(event)](event)  # type: ignore[operator]
        if not self.finished and (now_ns >= self.alarm_ns or self._lead_ns):
            self._check_units()
        if self.started and not self.finished:
            if self._latches:
                self.flow.mark_dirty(self.stages[0].unit)  # time alone may let it begin, without any event
            released_ns = self._release(now_ns) if now_ns >= self.source.due_ns else now_ns
            before = len(self.actions)
            self.assignment.assign(now_ns, released_ns, self.actions)
            if len(self.actions) > before:
                self._set_alarm(now_ns + self._hang_ns)  # the deadline of a job that was handed out now
            if not self.frames and self.source.exhausted:
                self._finish(Outcome(OutcomeKind.STOPPED if self.stopping else OutcomeKind.DONE))
        next_ns = NEVER if self.finished else self._next_deadline()
        return Decision(tuple(self.actions), next_ns)

    def report(self, *, clock: str, requested: int | None = None) -> dict[str, Any]:
        """Return the ledger's report.

        `clock`: "host" or "virtual".
        `requested`: number of frames that were asked for; None: the number in the settings.
        """
        asked = self.settings.frames if requested is None else requested
        return self.ledger.report(clock=clock, requested=asked, not_begun=asked - self.source.left)

    def _release(self, now_ns: int) -> int:
        """Release the frames that are due. Return the time in ns at which the first was due; `now_ns` if none was."""
        due_ns = self.source.due_ns
        if not self.source.advance(now_ns):
            return now_ns
        self.flow.mark_roots_dirty()
        return due_ns

    def _next_deadline(self) -> int:
        if self._lead_ns or self.alarm_ns <= self.now_ns:
            self.alarm_ns = next_alarm_ns(self.units.values(), self.now_ns, self._lead_ns)
        # before the start nothing is released, even if it is due
        next_ns = self.source.due_ns if self.started else NEVER
        if self.alarm_ns < next_ns:
            next_ns = self.alarm_ns
        if self._latches and not self.source.is_empty:
            latch_ns = self.choice.latch_from_ns(self.now_ns)
            if self.now_ns < latch_ns < next_ns:
                return latch_ns
        return next_ns

    def _reset_alarm(self) -> None:
        """Let this step compute the alarm from all units again, because a unit's deadline or pause was set."""
        self.alarm_ns = 0

    def _set_alarm(self, at_ns: int) -> None:
        if at_ns < self.alarm_ns:
            self.alarm_ns = at_ns

    def _finish(self, outcome: Outcome) -> None:
        self.finished, self.outcome = True, outcome
        self.ledger.close(self.now_ns)
        self.actions.append(Finish(outcome))

    def _finish_at_once(self, loss: Loss, outcome: Outcome) -> None:
        for frame in list(self.frames):
            self.flow.mark_lost(frame, loss)
        self._finish(outcome)

    def _count_drop_at_source(self, frame: int, release_ns: int, cause: DropCause) -> None:
        self.ledger.drop(frame, release_ns, Drop(f"source->{self.graph.stages[0].name}", cause))

    # events of jobs

    def _on_done(self, event: JobDone) -> None:
        name, job_id, begin_ns, end_ns, read_ns, preempted_ns, asleep_ns, preempted_before_ns, skips = event
        unit = self.units[name]
        if not unit.queue or unit.queue[0].id != job_id:
            return  # the job was lost with its process
        job = unit.queue.popleft()
        self._begin_next(unit)
        unit.failures = 0  # only failures in a row count
        stage = self._stage_named[job.stage]
        # A frame that was given up while this job worked on it stays in `gone` until its jobs end.
        frame = self.frames.get(job.frame) or self.flow.gone[job.frame]
        service_ns = end_ns - begin_ns
        if skips:
            if self.bypass is None or stage is not self.bypass.begin:
                raise ValueError(f"stage {stage.name} skips, but no bypass begins there")
            frame.skips = True
        ready_ns = frame.ready_ns[stage.position]
        self.ledger.job(job, ready_ns, begin_ns, end_ns, preempted_ns, asleep_ns, preempted_before_ns)
        if self._estimates:
            stage.learn(service_ns)
        if self.ladder is not None and not frame.skips:
            self._step_work(self.ladder, stage, frame, service_ns)
        if unit.duty < FULL_DUTY:
            # The job is then `duty` thousandths of the time of job and pause.
            unit.hold_until_ns = end_ns + service_ns * (FULL_DUTY - unit.duty) // unit.duty
            unit.update_queue_capacity()
            self._reset_alarm()
        sampled_ns = None if stage.before else frame.release_ns if self.graph.from_release else read_ns
        frame.end_stage(sampled_ns, end_ns, stage is self._latency_stage)
        self.flow.pass_on(stage, job, end_ns)

    def ready_ns(self, job: Job) -> int | None:
        """Return the time in ns from which a job had all inputs; None if its frame is not in flight or in `gone`."""
        frame = self.frames.get(job.frame) or self.flow.gone.get(job.frame)
        return None if frame is None else frame.ready_ns[self._stage_named[job.stage].position]

    def deadline_ns(self, job: Job) -> int:
        """Return the deadline in ns, or NEVER, of the frame of a job that a unit holds."""
        return (self.frames.get(job.frame) or self.flow.gone[job.frame]).deadline_ns

    def _step_work(self, ladder: WorkLadder, stage: StageState, frame: FrameState, service_ns: int) -> None:
        """Give the ladder a measured service time. If the rung changes, set all stages' estimates for the new rung."""
        ladder.learn(stage.position, frame.rung, service_ns)
        if stage.position == ladder.last and ladder.consider():
            self.flow.rung = ladder.rung
            for each in self.stages:
                each.estimate_ns = ladder.service_ns(each.position, ladder.rung)

    def _begin_next(self, unit: UnitState) -> None:
        """Note that the unit's job is over: if the unit holds another job, that job begins now."""
        unit.head_since_ns = self.now_ns
        unit.deadline_ns = self.now_ns + self._hang_ns if unit.queue and unit.life == READY else NEVER

    def _on_failed(self, event: JobFailed) -> None:
        unit = self.units[event.unit]
        if not unit.queue or unit.queue[0].id != event.job:
            return  # the job was lost with its process
        job = unit.queue.popleft()
        self._begin_next(unit)
        self.flow.free_slots(job)
        if job.frame in self.frames:
            self.flow.mark_lost(job.frame, Loss(LossKind.FAILED, job.stage))
        self.flow.mark_dirty(unit)
        self._on_stop(Stop())

    # events of units, each by the table in state.py

    def _on_ready(self, event: UnitReady) -> None:
        unit = self.units[event.unit]
        if not unit.move(UnitReady, NEVER):
            return
        unit.update_queue_capacity()
        self._reset_alarm()
        self.flow.mark_dirty(unit)
        if not self.started and all(other.life == READY for other in self.units.values()):
            self.started = True
            self.ledger.start(self.now_ns)
            self.source.start(self.now_ns)

    def _on_died(self, event: UnitDied) -> None:
        """Plan the unit's restart and reclaim its slots; if the unit has failed too often, end the run."""
        unit = self.units[event.unit]
        # Only a unit that passed its deadline is stopping.
        loss = Loss(LossKind.HUNG if unit.life == STOPPING else LossKind.DIED, unit.name)
        unit.move(UnitDied, self.now_ns + back_off_ns(unit.failures + 1))  # the deadline is now the time of its restart
        unit.failures += 1
        unit.update_queue_capacity()
        self._reset_alarm()
        self.flow.reclaim(unit, loss)
        self.flow.mark_dirty(unit)
        if unit.failures > self.settings.max_failures:
            self._finish_at_once(Loss(LossKind.GAVE_UP, unit.name), Outcome(OutcomeKind.GAVE_UP, unit.name))

    def _on_pinged(self, event: Pinged) -> None:
        unit = self.units[event.unit]
        answer_by_ns = self.now_ns + self._hang_ns
        # A job that was handed out meanwhile has a deadline of its own.
        if unit.move(Pinged, unit.deadline_ns if unit.queue else answer_by_ns):
            self._set_alarm(answer_by_ns)

    def _on_pong(self, event: Pong) -> None:
        unit = self.units[event.unit]
        unit.move(Pong, unit.deadline_ns if unit.queue else NEVER)

    def _on_duty(self, event: SetDuty) -> None:
        unit = self.units[event.unit]
        unit.duty = max(1, min(FULL_DUTY, event.permille))
        unit.update_queue_capacity()
        self.flow.mark_dirty(unit)

    def _check_units(self) -> None:
        """Carry out the `verdict` on each unit: kill or start its process, end its pause, or mark it dirty."""
        for unit in self.units.values():
            found = verdict(unit, self.now_ns, self._lead_ns)
            if found == KILL:
                unit.move(DeadlinePassed, NEVER)
                unit.update_queue_capacity()
                self.flow.mark_dirty(unit)
                self.actions.append(Kill(unit.name))
            elif found == START:
                unit.move(DeadlinePassed, self.now_ns + self.settings.start_ns)
                unit.hold_until_ns = NEVER
                self.ledger.restart(unit.name)
                self.actions.append(Start(unit.name))
            elif found == RESUME:
                unit.hold_until_ns = NEVER
                unit.update_queue_capacity()
                self.flow.mark_dirty(unit)
            elif found == LOOK:
                self.flow.mark_dirty(unit)

    # events of the run

    def _on_stalled(self, event: SchedulerStalled) -> None:
        # The units could not be heard in that time, so their deadlines and expected ends do not count it.
        for unit in self.units.values():
            if unit.deadline_ns != NEVER and unit.life in (STARTING, READY):  # restarts are not delayed
                unit.deadline_ns += event.ns
            unit.head_since_ns += event.ns
        self._reset_alarm()

    def _on_alone(self, event: StageAlone) -> None:
        if self.ladder is not None:
            self.ladder.set_alone(self._stage_named[event.stage].position, event.rung, event.ns)

    def _on_stop(self, _event: Stop) -> None:
        self.stopping = True
        self.source.stop()

    def _on_request(self, event: FrameRequest) -> None:
        self.source.request(event.frames, self.now_ns)
        self.flow.mark_roots_dirty()

    def _on_hold(self, event: Hold) -> None:
        self.source.hold(event.frames, self.now_ns)
        self.ledger.hold(event.frames >= 0)
        self.flow.mark_roots_dirty()

    def _on_abort(self, _event: Abort) -> None:
        self._finish_at_once(Loss(LossKind.ABORTED), Outcome(OutcomeKind.ABORTED))


class Clock(Protocol):
    """A driver's side of `run_loop`: it tells the time, returns events and carries out the core's actions."""

    def wait(self, deadline_ns: int) -> tuple[int, tuple[Event, ...]]:
        """Wait until something happens or the deadline comes; return (time in ns, events).

        The returned times must not decrease. The method may return without an event at any time. The first call of a
        run must return a `UnitReady` for each unit that is up.

        `deadline_ns`: latest time of return; NEVER: wait for an event, as in the first call of a run.
        """

    def perform(self, now_ns: int, actions: tuple[Action, ...]) -> None:
        """Carry out the actions that the core returned at `now_ns`; there is at least one."""


class Recorder(Protocol):
    """An object that takes the steps of a run, such as `trilane.scheduler.recording.Recording`."""

    def add(self, now_ns: int, events: tuple[Event, ...], actions: tuple[Action, ...], core: Core) -> None:
        """Add the step that `core` has just taken, after its actions were performed."""


def run_loop(core: Core, clock: Clock, recording: Recorder | None = None) -> Outcome:
    """Run `core` until it finishes, add every step to `recording`, and return how the run ended.

    Raises any error of `clock`, and the errors of `Core.step`.
    """
    wait, perform = clock.wait, clock.perform  # looked up once: they are called for every step
    deadline_ns: int = NEVER
    while True:
        now_ns, events = wait(deadline_ns)
        actions, deadline_ns = core.step(now_ns, events)
        if actions:
            perform(now_ns, actions)
        if recording is not None:
            recording.add(now_ns, events, actions, core)
        if core.outcome is not None:
            return core.outcome
