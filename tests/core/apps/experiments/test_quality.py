"""`trilane quality`: figures of runtimes that a test makes up, by hand; what is out of bounds or refused."""

from __future__ import annotations

import json
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from trilane.apps.cli import quality as cli
from trilane.apps.experiments import hard_cases, hard_numbers, scene_pictures
from trilane.apps.experiments.scene_pictures import runtime_differences
from trilane.errors import BadInputError
from trilane.stages import configure

Command = Callable[..., tuple[str, str]]
ROW = {"first": "ort", "second": "qnn", "mean": 0.0123456, "largest": 3, "worst_frame": 7}
FIGURES = dict.fromkeys(cli.HARD_COLUMNS, 1.0)
NUMBER = {"name": "a [number]", "error": 2.0, "bound": 1.0, "unit": "m", "source": "[proof]"}


@pytest.fixture
def rows(monkeypatch: pytest.MonkeyPatch) -> dict[str, list[Any]]:
    """What the command finds, in place of what it would measure."""
    found: dict[str, list[Any]] = {"runtimes": [], "numbers": [], "networks": []}

    def differences(*_: Any) -> Any:
        bounds = {"mean": 0.5, "largest": 4}
        return {"rows": found["runtimes"], "sources": {"rows": "measured in this run"}, "bounds": bounds, "frames": [0]}

    monkeypatch.setattr(configure, "configure", lambda *_: "checked")
    monkeypatch.setattr(configure, "required_machine", dict)
    monkeypatch.setattr(scene_pictures, "runtime_differences", differences)
    monkeypatch.setattr(hard_numbers, "hard_numbers", lambda: iter(found["numbers"]))
    monkeypatch.setattr(hard_cases, "hard_cases", lambda _: iter(found["networks"]))
    return found


@pytest.mark.parametrize(
    ("row", "said"),
    [
        ({"mean": 0.5, "largest": 4}, []),
        ({"mean": 0.50123}, ["out of bounds: ort and qnn, mean 0.501, expected 0.5"]),
        ({"largest": 5}, ["out of bounds: ort and qnn, largest 5, expected 4"]),
    ],
)
def test_what_is_out_of_its_bounds_is_said(
    row: dict[str, Any], said: list[str], rows: dict[str, list[Any]], command: Command
) -> None:
    rows["runtimes"] = [ROW | row]
    for words in ((), ("--json",)):
        _, err = command("quality", *words, code=1 if said else 0)
        assert err.splitlines() == said


@pytest.mark.parametrize("passed", [True, False])
def test_a_hard_case_that_fails_is_named(passed: bool, rows: dict[str, list[Any]], command: Command) -> None:
    row = {**FIGURES, "name": "batch, [odd], ort", "verdict": "above", "passed": passed}
    rows["networks"] = [{**row, "name": "good", "passed": True}, row]
    rows["numbers"] = [{**NUMBER, "verdict": "over", "passed": passed}]
    out, err = command("quality", "--hard-cases", "--json", code=0 if passed else 1)
    assert json.loads(out) == {"schema": 1, "hard_cases": [*rows["numbers"], *rows["networks"]]}
    assert err.splitlines() == ([] if passed else ["a [number]: over", "batch, [odd], ort: above"])


def test_each_hard_number_says_where_its_bound_comes_from(rows: dict[str, list[Any]], command: Command) -> None:
    found = [("first", 0.5, "[proof]"), ("second", None, "analysis"), ("third", 0.25, "[proof]")]
    row = {**NUMBER, "verdict": "holds", "passed": True}
    rows["numbers"] = [{**row, "name": name, "error": error, "source": source} for name, error, source in found]
    lines = command("quality", "--hard-cases")[0].splitlines()
    cells = [[cell.strip() for cell in line.split("│")[1:-1]] for line in lines if line.startswith("│")]
    assert [(name, error, mark) for name, error, _, _, mark, *_ in cells] == [
        ("first", "0.5", "[1]"),
        ("second", "no number", "[2]"),
        ("third", "0.25", "[1]"),
    ]
    assert [line for line in lines if "bound: " in line][:2] == ["[1] bound: [proof]", "[2] bound: analysis"]


