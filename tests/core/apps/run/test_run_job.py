"""From a checked configuration to a run folder, around runs that were made in virtual time: what is run, kept, told."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from trilane.apps.run import run_job
from trilane.apps.run.pace import Pace
from trilane.apps.run.report import read_report
from trilane.apps.run.run_job import Hooks, Prepared, RunOutcome, asked_frames, run_to_folder
from trilane.errors import BadInputError, TrilaneError
from trilane.hw_profiles.application import application_graph
from trilane.hw_profiles.governor import Governor
from trilane.pipeline.description import UnitSettings
from trilane.pipeline.journal import JournalWriter, journal_of
from trilane.pipeline.result import Failure, JournalFile, RunResult
from trilane.pipeline.run_metrics import RunMetrics
from trilane.scene.schema import OutputSpec, Scene
from trilane.scheduler.events import Settings
from trilane.scheduler.recording import Recording
from trilane.scheduler.virtual import simulate
from trilane.stages.config import RunConfig, pose_dtype
from trilane.stages.configure import Checked
from trilane.stages.cpu.present import KEPT_FOLDER, SEGMENTS, PresentStage
from trilane.stages.run_options import RunOptions
from trilane.transport.packets import SlotLayout, view_packet
from trilane.units import COMPARED, COMPUTED, MEASURED, PerformanceProfile

MS = 1_000_000
FRAMES, WIDTH, HEIGHT = 6, 96, 64
FILES = ["events.jsonl", "journal.msgpack", "report.json", "trace.pftrace"]
#: The slowest stage takes 4 ms: pipelined frames are 4 ms apart, frames one at a time 1 + 2 + 4 + 2 + 1 ms.
STAGE_NS = {"pose": MS, "raster": 2 * MS, "infer": 4 * MS, "composite": 2 * MS, "present": MS}
MACHINE = {
    "system": "Linux",
    "python": "3.11",
    "trilane": None,
    "cpu": {"model": "a processor", "architecture": "x86_64", "flags": [], "cores": 2, "cores_allowed": [0, 1]},
    "memory_bytes": 1,
    "gl": None,
    "packages": {},
}
MADE = {"at": "2026-11-22T01:00:00+00:00", "command": ["trilane"], "trilane": None, "revision": None, "modified": None}


def checked() -> Checked:
    units = {unit: UnitSettings(cores=(0,), threads=1) for unit in ("cpu", "gpu", "dsp")}
    scene = Scene(frames=FRAMES, fps=25.0, size="64x64", output=OutputSpec(width=WIDTH, height=HEIGHT))
    config = RunConfig(scene=scene, out_dir=Path("/nowhere"), avatar_dirs=(Path("/avatar"),), units=units)
    return Checked(config, {}, ("the motion is short", "runtime: ort"), {"someone": {"source": "no figures"}})


def a_result(frames: int = FRAMES, policy: str = "pipelined", **changes: Any) -> RunResult:
    """What a run of so many frames hands back."""
    run = simulate(application_graph(), Settings(frames, policy), lambda stage, *_: STAGE_NS[stage], keep=True)
    assert run.recording is not None
    report = RunMetrics.model_validate({**run.report, "clock": "host", "policy": policy, "edge": "double"})
    result = RunResult(
        report=report,
        requested=frames,
        presented=frames,
        lost={},
        dropped={},
        pids={"cpu": 11, "gpu": 12, "dsp": 13},
        startup_ms={"cpu": 1.5},
        jobs=run.jobs,
        recording=run.recording,
        metrics={"pose": {"visible": 0.5}},
        messages=("the unit gpu was slow",),
    )
    return replace(result, **changes)


def record(out_dir: Path, numbers: range) -> None:
    """The video of a run, as its last stage leaves it."""
    config = checked().config.model_copy(update={"out_dir": out_dir})
    layout = SlotLayout(pose_dtype(1), payload_bytes=WIDTH * HEIGHT * 3)
    slot = view_packet(memoryview(bytearray(layout.slot_bytes)), layout)
    stage = PresentStage(config)
    stage.bind([slot], [])
    for number in numbers:
        slot.payload[:] = np.uint8(40 + number)
        stage.run(number, 0, None)
    stage.close()


def journaled(result: RunResult, file: JournalFile) -> RunResult:
    """The run with its jobs and steps in the journal, and nowhere else."""
    with JournalWriter(file.path) as journal:
        for each in journal_of(result.recording, result.jobs, file.facts, result.report.as_json()):
            journal.add(each)
    return replace(result, jobs=(), recording=Recording(result.recording.graph, result.recording.settings))


PLACED = "placement: cpu 0, gpu 1, dsp 0"


@dataclass
class Runs:
    """In place of `run_avatar`: each call takes the next of `answers`, a result, an error, or what makes one."""

    answers: list[Any]
    calls: list[dict[str, Any]] = field(default_factory=list)
    said: list[Any] = field(default_factory=list)

    def __call__(self, config: RunConfig, assets: Any, **options: Any) -> RunResult:
        self.calls.append({"config": config, "assets": assets, **options})
        options["on_progress"](2, 5)
        options["on_message"]("hello")
        answer = self.answers.pop(0)
        if isinstance(answer, BaseException):
            raise answer
        result: RunResult = answer(config.out_dir) if callable(answer) else answer
        return result if options["journal"] is None else journaled(result, options["journal"])

    @property
    def hooks(self) -> Hooks:
        return Hooks(lambda *progress: self.said.append(progress), self.said.append)


@pytest.fixture
def runs(monkeypatch: pytest.MonkeyPatch) -> Callable[..., Runs]:
    def made(*answers: Any) -> Runs:
        double = Runs(list(answers))
        monkeypatch.setattr(run_job, "run_avatar", double)
        monkeypatch.setattr(run_job, "placed", with_a_place)
        return double

    return made


def with_a_place(given: Checked, _policy: str, _starter: Any, _driver: str, _say: Any) -> Checked:
    """In place of the placement: it adds a note and leaves the units where they are."""
    return replace(given, notes=(*given.notes, PLACED))


def go(
    runs: Runs,
    target: Path,
    made: Mapping[str, Any] | None = None,
    pace: Pace | None = None,
    record: bool = False,
    **options: Any,
) -> RunOutcome:
    starter: Any = "the starter"
    prepared = Prepared(RunOptions(**options), checked().changed(record=record), pace)
    return run_to_folder(prepared, target, runs.hooks, machine=MACHINE, made=made, starter=starter)


def test_a_run_and_its_baseline(runs: Callable[..., Runs], tmp_path: Path) -> None:
    """The baseline is of at most so many frames, one at a time, without a latch, and leaves no picture."""
    double = runs(a_result(), a_result(4, "sequential"))
    outcome = go(double, tmp_path / "run", MADE, policy="deadline", baseline_frames=4, latch_ms=3.0)
    assert (outcome.exit_code, outcome.folder) == (0, tmp_path / "run")
    first, second = double.calls
    assert [(call["policy"], call["frames"], call["latch_ms"]) for call in double.calls] == [
        ("deadline", None, 3.0),
        ("sequential", 4, 0.0),
    ]
    assert second["config"].out_dir == first["config"].out_dir / "sequential"
    assert first["config"].out_dir.name.endswith(".partial")
    assert first["config"].model_copy(update={"out_dir": Path("/nowhere")}) == checked().changed(record=False).config
    assert (first["starter"], first["governor"], first["assets"]) == ("the starter", None, {})
    assert double.said == [PLACED, ("deadline", 2, 5), "hello", ("sequential", 2, 5), "hello"]
    assert sorted(file.name for file in outcome.folder.iterdir()) == FILES
    report = read_report(outcome.folder)
    assert report == outcome.report
    assert (report.frames.presented, report.policy) == (FRAMES, "pipelined")
    assert report.baseline is not None
    assert (report.baseline.policy, report.baseline.frames.presented) == ("sequential", 4)
    assert report.baseline.frame_time_ms.mean == 10.0


CHECK = {
    **{"frames": 1, "psnr_db": 30.0, "worst_psnr_db": 30.0, "mae": 1.0, "ssim": None, "flip": 0.1, "iou": 0.9},
    **{"against": "the reference", "numbers": (1,)},
}


def test_frames_of_the_run_alone_are_kept_and_compared(
    runs: Callable[..., Runs], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The baseline keeps none; what was kept is gone when the folder is whole."""

    def check(_: Any, folder: Path, told: Any) -> dict[str, Any]:
        assert (folder / KEPT_FOLDER).is_dir()
        told(1, 2)
        return CHECK

    def run(folder: Path) -> RunResult:
        (folder / KEPT_FOLDER).mkdir()
        return a_result()

    monkeypatch.setattr(run_job, "check_run", check)
    double = runs(run, a_result(4, "sequential"))
    outcome = go(double, tmp_path / "run", baseline_frames=4, check=2)
    assert [call["config"].kept for call in double.calls] == [asked_frames(FRAMES, 2), ()]
    assert ("check", 1, 2) in double.said
    assert not (outcome.folder / KEPT_FOLDER).exists()
    document = json.loads((outcome.folder / "report.json").read_text())
    assert document["check"] == {**CHECK, "numbers": [1]}
    assert document["sources"]["check"] == MEASURED
    assert "kept" not in document["config"]


