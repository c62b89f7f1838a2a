"""The CPU time of units beside their wall time. Rule: it is counted in the run alone, and by core it cannot exceed it.

A unit's CPU time is that of all threads of its process, those that a runtime lets spin between jobs included. Whatever
the units do, those that may only run on a set of cores cannot have more CPU time than these cores had time: where the
figures say otherwise, a thread has run elsewhere or a clock is wrong. Efficiencies are of the CPU time of jobs alone.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

from trilane.scheduler.ledger import JobRecord
from trilane.scheduler.places import Place, Placement, busiest_core_ns
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


class Efficiencies:
    """How much of the time between the first and the last presented frame was work of jobs; none can pass 1.

    `places`: of each unit. To be told the jobs in the order of their ends, and with those that present a frame, that.

    Of a job that began before that time or ended after it, only the CPU time counts that must lie within, whatever the
    rest of the job had: all of it but as much as its cores had time outside. So what a unit or a set of cores is
    credited with fits into the time. The slowest unit counts a job with its CPU time for each of its threads, and with
    what it was busy beyond its CPU time: then a device of its own worked while the threads slept.
    """

    def __init__(self, places: Placement) -> None:
        self._places = places
        self._work_ns: dict[str, float] = dict.fromkeys(places, 0.0)
        self._cpu_ns: dict[str, float] = dict.fromkeys(places, 0.0)
        self._first_ns: int | None = None
        self._last_ns = 0
        self._unsettled: list[JobRecord] = []  # since the last presented frame

    def add(self, job: JobRecord, *, presents: bool) -> None:
        """The next job that has ended. `presents`: its end is that of a presented frame."""
        self._unsettled.append(job)
        if not presents:
            return
        self._first_ns = self._first_ns or job.end_ns
        self._last_ns = job.end_ns
        settled = [each for each in self._unsettled if each.end_ns <= job.end_ns]
        self._unsettled = [each for each in self._unsettled if each.end_ns > job.end_ns]
        self._book(settled, self._first_ns)

    def close(self) -> dict[str, float | None]:
        """After the last job: `efficiency`, `core_efficiency`, `machine_efficiency` of a report; None for one frame.

        The work of the slowest unit; the CPU time of the fullest set of cores by the units that have no others, which
        no division of the work avoids; that of all units on all cores. Each over the time that these had.
        """
        had_ns = self._last_ns - (self._first_ns or 0)
        if self._first_ns is None or had_ns <= 0:
            return dict.fromkeys(("efficiency", "core_efficiency", "machine_efficiency"))
        self._book(self._unsettled, self._first_ns)
        anywhere = {unit: Place(place.cores, 1) for unit, place in self._places.items()}
        cores = {core for place in anywhere.values() for core in place.cores}
        return {
            "efficiency": max(self._work_ns.values()) / had_ns,
            "core_efficiency": busiest_core_ns(anywhere, self._cpu_ns) / had_ns,
            "machine_efficiency": sum(self._cpu_ns.values()) / len(cores) / had_ns,
        }

    def _book(self, jobs: Sequence[JobRecord], first_ns: int) -> None:
        """What must lie between the first and the last presented frame."""
        for job in jobs:
            cores, threads = self._places[job.unit]
            length_ns = job.end_ns - job.begin_ns
            outside_ns = max(first_ns - job.begin_ns, 0) + max(job.end_ns - self._last_ns, 0)
            busy_ns = length_ns - job.preempted_ns - job.asleep_ns
            work_ns = min(job.cpu_ns / threads, length_ns) + max(busy_ns - job.cpu_ns, 0)
            self._work_ns[job.unit] += max(work_ns - outside_ns, 0)
            self._cpu_ns[job.unit] += max(job.cpu_ns - outside_ns * len(cores), 0)
