"""Cores that are divided in equal shares, against a simulated kernel that gives slices: the frame times are as good.

Rule: a second implementation (`support.sliced_kernel`). The driver divides a core at every moment; there time goes by
in steps.
"""

from __future__ import annotations

from typing import Any

import pytest

from support.sliced_kernel import SlicedRun, frame_ms
from trilane.hw_profiles.application import application_graph
from trilane.scheduler.events import Settings, Stop
from trilane.scheduler.placement import Place
from trilane.scheduler.shared_units import Member, simulate_beside

MS, SECONDS = 1_000_000, 4.0
#: ms of a frame's stages, as they were measured on a machine with two cores, at 256x256, 384x384 and 512x512.
SMALL, MIDDLE, LARGE = (3.6, 7.3, 8.4, 8.3, 3.6), (4.4, 12.3, 20.5, 11.7, 4.4), (3.9, 13.5, 33.0, 12.5, 3.9)
STAGES = ("pose", "raster", "infer", "composite", "present")
#: The rule for any run on two cores.
CORE = {"cpu": "0", "gpu": "0", "dsp": "1"}
PLACES = {unit: Place((int(core),), 1) for unit, core in CORE.items()}


def member(ms: tuple[float, ...]) -> Member:
    """The same pipeline, each job of a stage with the same time."""
    times = {stage: round(each * MS) for stage, each in zip(STAGES, ms, strict=True)}
    stop: Any = ((round(SECONDS * 1e9), Stop()),)
    return Member(
        application_graph(), Settings(1 << 40, hang_ns=1 << 50), lambda name, *_: times[name], CORE, inputs=stop
    )


def computed_ms(first: tuple[float, ...], second: tuple[float, ...], divided: set[str]) -> list[float]:
    runs = simulate_beside([member(first), member(second)], divided=divided)
    return [run.report["frame_time_ms"]["mean"] for run in runs]


def simulated_ms(first: tuple[float, ...], second: tuple[float, ...], slice_ms: float) -> list[float]:
    return frame_ms([SlicedRun(PLACES, ms, 0.1, seed) for seed, ms in enumerate((first, second), 1)], slice_ms)


@pytest.mark.parametrize(
    ("first", "second", "slice_ms"),
    [(SMALL, SMALL, 3.0), (SMALL, MIDDLE, 3.0), (SMALL, LARGE, 3.0), (MIDDLE, LARGE, 3.0), (SMALL, MIDDLE, 1.0)],
)
def test_equal_shares_are_nearly_what_slices_give(
    first: tuple[float, ...], second: tuple[float, ...], slice_ms: float
) -> None:
    """Within the tenth that is asked of a prediction of two pipelines."""
    assert computed_ms(first, second, {"0", "1"}) == pytest.approx(simulated_ms(first, second, slice_ms), rel=0.1)


def test_turns_to_the_end_of_each_job_are_not() -> None:
    """They give the pipeline with the longer jobs as many frames as the other one."""
    sliced, turns = simulated_ms(SMALL, LARGE, 3.0), computed_ms(SMALL, LARGE, set())
    assert sliced[1] / sliced[0] > 1.4
    assert turns[1] / turns[0] < 1.1