@pytest.mark.parametrize("options", [{"baseline_frames": 0}, {"policy": "sequential"}])
def test_no_baseline_where_none_is_asked_for_or_the_run_is_one(
    options: dict[str, Any], runs: Callable[..., Runs], tmp_path: Path
) -> None:
    double = runs(a_result())
    outcome = go(double, tmp_path / "run", **options)
    assert (len(double.calls), outcome.report.baseline, outcome.exit_code) == (1, None, 0)


STOPPED = "interrupted: the sequential run to compare with is left out"
FAILED = "the sequential run to compare with failed and is left out: no memory"
BASELINES = {
    "interrupted before a frame": (KeyboardInterrupt(), STOPPED, 130),
    "failed": (TrilaneError("no memory"), FAILED, 0),
    "interrupted": (a_result(3, "sequential", interrupted=True), None, 130),
    "cut short": (a_result(3, "sequential", failure=Failure("the unit gpu is gone")), None, 0),
    "without a frame": (a_result(3, "sequential", presented=0, interrupted=True), STOPPED, 130),
}


@pytest.mark.parametrize("case", BASELINES)
def test_a_baseline_that_is_not_whole_is_left_out(case: str, runs: Callable[..., Runs], tmp_path: Path) -> None:
    answer, said, code = BASELINES[case]
    double = runs(a_result(), answer)
    outcome = go(double, tmp_path / "run")
    assert (outcome.exit_code, outcome.report.baseline) == (code, None)
    assert double.said[5:] == ([said] if said else [])
    assert sorted(file.name for file in outcome.folder.iterdir()) == FILES


