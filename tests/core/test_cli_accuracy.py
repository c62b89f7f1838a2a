"""`trilane accuracy`: what is compared, what is refused, and the figures of two runtimes that a test makes up."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from trilane.apps.cli import accuracy as cli
from trilane.apps.experiments import accuracy, hard_cases, hard_numbers
from trilane.apps.experiments.accuracy import runtime_differences
from trilane.errors import BadInputError
from trilane.stages import configure
from trilane.stages.dsp import runtime
from trilane.stages.dsp.runtime import RuntimeOptions
from trilane.stages.run_options import RunOptions

Command = Callable[..., tuple[str, str]]
ROW = {"first": "ort", "second": "qnn", "mean": 0.0123456, "largest": 3, "worst_frame": 7}
RESULT = {
    "rows": [ROW],
    "sources": {"rows": "measured in this run"},
    "bounds": {"mean": 0.5, "largest": 4},
    "frames": [0, 9],
    "runtimes": {"ort": "1.0"},
}


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    found: list[Any] = []

    def configured(request: RunOptions, out_dir: Path) -> str:
        found.append((request, out_dir == Path.cwd()))
        return "checked"

    def differences(*arguments: Any) -> Any:
        found.append(arguments)
        return RESULT

    def cases(names: list[str]) -> Any:
        found.append(names)
        return iter([])

    monkeypatch.setattr(configure, "configure", configured)
    monkeypatch.setattr(configure, "required_machine", lambda: {"cpu": "a processor"})
    monkeypatch.setattr(accuracy, "runtime_differences", differences)
    monkeypatch.setattr(hard_cases, "hard_cases", cases)
    monkeypatch.setattr(hard_numbers, "hard_numbers", lambda: iter([]))
    monkeypatch.setattr(runtime, "installed", lambda: ("ort", "qnn"))
    return found


def test_a_scene_is_compared_as_the_options_say(asked: list[Any], command: Command) -> None:
    document = json.loads(command("accuracy", "--json")[0])
    assert document == {"schema": 1, **RESULT, "machine": {"cpu": "a processor"}}
    assert asked == [(RunOptions(scene="default", runtime="ort"), True), ("checked", ["ort", "qnn"], 8)]
    asked.clear()
    words = ("--avatar", "a", "--size", "64", "--frames", 3, "--runtime", "cuda", "--runtime", "ort")
    command("accuracy", "closeup", *words)
    assert asked == [
        (RunOptions(scene="closeup", avatar="a", size="64", runtime="ort"), True),
        ("checked", ["cuda", "ort"], 3),
    ]


@pytest.mark.parametrize(
    ("row", "said"),
    [
        ({"mean": 0.5, "largest": 4}, []),
        ({"mean": 0.50123}, ["out of bounds: ort and qnn, mean 0.501, expected 0.5"]),
        (
            {"mean": 2.0, "largest": 5},
            [
                "out of bounds: ort and qnn, mean 2, expected 0.5",
                "out of bounds: ort and qnn, largest 5, expected 4",
            ],
        ),
    ],
)
@pytest.mark.usefixtures("asked")
def test_what_is_out_of_its_bounds_is_said(
    row: dict[str, Any], said: list[str], monkeypatch: pytest.MonkeyPatch, command: Command
) -> None:
    monkeypatch.setattr(accuracy, "runtime_differences", lambda *_: {**RESULT, "rows": [{**ROW, **row}]})
    for words in ((), ("--json",)):
        _, err = command("accuracy", *words, code=1 if said else 0)
        assert err.splitlines() == said


def test_hard_cases_run_on_all_but_the_emulator(asked: list[Any], command: Command) -> None:
    assert json.loads(command("accuracy", "--hard-cases", "--json")[0]) == {"schema": 1, "hard_cases": []}
    command("accuracy", "--hard-cases", "--runtime", "qnn", "--runtime", "cuda")
    assert asked == [["ort"], ["qnn", "cuda"]]


@pytest.mark.usefixtures("asked")
@pytest.mark.parametrize("passed", [True, False])
def test_a_hard_case_that_fails_is_named(passed: bool, monkeypatch: pytest.MonkeyPatch, command: Command) -> None:
    figures = dict.fromkeys(cli.HARD_COLUMNS, 1.0)
    row = {**figures, "name": "batch, [odd], ort", "verdict": "above", "passed": passed}
    good = {**row, "name": "good", "passed": True}
    number = {"name": "a [number]", "error": 2.0, "bound": 1.0, "verdict": "over", "passed": passed}
    monkeypatch.setattr(hard_numbers, "hard_numbers", lambda: iter([number]))
    monkeypatch.setattr(hard_cases, "hard_cases", lambda _: iter([good, row]))
    out, err = command("accuracy", "--hard-cases", "--json", code=0 if passed else 1)
    assert json.loads(out) == {"schema": 1, "hard_cases": [number, good, row]}
    assert err.splitlines() == ([] if passed else ["a [number]: over", "batch, [odd], ort: above"])


@pytest.mark.usefixtures("asked")
def test_each_hard_number_says_where_its_bound_comes_from(monkeypatch: pytest.MonkeyPatch, command: Command) -> None:
    row = {"bound": 1.0, "unit": "m", "verdict": "holds", "passed": True}
    found = [("first", 0.5, "[proof]"), ("second", None, "analysis"), ("third", 0.25, "[proof]")]
    numbers = [{**row, "name": name, "error": error, "source": source} for name, error, source in found]
    monkeypatch.setattr(hard_numbers, "hard_numbers", lambda: iter(numbers))
    monkeypatch.setattr(hard_cases, "hard_cases", lambda _: iter([]))
    lines = command("accuracy", "--hard-cases")[0].splitlines()
    cells = [[cell.strip() for cell in line.split("│")[1:-1]] for line in lines if line.startswith("│")]
    assert [row[:2] + row[4:5] for row in cells] == [
        ["first", "0.5", "[1]"],
        ["second", "no number", "[2]"],
        ["third", "0.25", "[1]"],
    ]
    assert [line for line in lines if "bound: " in line][:2] == ["[1] bound: [proof]", "[2] bound: analysis"]


@pytest.mark.parametrize(
    ("words", "found"),
    [
        (("closeup",), "closeup"),
        (("--avatar", "a"), "--avatar"),
        (("--size", "64", "--frames", "8"), "--size, --frames"),
        (("closeup", "--frames", "0"), "--frames"),
    ],
)
def test_hard_cases_take_no_scene(words: tuple[str, ...], found: str, asked: list[Any], command: Command) -> None:
    out, err = command("accuracy", *words, "--hard-cases", code=2)
    assert (out, asked) == ("", [])
    said = f"found {found} beside it, expected it alone; hard cases have their own inputs"
    assert err == f"error: --hard-cases: {said}\n"


class Session:
    """A network whose picture is a constant for each input byte: `first` + the tensor's first byte x `times`."""

    def __init__(self, first: int, times: int) -> None:
        self._first, self._times = first, times

    def bind(self, inputs: Any, outputs: Any) -> Any:
        def run() -> None:
            outputs[0][0][:] = self._first
            outputs[0][0][0, 0] = self._first + self._times * int(inputs[0][0][0, 0, 0])

        return SimpleNamespace(run=run)


