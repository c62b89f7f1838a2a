"""The options of a run: each is one field, and whoever takes or tells options has them from the fields."""

from __future__ import annotations

import inspect
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from typer.main import get_command

import trilane
from trilane.apps.cli.run import app
from trilane.errors import BadInputError
from trilane.options import kind_of, limits_of
from trilane.stages.run_options import RunOptions

ADDED = """
import contextlib, inspect, json
from typing import Annotated
from pydantic import Field
from trilane.options import Option
from trilane.stages import run_options

class RunOptions(run_options.RunOptions):
    glow_ms: Annotated[float, Option("--glow", unit="milliseconds", offered=("1.0", "2.0"))] = Field(
        default=1.0, ge=0, le=50, description="How long a frame glows.")

run_options.RunOptions = RunOptions  # in place of a line in the model

import trilane
from trilane.apps import interface
from trilane.apps.cli.run import app
from trilane.apps.cli.sweep_options import SweptCommand
from trilane.apps.dashboard.live_run import choices_of
from trilane.apps.dashboard.run_facts import config_in_force
from support.run_report import make_report
from trilane.apps.run.report import Report
from trilane.errors import TrilaneError
from typer.testing import CliRunner

asked = []

def run_asked(options, hooks, command):
    asked[:] = options.as_json(), command
    raise TrilaneError("it is not run")

interface.run_asked = run_asked
with contextlib.suppress(TrilaneError):
    trilane.run(glow_ms=2.5)
swept = SweptCommand(["run"])
scene = {"size": "64", "avatars": [{"bundle": "default"}]}
in_force = config_in_force({"scene": scene, "policy": "latest", "edge": "single", "runtime": "ort"}, asked[0])
report = Report.model_validate(make_report(options=asked[0])).as_json()
print(json.dumps({
    "help": CliRunner().invoke(app, ["--help"]).stdout,
    "sweep": [swept.values_of(["--glow", "3", "--glow", "4"]), swept.words_of({"glow": 4.0})],
    "signature": str(inspect.signature(trilane.run).parameters["glow_ms"]),
    "asked": asked[0]["glow_ms"],
    "command": asked[1],
    "dashboard": choices_of(in_force)["glow_ms"],
    "report": report["options"]["glow_ms"],
}))
"""


def test_an_option_that_is_added_to_the_model_is_everywhere() -> None:
    done = subprocess.run([sys.executable, "-c", ADDED], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    assert "--glow <float range>" in found["help"]
    assert "How long a frame glows. [default: 1.0; 0<=x<=50]" in " ".join(found["help"].split())
    assert found["sweep"] == [{"glow": [3.0, 4.0]}, ["--glow", "4.0"]]
    assert found["signature"].startswith("glow_ms: ") and found["signature"].endswith(" = 1.0")
    assert (found["asked"], found["command"]) == (2.5, ["trilane.run", "glow_ms=2.5"])
    assert found["dashboard"] == ["1.0", "2.0", "2.5"]
    assert found["report"] == 2.5


def test_command_line_and_program_have_the_same_options() -> None:
    """Names, help texts and defaults of both are the fields'; the program's run has no baseline by default."""
    typed = {each.name: each for each in get_command(app).params}
    programmed = dict(inspect.signature(trilane.run).parameters)
    for name, field in RunOptions.model_fields.items():
        assert typed[name].help == field.description
        assert (typed[name].default or ()) == (field.default or ())
        assert programmed.pop(name).default == (0 if name == "baseline_frames" else field.default)
    assert [*programmed] == ["on_progress", "on_message"]
    assert [*typed][len(RunOptions.model_fields) :] == ["dashboard", "port", "table", "as_json"]


def test_an_unknown_option_of_a_program_is_a_type_error() -> None:
    with pytest.raises(TypeError, match="polcy"):
        trilane.run(polcy="latest")


@pytest.mark.parametrize(
    ("values", "typed", "programmed"),
    [
        ({"latch_ms": 1000.5}, "--latch", "latch_ms: found 1000.5, expected milliseconds, from 0 to 1000"),
        ({"baseline_frames": -1}, "--baseline", "baseline_frames: found -1, expected a whole number of frames, 0 or"),
        ({"width": 257}, "--width", "width: found 257, expected a whole number from 1 to 256"),
        ({"slow_motion": float("inf")}, "--slow-motion", "slow_motion: found inf, expected a number"),
        ({"hud": 1}, "--hud", "hud: found 1, expected true or false"),
        ({"cores": "dsp=0"}, "--cores", "cores: found 'dsp=0', expected a list of texts"),
        ({"split": (1,)}, "--split", "split: found 1, expected a list of texts"),
        ({"runtime": None}, "--runtime", "runtime: found None, expected text"),
        ({"out": 3}, "--out", "out: found 3, expected a path"),
        ({"channels": 5}, "--channels", "channels: found 5, expected 4, 8, 12 or 16"),
    ],
)
def test_what_is_not_what_its_field_says_is_refused_by_name(values: Any, typed: str, programmed: str) -> None:
    with pytest.raises(BadInputError) as raised:
        RunOptions.checked(values)
    assert str(raised.value).startswith(programmed)
    with pytest.raises(BadInputError) as raised:
        RunOptions.checked(values, as_typed=True)
    assert str(raised.value).startswith(typed + programmed[programmed.index(":") :])


def test_programs_give_paths_numbers_and_cores_by_unit() -> None:
    options = RunOptions.checked(
        {"scene": Path("a.toml"), "size": 96, "cores": {"dsp": [0, 1], "cpu": (2,)}, "split": ["x=cpu"], "out": "there"}
    )
    assert (options.scene, options.size, options.cores) == ("a.toml", "96", ("dsp=0,1", "cpu=2"))
    assert (options.split, options.out) == (("x=cpu",), Path("there"))
    assert {"cores": ["dsp=0,1", "cpu=2"], "out": "there"}.items() <= options.as_json().items()


def test_a_field_says_its_type_and_its_limits() -> None:
    kinds = {name: kind_of(field) for name, field in RunOptions.model_fields.items()}
    expected = {"scene": str, "motion": str, "width": int, "hud": bool, "fps": float, "cores": tuple, "out": Path}
    assert {name: kinds[name] for name in expected} == expected
    limits = {name: limits_of(field) for name, field in RunOptions.model_fields.items()}
    assert {name: both for name, both in limits.items() if both != (None, None)} == {
        "width": (1, 256),
        "latch_ms": (0, 1000),
        "baseline_frames": (0, None),
        "check": (0, 1000),
    }
