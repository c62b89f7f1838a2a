"""What the page asks of the runs, with doubles of the checks and of the server."""

from __future__ import annotations

from typing import Any

import pytest

from trilane.apps.asked_run import AskedRun, Prepared
from trilane.apps.dashboard.channel import Asked, Message, Refused, StateIs
from trilane.apps.dashboard.choices import choices_of, reasons_against
from trilane.apps.dashboard.director import Director, changed
from trilane.apps.dashboard.live_run import _numbered
from trilane.errors import BadInputError
from trilane.pipeline.controls import RunControls
from trilane.scheduler.events import Hold, Stop

ASKED = AskedRun({"policy": "pipelined", "size": None})


def prepared(asked: AskedRun) -> Prepared:
    """As `prepare`, for which tensors of 17 are wrong."""
    if asked.request["size"] == "17":
        raise BadInputError("size", "17", "multiples of 32")
    return Prepared(asked, None, None)  # type: ignore[arg-type]


@pytest.fixture
def told() -> list[Message]:
    return []


@pytest.fixture
def run(told: list[Message]) -> tuple[Director, RunControls]:
    director = Director(prepared, told.append)
    return director, director.begin(prepared(ASKED))


def test_before_a_run_nothing_can_be_asked(told: list[Message]) -> None:
    Director(prepared, told.append).do(Asked("pause", None))
    assert told == []


def test_the_run_is_held_stepped_and_let_go(run: tuple[Director, RunControls], told: list[Message]) -> None:
    director, controls = run
    for control in ("pause", "step", "play"):
        director.do(Asked(control, None))
    assert controls.taken() == ([Hold(0), Hold(1), Hold(-1)], [])
    assert told == [StateIs("paused", ""), StateIs("paused", ""), StateIs("running", "")]


def test_a_unit_is_killed_and_nothing_else(run: tuple[Director, RunControls]) -> None:
    director, controls = run
    for value in ("gpu", "npu", None, 1.0):
        director.do(Asked("kill", value))
    assert controls.taken() == ([], ["gpu"])


def test_a_new_configuration_is_checked_and_then_the_run_stops(
    run: tuple[Director, RunControls], told: list[Message]
) -> None:
    director, controls = run
    director.do(Asked("policy", "latest"))
    director.do(Asked("edge", "triple"))  # before the next run has begun: both hold
    assert controls.taken() == ([Stop(), Stop()], [])
    assert [type(message) for message in told] == [StateIs, StateIs]
    assert isinstance(told[0], StateIs) and told[0].state == "restarting" and "policy latest" in told[0].why
    following = director.take_next()
    assert following is not None and director.take_next() is None
    assert (following.asked.request["policy"], following.asked.edge) == ("latest", "triple")


def test_one_that_cannot_be_run_changes_nothing(run: tuple[Director, RunControls], told: list[Message]) -> None:
    director, controls = run
    director.do(Asked("size", "17"))
    assert controls.taken() == ([], []) and director.take_next() is None
    assert told == [Refused("size", "size: found 17, expected multiples of 32")]


@pytest.mark.parametrize("asked", [Asked("reboot", "x"), Asked("policy", None), Asked("size", 96.0), Asked("out", "/")])
def test_what_is_no_control_of_a_run_does_nothing(
    run: tuple[Director, RunControls], told: list[Message], asked: Asked
) -> None:
    director, controls = run
    director.do(asked)
    assert (controls.taken(), told, director.take_next()) == (([], []), [], None)


def test_a_control_changes_its_own_setting_alone() -> None:
    assert changed(ASKED, "edge", "single") == AskedRun(ASKED.request, edge="single")
    assert changed(ASKED, "avatar", "a/b").request == {**ASKED.request, "avatar": "a/b"}
    capped = changed(ASKED, "performance_profile", "burst")
    assert capped.performance_profile == "burst"
    assert changed(capped, "performance_profile", "none") == ASKED


def test_what_is_in_force_can_be_chosen_and_a_pace_is_capped_already(tmp_path: Any) -> None:
    for name in ("one", "two", "none"):
        (tmp_path / name).mkdir()
        if name != "none":
            (tmp_path / name / "manifest.json").touch()
    config = {
        "policy": "deadline", "edge": "fifo:9", "performance_profile": "none", "size": "160", "runtime": "ort",
        "avatar": str(tmp_path / "one"),
    }  # fmt: skip
    choices = choices_of(config)
    assert all(config[name] in words and len(set(words)) == len(words) for name, words in choices.items())
    assert choices["avatar"] == ("default", "hiker", str(tmp_path / "one"), str(tmp_path / "two"))
    assert reasons_against(ASKED) == {}
    assert set(reasons_against(AskedRun(paced_by=("snapdragon-888", 1.0)))) == {"performance_profile"}


def test_each_run_has_a_folder_of_its_own(tmp_path: Any) -> None:
    folders = [_numbered(tmp_path / "walk", number) for number in (1, 2, 3)]
    assert [folder.name for folder in folders] == ["walk", "walk-2", "walk-3"]


def test_controls_of_a_run_that_is_over_do_nothing() -> None:
    controls = RunControls()
    controls.hold(0)
    controls.close()
    controls.close()
    controls.hold(1)
    controls.stop()
    controls.kill("gpu")
    assert controls.taken() == ([Hold(0)], [])
