"""A simulated kernel: cores that give the threads of runs slices in turn, in steps of time.

Rule: a second implementation. Each unit is a thread that does its jobs, the latest stage first, two slots on every
edge; each core gives its threads slices in turn; a thread that wakes goes where it was, unless that core is taken and
another one of its is idle; an idle core pulls a thread that waits.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from random import Random

from trilane.scheduler.placement import CpuCore, Placement

STEP_MS, SLICE_MS, SLOTS, FRAMES, WARM = 0.1, 1.0, 2, 40, 10
SPREAD = 0.05  # of a job's time
CORES = [CpuCore(0, 0), CpuCore(1, 1)]
#: Unit of each stage, and its part of the unit's time.
STAGES = (("cpu", 0.5), ("gpu", 0.4), ("dsp", 1.0), ("gpu", 0.6), ("cpu", 0.5))


def placed_frame_ms(placement: Placement, unit_ms: Mapping[str, float], spread: float = SPREAD) -> float:
    """The frame time of one run whose units take `unit_ms` for a frame."""
    return frame_ms([SlicedRun(placement, [unit_ms[unit] * part for unit, part in STAGES], spread)])[0]


def frame_ms(runs: list[SlicedRun], slice_ms: float = SLICE_MS) -> list[float]:
    """The frame time of each of `runs` beside each other, until each has presented `FRAMES`."""
    kernel, now = Kernel(slice_ms), 0.0
    while min(len(run.presented) for run in runs) < FRAMES:
        for run in runs:
            for unit in run.placement:
                if unit not in run.stage and run.begin(unit):
                    kernel.wake(run, unit)
        kernel.step(now)
        now += STEP_MS
    return [(each.presented[-1] - each.presented[WARM]) / (len(each.presented) - 1 - WARM) for each in runs]


class SlicedRun:
    """The three units of a placement. `ms`: of each stage. `spread`: of a job's time."""

    def __init__(self, placement: Placement, ms: Sequence[float], spread: float, seed: int = 1) -> None:
        self.placement, self.ms, self.spread, self.random = placement, ms, spread, Random(seed)
        self.full = [0] * (len(STAGES) - 1)
        self.taken = [0] * (len(STAGES) - 1)  # slots that are being written, full or being read
        self.stage: dict[str, int] = {}
        self.left: dict[str, float] = {}
        self.core = {unit: place.cores[0] for unit, place in placement.items()}
        self.presented: list[float] = []

    def begin(self, unit: str) -> bool:
        """Whether the unit has a job now."""
        last = len(STAGES) - 1
        for number in reversed(range(len(STAGES))):
            has_input = number == 0 or self.full[number - 1] > 0
            if STAGES[number][0] == unit and has_input and (number == last or self.taken[number] < SLOTS):
                break
        else:
            return False
        if number > 0:
            self.full[number - 1] -= 1
        if number < last:
            self.taken[number] += 1
        self.stage[unit] = number
        self.left[unit] = self.ms[number] * self.random.gauss(1, self.spread)
        return True

    def end(self, unit: str, now: float) -> None:
        number = self.stage.pop(unit)
        if number > 0:
            self.taken[number - 1] -= 1
        if number == len(STAGES) - 1:
            self.presented.append(now)
        else:
            self.full[number] += 1


class Kernel:
    """Two cores, and the units that want each."""

    def __init__(self, slice_ms: float) -> None:
        self.slice_ms = slice_ms
        self.queue: dict[int, list[tuple[SlicedRun, str]]] = {core.number: [] for core in CORES}
        self.ran = dict.fromkeys(self.queue, 0.0)

    def wake(self, run: SlicedRun, unit: str) -> None:
        own = run.core[unit]
        if self.queue[own]:
            own = next((core for core in run.placement[unit].cores if not self.queue[core]), own)
        self.move(run, unit, own)

    def move(self, run: SlicedRun, unit: str, core: int) -> None:
        run.core[unit] = core
        self.queue[core].append((run, unit))

    def step(self, now: float) -> None:
        for core, queue in self.queue.items():
            if not queue:
                self.pull(core)
            if queue:
                self.run(core, now)

    def pull(self, core: int) -> None:
        for other, queue in self.queue.items():
            for run, unit in queue[1:]:
                if other != core and core in run.placement[unit].cores:
                    queue.remove((run, unit))
                    self.move(run, unit, core)
                    return

    def run(self, core: int, now: float) -> None:
        queue = self.queue[core]
        run, unit = queue[0]
        run.left[unit] -= STEP_MS
        self.ran[core] += STEP_MS
        if run.left[unit] <= 0:
            queue.pop(0)
            run.end(unit, now)
        elif self.ran[core] >= self.slice_ms:
            queue.append(queue.pop(0))
        else:
            return
        self.ran[core] = 0.0
