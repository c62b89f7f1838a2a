"""The accounts of real processes that compute and sleep on the same core; what they say holds on a busy machine too."""

from __future__ import annotations

import pytest

from support.cpu_load import FACTORY
from support.second_accounts import largest_difference, second_accounts
from trilane.hw_profiles.host import usable_cores
from trilane.pipeline.description import Pipeline, PipelineEdge, PipelineStage, UnitSettings
from trilane.pipeline.result import RunResult
from trilane.pipeline.run import run_pipeline

pytestmark = pytest.mark.usefixtures("nothing_left")
FRAMES, CPU_MS, SLEEP_MS = 25, 3.0, 2.0
ROUNDING = 1e-12  # of shares: far less than 1 ns of the run


def run(*, sleep_ms: float = 0.0, device: bool = False) -> RunResult:
    """Two stages, each a unit on the same core."""
    settings = {"cpu_ms": CPU_MS, "sleep_ms": sleep_ms, "device": device}
    unit = UnitSettings(cores=usable_cores()[:1], threads=1)
    pipeline = Pipeline(
        stages=tuple(PipelineStage(name=name, unit=name, factory=FACTORY, settings=settings) for name in "ab"),
        edges=(PipelineEdge(payload_bytes=64),),
        units={"a": unit, "b": unit},
    )
    return run_pipeline(pipeline, FRAMES)


def test_two_units_that_compute_on_one_core_share_it() -> None:
    """Both have a job nearly all the time; each can have the core for half of it at most, in sum for all of it."""
    result = run()
    (core,) = result.report.core_shares
    assert (core.units, core.busy <= core.cpu <= 1) == (("a", "b"), True)
    for stage in result.report.stages.values():
        assert stage.cpu_ms is not None
        assert stage.cpu_ms.mean >= CPU_MS
    busy_ns = sum(job.end_ns - job.begin_ns - job.preempted_ns - job.asleep_ns for job in result.jobs)
    assert busy_ns <= round(sum(1e9 * (unit.cpu_in_jobs_s or 0) for unit in result.report.units.values()))
    assert sum(unit.idle.preempted or 0 for unit in result.report.units.values()) > 0.1
    units = {unit: row.as_json() for unit, row in result.report.units.items()}
    assert largest_difference(units, second_accounts(result.recording, result.jobs)) < 1e-12
    assert result.messages == ()


@pytest.mark.parametrize("device", [False, True])
def test_a_job_that_sleeps_works_only_if_it_has_a_device(device: bool) -> None:
    result = run(sleep_ms=SLEEP_MS, device=device)
    duration_ms = 1e3 * result.report.duration_s
    slept = SLEEP_MS * FRAMES / duration_ms
    for unit in result.report.units.values():
        computed = (unit.cpu_in_jobs_s or 0) * 1e3 / duration_ms
        if device:
            assert unit.busy >= slept
        else:
            assert unit.busy <= computed + ROUNDING
            assert unit.idle.overhead >= slept
        assert unit.busy + sum(unit.idle.as_json().values()) == pytest.approx(1)
