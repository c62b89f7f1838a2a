"""Chooses which job runs next, drops frames that wait in vain, and hands jobs to units.

Rule: only dirty units are looked at, in the order in which they were marked. `Choice` changes nothing: it only answers
questions about the present state.

A frame is dropped only when a step looks at the stage that the frame waits for. The policy says which frames are
dropped: frames that must be late, or frames that a newer frame has made stale.

A frame must be late if even the earliest end of its last stage is past its deadline. While service times stay as they
were lately, this earliest end is never later than the real end. Therefore no frame is given up that could be in time.
At every stage older frames go first. A frame begins at a stage when the older frames have left this stage, and the
frame itself has left the stages before. If the last frame at the beginning of a bypass took the bypass, the frames that
have yet to come there are assumed to take it.

In a graph whose branches meet, a frame that one branch has begun can no longer become stale (flow.py).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from trilane.scheduler.events import NEVER, Action, Dispatch, DropCause, Settings
from trilane.scheduler.flow import Bypass, Flow, next_slot, side_of, stale_slot
from trilane.scheduler.ledger import ASSIGNED, BLOCKED, JOIN, STARVED, THROTTLED, Ledger
from trilane.scheduler.policy import Candidate, Policy, Source
from trilane.scheduler.state import READY, FrameState, StageState, UnitState
from trilane.transport.slots import READING, EdgeSlots


def earliest_completion_ns(
    now_ns: int,
    frame: int,
    stages: Sequence[StageState],
    frames: Mapping[int, FrameState],
    todo: int,
    bypass: Bypass | None = None,
) -> int:
    """Return the earliest time in ns at which `frame` can end its last stage, by the estimates of service times.

    A stage ends its work on the frame at max(end of the stages before it, end of its older work) + its own time.

    `now_ns`: present time in ns.
    `frame`: number of the frame; frames with smaller numbers are older.
    `stages`: all stages in the order of the graph, with their estimates.
    `frames`: frames in flight, by number.
    `todo`: bits of the stages that the frame has yet to do.
    `bypass`: bypass that is assumed for all frames that have not reached its beginning; None: they take no bypass.
    """
    older = [state.todo for number, state in frames.items() if number < frame]
    skipped, skips = 0, 0
    if bypass is not None:
        skipped = sum(stage.bit for stage in stages if bypass.begin.position < stage.position < bypass.end.position)
        skips = bypass.begin.bit
    ends: list[int] = []
    for stage in stages:
        if not todo & stage.bit:
            ends.append(0)
            continue
        end = max([ends[place] for place in stage.after], default=0)
        count = sum(1 for left in older if left & stage.bit and not (stage.bit & skipped and left & skips))
        if count:
            end = max(end, count * stage.estimate_ns - _done_of_running(now_ns, stage))
        # The bypass leads the frame past the stages of `skipped`, so they cost it no time.
        ends.append(end if stage.bit & skipped and todo & skips else end + stage.estimate_ns)
    return now_ns + max(ends)


def _done_of_running(now_ns: int, stage: StageState) -> int:
    """Return for how many ns the stage's job has run, at most the estimated service time; 0 if the stage has no job."""
    queue = stage.unit.queue
    if not queue or queue[0].stage != stage.name:
        return 0
    return min(now_ns - stage.unit.head_since_ns, stage.estimate_ns)  # a job that takes longer may end at any time


