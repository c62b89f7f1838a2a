"""A second scheduler, with which the core is compared. Rule: written from the rules, not from the scheduler's code.

It looks at every unit at every instant, marks nothing as dirty and keeps counts in place of slots. From the rules of
docs/conventions.md it works out every job, drop, loss, wait, latency and account. At the end stand pipelines, settings
and faults drawn at random; the same seed draws the same.
"""

from __future__ import annotations

import random
from collections import Counter
from dataclasses import dataclass
from typing import Any

from trilane.scheduler.events import Graph, Settings, StageSpec

SLOTS = {"single": 1, "double": 2, "triple": 3, "fifo:1": 1, "fifo:3": 3, "fifo:64": 64, "orphan:4": 4, "orphan": 6}
NO_TIME = (1 << 62) - 1


@dataclass(eq=False)
class Job:
    stage: int
    frame: int
    begin_ns: int
    end_ns: int
    skips: bool
    fresh: bool


class PlainUnit:
    def __init__(self, name: str, stages: list[int], duty: int) -> None:
        self.name, self.stages, self.duty = name, stages, duty
        self.queue: list[Any] = []  # of jobs
        self.is_up, self.free_ns, self.head_since_ns, self.failures = True, 0, 0, 0
        self.hold_until_ns: int | None = None
        self.start_ns: int | None = None
        self.ready_ns: int | None = None
        self.account, self.times_ns = "starved", Counter[str]()
        self.busy: list[tuple[int, int]] = []

    def room(self) -> int:
        if not self.is_up or self.hold_until_ns is not None:
            return 0
        return 2 if self.duty == 1000 else 1


LEAD_NS = {"sequential": 0, "pipelined": 0, "latest": 1_000_000, "deadline": 1_000_000}
BACK_OFF_NS = (0, 100_000_000, 400_000_000, 1_600_000_000)
RESTART_NS = 3_000_000


