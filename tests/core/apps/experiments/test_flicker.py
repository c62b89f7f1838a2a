"""Flicker: what stays is none, what comes and goes is its size; size and runtime stand beside error and time."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from trilane.apps.experiments import error_by_size
from trilane.apps.experiments import flicker as bench
from trilane.apps.experiments.error_by_size import refuse_twice
from trilane.apps.experiments.flicker import flicker
from trilane.apps.experiments.picture_errors import ErrorFigures
from trilane.apps.experiments.scene_pictures import spread
from trilane.errors import BadInputError

WHOLE = (slice(None), slice(None))
PICTURES: Any = None


def test_an_error_that_stays_does_not_flicker() -> None:
    error = np.random.default_rng(1).normal(0, 0.1, (4, 5, 3))
    assert flicker(error, error) == 0


def test_an_error_that_comes_and_goes_flickers_by_its_size() -> None:
    """One value of four changes from 0.1 to -0.1: 0.2 of 1, in steps of 1/255, over four values."""
    before, now = np.zeros((1, 4, 1)), np.zeros((1, 4, 1))
    before[0, 2], now[0, 2] = 0.1, -0.1
    assert flicker(before, now) == pytest.approx(0.2 * 255 / 4)


def test_a_row_has_the_mean_and_the_worst_pair() -> None:
    """Errors of 0, 1, 3 and 3 steps: changes of 1, 2 and 0."""
    row = bench.FlickerRow("ort", "minmax", "linear", PICTURES)
    for steps in (0, 1, 3, 3):
        row.add(np.full((2, 2, 3), steps / 255), WHOLE)
    assert row.as_json() == {
        "runtime": "ort",
        "calibration": "minmax",
        "texture_filter": "linear",
        "flicker": pytest.approx(1.0),
        "worst": pytest.approx(2.0),
        "worst_frame": 2,
        "mae": pytest.approx(7 / 4),
    }


def test_only_where_the_avatars_are_counts() -> None:
    row = bench.FlickerRow("ort", "minmax", "linear", PICTURES)
    for error in (0.0, 1.0):
        picture = np.zeros((2, 2, 3))
        picture[0] = error
        row.add(picture, (slice(1, 2), slice(None)))
    assert row.changes == [0.0]


def test_a_size_has_its_median_time_and_its_mean_error() -> None:
    errors = [ErrorFigures(1.0, 30.0, 0.9, None, 0.1), ErrorFigures(3.0, 20.0, None, None, 0.3)]
    row = error_by_size.SizeRow("128", "ort", PICTURES, 1, [1.0, 9.0, 2.0], [4.0, 12.0, 8.0], errors)
    found = row.as_json()
    assert (found["infer_ms"], found["frame_ms"]) == (2.0, 8.0)
    assert (found["infer_low_ms"], found["infer_high_ms"]) == (None, None)
    assert (found["psnr_db"], found["worst_psnr_db"], found["mae"], found["ssim"]) == (25.0, 20.0, 2.0, 0.9)
    assert found["flip"] == pytest.approx(0.2) and found["p1_psnr_db"] == pytest.approx(20.1)


@pytest.mark.parametrize(("jobs", "interval"), [(5, (None, None)), (6, (1.0, 6.0)), (9, (2.0, 8.0))])
def test_an_interval_of_95_percent_needs_six_jobs(jobs: int, interval: Any) -> None:
    """All of n lie on one side of the median with 2 / 2^n: 6 % for 5, 3 % for 6. All but one of 9: 20 / 512, 4 %."""
    times = [float(job + 1) for job in range(jobs)]
    row = error_by_size.SizeRow("128", "ort", PICTURES, 1, times, times, [ErrorFigures(1.0, 30.0, 0.9, None, 0.1)])
    found = row.as_json()
    assert (found["infer_low_ms"], found["infer_high_ms"]) == interval


@pytest.mark.parametrize(
    ("asked", "said"),
    [
        ({"runtime": ("ort", "ort")}, "--runtime"),
        ({"texture_filter": ("cubic",)}, "--texture-filter"),
        ({"calibration": ("minmx",)}, "did you mean 'minmax'|minmax"),
        ({"frames": 1}, "--frames"),
    ],
)
def test_bad_questions_are_refused_before_any_work(asked: dict[str, Any], said: str) -> None:
    with pytest.raises(BadInputError, match=said):
        bench.measure(**{"runtime": ("ort",), **asked})


def test_each_value_once_and_frames_within_the_scene() -> None:
    refuse_twice("--size", ["1", "2"])
    for bad in ([], ["1", "1"]):
        with pytest.raises(BadInputError, match="--size"):
            refuse_twice("--size", bad)
    assert spread(10, 3) == [0, 3, 6] and spread(2, 9) == [0, 1]
    with pytest.raises(BadInputError, match="--frames"):
        spread(10, 0)
