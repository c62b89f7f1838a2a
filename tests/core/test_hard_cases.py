"""What wrong pictures cost, and what a row of the hard cases says."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from typer.testing import CliRunner

from trilane.apps.cli.accuracy import app
from trilane.apps.experiments.hard_cases import EXCEEDED, HOLDS, IDEAL_STEPS, UNTOLD, Case, wrong_answers
from trilane.apps.experiments.hard_networks import INPUTS, SIDE, calibration_frames, case_input


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
