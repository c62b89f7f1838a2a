"""`trilane run` around a run that was made by hand: what it asks for, what it refuses, what it prints and ends with."""

from __future__ import annotations

import io
import json
import re
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from support.run_report import make_report
from trilane.apps.cli import run as cli_run
from trilane.apps.run import asked_run, pace, run_job
from trilane.apps.run.report import Report
from trilane.apps.run.run_job import Prepared, RunOutcome
from trilane.errors import BadInputError
from trilane.pipeline import unit_starter
from trilane.stages import PRELOAD, configure
from trilane.stages.run_options import RunOptions
from trilane.units import PerformanceProfile

Command = Callable[..., tuple[str, str]]
GL = {"renderer": "a driver", "hardware": True}


class Call:
    """The forked call that looks at OpenGL."""

    closed = 0

    def result(self) -> Any:
        return GL

    def close(self) -> None:
        Call.closed += 1


@dataclass
class Asked:
    """What the command asked of its parts, and the `report` that its run gives."""

    report: dict[str, Any]
    exit_code: int = 0
    raises: BaseException | None = None
    options: RunOptions | None = None
    pace: Any = None
    target: Path | None = None
    changes: list[dict[str, Any]] = field(default_factory=list)
    others: dict[str, Any] = field(default_factory=dict)


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Asked:
    monkeypatch.chdir(tmp_path)
    found = Asked(make_report())

    class Starter:
        def __init__(self, preload: Any) -> None:
            found.others["preload"] = preload

        def __enter__(self) -> Starter:
            return self

        def __exit__(self, *_: object) -> None:
            found.others["starter closed"] = True

        def call(self, name: str) -> Call:
            found.others["called"] = name
            return Call()

    config = SimpleNamespace(scene=SimpleNamespace(name="beach"))

    def changed(**changes: Any) -> Any:
        found.changes.append(changes)
        return checked

    checked = SimpleNamespace(config=config, notes=("the motion is short",), changed=changed)

    def configured(options: RunOptions, out_dir: Path, gl: Any) -> Any:
        found.options = options
        found.others |= {"out_dir": out_dir, "gl": (gl(), gl())}
        return checked

    def run_to_folder(given: Prepared, target: Path, hooks: Any, **others: Any) -> RunOutcome:
        assert given.options == found.options
        found.pace, found.target = given.pace, target
        found.others |= others | {
            "checked": given.checked is checked,
            "still open": "starter closed" not in found.others,
        }
        hooks.progress("pipelined", 1, 3)
        hooks.message("[red] is no markup")
        if found.raises is not None:
            raise found.raises
        return RunOutcome(Report.model_validate(found.report), target, found.exit_code)

    def pace_of(given: Any, profile: str, slow_motion: float) -> Any:
        assert given is config
        return SimpleNamespace(name=(profile, slow_motion), stage_ns={"infer": 5})

    monkeypatch.setattr(unit_starter, "UnitStarter", Starter)
    monkeypatch.setattr(configure, "configure", configured)
    monkeypatch.setattr(configure, "required_machine", lambda gl: ("machine", gl()))
    monkeypatch.setattr(run_job, "run_to_folder", run_to_folder)
    monkeypatch.setattr(pace, "pace_of", pace_of)
    monkeypatch.setattr(asked_run, "made_facts", lambda words: {"command": [*words]})
    return found


def test_what_a_run_without_options_asks_for(asked: Asked, command: Command) -> None:
    out, err = command("run")
    assert asked.options == RunOptions() == RunOptions(policy="pipelined", baseline_frames=60, latch_ms=0.0)
    assert (asked.changes, asked.others["checked"], asked.others["still open"]) == ([], True, True)
    assert asked.others["machine"] == ("machine", GL)
    assert asked.others["made"] == {"command": ["trilane", "run"]}
    assert asked.others["called"] == "trilane.stages.machine_facts:open_gl"
    assert asked.others["preload"] == PRELOAD
    assert asked.others["starter closed"]
    assert asked.others["starter"].__class__.__name__ == "Starter"
    assert asked.others["gl"] == (GL, GL)
    assert asked.others["out_dir"] == Path.cwd()
    assert asked.target is not None and asked.target.parent == Path("runs")
    assert asked.target.name.endswith("Z-beach")
    assert "Scene test: 640x480, tensor size 256" in out
    assert err.splitlines() == ["the motion is short", "[red] is no markup", f"run folder: {asked.target}"]


def test_a_run_that_is_steered_is_not_compared(asked: Asked, command: Command) -> None:
    assert "--check with --dashboard" in command("run", "--check", "2", "--dashboard", code=2)[1]
    assert asked.options is None