class Loaded:
    def __init__(self, name: str, session: Session, notes: list[Any]) -> None:
        self._name, self._session, self._notes = name, session, notes

    def version(self) -> str:
        return f"{self._name} 1.0"

    def load(self, network: Any, options: Any) -> Session:
        self._notes.append((self._name, network, options))
        return self._session


@pytest.fixture
def loaded(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """Frames of 2 x 4 and 4 x 4 pixels, whose first byte is 1, 2 or 3, on runtimes of which each answers differently.

    Of 2 x 4 x 4 bytes, the first pixel's four differ by more.
    """
    notes: list[Any] = []
    sessions = {"ort": Session(10, 0), "openvino": Session(12, 0), "qnn": Session(10, 8)}
    frames = [(0, 2, 1), (5, 4, 2), (9, 2, 3)]

    def tensors(checked: Any, count: int) -> Any:
        notes.append((checked, count))
        for number, height, first in frames:
            tensor = np.zeros((height, 4, 3), np.uint8)
            tensor[0, 0, 0] = first
            yield number, tensor

    monkeypatch.setattr(accuracy, "_tensors", tensors)
    monkeypatch.setattr(accuracy, "network_of", lambda assets: ("network of", assets))
    monkeypatch.setattr(accuracy, "reshaped", lambda network, *shape: (network, shape))
    monkeypatch.setattr(accuracy, "load_runtime", lambda name: Loaded(name, sessions[name], notes))
    return notes


def test_differences_by_hand(loaded: list[Any]) -> None:
    """ort and qnn differ in one pixel of 8, 16, 8 by 8, 16, 24: means of 1, 1 and 3; openvino is 2 from ort."""
    checked: Any = SimpleNamespace(assets="assets")
    found = runtime_differences(checked, ("ort", "openvino", "qnn"), 3)
    assert found["rows"] == [
        {"first": "ort", "second": "openvino", "mean": 2.0, "largest": 2, "worst_frame": 9},
        {"first": "ort", "second": "qnn", "mean": pytest.approx(5 / 3), "largest": 24, "worst_frame": 9},
        {
            "first": "openvino",
            "second": "qnn",
            "mean": pytest.approx(((7 * 2 + 6) / 8 + (15 * 2 + 14) / 16 + (7 * 2 + 22) / 8) / 3),
            "largest": 22,
            "worst_frame": 9,
        },
    ]
    assert found["sources"] == {"rows": "measured in this run"}
    assert found["bounds"] == {"mean": 0.5, "largest": 4}
    assert found["frames"] == [0, 5, 9]
    assert found["runtimes"] == {name: f"{name} 1.0" for name in ("ort", "openvino", "qnn")}
    assert loaded[0] == (checked, 3)
    network, once = ("network of", "assets"), RuntimeOptions(threads=1)
    names = ("ort", "openvino", "qnn")
    assert loaded[1:] == [(name, (network, shape), once) for shape in ((2, 4), (4, 4)) for name in names]


def test_the_worst_frame_is_that_of_the_largest_mean() -> None:
    steps = [(0.5, 9, 3), (0.75, 2, 4), (0.25, 4, 5)]
    row = accuracy._row(("a", "b"), steps)
    assert row == {"first": "a", "second": "b", "mean": 0.5, "largest": 9, "worst_frame": 4}


@pytest.mark.parametrize(
    ("names", "frames", "said"),
    [
        (("ort", "qnn"), 0, "--frames: found 0, expected 1 to 10000"),
        (("ort", "qnn"), 10001, "--frames: found 10001, expected 1 to 10000"),
        ((), 1, "--runtime: found none, expected two or more different runtimes"),
        (("ort",), 1, "--runtime: found ort, expected two or more different runtimes"),
        (("ort", "qnn", "ort"), 1, "--runtime: found ort, qnn, ort, expected two or more different runtimes"),
    ],
)
def test_what_cannot_be_compared(names: tuple[str, ...], frames: int, said: str, loaded: list[Any]) -> None:
    with pytest.raises(BadInputError) as refused:
        runtime_differences(SimpleNamespace(assets=None), names, frames)  # type: ignore[arg-type]
    assert (str(refused.value), loaded) == (said, [])


@pytest.mark.usefixtures("loaded")
def test_frames_that_show_nobody_are_no_agreement(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(accuracy, "_tensors", lambda *_: iter(()))
    checked: Any = SimpleNamespace(assets=None, config=SimpleNamespace(scene=SimpleNamespace(name="away")))
    with pytest.raises(BadInputError, match="scene away: found nobody in view"):
        runtime_differences(checked, ("ort", "qnn"), 3)


@pytest.mark.usefixtures("loaded")
@pytest.mark.parametrize("frames", [1, 10000])
def test_the_ends_of_the_range_are_in_it(frames: int) -> None:
    checked: Any = SimpleNamespace(assets=None)
    assert runtime_differences(checked, ("ort", "qnn"), frames)["frames"] == [0, 5, 9]
