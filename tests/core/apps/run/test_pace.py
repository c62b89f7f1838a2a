"""A run at a chip's pace: jobs that are held to their time, late ones, and the comparison with the virtual run."""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path

import pytest

from trilane.apps.run.pace import SLACK_NS, Pace, compare, pace_of, release_fps
from trilane.avatars.bundle import bundle_folder
from trilane.errors import BadInputError
from trilane.hw_profiles.application import application_graph
from trilane.pipeline.description import UnitSettings
from trilane.pipeline.unit_loop import hold_until
from trilane.scene.schema import Scene
from trilane.scheduler.events import Settings
from trilane.scheduler.ledger import JobRecord
from trilane.scheduler.virtual import simulate
from trilane.stages.config import RunConfig

MS = 1_000_000
STAGE_NS = {"pose": MS, "raster": 4 * MS, "infer": 9 * MS, "composite": 3 * MS, "present": MS}
PACE = Pace("chip", "sustained_high_performance", 1.0, STAGE_NS)


def config(size: str = "256") -> RunConfig:
    units = {unit: UnitSettings(cores=(0,), threads=1) for unit in ("cpu", "gpu", "dsp")}
    return RunConfig(scene=Scene(size=size), out_dir=Path(), avatar_dirs=(bundle_folder("default"),), units=units)


def jobs(late: int | None = None, frames: int = 40) -> list[JobRecord]:
    """Jobs of a simulated run; the inference of frame `late` takes twice its time."""

    def service(stage: str, _unit: str, frame: int, _begin: int) -> int:
        return STAGE_NS[stage] * (2 if (stage, frame) == ("infer", late) else 1)

    return list(simulate(application_graph(), Settings(frames, "pipelined"), service, keep=True).jobs)


def test_a_run_in_time_has_the_virtual_frame_time() -> None:
    comparison = compare(PACE, "pipelined", 40, jobs())
    assert comparison.ratio == pytest.approx(1.0)
    assert comparison.virtual_ms == 9.0
    assert (comparison.host_slower, comparison.late_frames, comparison.compared_share) == ({}, (), 1.0)


def test_a_single_frame_has_no_frame_time() -> None:
    comparison = compare(PACE, "pipelined", 1, jobs(frames=1))
    assert (comparison.virtual_ms, comparison.measured_ms, comparison.ratio) == (None, None, None)


def test_a_late_job_is_counted_and_its_neighbours_are_not_compared() -> None:
    comparison = compare(PACE, "pipelined", 40, jobs(late=20))
    assert comparison.host_slower == {"infer": 1}
    assert comparison.late_frames == (20,)
    assert comparison.ratio == pytest.approx(1.0)
    assert 0.7 < comparison.compared_share < 1


@pytest.mark.parametrize("policy", ["latest", "deadline"])
def test_a_policy_with_a_rate_has_the_scenes_slowed_down_as_the_chip_is(policy: str) -> None:
    """40 a second, 3 times slower: a frame every 75 ms, of which any of these takes less."""
    slow = replace(PACE, slow_motion=3.0)
    assert release_fps(slow, 40.0) == pytest.approx(40 / 3)
    assert sum(STAGE_NS.values()) < 75_000_000
    for edge in ("single", "triple"):
        assert compare(slow, policy, 20, jobs(), edge=edge, fps=40.0).virtual_ms == pytest.approx(75)


def test_the_edge_counts_in_virtual_time_too() -> None:
    """With one slot between them, raster, infer and composite take turns; with two the slowest unit decides."""
    turns = sum(STAGE_NS[stage] for stage in ("raster", "infer", "composite"))
    assert compare(PACE, "pipelined", 40, jobs(), edge="single").virtual_ms == pytest.approx(turns / 1e6)
    assert compare(PACE, "pipelined", 40, jobs(), edge="double").virtual_ms < turns / 1e6