RUNS = {
    "interrupted": (a_result(interrupted=True), 130, None),
    "failed": (a_result(failure=Failure("the unit gpu is gone", 3)), 3, "the unit gpu is gone"),
    "both": (a_result(failure=Failure("late", 1), interrupted=True), 130, "late"),
}


@pytest.mark.parametrize("case", RUNS)
def test_a_run_cut_short_keeps_its_frames_and_has_no_baseline(
    case: str, runs: Callable[..., Runs], tmp_path: Path
) -> None:
    answer, code, failure = RUNS[case]
    double = runs(answer)
    outcome = go(double, tmp_path / "run")
    assert (outcome.exit_code, len(double.calls)) == (code, 1)
    assert (outcome.report.failure, outcome.report.interrupted) == (failure, answer.interrupted)


NO_FRAME = {
    "failed": (a_result(presented=0, failure=Failure("no context", 3)), "no context", 3),
    "unknown": (
        a_result(presented=0, messages=("first", "second")),
        "no frame was presented: first; second",
        TrilaneError.exit_code,
    ),
}


@pytest.mark.parametrize("case", NO_FRAME)
def test_a_run_without_a_frame_leaves_no_folder(case: str, runs: Callable[..., Runs], tmp_path: Path) -> None:
    answer, said, code = NO_FRAME[case]
    with pytest.raises(TrilaneError) as raised:
        go(runs(answer), tmp_path / "run")
    assert (str(raised.value), raised.value.exit_code) == (said, code)
    assert list(tmp_path.iterdir()) == []


