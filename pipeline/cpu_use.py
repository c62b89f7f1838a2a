"""Compares the CPU time of units with their wall time. Rule: only the run counts, and no core does more than it can.

A unit's CPU time is that of all threads of its process, including those that a runtime lets spin between jobs. Units
that may only run on a set of cores cannot have more CPU time than these cores had time. Where the figures say
otherwise, a thread has run elsewhere or a clock is wrong. Efficiencies use the CPU time of jobs alone.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

from trilane.scheduler.ledger import JobRecord
from trilane.scheduler.places import Place, Placement, busiest_core_ns
from trilane.scheduler.samples import Samples, Sketch
from trilane.transport.messages import Done

CLOCKS_DIFFER = 0.001  # CLOCK_MONOTONIC is slewed by up to 500 ppm, but the clock of CPU times is not


class CoreUse(NamedTuple):
    """The use of a set of cores by the units that run on `cores` and nowhere else.

    `cpu`, `busy`: sums of the units' CPU time and busy time, as shares of the time that the cores had.
    """

    cores: tuple[int, ...]
    units: tuple[str, ...]
    cpu: float
    busy: float

    @property
    def is_possible(self) -> bool:
        """Whether no core did more than it can."""
        return self.cpu <= 1 + CLOCKS_DIFFER


class CpuTimes:
    """The CPU time of each unit and of each stage's jobs, in ns.

    `cores`: number of cores of each unit.
    `sketch`: function that makes a sketch, as for `trilane.scheduler.samples.Samples`.
    """

    def __init__(self, cores: Mapping[str, int], sketch: Callable[[], Sketch] | None = None) -> None:
        self._cores = cores
        self.in_jobs_ns: Counter[str] = Counter()
        self.between_ns: Counter[str] = Counter()
        self.stage_ns: defaultdict[str, Samples] = defaultdict(lambda: Samples(sketch))
        self._begun: set[str] = set()

    def add(self, unit: str, stage: str, done: Done, run_begin_ns: int) -> None:
        """Book a job.

        CPU time before a unit's first job counts at most the time that its cores had since the run began. CPU time
        between two jobs counts as it was read: an impossible figure must stay visible (`is_possible`).
        """
        self.in_jobs_ns[unit] += done.cpu_ns
        self.stage_ns[stage].add(done.cpu_ns)
        before_ns = done.cpu_before_ns
        if unit not in self._begun:
            self._begun.add(unit)
            before_ns = min(before_ns, max(done.t_begin_ns - run_begin_ns, 0) * self._cores[unit])
        self.between_ns[unit] += before_ns

    def of_unit_s(self, unit: str) -> float:
        """Return the unit's CPU time in seconds, in jobs and between them.

        It counts from the begin of the run to the end of the unit's last job.
        """
        return (self.in_jobs_ns[unit] + self.between_ns[unit]) / 1e9


def use_of_cores(
    cores: Mapping[str, Sequence[int]], cpu_s: Mapping[str, float], busy: Mapping[str, float], duration_s: float
) -> list[CoreUse]:
    """Return one row for each set of cores that a unit has, and one for all cores.

    `cores`: cores of each unit.
    `cpu_s`: CPU time of each unit in seconds.
    `busy`: busy share of each unit.
    `duration_s`: time of the run in seconds.
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
    """How much of the time between the first and the last presented frame was work of jobs; no share can pass 1.

    Jobs are added in the order of their ends. A job may begin before that time or end after it. Then it counts only the
    CPU time that must lie within: its CPU time less the time that its cores had outside. So what a unit or a set of
    cores is credited with fits into the time.

    A unit's work counts the CPU time of a job divided by the unit's threads. It also counts the busy time beyond the
    CPU time, because a device of its own worked then while the threads slept.

    `places`: cores and threads of each unit.
    """

    def __init__(self, places: Placement) -> None:
        self._places = places
        self._work_ns: dict[str, float] = dict.fromkeys(places, 0.0)
        self._cpu_ns: dict[str, float] = dict.fromkeys(places, 0.0)
        self._first_ns: int | None = None
        self._last_ns = 0
        self._unsettled: list[JobRecord] = []  # jobs since the last presented frame

    def add(self, job: JobRecord, *, presents: bool) -> None:
        """Take the next job that has ended. `presents`: whether its end is that of a presented frame."""
        self._unsettled.append(job)
        if not presents:
            return
        self._first_ns = self._first_ns or job.end_ns
        self._last_ns = job.end_ns
        settled = [each for each in self._unsettled if each.end_ns <= job.end_ns]
        self._unsettled = [each for each in self._unsettled if each.end_ns > job.end_ns]
        self._book(settled, self._first_ns)

    def close(self) -> dict[str, float | None]:
        """Return `efficiency`, `core_efficiency` and `machine_efficiency` of a report; None for one frame.

        Called after all jobs.

        The first is the work of the slowest unit. The second is the CPU time on the fullest set of cores, of the units
        that have no other cores. No division of the work avoids it. The third is the CPU time of all units on all
        cores. Each is a share of the time that these had.
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
        """Book the part of each job that must lie between the first and the last presented frame."""
        for job in jobs:
            cores, threads = self._places[job.unit]
            length_ns = job.end_ns - job.begin_ns
            outside_ns = max(first_ns - job.begin_ns, 0) + max(job.end_ns - self._last_ns, 0)
            busy_ns = length_ns - job.preempted_ns - job.asleep_ns
            work_ns = min(job.cpu_ns / threads, length_ns) + max(busy_ns - job.cpu_ns, 0)
            self._work_ns[job.unit] += max(work_ns - outside_ns, 0)
            self._cpu_ns[job.unit] += max(job.cpu_ns - outside_ns * len(cores), 0)
