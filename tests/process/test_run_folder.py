"""A run of mock units to its folder: whole when it went well, honest when it did not, gone when nothing came of it."""

from __future__ import annotations

import os
import signal
from collections import defaultdict
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest

from support.doubles import pipeline_of_doubles
from support.trace_reading import read_trace
from trilane.apps.run.report import read_report
from trilane.apps.run.run_job import Hooks, Prepared, RunOutcome, run_to_folder
from trilane.errors import TrilaneError
from trilane.hw_profiles.host import host_units
from trilane.pipeline.memory import Assets
from trilane.pipeline.result import RunResult
from trilane.pipeline.run import run_pipeline
from trilane.pipeline.unit_starter import UnitStarter
from trilane.scene.schema import OutputSpec, Scene
from trilane.scheduler.recording import read, replay
from trilane.stages.config import RunConfig
from trilane.stages.configure import Checked
from trilane.stages.machine_facts import machine_facts
from trilane.stages.run_options import RunOptions

FRAMES = 24
pytestmark = pytest.mark.usefixtures("no_new_process", "behaviour")


class Listener:
    """Keeps the messages, and interrupts this process once when `interrupt_at` is presented of run `during`."""

    def __init__(self, during: str = "", interrupt_at: int = 0) -> None:
        self.messages: list[str] = []
        self._during, self._interrupt_at = during, interrupt_at

    def progress(self, what: str, presented: int, requested: int) -> None:
        assert presented <= requested
        if what == self._during and presented >= self._interrupt_at:
            self._during = ""
            os.kill(os.getpid(), signal.SIGINT)


@pytest.fixture
def behaviour(starter: UnitStarter, monkeypatch: pytest.MonkeyPatch) -> dict[str, object]:
    """Runs are of doubles; what is put in here is how they behave, by stage."""
    asked: dict[str, object] = {}

    def run_doubles(config: RunConfig, assets: Assets, frames: int | None, edge: str, **options: Any) -> RunResult:
        pipeline = pipeline_of_doubles(**asked).with_rule(edge)
        count, fps = frames or config.scene.frames, config.scene.fps
        return run_pipeline(pipeline, count, fps=fps, assets=assets, **{**options, "starter": starter})

    monkeypatch.setattr("trilane.apps.run.run_job.run_avatar", run_doubles)
    return asked


def run_mocks(target: Path, listener: Listener, frames: int = FRAMES, **options: Any) -> RunOutcome:
    config = RunConfig(
        scene=Scene(frames=frames, output=OutputSpec(width=64, height=64)),
        out_dir=target,
        avatar_dirs=(),
        units=host_units(),
    )
    hooks = Hooks(listener.progress, listener.messages.append)
    checked = Checked(config, assets={}, notes=("x",), accuracy={})
    asked = RunOptions(**{"baseline_frames": 8, **options})
    return run_to_folder(Prepared(asked, checked), target, hooks, machine=machine_facts())


def test_the_report_has_the_keys_of_the_schema_and_the_baseline(tmp_path: Path, behaviour: dict[str, object]) -> None:
    """One after the other, jobs take 23 ms of a frame; the slowest unit takes 11."""
    behaviour.update(raster=10, infer=10)
    outcome = run_mocks(tmp_path / "run", Listener(), edge="fifo:3")
    report = read_report(outcome.folder)
    assert (outcome.exit_code, [path.name for path in tmp_path.iterdir()]) == (0, ["run"])
    assert list(replay(read(outcome.folder / "events.jsonl"))) == []
    assert (report.edge, report.config["edge"], report.config["policy"]) == ("fifo:3", "fifo:3", "pipelined")
    assert report.clock == "host"
    assert (report.frames.requested, report.frames.presented, report.frames.lost) == (FRAMES, FRAMES, 0)
    assert len(set(report.pids.values())) == 3
    assert report.baseline is not None
    assert report.baseline.policy == "sequential"
    assert report.baseline.frames.presented == 8
    assert report.baseline.fps < report.fps
    assert report.notes == ("x",)
    assert set(report.stages) == {"pose", "raster", "infer", "composite", "present"}
    for unit in report.units.values():
        idle = unit.idle
        assert unit.busy + sum(idle.as_json().values()) == pytest.approx(1)


def test_the_trace_of_a_run_adds_up_to_its_report(tmp_path: Path) -> None:
    """Read as any program would; `read_trace` refuses slices of one track that lie over each other."""
    outcome = run_mocks(tmp_path / "run", Listener(), baseline_frames=0)
    trace = read_trace((outcome.folder / "trace.pftrace").read_bytes())
    in_order = list(outcome.report.stages)
    through: dict[int, list[str]] = defaultdict(list)
    for unit, row in outcome.report.units.items():
        slices = trace.of(f"trilane, host clock/{unit}")
        jobs = [one for one in slices if one.flows]
        lost_ns = sum(one.notes.get(key, 0) for one in jobs for key in ("preempted_ns", "asleep_ns"))
        busy_ns = sum(one.end_ns - one.begin_ns for one in jobs) - lost_ns
        span_ns = slices[-1].end_ns - slices[0].begin_ns
        assert span_ns / 1e9 == pytest.approx(outcome.report.duration_s, rel=1e-6)
        assert busy_ns / span_ns == pytest.approx(row.busy, abs=0.005)
        assert all(before.end_ns == after.begin_ns for before, after in pairwise(slices))
        for one in slices:
            for flow in one.flows:
                through[flow].append(one.name)
    assert len(through) == FRAMES
    assert all(sorted(stages) == sorted(in_order) for stages in through.values())
    assert len(trace.of("Actual frames")) == FRAMES
    (run,) = trace.of("host clock/run")
    assert run.notes["config"]["policy"] == "pipelined"
    assert run.notes["machine"]["hardware_counters"] == machine_facts()["hardware_counters"]
    assert run.notes["times"] == "ns of CLOCK_MONOTONIC"


def test_no_baseline_beside_a_sequential_run(tmp_path: Path) -> None:
    assert run_mocks(tmp_path / "run", Listener(), policy="sequential").report.baseline is None


def test_an_interrupted_baseline_loses_nothing_of_the_run(tmp_path: Path) -> None:
    outcome = run_mocks(tmp_path / "run", Listener("sequential", 1), baseline_frames=2000, frames=60)
    assert outcome.exit_code == 130
    assert not outcome.report.interrupted
    assert outcome.report.baseline is None
    assert read_report(outcome.folder).frames.presented == 60
    assert not (outcome.folder / "sequential").exists()


def test_a_stage_that_fails_is_named_and_the_frames_before_it_are_kept(
    tmp_path: Path, behaviour: dict[str, object]
) -> None:
    behaviour["infer"] = "raise"
    listener = Listener()
    outcome = run_mocks(tmp_path / "run", listener, frames=100)  # frame 3 is none of those measured before the run
    assert outcome.exit_code == 2
    assert "mock.npz" in (outcome.report.failure or "")
    assert 1 <= outcome.report.frames.presented < 100
    assert any("mock.npz" in message for message in listener.messages)


def test_a_unit_that_cannot_be_built_leaves_nothing(tmp_path: Path, behaviour: dict[str, object]) -> None:
    behaviour["infer"] = "badbuild"
    with pytest.raises(TrilaneError, match=r"mock\.onnx: found nothing") as raised:
        run_mocks(tmp_path / "made" / "run", Listener())
    assert raised.value.exit_code == 2
    assert list(tmp_path.iterdir()) == []