class PlainClock:
    """What both second schedulers have: units, a queue of frames that were released, and the next event of all."""

    def __init__(
        self, graph: Graph, settings: Settings, service: Any, delay_ns: int, faults: list[Any], duties: dict[str, int]
    ) -> None:
        self.graph, self.settings, self.service, self.delay_ns = graph, settings, service, delay_ns
        self.faults = sorted(faults)
        self.units = [
            PlainUnit(name, [i for i, s in enumerate(graph.stages) if s.unit == name], duties.get(name, 1000))
            for name in graph.units
        ]
        self.unit_of = [next(u for u in self.units if i in u.stages) for i in range(len(graph.stages))]
        self.estimate = [0] * len(graph.stages)
        self.queue: list[tuple[int, int]] = []
        self.next_frame = self.now_ns = 0
        self.has_begun = False
        self.jobs: list[tuple[Any, ...]] = []
        self.ended: list[tuple[Any, ...]] = []
        self.dropped, self.lost = Counter[str](), Counter[str]()

    @property
    def is_paced(self) -> bool:
        return bool(self.settings.period_ns or self.settings.arrivals_ns)

    def release_ns(self, frame: int) -> int:
        arrivals = self.settings.arrivals_ns
        return arrivals[frame] if arrivals else frame * self.settings.period_ns

    def has_source(self) -> bool:
        return bool(self.queue) if self.is_paced else self.next_frame < self.settings.frames

    def is_full(self) -> bool:
        limits = [self.settings.in_flight] if self.settings.in_flight else []
        limits += [1] if self.settings.policy == "sequential" else []
        return bool(limits) and self.in_flight() >= min(limits)

    def in_flight(self) -> int:
        raise NotImplementedError

    def deadline(self, released_ns: int) -> int:
        return released_ns + self.settings.deadline_ns if self.settings.deadline_ns else NO_TIME

    def expected_end_ns(self, unit: PlainUnit) -> int:
        stage: int = unit.queue[0].stage
        return unit.head_since_ns + self.estimate[stage]

    def drop_from_queue(self, cause: str) -> None:
        self.queue.pop(0)
        self.dropped[f"source->{self.graph.stages[0].name}:{cause}"] += 1

    def in_all(self) -> bool:
        """Whether any frame has begun and has work left."""
        raise NotImplementedError

    def looks(self) -> list[int]:
        """Further times at which to look."""
        return []

    # what happens to units

    def finished(self, unit: PlainUnit) -> Any:
        """The job that the unit has ended, of which the unit and the estimates learn."""
        job = unit.queue.pop(0)
        took_ns = job.end_ns - job.begin_ns
        unit.head_since_ns, unit.failures = self.now_ns, 0
        unit.busy.append((job.begin_ns, job.end_ns))
        learnt = self.estimate[job.stage]
        self.estimate[job.stage] = learnt + ((took_ns - learnt) >> 3) if learnt else took_ns
        if unit.duty < 1000:
            unit.hold_until_ns = job.end_ns + took_ns * (1000 - unit.duty) // unit.duty
        return job

    def timed(self, unit: PlainUnit, stage: int, frame: int) -> tuple[int, int]:
        """When a job that is handed over now begins and ends."""
        begin_ns = max(self.now_ns + self.delay_ns, unit.free_ns)
        unit.free_ns = begin_ns + self.service(self.graph.stages[stage].name, unit.name, frame, begin_ns)
        if not unit.queue:
            unit.head_since_ns = self.now_ns
        return begin_ns, unit.free_ns

    def down(self, unit: PlainUnit) -> None:
        unit.is_up, unit.ready_ns = False, None
        unit.start_ns = self.now_ns + BACK_OFF_NS[unit.failures]
        unit.failures += 1

    def fault(self, name: str) -> list[PlainUnit]:
        self.faults.pop(0)
        unit = next(unit for unit in self.units if unit.name == name)
        if unit.is_up or unit.ready_ns is not None:
            self.die(unit)
        return []

    def ready(self, unit: PlainUnit) -> list[PlainUnit]:
        unit.is_up, unit.ready_ns = True, None
        return [unit]

    def die(self, unit: PlainUnit) -> None:
        raise NotImplementedError

    def done(self, unit: PlainUnit) -> list[PlainUnit]:
        """End the unit's job; the units to serve first."""
        raise NotImplementedError

    def account(self, unit: PlainUnit) -> str:
        raise NotImplementedError

    def assign(self, units: list[PlainUnit]) -> None:
        raise NotImplementedError

    # the run

    def run(self) -> None:
        while True:
            at_ns, event = self.next_event()
            for unit in self.units:
                unit.times_ns[unit.account] += at_ns - self.now_ns
            self.now_ns = at_ns
            first: list[PlainUnit] = event() if event is not None else []
            self.clockwork()
            self.assign([*first, *self.units])
            for unit in self.units:
                unit.account = self.account(unit)
            if not self.in_all() and not self.queue and self.next_frame >= self.settings.frames:
                return

    def next_event(self) -> tuple[int, Any]:
        """Faults come before other events at one time, events before the times that are only looked at."""
        events: list[tuple[int, int, int, Any]] = []
        if self.faults:
            at_ns, name = self.faults[0]
            events.append((at_ns, 0, 0, lambda: self.fault(name)))
        for number, unit in enumerate(self.units):
            if unit.queue:
                events.append((unit.queue[0].end_ns + self.delay_ns, 1, number, lambda u=unit: self.done(u)))
            if unit.ready_ns is not None:
                events.append((unit.ready_ns, 1, number, lambda u=unit: self.ready(u)))
        looks = [at for unit in self.units for at in (unit.hold_until_ns, unit.start_ns) if at is not None]
        if self.is_paced and self.next_frame < self.settings.frames:
            looks.append(self.release_ns(self.next_frame))
        if self.settings.queue_timeout_ns and self.queue:
            looks.append(self.queue[0][1] + self.settings.queue_timeout_ns)
        if lead_ns := LEAD_NS[self.settings.policy]:
            looks += [self.expected_end_ns(unit) - lead_ns for unit in self.units if len(unit.queue) == 1]
        later = [(at, 2, 0, None) for at in [*looks, *self.looks()] if self.now_ns < at < NO_TIME]
        if not self.has_begun:
            self.has_begun = True
            later.append((0, 2, 0, None))
        at_ns, _, _, event = min([*events, *later], key=lambda row: row[:3])
        return at_ns, event

    def clockwork(self) -> None:
        for unit in self.units:
            if unit.hold_until_ns is not None and unit.hold_until_ns <= self.now_ns:
                unit.hold_until_ns = None
            if unit.start_ns is not None and unit.start_ns <= self.now_ns:
                unit.start_ns, unit.ready_ns, unit.free_ns = None, self.now_ns + RESTART_NS, 0
                unit.hold_until_ns = None
        while self.is_paced and self.next_frame < self.settings.frames:
            if self.release_ns(self.next_frame) > self.now_ns:
                break
            self.queue.append((self.next_frame, self.release_ns(self.next_frame)))
            self.next_frame += 1
            if self.settings.in_queue and len(self.queue) > self.settings.in_queue:
                self.queue.pop()
                self.dropped[f"source->{self.graph.stages[0].name}:queue_full"] += 1
        timeout_ns = self.settings.queue_timeout_ns
        while timeout_ns and self.queue and self.queue[0][1] + timeout_ns <= self.now_ns:
            self.drop_from_queue("timeout")


