"""`trilane run` around a run that was made by hand: the options that arrive, what is refused, what is printed."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from support.run_report import make_report
from trilane.apps.run import asked_run
from trilane.apps.run.asked_run import prepare
from trilane.apps.run.pace import pace_of
from trilane.apps.run.report import Report
from trilane.apps.run.run_job import RunOutcome
from trilane.errors import BadInputError
from trilane.stages.run_options import RunOptions
from trilane.units import PerformanceProfile

Command = Callable[..., tuple[str, str]]


class Runs:
    """In place of the run: the options that arrive, and the report and the exit code that it ends with."""

    def __init__(self) -> None:
        self.asked: list[RunOptions] = []
        self.report, self.exit_code = make_report(), 0

    def __call__(self, options: RunOptions, hooks: Any, _command: tuple[str, ...]) -> RunOutcome:
        options.check_together()
        self.asked.append(options)
        with hooks() as told:
            told.progress("pipelined", 1, 3)
            told.message("[red] is no markup")
        return RunOutcome(Report.model_validate(self.report), Path("place"), self.exit_code)


@pytest.fixture
def runs(monkeypatch: pytest.MonkeyPatch) -> Runs:
    double = Runs()
    monkeypatch.setattr(asked_run, "run_asked", double)
    return double


EVERY = {
    "frames": 7,
    "motion": "m",
    "camera": "c",
    "background": "b",
    "avatar": "a",
    "size": "192",
    "policy": "latest",
    "runtime": "ort",
    "skinning": "gpu",
    "latch_ms": 2.5,
    "performance_profile": "power_saver",
    "baseline_frames": 9,
    "out": Path("place"),
}


@pytest.mark.parametrize(
    ("words", "options"),
    [
        ((), {}),
        (
            (
                *("beach.toml", "--motion", "m", "--camera", "c", "--background", "b", "--avatar", "a", "--frames", 7),
                *("--size", 192, "--hud", "--policy", "latest", "--runtime", "ort", "--skinning", "gpu"),
                *("--split", "x=cpu", "--split", "y=gpu", "--latch", 2.5, "--baseline", 9, "--out", "place"),
                *("--performance-profile", "power_saver"),
            ),
            {**EVERY, "scene": "beach.toml", "hud": True, "split": ("x=cpu", "y=gpu")},
        ),
        (("--no-hud", "--no-video"), {"hud": False, "video": False}),
        (
            ("--profile", "chip", "--pace", "--slow-motion", 24),
            {"profile": "chip", "pace": True, "slow_motion": 24.0},
        ),
        (("--latch", 0, "--baseline", 0), {"latch_ms": 0.0, "baseline_frames": 0}),
        (("--latch", 1000), {"latch_ms": 1000.0}),
        *((("--policy", name), {"policy": name}) for name in ("pipelined", "sequential", "latest", "deadline")),
        *((("--performance-profile", cap.value), {"performance_profile": cap.value}) for cap in PerformanceProfile),
    ],
)
def test_options_arrive_as_they_were_given(
    words: tuple[Any, ...], options: dict[str, Any], runs: Runs, command: Command
) -> None:
    command("run", *words)
    assert runs.asked == [RunOptions(**options)]


def test_the_table_or_the_document_and_where_the_run_is(runs: Runs, command: Command) -> None:
    out, err = command("run")
    assert out.startswith("PASS  50 fps, at 30 fps 0 of 2 frames late, 1 replaced by newer ones\n")
    assert "Scene test" not in out
    table = command("run", "--table")[0]
    assert table.startswith(out)
    assert "Scene test: 640x480, tensor size 256" in table
    assert err.splitlines() == ["[red] is no markup", "run folder: place"]
    document = json.loads(command("run", "--json")[0])
    assert document == json.loads(json.dumps(Report.model_validate(runs.report).as_json()))


def test_a_failed_run_says_why_and_ends_with_its_code(runs: Runs, command: Command) -> None:
    runs.report["failure"], runs.exit_code = "the unit [gpu] is gone", 3
    out, err = command("run", code=3)
    assert out.startswith("FAIL  the run ended early: the unit [gpu] is gone\n")
    assert err.splitlines()[1:] == ["run folder: place", "the run failed: the unit [gpu] is gone"]


PAIR = "give both; `trilane predict --profile` answers without running"
REFUSED = {
    ("--pace",): f"options: found --pace without --profile, expected both or neither; {PAIR}",
    ("--profile", "chip"): f"options: found --profile without --pace, expected both or neither; {PAIR}",
    ("--slow-motion", "3"): "options: found --slow-motion without --pace, expected --pace and --profile with it",
    ("--pace", "--profile", "chip", "--split", "x=cpu"): (
        "options: found --split with --pace, expected one of them; a chip's pace is that of a whole network"
    ),
    ("--pace", "--profile", "chip", "--performance-profile", "burst"): (
        "options: found --performance-profile with --pace, expected one of them; a pace is capped already"
    ),
    ("--check", "2", "--dashboard"): (
        "options: found --check with --dashboard, expected one of them; a run that is steered has no reference"
    ),
    ("--latch", "-1"): "--latch: found '-1', expected milliseconds, from 0 to 1000",
    ("--latch", "1001"): "--latch: found '1001', expected milliseconds, from 0 to 1000",
    ("--latch", "nan"): "--latch: found 'nan', expected milliseconds, from 0 to 1000",
    ("--latch", "soon"): "--latch: found 'soon', expected milliseconds, from 0 to 1000",
    ("--baseline", "-1"): "--baseline: found '-1', expected a whole number of frames, 0 or more",
    ("--policy", "latst"): (
        "--policy: found 'latst', expected one of sequential, pipelined, latest, deadline; did you mean 'latest'?"
    ),
}


@pytest.mark.parametrize("options", REFUSED, ids=" ".join)
def test_wrong_usage_is_refused_before_anything_starts(options: tuple[str, ...], runs: Runs, command: Command) -> None:
    assert command("run", *options, code=2) == ("", f"error: {REFUSED[options]}\n")
    assert runs.asked == []


def test_what_is_checked_holds_the_pace_and_leaves_the_video_out(drawable_bundle: Path) -> None:
    given: dict[str, Any] = {"avatar": str(drawable_bundle), "size": "64x64", "runtime": "ort"}
    gl = {"renderer": "a driver", "hardware": True}
    paced = RunOptions(**given, video=False, profile="snapdragon-888", pace=True, slow_motion=3.0)
    plain, found = prepare(RunOptions(**given), lambda: gl), prepare(paced, lambda: gl)
    wanted = pace_of(plain.checked.config, "snapdragon-888", 3.0)
    assert (plain.pace, found.pace) == (None, wanted)
    assert (plain.checked.config.pace_ns, found.checked.config.pace_ns) == ({}, dict(wanted.stage_ns))
    assert (plain.checked.config.record, found.checked.config.record) == (True, False)


def test_a_picture_with_a_hud_is_not_compared(drawable_bundle: Path) -> None:
    for library in ("skimage", "flip_evaluator"):
        pytest.importorskip(library)
    options = RunOptions(avatar=str(drawable_bundle), size="64x64", runtime="ort", check=2, hud=True)
    with pytest.raises(BadInputError, match="--no-hud"):
        prepare(options, lambda: {"renderer": "a driver", "hardware": True})
