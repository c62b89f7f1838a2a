"""`trilane quality` as a person runs it."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

COMMAND = [sys.executable, "-m", "trilane.apps.cli.main", "quality"]


def call(*arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([*COMMAND, *arguments], capture_output=True, text=True, check=False)


def test_runtimes_are_compared_on_the_frames_of_a_scene(drawable_bundle: Path) -> None:
    pytest.importorskip("openvino")
    scene = ("--avatar", str(drawable_bundle), "--size", "64x64", "--frames", "3")
    done = call(*scene, "--runtime", "ort", "--runtime", "openvino", "--json")
    found = json.loads(done.stdout)
    (row,) = found["rows"]
    assert (row["first"], row["second"]) == ("ort", "openvino")
    assert 0 <= row["mean"] <= row["largest"] <= 255
    assert found["frames"] == [0, 100, 200]
    within = row["mean"] <= found["bounds"]["mean"] and row["largest"] <= found["bounds"]["largest"]
    assert done.returncode == (0 if within else 1)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("--runtime", "ort", "--runtime", "abacus"), "'abacus'"),
        (("beach",), "default"),
        (("--by-cause", "--hard-cases"), "--hard-cases"),
        (("--by-cause", "--runtime", "ort", "--runtime", "openvino"), "one runtime"),
        (("--out", "maps"), "--by-cause"),
        (("--lpips-weights", "w.pth"), "--by-cause"),
    ],
)
def test_wrong_usage_is_one_sentence(arguments: tuple[str, ...], said: str) -> None:
    done = call(*arguments)
    assert done.returncode == 2
    assert said in done.stderr
    assert "Traceback" not in done.stderr
    assert done.stdout == ""
