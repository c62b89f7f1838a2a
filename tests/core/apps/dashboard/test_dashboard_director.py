"""What the page asks of the runs, with doubles of the checks and of the server."""

from __future__ import annotations

from typing import Any

import pytest

from trilane.apps.dashboard import live_run, run_facts
from trilane.apps.dashboard.channel import ChangesAsked, ChangesRefused, ControlAsked, Message, StateIs
from trilane.apps.dashboard.live_run import Director, FileWatch, _numbered, choices_of, reasons_against
from trilane.apps.run.run_job import Prepared
from trilane.errors import BadInputError
from trilane.pipeline.controls import RunControls
from trilane.scheduler.events import Hold, Stop
from trilane.stages.run_options import RunOptions
from trilane.units import AVATARS

ASKED = RunOptions()


def prepared(options: RunOptions) -> Prepared:
    """As `prepare`, for which tensors of 17 are wrong."""
    if options.size == "17":
        raise BadInputError("size", "17", "multiples of 32")
    return Prepared(options, None)  # type: ignore[arg-type]


@pytest.fixture
def told() -> list[Message]:
    return []


@pytest.fixture
def run(told: list[Message]) -> tuple[Director, RunControls]:
    director = Director(prepared, told.append)
    return director, director.begin(prepared(ASKED))


def test_before_a_run_nothing_can_be_asked(told: list[Message]) -> None:
    Director(prepared, told.append).do(ControlAsked("pause", None))
    assert told == []


def test_the_run_is_held_stepped_and_let_go(run: tuple[Director, RunControls], told: list[Message]) -> None:
    director, controls = run
    for control in ("pause", "step", "play"):
        director.do(ControlAsked(control, None))
    assert controls.taken() == ([Hold(0), Hold(1), Hold(-1)], [])
    assert told == [StateIs("paused", ""), StateIs("paused", ""), StateIs("running", "")]


def test_a_unit_is_killed_and_nothing_else(run: tuple[Director, RunControls]) -> None:
    director, controls = run
    for value in ("gpu", "npu", None, 1.0):
        director.do(ControlAsked("kill", value))
    assert controls.taken() == ([], ["gpu"])


def test_a_files_run_is_held_stepped_let_go_and_its_units_are_killed() -> None:
    watch = FileWatch(None)  # type: ignore[arg-type]
    for control, value in (("pause", None), ("step", None), ("play", None), ("kill", "writer")):
        watch.do(ControlAsked(control, value))
    assert watch.controls.taken() == ([Hold(0), Hold(1), Hold(-1)], ["writer"])


def test_a_new_configuration_is_checked_and_then_the_run_stops(
    run: tuple[Director, RunControls], told: list[Message]
) -> None:
    director, controls = run
    director.do(ChangesAsked({"policy": "latest", "size": "128"}))
    director.do(ChangesAsked({"edge": "triple"}))  # before the next run has begun: all of them hold
    assert controls.taken() == ([Stop(), Stop()], [])
    assert [type(message) for message in told] == [StateIs, StateIs]
    assert isinstance(told[0], StateIs) and told[0].state == "restarting" and "policy latest, size 128: " in told[0].why
    following = director.take_next()
    assert following is not None and director.take_next() is None
    assert following.options == RunOptions(policy="latest", size="128", edge="triple")


def test_one_that_cannot_be_run_changes_nothing(run: tuple[Director, RunControls], told: list[Message]) -> None:
    director, controls = run
    why = "size: found 17, expected multiples of 32"
    director.do(ChangesAsked({"size": "17"}))
    director.do(ChangesAsked({"policy": "latest", "size": "17"}))
    assert controls.taken() == ([], []) and director.take_next() is None
    assert told == [ChangesRefused("size", why), ChangesRefused("restart", why)]


@pytest.mark.parametrize(
    "asked",
    [
        *(ControlAsked("reboot", "x"), ControlAsked("policy", "latest"), ControlAsked("out", "/")),
        *(ChangesAsked({"out": "/"}), ChangesAsked({"policy": "latest", "out": "/"}), ChangesAsked({"size": 96.0})),  # type: ignore[dict-item]
    ],
)
def test_what_is_no_control_of_a_run_does_nothing(
    run: tuple[Director, RunControls], told: list[Message], asked: ControlAsked | ChangesAsked
) -> None:
    director, controls = run
    director.do(asked)
    assert (controls.taken(), told, director.take_next()) == (([], []), [], None)


def test_a_control_changes_its_own_option_alone(run: tuple[Director, RunControls]) -> None:
    director, _ = run
    for control, value, expected in (
        ("avatar", "a/b", RunOptions(avatar="a/b")),
        ("performance_profile", "burst", RunOptions(avatar="a/b", performance_profile="burst")),
        ("performance_profile", "none", RunOptions(avatar="a/b")),
    ):
        director.do(ChangesAsked({control: value}))
        following = director.take_next()
        assert following is not None and following.options == expected
        director.begin(following)


@pytest.mark.parametrize(
    ("name", "word", "expected"),
    [
        ("video", "False", False),
        ("hud", "True", True),
        ("hud", "none", None),
        ("check", "0", 0),
        ("latch_ms", "2.5", 2.5),
    ],
)
def test_a_word_stands_for_the_value_of_its_option(
    run: tuple[Director, RunControls], monkeypatch: pytest.MonkeyPatch, name: str, word: str, expected: object
) -> None:
    """`bool("False")` is True. A value in force is told as the word that asks for it."""
    monkeypatch.setattr(live_run, "OF_A_NEW_RUN", (name,))
    monkeypatch.setattr(run_facts, "OF_A_NEW_RUN", (name,))
    run[0].do(ChangesAsked({name: word}))
    following = run[0].take_next()
    assert following is not None and following.options == ASKED.changed(**{name: expected})
    config = {"scene": {"size": "64", "avatars": [{"bundle": "default"}]}}
    assert run_facts.config_in_force(config, dict(following.options)) == {name: word}


@pytest.mark.parametrize(
    ("name", "word", "said"),
    [
        ("video", "perhaps", "video: found 'perhaps', expected true or false"),
        ("check", "2.5", "check: found '2.5', expected a whole number of frames, from 0 to 1000"),
        ("check", "-1", "check: found -1, expected a whole number of frames, from 0 to 1000"),
    ],
)
def test_a_word_that_stands_for_no_value_is_refused(
    run: tuple[Director, RunControls],
    told: list[Message],
    monkeypatch: pytest.MonkeyPatch,
    name: str,
    word: str,
    said: str,
) -> None:
    monkeypatch.setattr(live_run, "OF_A_NEW_RUN", (name,))
    run[0].do(ChangesAsked({name: word}))
    assert (told, run[0].take_next()) == ([ChangesRefused(name, said)], None)


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
    assert choices["avatar"] == (*AVATARS, str(tmp_path / "one"), str(tmp_path / "two"))
    assert reasons_against(ASKED) == {}
    assert set(reasons_against(RunOptions(profile="snapdragon-888", pace=True))) == {"performance_profile"}


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