class PlainState(PlainClock):
    """One run of `graph` at one instant: its units, frames and counts of slots, and what can be said of them."""

    def __init__(self, graph: Graph, settings: Settings, *rest: Any, will_skip: Any = None) -> None:
        super().__init__(graph, settings, *rest)
        self.will_skip = will_skip
        self.last = len(graph.stages) - 1
        self.waiting: list[list[int]] = [[] for _ in graph.stages]
        self.epoch = [0] * self.last
        self.flying: dict[int, dict[str, int]] = {}
        self.presented: list[tuple[int, int, int, int]] = []
        names = [stage.name for stage in graph.stages]
        self.begin, self.end = [names.index(name) for name in graph.bypass or ()] or (-9, -9)
        self.passing: list[int] = []  # frames on the bypass that wait for its end
        self.fresh, self.last_skipped = True, False

    # what there is

    def in_flight(self) -> int:
        return len(self.flying)

    def in_all(self) -> bool:
        return bool(self.flying)

    def looks(self) -> list[int]:
        return [self.latch_from_ns()] if self.has_source() else []

    def used(self, edge: int) -> int:
        """Slots of the edge that are written, waited in or read."""
        jobs: list[Job] = [job for unit in self.units for job in unit.queue]
        reads = [edge + 1 if job.stage != self.end or not self.skips(job.frame) else -1 for job in jobs]
        count = sum(edge == job.stage or job.stage == at for job, at in zip(jobs, reads, strict=True))
        if edge == self.begin:
            count += len(self.passing) + sum(job.stage == self.end and self.skips(job.frame) for job in jobs)
        return len(self.waiting[edge + 1]) + count

    def skips(self, frame: int) -> bool:
        return bool(self.flying[frame].get("skips"))

    def line(self, stage: int) -> list[int]:
        """The frames that the stage takes, in order: one on the bypass waits until no older one is before its end."""
        frames = list(self.waiting[stage])
        if stage == self.end:
            before = min((number for number, row in self.flying.items() if row["at"] < stage), default=NO_TIME)
            frames += [frame for frame in self.passing if frame < before]
        return sorted(frames)

    def has_slot(self, stage: int) -> bool:
        if stage == self.last:
            return True
        rule = self.graph.edges[stage]
        waits = self.waiting[stage + 1] or (stage == self.begin and self.passing)
        yields = rule.startswith(("triple", "orphan")) and bool(waits)
        return self.used(stage) < SLOTS[rule] or yields

    def latch_from_ns(self) -> int:
        if self.settings.latch_ns == 0 or self.last == 0:
            return self.now_ns
        waits = self.waiting[1] or (self.begin == 0 and self.passing)
        if waits or any(job.stage == 0 for job in self.unit_of[0].queue):
            return NO_TIME
        second = self.unit_of[1]
        jobs: list[Job] = second.queue
        free_ns = second.head_since_ns if jobs else self.now_ns
        free_ns += sum(self.estimate[job.stage] for job in jobs)
        return free_ns - self.estimate[0] - self.settings.latch_ns

    def has_input(self, stage: int) -> bool:
        return bool(self.line(stage)) if stage else self.has_source()

    def may_enter(self) -> bool:
        return not self.is_full() and self.now_ns >= self.latch_from_ns()

    def can_begin(self, stage: int) -> bool:
        return self.has_input(stage) and (stage > 0 or self.may_enter()) and self.has_slot(stage)

    def head(self, stage: int) -> tuple[int, int]:
        """The stage's next frame and its deadline."""
        if stage:
            frame = self.line(stage)[0]
            return frame, self.flying[frame]["deadline"]
        frame, released_ns = self.queue[0] if self.queue else (self.next_frame, self.now_ns)
        return frame, self.deadline(released_ns)

    def is_late(self, stage: int) -> bool:
        """now + max over s of [max(own work before s, work of older frames at s) + own work from s on] > deadline.

        A frame that has still to do the stage where the bypass begins will skip if the last one there did.
        """
        frame, deadline_ns = self.head(stage)
        ends = []
        skipped = range(self.begin + 1, self.end) if self.last_skipped else range(0)
        own = [0 if s in skipped and stage <= self.begin else ns for s, ns in enumerate(self.estimate)]
        for s in range(stage, self.last + 1):
            least = self.begin + 1 if s in skipped else 0
            older = sum(number < frame and least <= row["at"] <= s for number, row in self.flying.items())
            unit, backlog_ns = self.unit_of[s], older * self.estimate[s]
            if older and unit.queue and unit.queue[0].stage == s:
                backlog_ns -= min(self.now_ns - unit.head_since_ns, self.estimate[s])
            ends.append(max(sum(own[stage:s]), backlog_ns) + sum(own[s:]))
        return deadline_ns != NO_TIME and self.now_ns + max(ends) > deadline_ns