def test_each_key_of_the_comparison_by_hand() -> None:
    """Frames presented 9 ms apart, but 30 and 12 between 20, 21 and 22; a late frame spoils itself, the one before it
    and seven after it: of 39 intervals, those that end with frames 19 to 27 are left out."""
    moved = [
        job._replace(end_ns=job.end_ns + {20: 21 * MS, 21: 24 * MS}.get(job.frame, 24 * MS * (job.frame > 21)))
        if job.stage == "present"
        else job
        for job in jobs()
    ]
    held = [job._replace(begin_ns=job.end_ns - MS) if job.stage == "present" else job for job in moved]
    late = [
        job._replace(begin_ns=job.begin_ns - 1 - SLACK_NS) if (job.stage, job.frame) == ("pose", 20) else job
        for job in held
    ]
    pace = Pace("chip", "burst", 2.5, STAGE_NS)
    assert compare(pace, "pipelined", 40, late).as_json() == {
        "profile": "chip",
        "performance_profile": "burst",
        "slow_motion": 2.5,
        "stage_ms": {"pose": 1.0, "raster": 4.0, "infer": 9.0, "composite": 3.0, "present": 1.0},
        "host_slower": {"pose": 1},
        "late_frames": [20],
        "virtual_ms": 9.0,
        "measured_ms": 9.0,
        "compared_share": 30 / 39,
        "ratio": 1.0,
    }
    just = [job._replace(begin_ns=job.begin_ns - SLACK_NS) if job.frame == 20 else job for job in held]
    assert compare(pace, "pipelined", 40, just).late_frames == ()


def test_one_frame_has_no_interval() -> None:
    """Nor any share: 0 of none are compared."""
    first = [job for job in jobs() if job.frame == 0]
    comparison = compare(PACE, "pipelined", 40, first)
    assert (comparison.measured_ms, comparison.compared_share, comparison.virtual_ms) == (None, 0.0, 9.0)


def test_the_policy_decides_the_virtual_frame_time() -> None:
    """One frame at a time takes 1 + 4 + 9 + 3 + 1 ms."""
    assert compare(PACE, "sequential", 40, jobs()).virtual_ms == 18.0
    assert compare(PACE, "sequential", 40, jobs()).ratio == 0.5


@pytest.mark.parametrize(("slow_motion", "said"), [(0, "0"), (-1.5, "-1.5"), (1001, "1001"), (float("nan"), "nan")])
def test_slow_motion_is_refused_word_by_word(slow_motion: float, said: str) -> None:
    with pytest.raises(BadInputError) as refused:
        pace_of(config(), "nowhere", slow_motion)
    assert str(refused.value) == f"--slow-motion: found {said}, expected above 0, at most 1000"
    with pytest.raises(BadInputError, match="nowhere"):
        pace_of(config(), "nowhere", 1000)


def test_nothing_is_compared_when_every_frame_is_late() -> None:
    slow = [job._replace(end_ns=job.end_ns + 2 * SLACK_NS) for job in jobs()]
    comparison = compare(PACE, "pipelined", 40, slow)
    assert (comparison.measured_ms, comparison.ratio, comparison.compared_share) == (None, None, 0.0)
    assert len(comparison.late_frames) == 40


def test_a_chips_times_grow_with_the_tensor_and_the_slow_motion() -> None:
    small, large = pace_of(config(), "snapdragon-888"), pace_of(config("512"), "snapdragon-888")
    assert set(small.stage_ns) == {"pose", "raster", "infer", "composite", "present"}
    assert large.stage_ns["infer"] > small.stage_ns["infer"] > 0
    assert pace_of(config(), "snapdragon-888", 8).stage_ns["infer"] == pytest.approx(
        8 * small.stage_ns["infer"], rel=1e-6
    )


def test_a_hold_ends_when_it_should_and_never_before() -> None:
    for hold_ns in (0, 50_000, 3 * MS):
        end_ns = time.monotonic_ns() + hold_ns
        hold_until(end_ns)
        assert time.monotonic_ns() >= end_ns
    before = time.monotonic_ns()
    hold_until(before - MS)
    assert time.monotonic_ns() - before < 100 * MS
