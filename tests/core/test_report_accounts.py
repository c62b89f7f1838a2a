"""What a report says beside a ledger's shares, by hand: CPU time, cores, contradictions in words."""

from __future__ import annotations

import subprocess
import sys
from typing import Any

import pytest

from support.small_pipeline import pipeline
from trilane.pipeline import cpu_use
from trilane.pipeline.cpu_use import CpuTimes
from trilane.pipeline.result import RunLog
from trilane.transport.messages import Done

MS = 1_000_000
PIPELINE = pipeline().with_rule("double")


def a_report() -> dict[str, Any]:
    idle = {"preempted": 0.1}
    return {
        "units": {"left": {"busy": 0.5, "idle": dict(idle)}, "right": {"busy": 0.25, "idle": dict(idle)}},
        "stages": {"mid": {}, "out": {}},
        "duration_s": 0.001,
    }


def test_accounts_that_contradict_themselves_are_told(monkeypatch: pytest.MonkeyPatch) -> None:
    """`right` has 2.5 ms of CPU time in a run of 1 ms on two cores."""
    monkeypatch.setattr(cpu_use, "counts_run_delay", lambda: False)
    cpu = CpuTimes({"left": 2, "right": 2})
    cpu.add("right", "mid", Done(0, MS, 2 * MS, 0, 0, 0, 0, 0, 2 * MS, MS // 2, {}), 0)
    report, heard = a_report(), []
    cpu_use.add_accounts(report, PIPELINE, cpu, RunLog(heard.append))
    right = report["units"]["right"]
    assert (right["cpu_s"], right["cpu_in_jobs_s"], right["idle"]) == (0.0025, 0.002, {"preempted": None})
    assert report["units"]["left"]["idle"] == {"preempted": None}
    assert (report["stages"]["mid"]["cpu_ms"]["mean"], report["stages"]["out"]["cpu_ms"]["samples"]) == (2.0, 0)
    assert [(row["cores"], row["cpu"], row["busy"]) for row in report["core_shares"]] == [
        ((0, 1), 0.0, 0.25),
        ((1, 3), pytest.approx(1.25), 0.125),
        ((0, 1, 3), pytest.approx(2.5 / 3), 0.25),
    ]
    assert heard == [
        "right had 125.0% of the time of cores (1, 3): please report this",
        cpu_use.NO_RUN_DELAY,
    ]


def test_a_process_of_one_thread_has_one_that_is_counted() -> None:
    """And nothing of what it waited before counts."""
    program = """
from trilane.pipeline.job_times import CoreMeter, counts_run_delay
meter = CoreMeter()
print(meter.threads, int(counts_run_delay()), meter._born_ns)
meter.close()
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    threads, counts, born_ns = map(int, done.stdout.split())
    assert (threads, born_ns) == (counts, 0)