class PlainScheduler(PlainState):
    """One run of `graph` from 0 to its end; `run` fills the public fields."""

    def drop(self, stage: int, cause: str) -> None:
        """The oldest that waits for the stage."""
        if stage:
            self.drop_frame(self.waiting[stage][0], cause)
        else:
            self.drop_from_queue(cause)

    def drop_frame(self, frame: int, cause: str) -> None:
        """One that waits for its next stage."""
        stages, at = self.graph.stages, self.flying[frame]["at"]
        came_from = at - 1
        if frame in self.passing:
            came_from = self.begin
            self.passing.remove(frame)
        else:
            self.waiting[at].remove(frame)
        self.dropped[f"{stages[came_from].name}->{stages[at].name}:{cause}"] += 1
        self.remove(frame)

    def remove(self, frame: int) -> None:
        """It did not get through: what it would have brought to the bypass's end is missing there."""
        row = self.flying.pop(frame)
        self.fresh |= not row.get("skips") and row["at"] <= self.end

    def stale(self) -> list[int]:
        """On the bypass: those that wait although a newer frame waits there that could go as soon."""
        return [
            frame
            for frame in self.passing
            if any(
                newer > frame and not any(frame < n < newer and row["at"] < self.end for n, row in self.flying.items())
                for newer in self.waiting[self.end] + self.passing
            )
        ]

    def drop_in_vain(self, stage: int) -> None:
        policy = self.settings.policy
        if stage == 0 and self.is_full():
            return
        line: list[Any] = self.waiting[stage] if stage else self.queue
        while policy == "latest" and len(line) > 1:
            self.drop(stage, "stale")
        while policy == "latest" and stage == self.end and self.stale():
            self.drop_frame(self.stale()[0], "stale")
        while policy == "deadline" and (self.line(stage) if stage else self.queue) and self.is_late(stage):
            if stage == 0 and not self.flying:
                self.estimate = [ns - (ns >> 4) for ns in self.estimate]
            if stage:
                self.drop_frame(self.line(stage)[0], "late")
            else:
                self.drop(0, "late")

    def next_stage(self, unit: PlainUnit) -> int | None:
        lead_ns = LEAD_NS[self.settings.policy]
        if lead_ns and unit.queue and self.now_ns < self.expected_end_ns(unit) - lead_ns:
            return None
        runnable = []
        for stage in unit.stages:
            self.drop_in_vain(stage)
            if self.can_begin(stage):
                runnable.append(stage)
        if self.settings.policy == "latest":
            return max(runnable, default=None)
        if self.settings.policy == "deadline":
            return min(runnable, key=lambda stage: self.head(stage)[::-1], default=None)
        return min(runnable, key=lambda stage: self.head(stage)[0], default=None)

    def hand_over(self, unit: PlainUnit, stage: int) -> None:
        if stage:
            frame = self.line(stage)[0]
            (self.passing if frame in self.passing else self.waiting[stage]).remove(frame)
        else:
            frame, released_ns = self.queue.pop(0) if self.queue else (self.next_frame, self.now_ns)
            self.next_frame = max(self.next_frame, frame + 1)
            self.flying[frame] = {"at": 0, "ready": released_ns, "deadline": self.deadline(released_ns), "pose": 0}
        if stage < self.last and self.used(stage) >= SLOTS[self.graph.edges[stage]]:
            first = self.passing[:1] if stage == self.begin else []
            victim = (first or self.waiting[stage + 1])[0]
            self.drop_frame(victim, "stale" if self.graph.edges[stage] == "triple" else "pool")
        begin_ns, end_ns = self.timed(unit, stage, frame)
        name = self.graph.stages[stage].name
        epoch = self.epoch[min(stage, self.last - 1)] if self.last else 0
        skips, fresh = False, False
        if stage == self.begin:
            fresh, self.fresh = self.fresh, False
            skips = self.will_skip(frame, fresh)
        unit.queue.append(Job(stage, frame, begin_ns, end_ns, skips, fresh))
        times = (self.flying[frame]["ready"], self.now_ns, begin_ns, end_ns)
        self.jobs.append((name, unit.name, frame, *times, epoch, fresh))

    def job_done(self, unit: PlainUnit) -> None:
        job = self.finished(unit)
        stage, end_ns, frame = job.stage, job.end_ns, self.flying[job.frame]
        row = (self.graph.stages[stage].name, job.frame, end_ns - job.begin_ns, job.begin_ns - frame["ready"], end_ns)
        self.ended.append(row)
        frame["ready"], frame["at"] = end_ns, stage + 1
        if stage == 0:
            frame["pose"] = job.begin_ns
        if self.graph.stages[stage].name == self.graph.latency_to:
            frame["latency"] = end_ns - frame["pose"]
        if stage == self.begin:
            self.last_skipped = bool(job.skips)
        if job.skips:
            frame["at"], frame["skips"] = self.end, 1
            while self.graph.edges[stage] == "triple" and self.passing:
                self.drop_frame(self.passing[0], "stale")
            self.passing.append(job.frame)
            return
        if stage == self.last:
            del self.flying[job.frame]
            self.presented.append((job.frame, end_ns, frame["latency"], end_ns - frame["deadline"]))
            return
        while self.graph.edges[stage] == "triple" and self.waiting[stage + 1]:
            self.drop(stage + 1, "stale")
        self.waiting[stage + 1].append(job.frame)

    def die(self, unit: PlainUnit) -> None:
        jobs, unit.queue = unit.queue, []
        for place, job in enumerate(jobs):
            self.fresh |= bool(job.fresh) and place == 1
            if place == 0 or job.stage == 0:
                self.remove(job.frame)
                self.lost[f"died:{unit.name}"] += 1
            else:
                skips = job.stage == self.end and self.skips(job.frame)
                line = self.passing if skips else self.waiting[job.stage]
                line[:] = sorted([*line, job.frame])
                edge = self.begin if skips else job.stage - 1
                while self.graph.edges[edge] == "triple" and len(line) > 1:
                    self.drop_frame(line[0], "stale")
        self.fresh |= self.end in unit.stages
        for stage in unit.stages:
            for edge in (stage - 1, stage, *([self.begin] if stage == self.end else [])):
                if 0 <= edge < self.last:
                    self.epoch[edge] += 1
        self.down(unit)

    def account(self, unit: PlainUnit) -> str:
        if unit.queue or not unit.is_up:
            return "assigned"
        why = "starved"
        for stage in unit.stages:
            if self.has_input(stage):
                if (stage == 0 and not self.may_enter()) or not self.has_slot(stage):
                    return "blocked"
                why = "throttled"
        return why

    def done(self, unit: PlainUnit) -> list[PlainUnit]:
        """The unit itself is served first, then the one before its stage, then the one after it."""
        stage, frame = unit.queue[0].stage, unit.queue[0].frame
        came_from = self.begin if stage == self.end and self.skips(frame) else stage - 1
        goes_to = self.end if unit.queue[0].skips else stage + 1
        self.job_done(unit)
        before = [self.unit_of[came_from]] if stage else []
        after = [self.unit_of[goes_to]] if stage < self.last else [self.unit_of[0]]
        return [unit, *before, *after]

    def assign(self, units: list[PlainUnit]) -> None:
        changed = True
        while changed:
            changed = False
            for unit in units:
                dropped = self.dropped.total()
                while len(unit.queue) < unit.room() and (stage := self.next_stage(unit)) is not None:
                    self.hand_over(unit, stage)
                    changed = True
                changed |= self.dropped.total() > dropped  # a frame less in flight: another may begin


