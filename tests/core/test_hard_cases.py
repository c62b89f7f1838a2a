"""What wrong pictures cost, and what a row of the hard cases says."""

from __future__ import annotations

import dataclasses
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from trilane.apps.cli.accuracy import app
from trilane.apps.experiments import hard_cases
from trilane.apps.experiments.hard_cases import (
    EXCEEDED,
    HOLDS,
    IDEAL_STEPS,
    INPUTS,
    SIDE,
    UNTOLD,
    Case,
    calibration_frames,
    case_input,
    wrong_answers,
)
from trilane.stages.dsp.runtime import RuntimeOptions


def test_wrong_pictures_by_hand():
    """In the last quarter of the rows red is 100 and blue 40, else all is 0, as are the medians. Moved sideways, the
    picture is the same."""
    picture = np.zeros((32, 32, 4), np.float32)
    picture[24:, :, 0], picture[24:, :, 2] = 100, 40
    wrong = wrong_answers(picture)
    assert wrong == {
        "constant_error": (100 + 40) / 4 / 4,
        "shifted_error": 0.0,
        "swapped_error": 2 * (100 - 40) / 4 / 4,
    }


def test_a_shift_is_by_8_pixels_in_the_direction_that_costs_least():
    """A bright column costs nothing when it is moved along itself; a bright square of 12 costs 8 of its 12 twice."""
    picture = np.zeros((32, 32, 4), np.float32)
    picture[:, 10:22] = 64
    assert wrong_answers(picture)["shifted_error"] == 0.0
    picture[:10] = picture[22:] = 0
    assert wrong_answers(picture)["shifted_error"] == 64 * 2 * 8 * 12 / 32**2


@pytest.fixture
def case():
    """Bound 10; the nearest wrong picture is at 11."""
    wrong = {"constant_error": 20.0, "shifted_error": 11.0, "swapped_error": 30.0}
    return Case(None, np.zeros(1, np.uint8), np.zeros(1, np.float32), 8.0, 10.0, IDEAL_STEPS, 12.0, wrong)


@pytest.mark.parametrize(("error", "verdict"), [(0.0, HOLDS), (10.0, HOLDS), (10.01, EXCEEDED), (np.nan, EXCEEDED)])
def test_an_error_above_the_bound_fails(case, error, verdict):
    assert case.verdict(error) == verdict


@pytest.mark.parametrize("bound", [11.0, 12.0, np.nan])
def test_a_row_whose_bound_a_wrong_picture_keeps_fails_without_any_error(case, bound):
    assert dataclasses.replace(case, bound=bound).verdict(0.0) == UNTOLD


@pytest.mark.parametrize(("verdict", "code"), [(HOLDS, 0), (EXCEEDED, 1), (UNTOLD, 1)])
def test_rows_that_fail_are_named_and_fail_the_command(monkeypatch, verdict, code):
    figures = {
        "error": 1.0,
        "bound": 2.0,
        "constant_error": 3.0,
        "shifted_error": 4.0,
        "swapped_error": 5.0,
        "source": IDEAL_STEPS,
    }
    row = {"name": "batch, usual, ort", **figures, "verdict": verdict, "passed": verdict == HOLDS}
    monkeypatch.setattr("trilane.apps.experiments.hard_cases.hard_cases", lambda _: iter([row]))
    if code:  # the numbers, which all hold, are computed once
        monkeypatch.setattr("trilane.apps.experiments.hard_numbers.hard_numbers", lambda: iter([]))
    result = CliRunner().invoke(app, ["--hard-cases", "--runtime", "ort"])
    assert result.exit_code == code
    assert (f"batch, usual, ort: {verdict}" in result.stderr) == (code == 1)
    assert "bound: computed" in result.stdout


