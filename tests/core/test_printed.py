"""What commands print for people stays what it was, letter for letter: the files in printed/.

Rule: a change is meant when the files are written again (`TRILANE_WRITE_PRINTED=1`) and their difference is read. What
depends on the machine is not here.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from trilane.apps.experiments import error_by_cause
from trilane.stages import configure

Printed = Callable[..., str]
Check = Callable[[str, str], None]


@pytest.fixture
def printed(command: Callable[..., tuple[str, str]]) -> Printed:
    """What `trilane ARGUMENTS` prints on stdout; it must end with the exit code `code`."""
    return lambda *arguments, code=0: command(*arguments, code=code)[0]


CHIP = ("predict", "--profile", "snapdragon-888", "--encoder", "resnet18")
COMMANDS = {
    "predict": CHIP,
    "predict-gpu": (*CHIP, "--unit", "gpu", "--size", "384x192", "--norm", "instance", "--what-if"),
    "predict-burst": (*CHIP, "--performance-profile", "burst", "--minutes", "12", "--policy", "pipelined"),
    "predict-saver": (*CHIP, "--performance-profile", "power_saver", "--edge", "double", "--policy", "latest"),
}


@pytest.mark.parametrize("name", COMMANDS)
def test_commands(printed: Printed, check_printed: Check, name: str) -> None:
    check_printed(name, printed(*COMMANDS[name]))


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
    monkeypatch.setattr(configure, "configure", lambda request, _: request)
    monkeypatch.setattr(configure, "required_machine", dict)
    monkeypatch.setattr(error_by_cause, "error_by_cause", lambda *_: result)
    out = tmp_path / "maps"
    check_printed("accuracy-by-cause", printed("accuracy", "--by-cause", "--runtime", "ort", "--out", out))
    assert out.is_dir()