def service_of(seed: int) -> Any:
    """0.2 to 5 ms, other for each stage and frame, so that hardly two jobs end in one instant."""
    return lambda stage, _unit, frame, _begin_ns: random.Random(f"{seed} {stage} {frame}").randint(200_000, 5_000_000)


def drawn(seed: int) -> tuple[Graph, Settings, int, list[tuple[int, str]], dict[str, int]]:
    draw = random.Random(seed)
    policy = draw.choice(["sequential", "pipelined", "pipelined", "latest", "deadline"])
    count = draw.randint(1, 5)
    stages = tuple(StageSpec(f"s{i}", draw.choice(["cpu", "gpu", "dsp"])) for i in range(count))
    # a frame that waits for a slot of the next edge is given up as late when its unit is looked at, which need not be
    # the first instant in which it is late: so the edges of `deadline` are never full
    rules = ["fifo:64"] if policy == "deadline" else [rule for rule in SLOTS if rule != "fifo:64"]
    graph = Graph(stages, tuple(draw.choice(rules) for _ in stages[1:]), draw.choice(stages).name)
    paced = policy in ("latest", "deadline") or draw.random() < 0.5
    rate = draw.choice(["period_ns", "arrivals_ns"]) if paced else None
    period_ns = draw.randint(2_000_000, 9_000_000)
    frames = 40
    arrivals_ns = tuple(sorted(draw.randint(0, frames * period_ns) for _ in range(frames)))
    settings = Settings(
        frames,
        policy,
        period_ns=period_ns if rate == "period_ns" else 0,
        arrivals_ns=arrivals_ns if rate == "arrivals_ns" else (),
        latch_ns=draw.choice([0, 0, 700_001]) if policy == "pipelined" else 0,
        deadline_ns=draw.choice([0, 9_000_000, 16_000_001, 30_000_000]) if paced or policy == "pipelined" else 0,
        in_flight=draw.choice([0, 0, 2, 3, 5]),
        in_queue=draw.choice([0, 0, 1, 2]),
        queue_timeout_ns=draw.choice([0, 0, 6_000_001]) if rate else 0,
    )
    faults = [(draw.randint(1, 150_000_000), draw.choice(graph.units)) for _ in range(draw.choice([0, 0, 1, 3]))]
    yields = any(rule.startswith(("triple", "orphan")) for rule in graph.edges)
    duties = {name: draw.choice([1000, 1000, 500, 333]) for name in graph.units} if not yields and count > 1 else {}
    return graph, settings, draw.choice([0, 50_001]), faults, duties


def skips_of(seed: int) -> Any:
    """Six of ten frames skip; of those that are told to be fresh one of ten, as one in which there is nobody."""

    def skips(frame: int, fresh: bool) -> bool:
        return random.Random(f"{seed} skip {frame}").random() < (0.1 if fresh else 0.6)

    return skips


def with_bypass(seed: int, graph: Graph) -> Graph:
    """`graph` with a bypass between two stages drawn at random, if it is long enough for one."""
    draw, count = random.Random(f"{seed} bypass"), len(graph.stages)
    ends = [(begin, end) for begin in range(count) for end in range(begin + 2, count)]
    if not ends:
        return graph
    begin, end = draw.choice(ends)
    names = [stage.name for stage in graph.stages]
    return Graph(graph.stages, graph.edges, draw.choice(names[: begin + 1] + names[end:]), (names[begin], names[end]))
