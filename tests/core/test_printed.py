"""What commands print for people stays what it was, letter for letter: the files in printed/.

Rule: a change is meant when the files are written anew (`TRILANE_WRITE_PRINTED=1`) and their difference is read. What
depends on the machine is not here.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from trilane.apps.cli import bench
from trilane.apps.experiments import accuracy, error_by_cause, hard_cases, hard_numbers
from trilane.stages import configure, machine_facts
from trilane.stages.run_options import RunOptions

MACHINE = {"cpu": {"model": "a processor", "cores": 2}}
Printed = Callable[..., str]
Check = Callable[[str, str], None]


@pytest.fixture
def printed(command: Callable[..., tuple[str, str]]) -> Printed:
    """What `trilane ARGUMENTS` prints on stdout; it must end with the exit code `code`."""
    return lambda *arguments, code=0: command(*arguments, code=code)[0]


CHIP = ("predict", "--profile", "snapdragon-888", "--encoder", "resnet18")
COMMANDS = {
    "predict": CHIP,
    "predict-gpu": (*CHIP, "--runtime", "gpu", "--size", "384x192", "--norm", "instance", "--what-if"),
    "predict-burst": (*CHIP, "--performance-profile", "burst", "--minutes", "12", "--policy", "pipelined"),
    "predict-saver": (*CHIP, "--performance-profile", "power_saver", "--edge", "double", "--policy", "latest"),
    "profiles-show": ("profiles", "show", "snapdragon-8-gen-2"),
    "profiles-check": ("profiles", "check"),
}


@pytest.mark.parametrize("name", COMMANDS)
def test_commands(printed: Printed, check_printed: Check, name: str) -> None:
    check_printed(name, printed(*COMMANDS[name]))


@pytest.fixture
def known_machine(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(machine_facts, "machine_facts", lambda *_: MACHINE)
    monkeypatch.setattr(configure, "required_machine", lambda: MACHINE)


ROW = {"first": "ort", "second": "qnn", "mean": 0.0123456, "largest": 3, "worst_frame": 7}


@pytest.mark.usefixtures("known_machine")
@pytest.mark.parametrize(("mean", "code"), [(0.0123456, 0), (0.75, 1)])
def test_differences_between_runtimes(
    printed: Printed, check_printed: Check, monkeypatch: pytest.MonkeyPatch, mean: float, code: int
) -> None:
    result = {
        "rows": [ROW | {"mean": mean}],
        "bounds": {"mean": 0.5, "largest": 4},
        "frames": [0, 9],
        "sources": {"rows": "measured in this run"},
    }
    monkeypatch.setattr(accuracy, "runtime_differences", lambda *_: result)
    asked = ("accuracy", "--runtime", "ort", "--runtime", "openvino")
    check_printed(f"accuracy-{code}", printed(*asked, code=code))


@pytest.mark.usefixtures("known_machine")
def test_errors_by_cause(
    tmp_path: Path, printed: Printed, check_printed: Check, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A cause that moves vertices and one that does not; a figure that a small picture has not; the sums."""
    figures = {
        "mae": 1.5,
        "square": 9.0,
        "psnr_db": 38.6,
        "ssim": 0.99,
        "ms_ssim": None,
        "flip": 0.02,
        "dice": 1,
        "lpips": None,
        "iou": 1,
    }
    adds = {"mae": 0.75, "square": 4.5, "product": 3.0}
    row = {"cause": "FP16 texture", "alone": figures, "step": figures, "so_far": figures, "adds": adds, "moved": None}
    moved = row | {"cause": "skin weights", "moved": {"largest_mm": 1.25, "mean_mm": 0.5, "largest_px": 0.125}}
    left = {"mae": 0.0, "square": 1e-12, "product": 0.0}
    result = {
        "causes": [moved, row],
        "whole": figures,
        "sums": {"in_order": adds, "left_in_order": left, "alone": adds, "left_alone": adds},
        "remainder": figures | {"mae": 0.0},
        "truth": {"reference": figures, "run": figures},
        "frames": [0, 9],
        "empty_frames": [9],
        "network": "a network",
        "config": {"scene": "default", "plan": "planned", "size": "256", "runtime": "ort"},
    }
    asked = []

    def measured(*arguments: Any) -> Any:
        asked.append((*arguments[:3], *arguments[4:]))
        return result

    monkeypatch.setattr(configure, "configure", lambda request, _: request)
    monkeypatch.setattr(error_by_cause, "error_by_cause", measured)
    out = tmp_path / "maps"
    check_printed("accuracy-by-cause", printed("accuracy", "--by-cause", "--runtime", "ort", "--out", out))
    assert out.is_dir()
    printed("accuracy", "far", "--by-cause", "--size", "64", "--frames", 3)
    assert asked == [
        (RunOptions(scene="default", runtime="ort"), 2, out, None),
        (RunOptions(scene="far", size="64"), 3, None, None),
    ]


def test_hard_cases(printed: Printed, check_printed: Check, monkeypatch: pytest.MonkeyPatch) -> None:
    figures = ("error", "bound", "predicted_error", "constant_error", "shifted_error", "swapped_error")
    row: dict[str, Any] = {name: 1.25 * (n + 1) for n, name in enumerate(figures)}
    row |= {"name": "batch, usual, ort", "verdict": "holds", "passed": True, "unit": "u", "source": "s"}
    bad = row | {"name": "batch, odd, ort", "verdict": "above its bound", "passed": False}
    number = {key: row[key] for key in ("error", "bound", "unit", "source", "verdict", "passed")}
    numbers = [number | {"name": "rotation by 0"}, number | {"name": "rotation by pi", "source": "another"}]
    monkeypatch.setattr(hard_numbers, "hard_numbers", lambda: iter(numbers))
    monkeypatch.setattr(hard_cases, "hard_cases", lambda _: iter([row, bad]))
    check_printed("hard-cases", printed("accuracy", "--hard-cases", "--runtime", "ort", code=1))


@pytest.mark.usefixtures("known_machine")
@pytest.mark.parametrize("columns", [3, 30])
def test_benches(
    capsys: pytest.CaptureFixture[str], check_printed: Check, monkeypatch: pytest.MonkeyPatch, columns: int
) -> None:
    """Rows as they come, or turned where there are many columns; mappings in them are joined by dots."""
    monkeypatch.setenv("COLUMNS", "160")
    monkeypatch.setenv("NO_COLOR", "1")
    rows = [{f"c{n}": n / 7 + k for n in range(columns)} | {"inner": {"a": k, "b": "[x]"}} for k in (0, 1)]
    bench.show("raster", lambda **_: {"rows": rows, "ratios": {"r": 1 / 3}, "note": "n"}, {}, as_json=False)
    check_printed(f"bench-{columns}", capsys.readouterr().out)
