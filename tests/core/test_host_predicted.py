"""`bench predict`: what it says of predictions and runs that are told, worked out by hand."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from trilane.apps.experiments import host_predicted
from trilane.apps.experiments.host_predicted import Predicted, measure, summary
from trilane.errors import BadInputError


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


def test_every_network_is_predicted_before_it_runs(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Of the avatar and of one further width: runs of 12 ms predicted at 10 (9 to 11), calls of 5 ms at 4 (none)."""
    done: list[Any] = []

    def noted(what: str, answer: Any) -> Any:
        return lambda *asked: done.append((what, *asked)) or answer

    monkeypatch.setattr(host_predicted, "remade_avatar", lambda _, remake: (tmp_path / f"w{remake.width}", ""))
    monkeypatch.setattr(host_predicted, "load_bundle", lambda name: SimpleNamespace(network_path=Path(f"{name}.onnx")))
    monkeypatch.setattr(host_predicted, "_of_run", noted("predict run", Predicted(10.0, 9.0, 11.0)))
    monkeypatch.setattr(host_predicted, "_of_network", noted("predict calls", Predicted(4.0, None, None)))
    monkeypatch.setattr(host_predicted, "_run", lambda *asked: done.append(("run", *asked[:2])) or (12.0, 0.01))
    monkeypatch.setattr(host_predicted, "_calls", noted("calls", 5.0))
    found = measure("mine", (32,), 150, 2.0)
    wide = str(tmp_path / "w32")
    assert done == [
        ("predict run", "mine"),
        ("run", "mine", 150),
        ("predict calls", Path("mine.onnx")),
        ("calls", Path("mine.onnx"), 2.0),
        ("predict run", wide),
        ("run", wide, 150),
        ("predict calls", Path(f"{wide}.onnx")),
        ("calls", Path(f"{wide}.onnx"), 2.0),
    ]
    assert [(each["name"], each["what"], each["inside"]) for each in found["rows"]] == [
        ("mine", "run", False),
        ("mine", "network", False),
        ("width 32", "run", False),
        ("width 32", "network", False),
    ]
    first, second = found["rows"][:2]
    assert first["error"] == pytest.approx(-1 / 6) and second["error"] == pytest.approx(-0.2)
    assert (first["others"], second["others"], second["low_ms"]) == (0.01, None, None)
    assert found["run"]["of"] == found["network"]["of"] == 2
    assert found["run"]["median_error"] == pytest.approx(1 / 6)


@pytest.mark.parametrize(("ms", "inside"), [(8.9, False), (9.0, True), (11.0, True), (11.1, False)])
def test_the_ends_of_an_interval_are_in_it(ms: float, inside: bool) -> None:
    assert host_predicted._row("a", "run", Predicted(10.0, 9.0, 11.0), ms, None)["inside"] is inside


def test_runs_that_are_not_placed_by_their_times_are_refused() -> None:
    with pytest.raises(BadInputError, match=r"--frames: found 99, expected at least 100"):
        measure(frames=99)
