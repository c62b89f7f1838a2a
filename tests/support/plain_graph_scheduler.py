"""A second scheduler for graphs. Rule: written from docs/decisions/graph-core.md, not from the scheduler's code.

It looks at every unit at every instant, marks nothing as dirty and keeps a list of slots for each stage, with who has
yet to read them. At the end stand graphs, settings and faults drawn at random; the same seed draws the same.
"""

from __future__ import annotations

import math
import random
from dataclasses import dataclass, field
from typing import Any

from support import plain_scheduler
from support.plain_scheduler import LEAD_NS, NO_TIME, PlainClock, PlainUnit
from trilane.scheduler.events import Graph, Input, Settings, StageSpec

SLOTS = {**plain_scheduler.SLOTS, "fifo:4": 4}


@dataclass(eq=False)
class Frame:
    """`todo`: stages that take it and have not begun it. `is_over`: shown, or of no use to the last stages."""

    number: int
    ordinal: int
    released_ns: int
    deadline_ns: int
    todo: set[int]
    begun: set[int] = field(default_factory=set)
    done: dict[int, int] = field(default_factory=dict)  # the stage, and when
    sampled_ns: int = NO_TIME
    latency_ns: int = 0
    is_over: bool = False
    is_gone: bool = False

    def left(self) -> set[int]:
        return self.todo | self.begun - set(self.done)


@dataclass(eq=False)
class Slot:
    """`pending`: stages that wait to read it. `holders`: stages of which it is the newest. `jobs`: that read it now."""

    frame: Frame
    is_written: bool = False
    pending: set[int] = field(default_factory=set)
    holders: set[int] = field(default_factory=set)
    jobs: list[Job] = field(default_factory=list)


@dataclass(eq=False)
class Job:
    stage: int
    frame: Frame
    inputs: list[Slot]
    output: Slot | None
    begin_ns: int
    end_ns: int


class PlainGraph(PlainClock):
    """One run of `graph` at one instant, and what can be said of it."""

    def __init__(self, graph: Graph, settings: Settings, service: Any, delay_ns: int, faults: Any, duties: Any) -> None:
        super().__init__(graph, settings, service, delay_ns, faults, duties)
        names = [stage.name for stage in graph.stages]
        self.inputs = [[(names.index(each.stage), each) for each in stage.inputs or ()] for stage in graph.stages]
        self.same = [[x for x, each in found if not each.latest] for found in self.inputs]
        places = range(len(names))
        self.readers = [[i for i in places if x in self.same[i]] for x in places]
        self.newest_readers = [
            [i for i in places if any(y == x and e.latest for y, e in self.inputs[i])] for x in places
        ]
        self.sources = [i for i in places if not self.same[i]]
        self.before: list[set[int]] = []
        self.period: list[int] = []
        for i in places:
            self.before.append(set(self.same[i]).union(*(self.before[x] for x in self.same[i])))
            self.period.append(math.lcm(graph.stages[i].every, *(self.period[x] for x in self.same[i])))
        ends = [i for i in places if not self.readers[i] and not self.newest_readers[i]]
        self.ends = ends
        self.is_side = [not any(i == end or i in self.before[end] for end in ends) for i in places]
        self.waits_at_release = len(self.sources) > 1 or graph.stages[self.sources[0]].every > 1
        streams = [i for i in places if self.readers[i] or self.newest_readers[i]]
        self.rule = dict(zip(streams, graph.edges, strict=True))
        self.slots: list[list[Slot]] = [[] for _ in places]
        self.newest: dict[tuple[int, int], Slot] = {}  # (reader, stage that is read)
        self.frames: list[Frame] = []
        self.ordinals = 0
        self.presented: list[tuple[int, int]] = []
        self.latencies: list[int] = []

    # what there is

    def in_flight(self) -> int:
        return sum(not frame.is_over for frame in self.frames)

    def in_all(self) -> bool:
        return bool(self.frames)

    def line(self, stage: int) -> list[Frame]:
        """The frames that the stage could read, in order."""
        return [f for f in self.frames if stage in f.todo and all(x in f.done for x in self.same[stage])]

    def head(self, stage: int) -> tuple[int, int] | None:
        """The frame that the stage would take, and its deadline."""
        if line := self.line(stage):
            return line[0].number, line[0].deadline_ns
        if stage not in self.sources or not self.has_source():
            return None
        frame, released_ns = self.queue[0] if self.queue else (self.next_frame, self.now_ns)
        return frame, self.deadline(released_ns)

    def may_enter(self, stage: int) -> bool:
        return bool(self.line(stage)) or not self.is_full()

    def has_slot(self, stage: int) -> bool:
        if stage not in self.rule:
            return True
        return len(self.slots[stage]) < SLOTS[self.rule[stage]] or bool(self.evictable(stage))

    def can_begin(self, stage: int) -> bool:
        if self.waits_at_release and not self.line(stage):
            return False
        return self.head(stage) is not None and self.may_enter(stage) and self.has_slot(stage)

    def is_kept(self, frame: Frame, stages: set[int]) -> bool:
        """Whether a stage that a picture waits for has begun it, other than `stages`."""
        return any(not self.is_side[s] and s not in stages for s in frame.begun)

    def evictable(self, stage: int, except_newest: bool = True) -> list[Slot]:
        """Of a stream that yields: what waits there and may be given up, the oldest first."""
        if not self.rule[stage].startswith(("triple", "orphan")):
            return []
        found = [s for s in self.slots[stage] if s.pending and not s.is_written and not s.jobs]
        found = [s for s in found if not (except_newest and s.holders)]
        own = self.before[stage] | {stage}
        found = [s for s in found if all(self.is_side[r] for r in s.pending) or not self.is_kept(s.frame, own)]
        return sorted(found, key=lambda s: s.frame.number)


