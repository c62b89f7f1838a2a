"""The efficiency of the busiest core, by hand."""

from __future__ import annotations

from typing import Any

import pytest

from trilane.pipeline.accounts import core_efficiency
from trilane.pipeline.description import Pipeline, PipelineStage, UnitSettings


def pipeline_of(units: dict[str, UnitSettings]) -> Pipeline:
    stages = tuple(PipelineStage(name=f"{unit}-stage", unit=unit, factory="m:f") for unit in units)
    return Pipeline.model_construct(stages=stages, units=units)


def measured(isolated_ms: dict[str, float], cpu_ms: dict[str, float], frame_ms: float = 20.0) -> dict[str, Any]:
    stages = {f"{unit}-stage": {"unit": unit, "jobs": 12, "cpu_ms": {"mean": ms}} for unit, ms in cpu_ms.items()}
    isolated = {f"{unit}-stage": ms for unit, ms in isolated_ms.items()}
    frames = {"presented": 12}
    return {"frame_time_ms": {"mean": frame_ms}, "isolated_ms": isolated, "stages": stages, "frames": frames}


def test_core_efficiency_is_of_the_busiest_core() -> None:
    one, two = (UnitSettings(cores=(core,), threads=1) for core in (0, 1))
    both = UnitSettings(cores=(0, 1), threads=2)
    cpu_ms = {"a": 7.0, "b": 6.0, "c": 8.0}
    apart = pipeline_of({"a": one, "b": one, "c": two})
    # a and b are on core 0: 5 alone, and 6 of CPU time in the run, of 20
    assert core_efficiency(measured({"a": 5.0}, cpu_ms), apart) == pytest.approx((5 + 6) / 20)
    # a core that slept, or that others had, did no work: of 30 ms only the 7 of CPU time count
    assert core_efficiency(measured({"a": 30.0}, cpu_ms), apart) == pytest.approx((7 + 6) / 20)
    # c has a thread on each core, with half of its CPU time
    with_threads = pipeline_of({"a": one, "b": two, "c": both})
    assert core_efficiency(measured({"a": 5.0}, cpu_ms), with_threads) == pytest.approx((6 + 4) / 20)
    assert core_efficiency(measured({}, cpu_ms), apart) is None
    assert core_efficiency(measured({"a": 5.0}, cpu_ms, frame_ms=0.0), apart) is None


def test_a_stage_that_frames_skip_counts_with_its_jobs() -> None:
    """b had 3 jobs in 12 frames: a quarter of its 6 ms a frame."""
    report = measured({"a": 5.0}, {"a": 7.0, "b": 6.0})
    report["stages"]["b-stage"]["jobs"] = 3
    on_one = pipeline_of(dict.fromkeys(("a", "b"), UnitSettings(cores=(0,), threads=1)))
    assert core_efficiency(report, on_one) == pytest.approx((5 + 6 / 4) / 20)
