"""A second scheduler, with which the core is compared. Rule: written from the rules, not from the scheduler's code.

It looks at every unit at every instant and marks nothing as dirty. From the rules of docs/conventions.md it works out
every job, drop, loss, wait, latency and account.
"""

from __future__ import annotations

from typing import Any

from trilane.testing.plain_state import NO_TIME, SLOTS, PlainState, PlainUnit

LEAD_NS = {"sequential": 0, "pipelined": 0, "latest": 1_000_000, "deadline": 1_000_000}
BACK_OFF_NS = (0, 100_000_000, 400_000_000, 1_600_000_000)
RESTART_NS = 3_000_000


class PlainScheduler(PlainState):
    """One run of `graph` from 0 to its end; `run` fills the public fields."""

    def drop(self, stage: int, cause: str) -> None:
        """The oldest that waits for the stage."""
        if stage:
            self.drop_frame(self.waiting[stage][0], cause)
        else:
            self.queue.pop(0)
            self.dropped[f"source->{self.graph.stages[0].name}:{cause}"] += 1

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

    def expected_end_ns(self, unit: PlainUnit) -> int:
        return unit.head_since_ns + self.estimate[unit.queue[0]["stage"]]

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
        begin_ns = max(self.now_ns + self.delay_ns, unit.free_ns)
        name = self.graph.stages[stage].name
        end_ns = unit.free_ns = begin_ns + self.service(name, unit.name, frame, begin_ns)
        epoch = self.epoch[min(stage, self.last - 1)] if self.last else 0
        if not unit.queue:
            unit.head_since_ns = self.now_ns
        skips, fresh = False, False
        if stage == self.begin:
            fresh, self.fresh = self.fresh, False
            skips = self.will_skip(frame, fresh)
        job = {"stage": stage, "frame": frame, "begin": begin_ns, "end": end_ns, "from": self.now_ns, "skips": skips}
        unit.queue.append(job | {"fresh": fresh})
        times = (self.flying[frame]["ready"], self.now_ns, begin_ns, end_ns)
        self.jobs.append((name, unit.name, frame, *times, epoch, fresh))

    def job_done(self, unit: PlainUnit) -> None:
        job = unit.queue.pop(0)
        stage, end_ns, frame = job["stage"], job["end"], self.flying[job["frame"]]
        took_ns = end_ns - job["begin"]
        unit.head_since_ns, unit.failures = self.now_ns, 0
        unit.busy.append((job["begin"], end_ns))
        self.ended.append((self.graph.stages[stage].name, job["frame"], took_ns, job["begin"] - frame["ready"], end_ns))
        learnt = self.estimate[stage]
        self.estimate[stage] = learnt + ((took_ns - learnt) >> 3) if learnt else took_ns
        if unit.duty < 1000:
            unit.hold_until_ns = end_ns + took_ns * (1000 - unit.duty) // unit.duty
        frame["ready"], frame["at"] = end_ns, stage + 1
        if stage == 0:
            frame["pose"] = job["begin"]
        if self.graph.stages[stage].name == self.graph.latency_to:
            frame["latency"] = end_ns - frame["pose"]
        if stage == self.begin:
            self.last_skipped = bool(job["skips"])
        if job["skips"]:
            frame["at"], frame["skips"] = self.end, 1
            while self.graph.edges[stage] == "triple" and self.passing:
                self.drop_frame(self.passing[0], "stale")
            self.passing.append(job["frame"])
            return
        if stage == self.last:
            del self.flying[job["frame"]]
            self.presented.append((job["frame"], end_ns, frame["latency"], end_ns - frame["deadline"]))
            return
        while self.graph.edges[stage] == "triple" and self.waiting[stage + 1]:
            self.drop(stage + 1, "stale")
        self.waiting[stage + 1].append(job["frame"])

    def die(self, unit: PlainUnit) -> None:
        jobs, unit.queue = unit.queue, []
        for place, job in enumerate(jobs):
            self.fresh |= bool(job["fresh"]) and place == 1
            if place == 0 or job["stage"] == 0:
                self.remove(job["frame"])
                self.lost[f"died:{unit.name}"] += 1
            else:
                skips = job["stage"] == self.end and self.skips(job["frame"])
                line = self.passing if skips else self.waiting[job["stage"]]
                line[:] = sorted([*line, job["frame"]])
                edge = self.begin if skips else job["stage"] - 1
                while self.graph.edges[edge] == "triple" and len(line) > 1:
                    self.drop_frame(line[0], "stale")
        self.fresh |= self.end in unit.stages
        for stage in unit.stages:
            for edge in (stage - 1, stage, *([self.begin] if stage == self.end else [])):
                if 0 <= edge < self.last:
                    self.epoch[edge] += 1
        unit.is_up, unit.ready_ns = False, None
        unit.start_ns = self.now_ns + BACK_OFF_NS[unit.failures]
        unit.failures += 1

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

    # the run

    def run(self) -> None:
        while True:
            at_ns, event = self.next_event()
            for unit in self.units:
                unit.times_ns[unit.account] += at_ns - self.now_ns
            self.now_ns = at_ns
            first: list[PlainUnit] = []
            if event is not None:
                first = event()
            self.clockwork()
            self.assign([*first, *self.units])
            for unit in self.units:
                unit.account = self.account(unit)
            if not self.flying and not self.queue and self.next_frame >= self.settings.frames:
                return

    def next_event(self) -> tuple[int, Any]:
        """Faults come before other events at one time, events before the times that are only looked at."""
        events: list[tuple[int, int, int, Any]] = []
        if self.faults:
            at_ns, name = self.faults[0]
            events.append((at_ns, 0, 0, lambda: self.fault(name)))
        for number, unit in enumerate(self.units):
            if unit.queue:
                events.append((unit.queue[0]["end"] + self.delay_ns, 1, number, lambda u=unit: self.done(u)))
            if unit.ready_ns is not None:
                events.append((unit.ready_ns, 1, number, lambda u=unit: self.ready(u)))
        looks = [at for unit in self.units for at in (unit.hold_until_ns, unit.start_ns) if at is not None]
        if self.is_paced and self.next_frame < self.settings.frames:
            looks.append(self.release_ns(self.next_frame))
        if self.settings.queue_timeout_ns and self.queue:
            looks.append(self.queue[0][1] + self.settings.queue_timeout_ns)
        if lead_ns := LEAD_NS[self.settings.policy]:
            looks += [self.expected_end_ns(unit) - lead_ns for unit in self.units if len(unit.queue) == 1]
        if self.has_source():
            looks.append(self.latch_from_ns())
        later = [(at, 2, 0, None) for at in looks if self.now_ns < at < NO_TIME]
        if not self.has_begun:
            self.has_begun = True
            later.append((0, 2, 0, None))
        at_ns, _, _, event = min([*events, *later], key=lambda row: row[:3])
        return at_ns, event

    def fault(self, name: str) -> list[PlainUnit]:
        self.faults.pop(0)
        unit = next(unit for unit in self.units if unit.name == name)
        if unit.is_up or unit.ready_ns is not None:
            self.die(unit)
        return []

    def done(self, unit: PlainUnit) -> list[PlainUnit]:
        """The unit itself is served first, then the one before its stage, then the one after it."""
        stage, frame = unit.queue[0]["stage"], unit.queue[0]["frame"]
        came_from = self.begin if stage == self.end and self.skips(frame) else stage - 1
        goes_to = self.end if unit.queue[0]["skips"] else stage + 1
        self.job_done(unit)
        before = [self.unit_of[came_from]] if stage else []
        after = [self.unit_of[goes_to]] if stage < self.last else [self.unit_of[0]]
        return [unit, *before, *after]

    def ready(self, unit: PlainUnit) -> list[PlainUnit]:
        unit.is_up, unit.ready_ns = True, None
        return [unit]

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
            self.drop(0, "timeout")

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
