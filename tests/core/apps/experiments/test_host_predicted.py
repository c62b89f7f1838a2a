"""`bench predict`: what it says of predictions and runs that are told, worked out by hand."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from trilane.apps.experiments import host_predicted
from trilane.apps.experiments.host_predicted import measure, summary
from trilane.errors import BadInputError
from trilane.hw_profiles.rates import FrameInterval


def row(error: float, inside: bool = False) -> dict[str, Any]:
    return {"error": error, "inside": inside}


def test_errors_are_said_by_their_median_and_without_each_one_in_turn() -> None:
    """Errors of +10 %, -10 %, +20 % and none: 0.1 in the median of their sizes.

    Squares of the logarithms: 0.00908, 0.01110, 0.03324, 0; together 0.05342. Without the third the others have a mean
    of 0.00673, and 1.2816^2 times that is 0.01105: it is outside, the others are inside of theirs.
    """
    found = summary([row(0.1, True), row(-0.1), row(0.2), row(0.0, True)])
    assert (found["inside"], found["of"]) == (2, 4)
    assert found["median_error"] == pytest.approx(0.1)
    assert found["leave_one_out_error"] == pytest.approx((0.053424 / 4) ** 0.5, rel=1e-4)
    assert found["inside_left_out"] == 3


@pytest.mark.parametrize(("ms", "inside"), [(8.9, False), (9.0, True), (11.0, True), (11.1, False)])
def test_the_ends_of_an_interval_are_in_it(ms: float, inside: bool) -> None:
    assert host_predicted._row("a", "run", FrameInterval(10.0, 9.0, 11.0), ms, None)["inside"] is inside


def test_runs_that_are_not_placed_by_their_times_are_refused() -> None:
    with pytest.raises(BadInputError, match=r"--frames: found 99, expected at least 100"):
        measure(frames=99)


def test_runs_and_calls_stand_beside_their_predictions(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """The avatar and one further width: runs of 12 ms predicted at 10 (9 to 11), calls of 5 ms at 4 (no interval)."""
    bundle = SimpleNamespace(network_path=tmp_path / "network.onnx")
    for name, answer in (
        ("remade_avatar", (tmp_path, "")),
        ("load_bundle", bundle),
        ("_of_run", FrameInterval(10.0, 9.0, 11.0)),
        ("_of_network", FrameInterval(4.0)),
        ("_run", (12.0, 0.01)),
        ("_calls", 5.0),
    ):
        monkeypatch.setattr(host_predicted, name, lambda *_, answer=answer: answer)
    found = measure("mine", (32,), 150, 2.0)
    keys = ("name", "what", "error", "inside", "others", "low_ms")
    assert [tuple(each[key] for key in keys) for each in found["rows"]] == [
        row
        for name in ("mine", "width 32")
        for row in (
            (name, "run", pytest.approx(-1 / 6), False, 0.01, 9.0),
            (name, "network", pytest.approx(-0.2), False, None, None),
        )
    ]
    assert found["run"]["of"] == found["network"]["of"] == 2
    assert found["run"]["median_error"] == pytest.approx(1 / 6)


def test_a_single_row_has_no_other_rows() -> None:
    found = summary([row(0.1, True)])
    assert (found["of"], found["inside"], found["inside_left_out"]) == (1, 1, None)


@pytest.mark.parametrize("width", [0, 257])
def test_a_width_that_no_network_has_is_refused(width: int) -> None:
    with pytest.raises(BadInputError, match=f"width: found {width}"):
        measure(width=(8, width))
