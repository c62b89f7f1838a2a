"""Compares the CPU time of units with their wall time, and adds both to the report of a run on the host clock.

Rule: only the run counts, and no core does more than it can. Figures that must agree stand side by side. Where they
contradict each other, or were not measured, a message says so.

A unit's CPU time is that of all threads of its process, including those that a runtime lets spin between jobs. Units
that may only run on a set of cores cannot have more CPU time than these cores had time. Where the figures say
otherwise, a thread has run elsewhere or a clock is wrong.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

from trilane.pipeline.description import Pipeline
from trilane.pipeline.job_times import counts_run_delay
from trilane.pipeline.result import RunLog
from trilane.scheduler.stats import Samples, Sketch
from trilane.transport.messages import Done
from trilane.units import NS_PER_S

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
    `sketch`: function that makes a sketch, as for `trilane.scheduler.stats.Samples`.
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
        return (self.in_jobs_ns[unit] + self.between_ns[unit]) / NS_PER_S


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


NO_RUN_DELAY = (
    "this kernel does not count how long threads wait for a core (CONFIG_SCHED_INFO): the time in which a unit had a "
    "job but not its core is not known, and counts as overhead"
)


def add_accounts(report: dict[str, Any], pipeline: Pipeline, cpu: CpuTimes, log: RunLog) -> None:
    """Add `cpu_s`, `cpu_ms` and `core_shares` to a ledger's report.

    `pipeline`: pipeline that ran.
    `cpu`: CPU time of its units and stages.
    `log`: log for messages about missing or contradictory figures.
    """
    for unit, row in report["units"].items():
        row.update(cpu_s=cpu.of_unit_s(unit), cpu_in_jobs_s=cpu.in_jobs_ns[unit] / NS_PER_S)
    for stage, row in report["stages"].items():
        row["cpu_ms"] = cpu.stage_ns[stage].summary_ms()
    cores = {unit: pipeline.units[unit].cores for unit in report["units"]}
    cpu_s = {unit: cpu.of_unit_s(unit) for unit in cores}
    uses = use_of_cores(cores, cpu_s, {unit: report["units"][unit]["busy"] for unit in cores}, report["duration_s"])
    report["core_shares"] = [use._asdict() for use in uses]
    for use in uses:
        if not use.is_possible:
            log.say(f"{', '.join(use.units)} had {use.cpu:.1%} of the time of cores {use.cores}: please report this")
    if not counts_run_delay():
        for row in report["units"].values():
            row["idle"]["preempted"] = None
        log.say(NO_RUN_DELAY)