def test_a_taken_place_is_refused_before_anything_runs(runs: Callable[..., Runs], tmp_path: Path) -> None:
    double = runs()
    with pytest.raises(BadInputError, match="a name that is free"):
        go(double, tmp_path)
    assert double.calls == []


def test_a_run_at_a_chips_pace_is_compared(runs: Callable[..., Runs], tmp_path: Path) -> None:
    pace = Pace("chip", "burst", 2.0, STAGE_NS)
    report = go(runs(a_result(), a_result(policy="sequential")), tmp_path / "run", pace=pace).report
    assert report.pace is not None
    assert (report.pace.profile, report.pace.virtual_ms, report.pace.ratio) == ("chip", 4.0, 1.0)
    assert (report.sources["pace"], report.sources["pace.ratio"]) == (COMPUTED, COMPARED)


def test_a_cap_is_kept_by_a_governor_of_this_machine(runs: Callable[..., Runs], tmp_path: Path) -> None:
    caps = {"how": "duty cycles", "profile": "host", "performance_profile": "balanced"}
    capped = a_result()
    changed = {**capped.report.as_json(), "caps": caps, "temperature_c": {"kind": "modelled"}}
    capped = replace(capped, report=RunMetrics.model_validate(changed))
    double = runs(capped, a_result(policy="sequential"))
    report = go(double, tmp_path / "run", performance_profile=PerformanceProfile.BALANCED.value).report
    governors = [call["governor"] for call in double.calls]
    assert all(isinstance(governor, Governor) for governor in governors) and governors[0] is not governors[1]
    assert report.caps.as_json() == caps
    assert report.temperature_c.kind == "modelled" and "sensor" in report.temperature_c.as_json()


def test_the_video_is_joined_and_what_it_lacks_is_told(runs: Callable[..., Runs], tmp_path: Path) -> None:
    """Five of six frames recorded at 25 a second, the last of them number 4."""

    def recorded(out_dir: Path) -> RunResult:
        record(out_dir, range(2))
        record(out_dir, range(2, 5))
        return a_result(metrics={"pose": {"visible": 0.0}})

    double = runs(recorded)
    outcome = go(double, tmp_path / "run", record=True, baseline_frames=0)
    assert outcome.report.video is not None
    assert (outcome.report.video.frames, outcome.report.video.seconds) == (5, pytest.approx(0.2))
    assert len(outcome.report.checksum or "") == 64
    assert double.said[3:] == [
        "video.mp4 holds 5 of 6 frames: a writer was killed before its last",
        "no avatar was in the picture in any frame",
    ]
    files = {file.name for file in outcome.folder.iterdir()}
    assert files == {"contact.png", "video.mp4", *FILES}
    assert SEGMENTS not in files


def test_a_run_without_a_video_says_why(runs: Callable[..., Runs], tmp_path: Path) -> None:
    double, unrecorded = runs(a_result()), checked().changed(record=False)
    report = run_to_folder(
        Prepared(RunOptions(baseline_frames=0), unrecorded), tmp_path / "run", double.hooks, machine=MACHINE
    ).report
    assert (report.video, report.checksum) == (None, None)
    assert report.notes == (*checked().notes, run_job.NO_VIDEO)
    assert not double.calls[0]["config"].record