def test_a_picture_with_a_hud_is_not_compared(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(run_job, "require_parts", lambda _: None)

    def checked(hud: bool) -> Any:
        return SimpleNamespace(config=SimpleNamespace(scene=SimpleNamespace(hud=hud), avatar_dirs=()))

    asked_run._require_check(checked(False))
    with pytest.raises(BadInputError, match="--no-hud"):
        asked_run._require_check(checked(True))


def test_every_option_arrives_where_it_belongs(asked: Asked, command: Command) -> None:
    out, _ = command(
        *("run", "beach.toml", "--motion", "m", "--camera", "c", "--background", "b", "--avatar", "a"),
        *("--frames", 7, "--size", 192, "--hud", "--policy", "latest", "--runtime", "ort", "--skinning", "gpu"),
        *("--split", "x=cpu", "--split", "y=gpu", "--latch", 2.5, "--performance-profile", "power_saver"),
        *("--baseline", 9, "--out", "place", "--json"),
    )
    assert asked.options == RunOptions(
        scene="beach.toml",
        motion="m",
        camera="c",
        background="b",
        avatar="a",
        frames=7,
        size="192",
        hud=True,
        policy="latest",
        runtime="ort",
        skinning="gpu",
        split=("x=cpu", "y=gpu"),
        latch_ms=2.5,
        performance_profile="power_saver",
        baseline_frames=9,
        out=Path("place"),
    )
    assert type(asked.options.performance_profile) is str and type(asked.options.policy) is str
    assert asked.target == Path("place")
    assert json.loads(out) == json.loads(json.dumps(Report.model_validate(asked.report).as_json()))


@pytest.mark.parametrize("hud", [True, False])
def test_the_hud_is_asked_for_or_refused(hud: bool, asked: Asked, command: Command) -> None:
    command("run", "--hud" if hud else "--no-hud")
    assert asked.options == RunOptions(hud=hud)


def test_a_run_that_lasts_needs_no_video(asked: Asked, command: Command) -> None:
    command("run", "--no-video")
    assert asked.changes == [{"record": False}]


def test_a_pace_holds_the_jobs(asked: Asked, command: Command) -> None:
    command("run", "--profile", "chip", "--pace", "--slow-motion", 24)
    assert asked.pace is not None
    assert asked.pace.name == ("chip", 24.0)
    assert asked.changes == [{"pace_ns": {"infer": 5}}]


def test_a_pace_is_that_of_the_chip_when_no_slow_motion_is_given(asked: Asked, command: Command) -> None:
    command("run", "--profile", "chip", "--pace")
    assert asked.pace is not None and asked.pace.name == ("chip", 1.0)


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
}


@pytest.mark.parametrize("options", REFUSED, ids=" ".join)
def test_options_that_leave_no_room_for_each_other(options: tuple[str, ...], asked: Asked, command: Command) -> None:
    assert command("run", *options, code=2) == ("", f"error: {REFUSED[options]}\n")
    assert asked.options is None


OUT_OF_RANGE = {
    ("--latch", "-1"): "greater than or equal to 0",
    ("--latch", "1001"): "less than or equal to 1000",
    ("--baseline", "-1"): "greater than or equal to 0",
}


@pytest.mark.parametrize("options", OUT_OF_RANGE, ids=" ".join)
def test_a_number_out_of_range_is_wrong_usage(options: tuple[str, str], asked: Asked, command: Command) -> None:
    option, found = options
    said = f"error: {option}: found '{found}', expected {OUT_OF_RANGE[options]}\n"
    assert command("run", *options, code=2) == ("", said)
    assert asked.options is None


def test_a_word_that_is_none_is_refused_with_the_nearest(asked: Asked, command: Command) -> None:
    said = "expected one of sequential, pipelined, latest, deadline; did you mean 'latest'?"
    assert command("run", "--policy", "latst", code=2) == ("", f"error: --policy: found 'latst', {said}\n")
    assert asked.options is None


@pytest.mark.parametrize("options", [("--latch", "0"), ("--latch", "1000"), ("--baseline", "0")], ids=" ".join)
def test_the_ends_of_a_range_are_in_it(options: tuple[str, ...], asked: Asked, command: Command) -> None:
    command("run", *options)
    ends = (RunOptions(latch_ms=0.0), RunOptions(latch_ms=1000.0), RunOptions(baseline_frames=0))
    assert asked.options in ends


@pytest.mark.parametrize("policy", ["pipelined", "sequential", "latest", "deadline"])
def test_every_policy_has_its_name(policy: str, asked: Asked, command: Command) -> None:
    command("run", "--policy", policy)
    assert asked.options == RunOptions(policy=policy)


@pytest.mark.parametrize("cap", list(PerformanceProfile))
def test_every_cap_has_its_name(cap: PerformanceProfile, asked: Asked, command: Command) -> None:
    command("run", "--performance-profile", cap.value)
    assert asked.options == RunOptions(performance_profile=cap.value)


def test_a_failed_run_says_why_and_ends_with_its_code(asked: Asked, command: Command) -> None:
    asked.report["failure"], asked.exit_code = "the unit [gpu] is gone", 3
    out, err = command("run", "--out", "place", code=3)
    assert "frames per second" in out
    assert err.splitlines()[2:] == ["run folder: place", "the run failed: the unit [gpu] is gone"]


def test_an_interrupt_says_that_nothing_was_written(asked: Asked, command: Command) -> None:
    asked.raises = KeyboardInterrupt()
    out, err = command("run", code=130)
    assert (out, err.splitlines()[2]) == ("", "interrupted: nothing was written")


def test_a_bar_for_each_run_when_stderr_is_a_terminal(monkeypatch: pytest.MonkeyPatch) -> None:
    """The first bar, which waits for the units, goes when the first frame comes; each run has its own."""
    from rich.console import Console

    screen = io.StringIO()
    console = Console(file=screen, force_terminal=True, width=120, color_system=None)
    monkeypatch.setattr(cli_run, "stderr_console", lambda: console)
    monkeypatch.setattr(cli_run.sys, "stderr", SimpleNamespace(isatty=lambda: True))
    with cli_run._hooks() as hooks:
        hooks.progress("pipelined", 2, 8)
        hooks.progress("pipelined", 4, 8)
        hooks.progress("sequential", 1, 3)
        hooks.message("[b]said")
    last = screen.getvalue().rpartition("[b]said")[2]
    assert "starting" not in last
    assert re.search(r"pipelined  ?[━╸╺ ]+4/8 \S", last)
    assert re.search(r"sequential [━╸╺ ]+1/3 \S", last)


def test_the_call_is_closed_though_the_command_fails(asked: Asked, command: Command) -> None:
    before = Call.closed
    asked.raises = BadInputError("dsp", "no core", "one")
    command("run", code=2)
    assert Call.closed == before + 1
    assert asked.others["starter closed"]
