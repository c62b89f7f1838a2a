"""Frames that skip raster and infer, in runs of real units: what is done for them, and that nobody sees it."""

from __future__ import annotations

import contextlib
import os
import signal
from collections.abc import Callable, Mapping
from pathlib import Path

import pytest

from support.doubles import pipeline_of_doubles
from support.faults import unit_process
from trilane.pipeline.controls import RunControls
from trilane.pipeline.description import Pipeline
from trilane.pipeline.result import RunResult
from trilane.pipeline.run import run_pipeline
from trilane.scheduler.recording import read, replay
from trilane.stages.avatar_pipeline import avatar_pipeline
from trilane.stages.configure import configure
from trilane.stages.run_options import RunOptions
from trilane.units import BYPASS

FRAMES, KILL_AT = 50, 12
SCENE = """
size = "64x64"
output = {{ width = 96, height = 64 }}
camera = {{ source = "builtin:static", place = "none" }}
[[avatars]]
motion = "builtin:t-pose"
position = {position}
"""
STILL, OFF_SCREEN = "[0.0, 0.0, 0.0]", "[0.0, 0.0, 40.0]"

pytestmark = pytest.mark.usefixtures("nothing_left")


def kills(unit: str, controls: RunControls | None = None) -> tuple[Callable[[int, int], None], list[int]]:
    """What kills the unit once `KILL_AT` frames were presented, and whom it killed.

    `controls`: of a run that ends 20 frames after the unit is back.
    """
    victims: list[int] = []
    stop_at: list[int] = []

    def kill(presented: int, _requested: int) -> None:
        if presented >= KILL_AT and not victims:
            victims.append(unit_process(unit).pid)
            os.kill(victims[0], signal.SIGKILL)
        elif controls is not None and victims and not stop_at:
            with contextlib.suppress(LookupError):
                if unit_process(unit).pid != victims[0]:
                    stop_at.append(presented + 20)
        elif controls is not None and stop_at and presented >= stop_at[0]:
            controls.stop()

    return kill, victims


def with_pose(pipeline: Pipeline, factory: str, bypass: tuple[str, str] | None) -> Pipeline:
    first = pipeline.stages[0].model_copy(update={"factory": factory})
    return pipeline.model_copy(update={"stages": (first, *pipeline.stages[1:]), "bypass": bypass})


@pytest.mark.parametrize(("unit", "policy", "edge"), [("dsp", "pipelined", "double"), ("gpu", "latest", "triple")])
def test_a_unit_that_dies_between_skipping_frames_costs_no_more_than_its_jobs(
    unit: str, policy: str, edge: str, tmp_path: Path
) -> None:
    doubles = with_pose(
        pipeline_of_doubles(tmp_path / "log", infer=10, composite=6), "support.doubles:build_skipping", BYPASS
    )
    controls = RunControls()
    kill, victims = kills(unit, controls)
    chosen = doubles.with_rule(edge)
    result = run_pipeline(chosen, 100_000, policy=policy, pace_fps=100, on_progress=kill, controls=controls)
    report, presented = result.report, [int(line) for line in (tmp_path / "log").read_text().split()]
    assert (result.failure, bool(victims), report.units[unit].restarts) == (None, True, 1)
    assert presented == sorted(set(presented)) and len(presented) == result.presented
    assert sum(result.lost.values()) <= 2
    begun = report.frames.requested - report.frames.not_begun
    assert result.presented + sum(result.lost.values()) + sum(result.dropped.values()) == begun
    posed = report.stages["pose"].jobs
    full = round(result.metrics["pose"]["full"] * posed)
    assert report.stages["infer"].jobs <= full < posed / 2
    assert 0 < report.frames.skipped <= posed - full
    assert not list(replay(result.recording))
    result.recording.write(tmp_path / "events.jsonl")
    assert read(tmp_path / "events.jsonl") == result.recording


def avatar(bundle: Path, folder: Path, position: str, frames: int, *, skips: bool, **options: object) -> RunResult:
    folder.mkdir()
    (folder / "scene.toml").write_text(SCENE.format(position=position), encoding="utf-8")
    asked = RunOptions(scene=str(folder / "scene.toml"), avatar=str(bundle), frames=frames, runtime="ort")
    checked = configure(asked, folder)
    pipeline = avatar_pipeline(checked.config, checked.assets, "double")
    if not skips:
        pipeline = with_pose(pipeline, "support.doubles:build_full_frames", None)
    return run_pipeline(pipeline, frames, assets=checked.assets, **options)  # type: ignore[arg-type]


def digests(folder: Path) -> Mapping[int, str]:
    texts = [file.read_text() for file in sorted(folder.glob("segments/*.sha256"))]
    return {int(frame): digest for text in texts for frame, digest in map(str.split, text.splitlines())}


def counts(result: RunResult) -> dict[str, int]:
    """Of composite's jobs: how many of each kind."""
    jobs = result.report.stages["composite"].jobs
    return {name: round(mean * jobs) for name, mean in result.metrics["composite"].items()}


def test_a_still_scene_is_inferred_once_and_once_more_when_the_gpu_dies(drawable_bundle: Path, tmp_path: Path) -> None:
    """Frame 0 is made as ever. One that skipped and met the new unit before its picture came is counted."""
    kill, victims = kills("gpu")
    run = {"pace_fps": 100.0, "on_progress": kill}
    result = avatar(drawable_bundle, tmp_path / "still", STILL, FRAMES, skips=True, **run)
    report, shown, said = result.report, digests(tmp_path / "still"), counts(result)
    assert (len(victims), report.units["gpu"].restarts) == (1, 1)
    assert 2 <= report.stages["infer"].jobs <= 3 and report.stages["raster"].jobs <= 3
    assert said["reused"] >= FRAMES - 10 and said["nobody"] == 0
    assert report.frames.skipped + report.stages["infer"].jobs >= result.presented == len(shown)
    wrong = [frame for frame, digest in shown.items() if digest != shown[0]]
    assert len(wrong) <= said["stale"] <= 4
    assert shown[FRAMES - 1] == shown[0]


def test_nothing_is_drawn_or_inferred_of_a_body_off_the_screen(drawable_bundle: Path, tmp_path: Path) -> None:
    avatar(drawable_bundle, tmp_path / "full", OFF_SCREEN, 2, skips=False)
    result = avatar(drawable_bundle, tmp_path / "off", OFF_SCREEN, FRAMES, skips=True)
    report, said = result.report, counts(result)
    assert [report.stages[stage].jobs for stage in ("pose", "raster", "infer", "composite")] == [FRAMES, 0, 0, FRAMES]
    assert (report.frames.skipped, report.frames.presented) == (FRAMES, FRAMES)
    assert (said["nobody"], said["reused"], said["stale"], said["copied"] >= FRAMES - 1) == (FRAMES, 0, 0, True)
    assert set(digests(tmp_path / "off").values()) == set(digests(tmp_path / "full").values())
    assert len(digests(tmp_path / "off")) == FRAMES
