"""The three efficiencies of a run of processes, beside what the kernel and the journal say of it from outside."""

from __future__ import annotations

import importlib.util
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import psutil
import pytest

from support.cpu_load import FACTORY
from trilane.hw_profiles.host import usable_cores
from trilane.pipeline.description import Pipeline, PipelineEdge, PipelineStage, UnitSettings
from trilane.pipeline.result import JournalFile
from trilane.pipeline.run import run_pipeline
from trilane.pipeline.run_metrics import RunMetrics

pytestmark = pytest.mark.usefixtures("nothing_left")
OUTSIDE = Path(__file__).with_name("seen_from_outside.py")
KEYS = ("efficiency", "core_efficiency", "machine_efficiency")
CORES = usable_cores()
#: Milliseconds of CPU time of a job. a and c share the first core, b has the last one.
WORK_MS = {"a": 8.0, "b": 11.0, "c": 12.0}
#: At each end of a run at most a job of each unit is left out: 2 of 100 may be missing.
FRAMES = 100


def _loaded() -> Any:
    spec = importlib.util.spec_from_file_location(OUTSIDE.stem, OUTSIDE)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


outside = _loaded()


def pipeline_of(work_ms: dict[str, float]) -> Pipeline:
    places = {"a": CORES[:1], "b": CORES[-1:], "c": CORES[:1]}
    return Pipeline(
        stages=tuple(
            PipelineStage(
                name=name, unit=name, factory=FACTORY, settings={"cpu_ms": ms, "sleep_ms": 0.0, "device": False}
            )
            for name, ms in work_ms.items()
        ),
        edges=tuple(PipelineEdge(payload_bytes=64) for _ in range(2)),
        units={unit: UnitSettings(cores=cores, threads=1) for unit, cores in places.items()},
    )


def measured(folder: Path) -> tuple[RunMetrics, dict[str, float], dict[str, float]]:
    """A run's report, its efficiencies from /proc, and from its journal."""
    pipeline, journal = pipeline_of(WORK_MS), folder / "journal.msgpack"
    with outside.Sampler(os.getpid()) as sampler:
        result = run_pipeline(pipeline, FRAMES, journal=JournalFile(journal, {}))
    places = {unit: (settings.cores, settings.threads) for unit, settings in pipeline.units.items()}
    seen = outside.of_processes(places, result.pids, sampler, journal)
    return result.report, seen, outside.of_journal(places, journal)


def test_the_efficiencies_are_those_that_are_seen_from_outside(tmp_path: Path) -> None:
    """However busy the machine is. The kernel counts what a process has between its jobs as well, which is no work.

    With many programs beside it that is several percent: each time that a unit gets its core again costs it a little.
    """
    report, of_kernel, of_jobs = measured(tmp_path)
    more = [row.cpu_s / row.cpu_in_jobs_s for row in report.units.values() if row.cpu_s and row.cpu_in_jobs_s]
    assert len(more) == 3
    for key in KEYS:
        found = getattr(report, key)
        assert found == pytest.approx(of_jobs[key], rel=0.03)
        assert 0.97 * min(more) * found <= of_kernel[key] <= 1.03 * max(more) * found
        assert found <= 1
    # a and c are on one core: 20 ms of the 31 that a frame takes two cores
    if len(CORES) > 1:
        assert report.core_efficiency == pytest.approx(report.machine_efficiency * 2 * 20 / 31, rel=0.03)
        assert report.efficiency == pytest.approx(report.core_efficiency * 12 / 20, rel=0.03)


@pytest.fixture
def busy_process() -> Iterator[None]:
    """A program that computes on the first core."""
    code = f"import os\nos.sched_setaffinity(0, [{CORES[0]}])\nwhile True: pass"
    process = subprocess.Popen([sys.executable, "-c", code])
    try:
        while psutil.Process(process.pid).cpu_affinity() != [CORES[0]]:
            time.sleep(0.01)
        yield
    finally:
        process.kill()
        process.wait()


@pytest.mark.usefixtures("busy_process")
def test_another_program_makes_a_run_slower_and_none_of_it_efficient(tmp_path: Path) -> None:
    """It takes its share of the core that a and c have: what they lack is preempted, and nobody's of this run."""
    report, _, of_jobs = measured(tmp_path)
    for key in KEYS:
        assert getattr(report, key) == pytest.approx(of_jobs[key], rel=0.03)
    assert report.core_efficiency is not None
    assert report.core_efficiency < 0.8  # of three that compute on it, two are of the run
    assert report.units["c"].idle.preempted is not None
    assert report.units["a"].idle.preempted is not None
    assert report.units["a"].idle.preempted + report.units["c"].idle.preempted > 0.3
    assert report.other_programs is not None
    assert report.other_programs > 0.15