class PlainGraphScheduler(PlainGraph):
    """One run of `graph` from 0 to its end; `run` fills the public fields."""

    # frames

    def admit(self, number: int, released_ns: int) -> Frame:
        todo = {i for i in range(len(self.period)) if self.ordinals % self.period[i] == 0}
        frame = Frame(number, self.ordinals, released_ns, self.deadline(released_ns), todo)
        self.ordinals += 1
        self.frames.append(frame)
        if self.graph.from_release:
            frame.sampled_ns = released_ns
        self.end_if_over(frame)
        return frame

    def end_if_over(self, frame: Frame) -> None:
        """It is shown when the last stages that take it have done it; its side work may still be left."""
        ends = set(self.ends) & (frame.todo | frame.begun)
        left = (ends or frame.todo | frame.begun) - set(frame.done)
        if not frame.is_over and not left:
            frame.is_over = True
            if any(end in frame.done for end in self.ends):
                self.presented.append((frame.number, max(frame.done[end] for end in self.ends if end in frame.done)))
                if frame.latency_ns:
                    self.latencies.append(frame.latency_ns)
            else:
                self.dropped[f"{','.join(self.graph.stages[i].name for i in self.ends)}:every"] += 1
        if frame.is_over and not frame.left() and frame in self.frames:
            self.frames.remove(frame)

    def remove(self, frame: Frame) -> None:
        self.frames.remove(frame)
        frame.is_gone = True
        for slots in self.slots:
            for slot in slots:
                if slot.frame is frame:
                    slot.pending.clear()
        self.free_slots()

    def free_slots(self) -> None:
        for slots in self.slots:
            slots[:] = [s for s in slots if s.is_written or s.pending or s.holders or s.jobs]

    def leave_out(self, frame: Frame, stage: int) -> None:
        """Side work: the frame goes on elsewhere."""
        out = {i for i in frame.todo if i == stage or stage in self.before[i]}
        frame.todo -= out
        for slots in self.slots:
            for slot in slots:
                if slot.frame is frame:
                    slot.pending -= out
        self.free_slots()
        self.end_if_over(frame)

    def drop(self, frame: Frame, edge: str, cause: str) -> None:
        if not frame.is_over:
            self.dropped[f"{edge}:{cause}"] += 1
        self.remove(frame)

    def evict(self, slot: Slot, stage: int) -> None:
        cause = "stale" if self.rule[stage] == "triple" else "pool"
        if all(self.is_side[r] for r in slot.pending):
            for reader in sorted(slot.pending):
                self.leave_out(slot.frame, reader)
        else:
            names = [self.graph.stages[r].name for r in self.readers[stage]]
            self.drop(slot.frame, f"{self.graph.stages[stage].name}->{','.join(names)}", cause)

    def all_readers(self, stage: int) -> list[int]:
        return self.readers[stage] + self.newest_readers[stage]

    def is_late(self, stage: int) -> bool:
        """Whether even the earliest end of the frame's work but side work is past its deadline.

        A stage begins when those that it reads have ended, and has done the older frames' work before.
        """
        found = self.head(stage)
        if found is None or found[1] == NO_TIME:
            return False
        number, deadline_ns = found
        frame = next((each for each in self.frames if each.number == number), None)
        left = frame.left() if frame else {i for i, every in enumerate(self.period) if self.ordinals % every == 0}
        ends: dict[int, int] = {}
        for i in sorted(s for s in left if not self.is_side[s]):
            older = sum(each.number < number and i in each.left() for each in self.frames)
            unit, backlog_ns = self.unit_of[i], older * self.estimate[i]
            if older and unit.queue and unit.queue[0].stage == i:
                backlog_ns -= min(self.now_ns - unit.head_since_ns, self.estimate[i])
            ends[i] = max(backlog_ns, *(ends.get(x, 0) for x in self.same[i]), 0) + self.estimate[i]
        return self.now_ns + max(ends.values(), default=0) > deadline_ns

    def drop_late(self, stage: int) -> None:
        """One that nothing is in the way of is late by the estimates alone, which are lowered."""
        from_queue = stage in self.sources and not self.waits_at_release
        while (self.queue if from_queue else self.line(stage)) and not self.is_side[stage] and self.is_late(stage):
            if stage in self.sources and len(self.frames) == (not from_queue):
                self.estimate = [ns - (ns >> 4) for ns in self.estimate]
            if from_queue:
                self.drop_from_queue("late")
            else:
                writer = self.graph.stages[self.same[stage][0]].name if self.same[stage] else "source"
                self.drop(self.line(stage)[0], f"{writer}->{self.graph.stages[stage].name}", "late")

    def drop_in_vain(self, stage: int) -> None:
        if self.settings.policy == "deadline" and (self.line(stage) or not self.is_full()):
            self.drop_late(stage)
        if self.settings.policy != "latest":
            return
        if stage in self.sources and not self.waits_at_release:
            while len(self.queue) > 1 and not self.is_full():
                self.drop_from_queue("stale")
            return
        for frame in self.line(stage)[:-1]:
            if self.is_side[stage]:
                self.leave_out(frame, stage)
            elif not self.is_kept(frame, self.before[stage]):
                name = self.graph.stages[self.same[stage][0]].name if self.same[stage] else "source"
                self.drop(frame, f"{name}->{self.graph.stages[stage].name}", "stale")

    # jobs

    def next_stage(self, unit: PlainUnit) -> int | None:
        lead_ns = LEAD_NS[self.settings.policy]
        if lead_ns and unit.queue and self.now_ns < self.expected_end_ns(unit) - lead_ns:
            return None
        runnable: list[tuple[int, int, int]] = []
        for stage in unit.stages:
            self.release_for(stage)
        for stage in unit.stages:
            self.drop_in_vain(stage)
        for stage in unit.stages:
            if self.can_begin(stage):
                head = self.head(stage)
                assert head is not None
                runnable.append((*head, stage))
        if not runnable:
            return None
        if self.settings.policy == "latest":
            return max(stage for _, _, stage in runnable)
        if self.settings.policy == "deadline":
            return min(runnable, key=lambda row: (row[1], row[0]))[2]
        return min(runnable, key=lambda row: row[0])[2]

    def release_for(self, stage: int) -> None:
        """Without a rate a frame is released when a stage could take it."""
        if stage not in self.sources or self.is_paced or not self.waits_at_release or not self.has_slot(stage):
            return
        while self.has_source() and not self.line(stage) and not self.is_full():
            self.next_frame += 1
            self.admit(self.next_frame - 1, self.now_ns)

    def taken(self, stage: int) -> Frame:
        if line := self.line(stage):
            return line[0]
        if not self.waits_at_release and self.queue:
            return self.admit(*self.queue.pop(0))
        self.next_frame += 1
        return self.admit(self.next_frame - 1, self.now_ns)

    def hand_over(self, unit: PlainUnit, stage: int) -> None:
        frame = self.taken(stage)
        if stage in self.rule and len(self.slots[stage]) >= SLOTS[self.rule[stage]]:
            self.evict(self.evictable(stage)[0], stage)
        frame.todo.remove(stage)
        frame.begun.add(stage)
        inputs, read = [], []
        for x, each in self.inputs[stage]:
            slot = self.newest.get((stage, x)) if each.latest else self.slot_of(x, frame)
            if slot and each.max_age_ns and self.now_ns - slot.frame.sampled_ns > each.max_age_ns:
                slot = None
            read.append(slot.frame.number if slot else None)
            if slot:
                inputs.append(slot)
                slot.pending.discard(stage)
        output = Slot(frame, is_written=True) if stage in self.rule else None
        if output:
            self.slots[stage].append(output)
        begin_ns, end_ns = self.timed(unit, stage, frame.number)
        job = Job(stage, frame, inputs, output, begin_ns, end_ns)
        for slot in inputs:
            slot.jobs.append(job)
        unit.queue.append(job)
        ready_ns = max((frame.done[x] for x in self.same[stage]), default=frame.released_ns)
        times = (ready_ns, self.now_ns, begin_ns, end_ns)
        self.jobs.append((self.now_ns, self.graph.stages[stage].name, unit.name, frame.number, tuple(read), times))

    def slot_of(self, stage: int, frame: Frame) -> Slot:
        return next(slot for slot in self.slots[stage] if slot.frame is frame)

    def release_inputs(self, job: Job) -> None:
        for slot in job.inputs:
            slot.jobs.remove(job)

    def job_done(self, unit: PlainUnit) -> None:
        job = self.finished(unit)
        stage, frame = job.stage, job.frame
        self.ended.append((self.graph.stages[stage].name, frame.number, job.begin_ns, job.end_ns))
        self.release_inputs(job)
        if stage in self.sources and not self.graph.from_release:
            frame.sampled_ns = min(frame.sampled_ns, job.begin_ns)
        if not frame.is_gone:
            self.goes_on(job)
        if job.output:
            job.output.is_written = False
        self.free_slots()

    def goes_on(self, job: Job) -> None:
        stage, frame = job.stage, job.frame
        frame.done[stage] = job.end_ns
        if self.graph.stages[stage].name == self.graph.latency_to:
            frame.latency_ns = job.end_ns - frame.sampled_ns
        if job.output:
            pending = {r for r in self.readers[stage] if r in frame.todo}
            for slot in self.evictable(stage, except_newest=False) if self.rule[stage] == "triple" else []:
                if slot.pending & pending:
                    self.evict(slot, stage)
            job.output.pending = pending & frame.todo
            for reader in self.newest_readers[stage]:
                if (old := self.newest.get((reader, stage))) is not None:
                    old.holders.remove(reader)
                self.newest[reader, stage] = job.output
                job.output.holders.add(reader)
        self.end_if_over(frame)

    def die(self, unit: PlainUnit) -> None:
        jobs, unit.queue = unit.queue, []
        for place, job in enumerate(jobs):
            frame = job.frame
            self.release_inputs(job)
            if job.output:
                job.output.is_written = False
            if not frame.is_gone:
                if place == 0 or (job.stage in self.sources and not self.waits_at_release):
                    if not frame.is_over:
                        self.lost[f"died:{unit.name}"] += 1
                    self.remove(frame)
                else:
                    self.wait_again(job)
        self.free_slots()
        self.down(unit)

    def wait_again(self, job: Job) -> None:
        job.frame.begun.remove(job.stage)
        job.frame.todo.add(job.stage)
        for x in self.same[job.stage]:
            self.slot_of(x, job.frame).pending.add(job.stage)
        for x in self.same[job.stage]:
            newest = max(s.frame.number for s in self.slots[x] if s.pending)
            for slot in self.evictable(x) if self.rule[x] == "triple" else []:
                if slot.frame.number < newest:
                    self.evict(slot, x)

    def account(self, unit: PlainUnit) -> str:
        if unit.queue or not unit.is_up:
            return "assigned"
        why = "starved"
        for stage in unit.stages:
            if self.head(stage) is not None:
                if not self.may_enter(stage) or not self.has_slot(stage):
                    return "blocked"
                why = "throttled"
            elif why == "starved" and any(slot.pending >= {stage} for x in self.same[stage] for slot in self.slots[x]):
                why = "join"
        return why

    # the run

    def done(self, unit: PlainUnit) -> list[PlainUnit]:
        """The unit itself is served first, then those that it reads, then those that read it."""
        stage = unit.queue[0].stage
        self.job_done(unit)
        near = [*(x for x, _ in self.inputs[stage]), *(self.all_readers(stage) or self.sources)]
        return [unit, *(self.unit_of[i] for i in near)]

    def clockwork(self) -> None:
        super().clockwork()
        self.enter()

    def enter(self) -> bool:
        entered = False
        while self.waits_at_release and self.queue and not self.is_full():
            while self.settings.policy == "latest" and len(self.queue) > 1:
                self.drop_from_queue("stale")
            self.admit(*self.queue.pop(0))
            entered = True
        return entered

    def assign(self, units: list[PlainUnit]) -> None:
        changed = True
        while changed:
            changed = False
            for unit in units:
                before = self.dropped.total(), sum(map(len, self.slots)), len(self.frames)
                while len(unit.queue) < unit.room() and (stage := self.next_stage(unit)) is not None:
                    self.hand_over(unit, stage)
                    changed = True
                changed |= (self.dropped.total(), sum(map(len, self.slots)), len(self.frames)) != before
            changed |= self.enter()


