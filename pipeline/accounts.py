"""Adds CPU times to the report of a run on the host clock. Rule: figures that must agree stand side by side.

CPU time stands beside wall time, and beside the sums over the units that share cores. Where they contradict each other,
or were not measured, a message says so.
"""

from __future__ import annotations

from typing import Any

from trilane.pipeline.core_meter import counts_run_delay
from trilane.pipeline.cpu_use import CpuTimes, use_of_cores
from trilane.pipeline.description import Pipeline
from trilane.pipeline.run_log import RunLog

NO_RUN_DELAY = (
    "this kernel does not count how long threads wait for a core (CONFIG_SCHED_INFO): the time in which a unit had a "
    "job but not its core is not known, and counts as overhead"
)


def add_accounts(report: dict[str, Any], pipeline: Pipeline, cpu: CpuTimes, log: RunLog) -> None:
    """Add `cpu_s`, `cpu_ms` and `core_shares` to a ledger's report.

    `pipeline`: pipeline that ran.
    `cpu`: CPU time of its units and stages.
    `log`: log for what was not measured, and what contradicts itself.
    """
    for unit, row in report["units"].items():
        row.update(cpu_s=cpu.of_unit_s(unit), cpu_in_jobs_s=cpu.in_jobs_ns[unit] / 1e9)
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
