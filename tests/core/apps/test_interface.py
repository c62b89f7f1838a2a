"""`trilane.run`, `predict` and `load_run`: what they ask of the parts below, what they hand back, what they raise."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import trilane
from support.run_folders import write_run
from support.run_report import make_report
from support.second_accounts import idle_slices
from trilane.apps import interface
from trilane.apps.explain.explained_run import COLUMNS
from trilane.apps.interface import run_html
from trilane.apps.run.report import Report, read_report
from trilane.apps.run.run_job import RunOutcome
from trilane.errors import BadInputError, MissingPartError, TrilaneError
from trilane.hw_profiles.application import application_graph
from trilane.pipeline.journal import Stepped
from trilane.scheduler.events import Settings
from trilane.scheduler.virtual import Simulation, simulate
from trilane.stages.run_options import RunOptions

MS = 1_000_000
STAGE_MS = {"pose": 1, "raster": 2, "infer": 4, "composite": 2, "present": 1}
Command = Callable[..., tuple[str, str]]


@pytest.fixture(scope="module")
def simulated() -> Simulation:
    return simulate(application_graph(), Settings(30), lambda stage, *_: STAGE_MS[stage] * MS, keep=True)


@pytest.fixture
def folder(tmp_path: Path, simulated: Simulation) -> Path:
    return write_run(tmp_path / "run", simulated, figures={"pose": {"visible": 1.0}})


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch, folder: Path) -> list[Any]:
    """What `run` asked for; the run ends with the exit code that is put in front."""
    found: list[Any] = [0]

    def run_asked(options: RunOptions, hooks: Any, command: tuple[str, ...]) -> RunOutcome:
        found.extend([options, command])
        with hooks() as told:
            told.progress("pipelined", 1, 2)
            told.message("a note")
        failure = {"failure": "infer broke"} if found[0] == 1 else {}
        return RunOutcome(Report.model_validate(make_report(**failure)), folder, found[0])

    monkeypatch.setattr(interface, "run_asked", run_asked)
    return found


def test_importing_trilane_imports_nothing_else() -> None:
    script = (
        "import sys, trilane; dir(trilane); print([name for name in sys.modules if name[:8] in ('trilane.', 'numpy')])"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert done.stdout == "[]\n"
    assert set(trilane.__all__) <= set(dir(trilane))


def test_arguments_arrive_as_options(asked: list[Any], folder: Path, tmp_path: Path) -> None:
    run = trilane.run()
    assert (run.folder, run.report.frames.presented) == (folder, 3)
    assert asked[1:] == [RunOptions(baseline_frames=0), ("trilane.run",)]
    said: list[Any] = []
    same: dict[str, Any] = {"frames": 3, "policy": "latest", "fps": 24, "latch_ms": 2.0, "check": 2, "width": 8}
    trilane.run(
        tmp_path / "s.toml",
        **same,
        size=96,
        avatar=tmp_path,
        cores={"dsp": [0, 1], "cpu": (1,)},
        out="there",
        on_progress=lambda *given: said.append(given),
        on_message=said.append,
    )
    words = asked[-1]
    paths = {"scene": str(tmp_path / "s.toml"), "avatar": str(tmp_path), "out": Path("there")}
    assert asked[-2] == RunOptions(**same, **paths, size="96", cores=("dsp=0,1", "cpu=1"), baseline_frames=0)
    assert words[:2] == ("trilane.run", f"scene={tmp_path / 's.toml'!r}") and "size=96" in words
    assert said == [("pipelined", 1, 2), "a note"]


def test_a_run_that_failed_or_was_interrupted_raises_and_keeps_what_was_done(asked: list[Any], folder: Path) -> None:
    asked[0] = 1
    with pytest.raises(trilane.RunFailedError, match=r"infer broke; what was done is in .*run$") as raised:
        trilane.run()
    assert isinstance(raised.value, TrilaneError)
    assert (raised.value.run.folder, raised.value.exit_code) == (folder, 1)
    asked[0] = 130
    with pytest.raises(KeyboardInterrupt, match="what was done is in"):
        trilane.run()


def test_jobs_are_those_that_the_run_did(folder: Path, simulated: Simulation) -> None:
    jobs = trilane.load_run(folder).jobs
    assert jobs.dtype.names == (*COLUMNS, "visible")
    fields = ("stage", "unit", "frame", "ready_ns", "dispatch_ns", "begin_ns", "end_ns", "preempted_ns", "asleep_ns")
    found = [tuple(row) for row in jobs[list(fields)].tolist()]
    assert found == [tuple(getattr(job, name) for name in fields) for job in simulated.jobs]
    is_pose = jobs["stage"] == "pose"
    assert np.array_equal(np.isnan(jobs["visible"]), ~is_pose)
    assert (jobs["wait_ns"] == jobs["begin_ns"] - jobs["ready_ns"]).all()


def test_frames_idle_time_and_events_are_those_of_the_run(folder: Path, simulated: Simulation) -> None:
    """Frames are 4 ms apart; the first one takes 1 + 2 + 4 + 2 + 1 ms, and composite ends 1 ms before it is shown."""
    run = trilane.load_run(str(folder))
    frames, recording = run.frames(), simulated.recording
    assert recording is not None
    assert frames["frame"].tolist() == list(range(30))
    assert frames["presented_ns"][:3].tolist() == [10 * MS, 14 * MS, 18 * MS]
    assert frames["frame_ns"][:3].tolist() == [-1, 4 * MS, 4 * MS]
    assert frames["latency_ns"][:2].tolist() == [9 * MS, 12 * MS]  # frame 1 is posed from 1 to 2, and mixed until 13
    assert sorted(run.idle) == sorted(idle_slices(recording, simulated.jobs)[0])
    assert run.events == [(now_ns, event) for now_ns, events, _ in recording.steps for event in events]
    assert sum(isinstance(record, Stepped) for record in run.records()) == len(recording.steps)
    assert run.explain(2)["frames"] == 30
    assert repr(run).startswith(f"Run {folder}\nPASS  50 fps, at 30 fps 0 of 2 frames late, 1 replaced by newer ones\n")


def test_a_data_frame_has_the_jobs(folder: Path) -> None:
    pytest.importorskip("pandas")
    run = trilane.load_run(folder)
    table = run.to_pandas()
    assert list(table.columns) == [*COLUMNS, "visible"]
    assert table["end_ns"].tolist() == run.jobs["end_ns"].tolist()


def test_a_data_frame_without_pandas_names_the_extra(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(MissingPartError, match=r"needs pandas.*\[table\]|needs pandas"):
        trilane.load_run(folder).to_pandas()


@pytest.mark.parametrize(
    ("function", "typed", "meant"), [("run", "frams", "frames"), ("predict", "gpu_shar", "gpu_share")]
)
def test_a_mistyped_option_is_answered_with_the_nearest(function: str, typed: str, meant: str) -> None:
    said = rf"^{function}\(\) got an unexpected keyword argument '{typed}'; did you mean '{meant}'\?$"
    with pytest.raises(TypeError, match=said):
        getattr(trilane, function)(**{typed: 3})
    with pytest.raises(TypeError, match=r"argument 'zzz'$"):
        getattr(trilane, function)(zzz=3)


def test_what_is_no_run_is_refused(tmp_path: Path) -> None:
    with pytest.raises(BadInputError, match="no folder"):
        trilane.load_run(tmp_path / "none")
    with pytest.raises(BadInputError, match=r"report\.json"):
        trilane.load_run(tmp_path)
    with pytest.raises(BadInputError, match="load_run: found an empty path, expected a file or a folder"):
        trilane.load_run(" ")


def test_a_notebook_shows_the_error_beside_the_speed_and_nothing_unescaped(folder: Path) -> None:
    report = read_report(folder)
    shown = trilane.load_run(folder)._repr_html_()
    for part in (
        "20.00 ms",
        "50.0 frames a second",
        "PSNR face 31.2 dB",
        "validation of 2026-01-02",
        "a processor",
        "dsp: infer 8.8 of 20.0 ms on the critical path (82 %)",
    ):
        assert part in shown
    named = report.model_copy(update={"accuracy": {"<script>": {"why": "<b>&"}}, "failure": "<i>"})
    spoilt = run_html(named, "<u>")
    assert not any(tag in spoilt for tag in ("<script>", "<b>&", "<i>", "<u>"))
    assert "error of &lt;script&gt;" in spoilt
    assert "no figures" in spoilt


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({}, []),
        (
            {"policy": "pipelined", "edge": "double", "avatar": "default", "unit": "gpu"},
            ["--policy", "pipelined", "--edge", "double", "--avatar", "default", "--unit", "gpu"],
        ),
        ({"size": 256, "fps": 20}, ["--size", 256, "--fps", 20]),
        ({"profile": "host", "channels": 4}, ["--profile", "host", "--channels", 4]),
    ],
)
def test_a_prediction_is_that_of_the_command_line(
    arguments: dict[str, Any], words: list[Any], command: Command
) -> None:
    predicted = trilane.predict(**arguments)
    document = json.loads(command("predict", *words, "--json")[0])
    assert json.loads(json.dumps(predicted.document)) == document
    frame = document["frame_time_ms"]
    assert (predicted.frame_ms, predicted.low_ms, predicted.high_ms) == (frame["mean"], frame["low"], frame["high"])
    assert (predicted.power_w, predicted.latency_ms) == (document["power_w"], document["latency_ms"]["mean"])
    assert predicted.fps == pytest.approx(document["fps"])
    assert set(predicted.units) == {"cpu", "gpu", "dsp"}
    said = f"{frame['mean']:.2f} ms"
    if arguments.get("profile") != "host":
        said += f" (80 %: {frame['low']:.2f} to {frame['high']:.2f})"
    assert said in predicted._repr_html_()
    assert ("80 %" in predicted._repr_html_()) == (frame["low"] is not None)


def test_a_network_by_itself_is_predicted_like_on_the_command_line(tiny_bundle: Path, command: Command) -> None:
    network = tiny_bundle / "network.onnx"
    predicted = trilane.predict(network=network)
    (document,) = json.loads(command("predict", "--network", network, "--json")[0])["networks"]
    assert json.loads(json.dumps(predicted.document)) == document
    assert (predicted.frame_ms, predicted.power_w) == (document["network_ms"], document["power"]["w"])
    assert (predicted.latency_ms, predicted.units, predicted.is_display_capped) == (None, {}, False)
    assert trilane.predict(network=network, application=True).latency_ms is not None


@pytest.mark.parametrize(
    ("arguments", "found"),
    [
        ({"avatar": "default", "network": "n.onnx"}, "--avatar beside --network"),
        ({"application": True}, "--application with 0 networks"),
        ({"performance_profile": "turbo"}, "found 'turbo'"),
        ({"profile": "none"}, "none"),
        ({"unit": "npu"}, "npu"),
        ({"network": "none.onnx"}, "none.onnx"),
    ],
)
def test_what_cannot_be_predicted_is_refused(arguments: dict[str, Any], found: str) -> None:
    with pytest.raises(BadInputError, match=found):
        trilane.predict(**arguments)


@pytest.mark.parametrize(
    ("argument", "value", "said"),
    [
        ("latch_ms", float("nan"), "latch_ms: found nan, expected milliseconds, from 0 to 1000"),
        ("latch_ms", float("inf"), "latch_ms: found inf, expected milliseconds, from 0 to 1000"),
        ("latch_ms", -5, "latch_ms: found -5, expected"),
        ("latch_ms", 1000.5, "latch_ms: found 1000.5, expected"),
        ("latch_ms", "3", "latch_ms: found '3', expected"),
        ("baseline_frames", -1, "baseline_frames: found -1, expected a whole number of frames, 0 or more"),
        ("baseline_frames", 2.0, "baseline_frames: found 2.0, expected"),
        ("baseline_frames", True, "baseline_frames: found True, expected"),
        ("check", -1, "check: found -1, expected a whole number of frames, from 0 to 1000"),
        ("check", 1001, "check: found 1001, expected"),
        ("check", True, "check: found True, expected"),
        ("policy", "latst", "policy: found 'latst', .*did you mean 'latest'"),
        ("performance_profile", "turbo", "performance_profile: found 'turbo'"),
        ("out", " ", "out: found an empty path, expected a file or a folder"),
        ("motion", "", "motion: found an empty path, expected a file or a folder"),
    ],
)
def test_wrong_arguments_are_refused_before_a_process_starts(
    argument: str, value: Any, said: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("trilane.apps.run.asked_run.early_processes", pytest.fail)
    with pytest.raises(BadInputError, match=f"^{said}"):
        trilane.run(**{argument: value})
