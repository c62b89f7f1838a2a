"""What a second scheduler knows, and what follows from it. Rule: written from the rules, not from the scheduler's code.

It keeps counts in place of slots; times are whole nanoseconds.
"""

from __future__ import annotations

from collections import Counter
from typing import Any

from trilane.scheduler.events import Graph, Settings

SLOTS = {"single": 1, "double": 2, "triple": 3, "fifo:1": 1, "fifo:3": 3, "fifo:64": 64, "orphan:4": 4, "orphan": 6}
NO_TIME = (1 << 62) - 1


class PlainUnit:
    def __init__(self, name: str, stages: list[int], duty: int) -> None:
        self.name, self.stages, self.duty = name, stages, duty
        self.queue: list[dict[str, int]] = []
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


class PlainState:
    """One run of `graph` at one instant: its units, frames and counts of slots, and what can be said of them."""

    def __init__(
        self,
        graph: Graph,
        settings: Settings,
        service: Any,
        delay_ns: int,
        faults: list[Any],
        duties: dict[str, int],
        will_skip: Any = None,
    ) -> None:
        self.will_skip = will_skip
        self.graph, self.settings, self.service, self.delay_ns = graph, settings, service, delay_ns
        self.last = len(graph.stages) - 1
        self.faults = sorted(faults)
        self.units = [
            PlainUnit(name, [i for i, s in enumerate(graph.stages) if s.unit == name], duties.get(name, 1000))
            for name in graph.units
        ]
        self.unit_of = [next(u for u in self.units if i in u.stages) for i in range(self.last + 1)]
        self.waiting: list[list[int]] = [[] for _ in graph.stages]
        self.epoch = [0] * self.last
        self.estimate = [0] * len(graph.stages)
        self.flying: dict[int, dict[str, int]] = {}
        self.queue: list[tuple[int, int]] = []
        self.next_frame = self.now_ns = 0
        self.has_begun = False
        self.jobs: list[tuple[Any, ...]] = []
        self.ended: list[tuple[str, int, int, int, int]] = []
        self.presented: list[tuple[int, int, int, int]] = []
        self.dropped, self.lost = Counter[str](), Counter[str]()
        names = [stage.name for stage in graph.stages]
        self.begin, self.end = [names.index(name) for name in graph.bypass or ()] or (-9, -9)
        self.passing: list[int] = []  # frames on the bypass that wait for its end
        self.fresh, self.last_skipped = True, False

    # what there is

    @property
    def is_paced(self) -> bool:
        return bool(self.settings.period_ns or self.settings.arrivals_ns)

    def release_ns(self, frame: int) -> int:
        arrivals = self.settings.arrivals_ns
        return arrivals[frame] if arrivals else frame * self.settings.period_ns

    def used(self, edge: int) -> int:
        """Slots of the edge that are written, waited in or read."""
        jobs = [job for unit in self.units for job in unit.queue]
        reads = [edge + 1 if job["stage"] != self.end or not self.skips(job["frame"]) else -1 for job in jobs]
        count = sum(edge == job["stage"] or job["stage"] == at for job, at in zip(jobs, reads, strict=True))
        if edge == self.begin:
            count += len(self.passing) + sum(job["stage"] == self.end and self.skips(job["frame"]) for job in jobs)
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

    def is_full(self) -> bool:
        limits = [self.settings.in_flight] if self.settings.in_flight else []
        limits += [1] if self.settings.policy == "sequential" else []
        return bool(limits) and len(self.flying) >= min(limits)

    def has_source(self) -> bool:
        return bool(self.queue) if self.is_paced else self.next_frame < self.settings.frames

    def latch_from_ns(self) -> int:
        if self.settings.latch_ns == 0 or self.last == 0:
            return self.now_ns
        waits = self.waiting[1] or (self.begin == 0 and self.passing)
        if waits or any(job["stage"] == 0 for job in self.unit_of[0].queue):
            return NO_TIME
        second = self.unit_of[1]
        free_ns = second.head_since_ns if second.queue else self.now_ns
        free_ns += sum(self.estimate[job["stage"]] for job in second.queue)
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

    def deadline(self, released_ns: int) -> int:
        return released_ns + self.settings.deadline_ns if self.settings.deadline_ns else NO_TIME

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
            if older and unit.queue and unit.queue[0]["stage"] == s:
                backlog_ns -= min(self.now_ns - unit.head_since_ns, self.estimate[s])
            ends.append(max(sum(own[stage:s]), backlog_ns) + sum(own[s:]))
        return deadline_ns != NO_TIME and self.now_ns + max(ends) > deadline_ns