def drawn(seed: int, yields: bool = False) -> tuple[Graph, Settings, int, list[tuple[int, str]], dict[str, int]]:
    """Up to 12 stages. `yields`: whether streams may be `triple` and `orphan`."""
    draw = random.Random(f"{seed} graph")
    policy = draw.choice(["sequential", "pipelined", "pipelined", "latest", "deadline"])
    count = draw.randint(2, 12)
    units = [f"u{i}" for i in range(draw.randint(1, min(count, 6)))]
    sources = draw.choice([1, 1, 1, 2])
    stages: list[StageSpec] = []
    for i in range(count):
        read = draw.sample(range(i), min(i, draw.choice([1, 1, 1, 2, 2, 3]))) if i >= sources else []
        if i and draw.random() < 0.3 and i >= sources:
            read = sorted({*read, i - 1})
        inputs = tuple(Input(f"s{x}", draw.random() < 0.25, draw.choice([0, 0, 9_000_001])) for x in sorted(read))
        inputs = tuple(each if each.latest else Input(each.stage) for each in inputs)
        if inputs and all(each.latest for each in inputs):
            inputs = (Input(inputs[0].stage), *inputs[1:])
        stages.append(StageSpec(f"s{i}", draw.choice(units), inputs, draw.choice([1, 1, 1, 1, 1, 2, 3])))
    rules = ["fifo:64"] if policy == "deadline" else ["single", "double", "double", "fifo:3", "fifo:4"]
    rules += ["triple", "orphan:4"] if yields and policy != "deadline" else []
    newest = {each.stage for s in stages for each in s.inputs or () if each.latest}
    read_of = {each.stage for s in stages for each in s.inputs or ()}
    edges = tuple(
        draw.choice([rule for rule in rules if rule != "single" or s.name not in newest])
        for s in stages
        if s.name in read_of
    )
    ends = [s.name for s in stages if s.name not in read_of]
    graph = Graph(tuple(stages), edges, draw.choice(ends), from_release=draw.random() < 0.3)
    paced = policy in ("latest", "deadline") or draw.random() < 0.5
    rate = draw.choice(["period_ns", "arrivals_ns"]) if paced else None
    period_ns, frames = draw.randint(2_000_000, 12_000_000), 40
    settings = Settings(
        frames,
        policy,
        period_ns=period_ns if rate == "period_ns" else 0,
        arrivals_ns=tuple(sorted(draw.randint(0, frames * period_ns) for _ in range(frames)))
        if rate == "arrivals_ns"
        else (),
        deadline_ns=draw.choice([12_000_000, 30_000_001, 10**12]) if policy == "deadline" else 0,
        in_flight=draw.choice([0, 0, 2, 3, 5]),
        in_queue=draw.choice([0, 0, 1, 2]),
        queue_timeout_ns=draw.choice([0, 0, 6_000_001]) if rate else 0,
    )
    faults = [(draw.randint(1, 150_000_000), draw.choice(graph.units)) for _ in range(draw.choice([0, 0, 1, 3]))]
    duties = {name: draw.choice([1000, 1000, 1000, 500, 333]) for name in graph.units}
    return graph, settings, draw.choice([0, 50_001]), faults, duties