class Choice:
    """Answers questions about the present state of the stages, the source and the frames of a `Core`."""

    def __init__(self, settings: Settings, policy: Policy, source: Source, flow: Flow) -> None:
        self._policy, self._source, self._flow = policy, source, flow
        self._stages, self._frames, self._bypass = flow.stages, flow.frames, flow.bypass
        self._stage_named, stages = flow.stage_named, flow.stages
        self._latch_ns, self.due_from_ns = settings.latch_ns, settings.due_from_ns
        self._in_flight = min([limit for limit in (settings.in_flight, policy.in_flight) if limit], default=0)
        self.latches = settings.latch_ns > 0 and len(stages) > 1

    def can_begin(self, stage: StageState, now_ns: int) -> bool:
        """Return whether the stage has a frame to take and an output slot to write to.

        The source gives no frame while the limit of frames in flight is reached, or before `latch_from_ns`.
        """
        source, sink = stage.input, stage.output
        if source is None:
            if self._source.is_empty or self.is_full() or (self.latches and now_ns < self.latch_from_ns(now_ns)):
                return False
        elif not stage.waiting and (stage.bypassed is None or next_slot(stage, self._frames) < 0):
            return False
        if stage.others and not all(stage.others):
            return False
        return sink is None or bool(sink.free) or (sink.rule.yields and self.can_claim(stage, sink))

    def can_claim(self, stage: StageState, sink: EdgeSlots) -> bool:
        """Return whether an output slot of the stage is free, or can be taken from a waiting frame."""
        if self._flow.is_chain:
            return sink.can_claim()
        return sink.can_claim(lambda frame: self._flow.must_stay(stage, frame))

    def slot_to_take(self, stage: StageState) -> int:
        """Return the slot, on the stage's first input, of the next frame that all its inputs have; -1: no such frame.

        If a bypass ends at the stage, the slot is numbered as in `Job.slot_in`.
        """
        if stage.bypassed is not None:
            return next_slot(stage, self._frames)
        return stage.waiting[0] if stage.waiting and all(stage.others) else -1

    def preferred(self, runnable: Sequence[StageState], now_ns: int) -> StageState:
        """Return the stage of `runnable` (stages of one unit) whose job the policy chooses."""
        return self._stages[self._policy.choose([self._candidate(stage, now_ns) for stage in runnable]).position]

    def is_full(self) -> bool:
        """Return whether the number of frames in flight has reached its limit; presented frames do not count."""
        return 0 < self._in_flight <= len(self._frames) - self._flow.aside

    def latch_from_ns(self, now_ns: int) -> int:
        """Return the time in ns from which the first stage may begin its next frame; only for a run that latches.

        The time is NEVER while the first stage works, or a frame waits for the second stage. Otherwise it is chosen so
        that the first stage should end `latch_ns` before the second stage's unit is free.
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
        """Return whether the stage's next frame can no longer meet its deadline; False without a deadline."""
        waiting = self._candidate(stage, now_ns)
        if waiting.deadline_ns == NEVER:
            return False
        bypass = self._bypass if self._bypass is not None and self._bypass.was_taken else None
        state = self._frames.get(waiting.frame)
        # Side work presents nothing, so it makes no frame late.
        todo = (self._flow.next_todo() if state is None else state.todo) & self._flow.main
        end_ns = earliest_completion_ns(now_ns, waiting.frame, self._stages, self._frames, todo, bypass)
        return end_ns > waiting.deadline_ns

    def account_without_job(self, unit: UnitState, now_ns: int) -> int:
        """Return the ledger's account that says why an idle unit has no job; ASSIGNED if the unit is not ready."""
        if unit.life != READY:
            return ASSIGNED
        account = STARVED
        for stage in unit.stages:
            if not stage.before and not stage.waiting:
                if self._source.is_empty:
                    continue
                if self.is_full() or (self.latches and now_ns < self.latch_from_ns(now_ns)):
                    return BLOCKED
            elif stage.others:
                there = [bool(line) for line in (stage.waiting, *stage.others)]
                if not all(there):
                    account = JOIN if any(there) and account == STARVED else account
                    continue
            elif not stage.waiting and (stage.bypassed is None or next_slot(stage, self._frames) < 0):
                continue
            sink = stage.output
            if sink is not None and not sink.free and not (sink.rule.yields and self.can_claim(stage, sink)):
                return BLOCKED
            account = THROTTLED  # it has input and a free slot, so only its duty can hold it
        return account

    def _candidate(self, stage: StageState, now_ns: int) -> Candidate:
        """Return the stage's next job as a candidate; a frame must be there to take."""
        edge = stage.input
        if edge is None:
            frame, release_ns = self._source.head(now_ns)
            return Candidate(frame, stage.position, self.due_from_ns(release_ns))
        if stage.bypassed is None:
            slot = stage.waiting[0]
        else:
            edge, slot = side_of(stage, next_slot(stage, self._frames))
        frame = edge.frame[slot]
        return Candidate(frame, stage.position, self._frames[frame].deadline_ns)


