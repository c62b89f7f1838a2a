"""The CPU time of units beside their wall time. Rule: it is counted in the run alone, and by core it cannot exceed it.

A unit's CPU time is that of all threads of its process, those that a runtime lets spin between jobs included. Whatever
the units do, those that may only run on a set of cores cannot have more CPU time than these cores had time: where the
figures say otherwise, a thread has run elsewhere or a clock is wrong.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

from trilane.scheduler.samples import Samples, Sketch
from trilane.transport.messages import Done

CLOCKS_DIFFER = 0.001  # CLOCK_MONOTONIC is slewed by up to 500 ppm, the clock of CPU times is not


class CoreUse(NamedTuple):
    """Units that run on `cores` and nowhere else. `cpu`, `busy`: sums of theirs, as shares of what the cores had."""

    cores: tuple[int, ...]
    units: tuple[str, ...]
    cpu: float
    busy: float

    @property
    def is_possible(self) -> bool:
        """Whether no core did more than it can."""
        return self.cpu <= 1 + CLOCKS_DIFFER


class CpuTimes:
    """CPU time of each unit, and of each stage's jobs, in ns. `cores`: how many each unit has.

    `sketch`: as of `trilane.scheduler.samples.Samples`.
    """

    def __init__(self, cores: Mapping[str, int], sketch: Callable[[], Sketch] | None = None) -> None:
        self._cores = cores
        self.in_jobs_ns: Counter[str] = Counter()
        self.between_ns: Counter[str] = Counter()
        self.stage_ns: defaultdict[str, Samples] = defaultdict(lambda: Samples(sketch))
        self._begun: set[str] = set()

    def add(self, unit: str, stage: str, done: Done, run_begin_ns: int) -> None:
        """Book a job. Of the CPU time before a unit's first job at most what its cores had since the run began counts.

        What is between two jobs counts as it was read: a figure that cannot be must stay visible (`is_possible`).
        """
        self.in_jobs_ns[unit] += done.cpu_ns
        self.stage_ns[stage].add(done.cpu_ns)
        before_ns = done.cpu_before_ns
        if unit not in self._begun:
            self._begun.add(unit)
            before_ns = min(before_ns, max(done.t_begin_ns - run_begin_ns, 0) * self._cores[unit])
        self.between_ns[unit] += before_ns

    def of_unit_s(self, unit: str) -> float:
        """In jobs and between them, from the begin of the run to the end of the unit's last job."""
        return (self.in_jobs_ns[unit] + self.between_ns[unit]) / 1e9


def use_of_cores(
    cores: Mapping[str, Sequence[int]], cpu_s: Mapping[str, float], busy: Mapping[str, float], duration_s: float
) -> list[CoreUse]:
    """One row for each set of cores that a unit has, and one for all cores.

    `cores`: of each unit. `cpu_s`: its CPU time. `busy`: its share of the time. `duration_s`: of the run.
    """
    sets = {frozenset(own) for own in cores.values()} | {frozenset().union(*cores.values())}
    rows = []
    for these in sorted(sets, key=lambda these: (len(these), sorted(these))):
        units = tuple(unit for unit, own in cores.items() if these.issuperset(own))
        had_s = len(these) * duration_s
        cpu = sum(cpu_s[unit] for unit in units) / had_s if had_s else 0.0
        rows.append(CoreUse(tuple(sorted(these)), units, cpu, sum(busy[unit] for unit in units) / len(these)))
    return rows