@pytest.mark.parametrize("words", [(), ("--hard-cases",), ("--by-cause",)])
def test_a_runtime_that_is_none_is_refused_before_the_work(
    words: tuple[str, ...], command: Command, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(configure, "configure", pytest.fail)
    monkeypatch.setattr(hard_numbers, "hard_numbers", pytest.fail)
    said = command("quality", *words, "--runtime", "opevino", code=2)[1]
    assert "runtime: found 'opevino', expected one of " in said
    assert "did you mean 'openvino'?" in said


@pytest.mark.parametrize(
    ("words", "found"),
    [
        (("closeup",), "closeup"),
        (("--avatar", "a"), "--avatar"),
        (("--size", "64", "--frames", "8"), "--size, --frames"),
    ],
)
def test_hard_cases_take_no_scene(words: tuple[str, ...], found: str, command: Command) -> None:
    said = f"found {found} beside it, expected it alone; hard cases have their own inputs"
    assert command("quality", *words, "--hard-cases", code=2) == ("", f"error: --hard-cases: {said}\n")


class Runtime:
    """A runtime whose pictures are `first`, and in the first pixel `first` + the tensor's first byte x `times`."""

    def __init__(self, first: int, times: int) -> None:
        self._first, self._times = first, times

    def version(self) -> str:
        return f"{self._first}"

    def load(self, *_: Any) -> Any:
        return self

    def bind(self, inputs: Any, outputs: Any) -> Any:
        def run() -> None:
            outputs[0][0][:] = self._first
            outputs[0][0][0, 0] = self._first + self._times * int(inputs[0][0][0, 0, 0])

        return SimpleNamespace(run=run)


@pytest.fixture
def frames(monkeypatch: pytest.MonkeyPatch) -> list[tuple[int, int, int]]:
    """Number, height and first byte of the frames; they are 4 pixels wide. Each runtime answers differently."""
    shown = [(0, 2, 1), (5, 4, 2), (9, 2, 3)]
    runtimes = {"ort": Runtime(10, 0), "openvino": Runtime(12, 0), "qnn": Runtime(10, 8)}

    def tensors(*_: Any) -> Any:
        for number, height, first in shown:
            tensor = np.zeros((height, 4, 3), np.uint8)
            tensor[0, 0, 0] = first
            yield number, 0, tensor

    monkeypatch.setattr(scene_pictures, "_tensors", tensors)
    monkeypatch.setattr(scene_pictures, "networks_of", lambda _: [None, None])
    monkeypatch.setattr(scene_pictures, "reshaped", lambda *_: None)
    monkeypatch.setattr(scene_pictures, "load_runtime", runtimes.__getitem__)
    return shown


CHECKED: Any = SimpleNamespace(assets=None, config=SimpleNamespace(scene=SimpleNamespace(name="away", frames=9)))


@pytest.mark.usefixtures("frames")
@pytest.mark.parametrize("count", [1, 10000])
def test_differences_by_hand(count: int) -> None:
    """ort and qnn differ in one pixel of 8, 16, 8 by 8, 16, 24: means of 1, 1 and 3; openvino is 2 from ort."""
    found = runtime_differences(CHECKED, ("ort", "openvino", "qnn"), count)
    means = (7 * 2 + 6) / 8, (15 * 2 + 14) / 16, (7 * 2 + 22) / 8
    assert [tuple(row.values()) for row in found["rows"]] == [
        ("ort", "openvino", 2.0, 2, 9),
        ("ort", "qnn", pytest.approx(5 / 3), 24, 9),
        ("openvino", "qnn", pytest.approx(sum(means) / 3), 22, 9),
    ]
    assert found["bounds"] == {"mean": 0.5, "largest": 4}
    assert found["frames"] == [0, 5, 9]


def test_the_worst_frame_is_that_of_the_largest_mean(frames: list[tuple[int, int, int]]) -> None:
    """Frame 5 has the largest first byte in 8 pixels."""
    frames[1] = (5, 2, 9)
    (row,) = runtime_differences(CHECKED, ("ort", "qnn"), 3)["rows"]
    assert (row["largest"], row["worst_frame"]) == (72, 5)


@pytest.mark.usefixtures("frames")
@pytest.mark.parametrize(
    ("names", "count", "said"),
    [
        (("ort", "qnn"), 0, "--frames: found 0, expected 1 to 10000"),
        (("ort", "qnn"), 10001, "--frames: found 10001, expected 1 to 10000"),
        ((), 1, "--runtime: found none, expected two or more different runtimes"),
        (("ort",), 1, "--runtime: found ort, expected two or more different runtimes"),
        (("ort", "qnn", "ort"), 1, "--runtime: found ort, qnn, ort, expected two or more different runtimes"),
    ],
)
def test_what_cannot_be_compared(names: tuple[str, ...], count: int, said: str) -> None:
    with pytest.raises(BadInputError) as refused:
        runtime_differences(CHECKED, names, count)
    assert str(refused.value) == said


@pytest.mark.usefixtures("frames")
def test_a_frame_with_two_networks_counts_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """Both tensors are compared: the second differs by 16 in one pixel of 8, as its first byte is 2."""
    tensors = np.zeros((2, 2, 4, 3), np.uint8)
    tensors[:, 0, 0, 0] = 1, 2
    monkeypatch.setattr(scene_pictures, "_tensors", lambda *_: iter([(4, 0, tensors[0]), (4, 1, tensors[1])]))
    found = runtime_differences(CHECKED, ("ort", "qnn"), 1)
    assert found["frames"] == [4]
    assert [tuple(row.values()) for row in found["rows"]] == [("ort", "qnn", 1.5, 16, 4)]


def test_frames_that_show_nobody_are_no_agreement(frames: list[tuple[int, int, int]]) -> None:
    frames.clear()
    with pytest.raises(BadInputError, match="scene away: found nobody in view"):
        runtime_differences(CHECKED, ("ort", "qnn"), 3)