class _LateFrames:
    """Drops waiting frames that are stale, or can no longer meet their deadline."""

    def __init__(self, policy: Policy, flow: Flow, source: Source, choice: Choice) -> None:
        self._policy, self._flow, self._source, self._choice = policy, flow, source, choice

    def drop(self, stage: StageState, now_ns: int) -> None:
        """Drop frames that wait for the stage: stale and late ones, each only if the policy drops such frames."""
        edge = stage.input
        if edge is None:
            if not self._choice.is_full():
                self._drop_at_source(stage, now_ns)
            return
        if self._policy.newest:
            self._drop_stale(stage)
            while stage.bypassed is not None and (slot := stale_slot(stage, self._flow.frames)) >= 0:
                self._flow.drop_waiting(stage, slot, DropCause.STALE)
        if self._policy.drop_late and stage.is_main:
            while (slot := self._choice.slot_to_take(stage)) >= 0 and self._choice.is_late(stage, now_ns):
                if not stage.before and len(self._flow.frames) == 1:
                    self._expect_less()
                self._flow.drop_waiting(stage, slot, DropCause.LATE)

    def _drop_stale(self, stage: StageState) -> None:
        """Drop the frames that the stage could take, but keep the newest, and frames that another branch has begun."""
        line, edge, flow = stage.waiting, stage.input, self._flow
        if flow.is_chain or edge is None:
            while len(line) > 1:
                flow.drop_waiting(stage, line[0], DropCause.STALE)
            return
        if len(line) > 1:
            complete = [slot for slot in line if self._is_complete(stage, edge.frame[slot])]
            for slot in complete[:-1]:
                if not stage.is_main or not flow.is_held(stage, edge.frame[slot]):
                    flow.drop_waiting(stage, slot, DropCause.STALE)

    def _is_complete(self, stage: StageState, frame: int) -> bool:
        """Return whether all inputs of the stage have the frame."""
        return all(any(inlet.edge.frame[slot] == frame for slot in inlet.waiting) for inlet in stage.inlets)

    def _drop_at_source(self, first: StageState, now_ns: int) -> None:
        if self._policy.newest:
            self._source.keep_newest()
        if self._policy.drop_late:
            while self._source.queue and self._choice.is_late(first, now_ns):
                if not self._flow.frames:
                    self._expect_less()
                self._source.drop_late_head()

    def _expect_less(self) -> None:
        """Lower all estimates by a sixteenth: they are too high if a frame seems late while no other is in flight.

        An estimate may come from one slow job. While every frame is dropped as late, no other job corrects it.
        """
        for stage in self._flow.stages:
            stage.estimate_ns -= stage.estimate_ns >> 4