def test_inputs_have_a_figure_on_background_and_are_no_frame_of_the_calibration():
    for name in INPUTS:
        frame = case_input(name)
        shown = (frame != 0).any(axis=-1)
        assert 0.1 < shown.mean() < 0.4 and not shown[0].any() and shown[SIDE // 2, SIDE // 2]
    assert (case_input("saturating") == 10 * case_input("usual")).all()
    assert not any((frame == case_input("usual")).all() for frame in calibration_frames())


def test_a_case_has_the_smaller_bound_of_two(monkeypatch: pytest.MonkeyPatch) -> None:
    """The input in steps of 0.5 round 100: 1.3 is 102.6, 103 when rounded; bytes end at 0 and 255."""
    frame = np.array([[[1.3, -60.0], [90.0, -0.2]]], np.float32)
    encoding = SimpleNamespace(scale=0.5, zero_point=100)
    quantised: Any = SimpleNamespace(network=SimpleNamespace(input=encoding))
    wanted = np.zeros((1, 2, 2, 4), np.float32)
    wanted[0, :, :, 0] = 40.0
    bounds = {"own": (3.0, 9.0), "ideal": (4.0, 8.0)}
    monkeypatch.setattr(hard_cases, "case_input", lambda name: frame if name == "odd" else None)
    monkeypatch.setattr(hard_cases, "float_picture", lambda *_: wanted)
    monkeypatch.setattr(hard_cases, "ideal_noise_model", lambda *_: "ideal")
    monkeypatch.setattr(hard_cases, "predicted_bound", lambda model, *_: bounds[model])
    pair = hard_cases.NetworkPair("net", quantised, "own")  # type: ignore[arg-type]
    case = hard_cases.make_case(pair, "odd")
    assert case.tensor.tolist() == [[[[103, 0], [255, 100]]]]
    assert (case.tensor.dtype, case.tensor.flags.c_contiguous) == (np.uint8, True)
    assert (case.predicted, case.bound, case.source, case.own_bound) == (4.0, 8.0, hard_cases.IDEAL_STEPS, 9.0)
    assert case.wrong == {"constant_error": 0.0, "shifted_error": 0.0, "swapped_error": 20.0}
    assert (case.pair, case.wanted is wanted) == (pair, True)
    bounds["own"] = (3.0, 7.0)
    case = hard_cases.make_case(pair, "odd")
    assert (case.predicted, case.bound, case.source, case.own_bound) == (3.0, 7.0, hard_cases.OWN_STEPS, 7.0)


def test_the_error_of_a_runtime_is_the_mean_difference(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[Any] = []

    class Runtime:
        def load(self, network: str, options: RuntimeOptions) -> Any:
            asked.append((network, options))
            return self

        def bind(self, inputs: list[Any], outputs: list[Any]) -> Any:
            def run() -> None:
                outputs[0][:] = inputs[0][0, 0]

            return SimpleNamespace(run=run)

    monkeypatch.setattr(hard_cases, "load_runtime", lambda name: asked.append(name) or Runtime())
    quantised: Any = SimpleNamespace(network="the network")
    wanted = np.array([[[[10.5, 9.0, 4.0, 8.0]]]], np.float32)
    pair = hard_cases.NetworkPair("net", quantised, "own")  # type: ignore[arg-type]
    case = hard_cases.Case(pair, np.full((1, 1), 8, np.uint8), wanted, 0.0, 0.0, "", 0.0, {})
    assert hard_cases.error_of(case, "ort") == (2.5 + 1 + 4 + 0) / 4
    assert asked == ["ort", ("the network", RuntimeOptions())]


def test_a_row_for_every_network_input_and_runtime(monkeypatch: pytest.MonkeyPatch) -> None:
    wrong = {"constant_error": 20.0, "shifted_error": 11.0, "swapped_error": 30.0}
    errors = {"ort": 9.0, "qnn": 10.5}
    pairs = []

    def make_case(pair: str, name: str) -> Any:
        return hard_cases.Case(pair, name, None, 8.0, 10.0, "told", 12.0, wrong)  # type: ignore[arg-type]

    def make_pair(name: str) -> str:
        pairs.append(name)
        return name

    monkeypatch.setattr(hard_cases, "NETWORKS", {"first": 0, "second": 0})
    monkeypatch.setattr(hard_cases, "INPUTS", {"plain": 0, "odd": 0})
    monkeypatch.setattr(hard_cases, "make_pair", make_pair)
    monkeypatch.setattr(hard_cases, "make_case", make_case)
    monkeypatch.setattr(hard_cases, "error_of", lambda case, runtime: errors[runtime] + (case.tensor == "odd"))
    rows = list(hard_cases.hard_cases(["ort", "qnn"]))
    names = [f"{network}, {case}, {runtime}" for network in pairs for case in ("plain", "odd") for runtime in errors]
    assert ([row["name"] for row in rows], pairs) == (names, ["first", "second"])
    assert [row["error"] for row in rows] == [9.0, 10.5, 10.0, 11.5] * 2
    assert [row["passed"] for row in rows] == [True, False, True, False] * 2
    assert rows[1] == {
        "name": "first, plain, qnn",
        "error": 10.5,
        "bound": 10.0,
        "unit": hard_cases.UNIT,
        "source": "told",
        "predicted_error": 8.0,
        **wrong,
        "verdict": hard_cases.EXCEEDED,
        "passed": False,
    }


def test_a_pair_is_quantised_on_the_calibration(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(hard_cases, "float_network", lambda name: f"network {name}")
    monkeypatch.setattr(hard_cases, "calibration_frames", lambda: "frames")
    monkeypatch.setattr(hard_cases, "quantise", lambda *given: given)
    monkeypatch.setattr(hard_cases, "noise_model", lambda given: ("noise", given))
    both = ("network x", "frames")
    assert hard_cases.make_pair("x") == hard_cases.NetworkPair("network x", both, ("noise", both))  # type: ignore[arg-type]
