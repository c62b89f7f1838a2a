"""A simulated kernel: cores that give the threads of a run slices in turn, in steps of time.

Rule: a second implementation. Each unit is a thread that does its jobs, the latest stage first, two slots on every
edge; each core gives its threads slices in turn; a thread that wakes goes where it was, unless that core is taken and
another one of its is idle; an idle core pulls a thread that waits.
"""

from __future__ import annotations

from random import Random

from trilane.scheduler.placement import CpuCore, Placement

STEP_MS, SLICE_MS, SLOTS, FRAMES, WARM = 0.1, 1.0, 2, 40, 10
SPREAD = 0.05  # of a job's time
CORES = [CpuCore(0, 0), CpuCore(1, 1)]
#: Unit of each stage, and its part of the unit's time.
STAGES = (("cpu", 0.5), ("gpu", 0.4), ("dsp", 1.0), ("gpu", 0.6), ("cpu", 0.5))


class Kernel:
    """Two cores and the three units of a placement."""

    def __init__(self, placement: Placement, ms: dict[str, float], spread: float = SPREAD) -> None:
        self.placement, self.ms, self.spread, self.random = placement, ms, spread, Random(1)
        self.full = [0] * (len(STAGES) - 1)
        self.taken = [0] * (len(STAGES) - 1)  # slots that are being written, full or being read
        self.stage: dict[str, int] = {}
        self.left = dict.fromkeys(ms, 0.0)
        self.core = {unit: place.cores[0] for unit, place in placement.items()}
        self.queue: dict[int, list[str]] = {core.number: [] for core in CORES}
        self.ran = dict.fromkeys(self.queue, 0.0)
        self.presented: list[float] = []

    def frame_ms(self) -> float:
        now = 0.0
        while len(self.presented) < FRAMES:
            for unit in self.placement:
                if unit not in self.stage:
                    self.begin(unit)
            for core, queue in self.queue.items():
                if not queue:
                    self.pull(core)
                if queue:
                    self.run(core, now)
            now += STEP_MS
        return (self.presented[-1] - self.presented[WARM]) / (FRAMES - 1 - WARM)

    def begin(self, unit: str) -> None:
        last = len(STAGES) - 1
        for number in reversed(range(len(STAGES))):
            has_input = number == 0 or self.full[number - 1] > 0
            if STAGES[number][0] == unit and has_input and (number == last or self.taken[number] < SLOTS):
                break
        else:
            return
        if number > 0:
            self.full[number - 1] -= 1
        if number < last:
            self.taken[number] += 1
        self.stage[unit] = number
        self.left[unit] = self.ms[unit] * STAGES[number][1] * self.random.gauss(1, self.spread)
        own = self.core[unit]
        if self.queue[own]:
            own = next((core for core in self.placement[unit].cores if not self.queue[core]), own)
        self.move(unit, own)

    def move(self, unit: str, core: int) -> None:
        self.core[unit] = core
        self.queue[core].append(unit)

    def pull(self, core: int) -> None:
        for other, queue in self.queue.items():
            for unit in queue[1:]:
                if other != core and core in self.placement[unit].cores:
                    queue.remove(unit)
                    self.move(unit, core)
                    return

    def run(self, core: int, now: float) -> None:
        queue = self.queue[core]
        unit = queue[0]
        self.left[unit] -= STEP_MS
        self.ran[core] += STEP_MS
        if self.left[unit] <= 0:
            self.end(queue.pop(0), now)
        elif self.ran[core] >= SLICE_MS:
            queue.append(queue.pop(0))
        else:
            return
        self.ran[core] = 0.0

    def end(self, unit: str, now: float) -> None:
        number = self.stage.pop(unit)
        if number > 0:
            self.taken[number - 1] -= 1
        if number == len(STAGES) - 1:
            self.presented.append(now)
        else:
            self.full[number] += 1