class Assignment:
    """Fills the queues of the units of a run."""

    def __init__(
        self, policy: Policy, hang_ns: int, flow: Flow, source: Source, choice: Choice, ledger: Ledger
    ) -> None:
        """Take the parts of the run.

        `policy`: policy that says which frames are given up, and how far ahead jobs are handed out.
        `hang_ns`: longest time of a job in ns.
        `flow`, `source`: frames in flight, and frames that have yet to be put in flight; this class changes both.
        `choice`: object that says what could run next.
        `ledger`: ledger that gets the reasons why units have no job.
        """
        self._hang_ns = hang_ns
        self._flow, self._source, self._choice, self._ledger = flow, source, choice, ledger
        self._lead_ns = policy.lead_ns
        self._first_unit = flow.stages[0].unit
        self._late = _LateFrames(policy, flow, source, choice)
        self._newest, self._is_fed = policy.newest, bool(flow.source_lines)
        drops = policy.newest or policy.drop_late
        self._drops = drops and flow.is_chain
        self._drops_first = drops and not flow.is_chain
        self._prepares = self._is_fed or self._drops_first

    def assign(self, now_ns: int, released_ns: int, actions: list[Action]) -> None:
        """Hand jobs to each dirty unit until its queue is full or it has nothing to run.

        `released_ns`: time at which the first frame that this step released was due; `now_ns` if it released none. If
        the first stage's unit was starved, the ledger counts its new job as assigned from this time on.
        `actions`: list that gets a `Dispatch` for each job.
        """
        dirty, is_fed = self._flow.dirty, self._is_fed
        for unit in dirty:  # a dispatch may append to it, even a unit looked at before
            if is_fed and self._source.queue:
                self._feed(now_ns)
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

    def _feed(self, now_ns: int) -> None:
        """Put released frames in flight, up to the limit. If the policy takes the newest frame, drop all others."""
        while self._source.queue and not self._choice.is_full():
            if self._newest:
                self._source.keep_newest()
            self._admit(now_ns)

    def _feed_stage(self, stage: StageState, now_ns: int) -> None:
        """If the stage has no inputs and its output has room, put frames in flight until one waits for the stage.

        This ends early when the source is empty or the limit of frames in flight is reached.
        """
        if stage.before or not (stage.output is None or self._choice.can_claim(stage, stage.output)):
            return
        while not stage.waiting and not self._source.is_empty and not self._choice.is_full():
            self._admit(now_ns)

    def _admit(self, now_ns: int) -> int:
        """Put the source's next frame in flight, and return its number."""
        frame, release_ns = self._source.take(now_ns)
        self._flow.admit(frame, release_ns, self._choice.due_from_ns(release_ns))
        return frame

    def _next_stage(self, unit: UnitState, now_ns: int) -> StageState | None:
        if self._lead_ns and unit.queue and now_ns < unit.expected_end_ns() - self._lead_ns:
            return None
        if self._prepares:
            self._prepare(unit, now_ns)
        runnable: list[StageState] = []
        for stage in unit.stages:
            if stage.feeder is not None and not stage.waiting:  # most looks: `can_begin` takes longer
                continue
            if self._drops:
                self._late.drop(stage, now_ns)
            if self._choice.can_begin(stage, now_ns):
                runnable.append(stage)
        if len(runnable) > 1:
            return self._choice.preferred(runnable, now_ns)
        return runnable[0] if runnable else None

    def _prepare(self, unit: UnitState, now_ns: int) -> None:
        """Put frames in flight for the unit's stages, and drop frames that wait for them in vain.

        This happens before the policy chooses, because one stage may drop a frame that another stage could take.
        """
        if self._is_fed:
            for stage in unit.stages:
                self._feed_stage(stage, now_ns)
        if self._drops_first:
            for stage in unit.stages:
                self._late.drop(stage, now_ns)

    def _dispatch(self, unit: UnitState, stage: StageState, now_ns: int, actions: list[Action]) -> None:
        edge = stage.input
        slot_in = -1
        if edge is None:
            frame = self._admit(now_ns)
        elif stage.bypassed is None:
            slot_in = stage.waiting[0]
            frame = edge.frame[slot_in]
        else:
            slot_in = next_slot(stage, self._flow.frames)
            edge, slot = side_of(stage, slot_in)
            frame = edge.frame[slot]
        job = self._flow.begin(stage, frame, slot_in, now_ns)
        if not unit.queue:
            unit.head_since_ns = now_ns
            unit.deadline_ns = now_ns + self._hang_ns
        unit.queue.append(job)
        actions.append(Dispatch(job))
