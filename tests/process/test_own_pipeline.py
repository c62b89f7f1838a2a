"""docs/own-pipeline.md does what it says: its files are those of docs/examples/street, and they run."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import av
import numpy as np
import pytest

ROOT = Path(__file__).resolve().parents[2]
EXAMPLE = ROOT / "docs" / "examples" / "street"
PAGE = (ROOT / "docs" / "own-pipeline.md").read_text(encoding="utf-8")


def test_the_page_shows_the_files_as_they_are() -> None:
    (toml,) = re.findall(r"```toml\n(.*?)```", PAGE, re.DOTALL)
    (python,) = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)
    assert (toml, python) == ((EXAMPLE / "street.toml").read_text(), (EXAMPLE / "crop.py").read_text())
    assert len([line for line in toml.splitlines() if not line.startswith("[")]) <= 10


def test_the_example_marks_the_ball_and_is_predicted(tmp_path: Path) -> None:
    """The ball of picture n is at (40 + 2.6 n, 120 + 60 sin(n / 15)); its box is 128 wide, and ends at the border."""
    shutil.copytree(EXAMPLE, tmp_path / "street")

    def ran(*command: str) -> str:
        done = subprocess.run(
            [sys.executable, *command],
            cwd=tmp_path / "street",
            env={**os.environ, "PYTHONDONTWRITEBYTECODE": "1"},
            capture_output=True,
            text=True,
            check=False,
            timeout=110,
        )
        assert done.returncode == 0, done.stderr
        return done.stdout

    ran("make_inputs.py")
    assert "imports   crop:best" in ran("-m", "trilane", "check", "street.toml")
    report = json.loads(ran("-m", "trilane", "run", "street.toml", "--out", "run", "--json"))
    assert report["frames"]["presented"] == 90
    with av.open(str(tmp_path / "street" / "out.mp4")) as video:
        pictures = [frame.to_ndarray(format="rgb24").astype(int) for frame in video.decode(video=0)]
    for number in (0, 30, 60, 89):
        left = np.clip(40 + 2.6 * number - 64, 0, 320 - 128)
        frame_of_box = pictures[number][:, :, 0] - pictures[number][:, :, 2] > 120  # yellow: the ball, and its box
        columns = np.flatnonzero(frame_of_box.sum(axis=0) > 60)
        assert (columns[0], columns[-1]) == pytest.approx((left, left + 127), abs=10), number
    with av.open(str(tmp_path / "street" / "close.mp4")) as video:
        assert sum(frame.width == 128 for frame in video.decode(video=0)) == 90
    answer = ran("-m", "trilane", "predict", "street.toml", "--profile", "host", "--measured", "run", "--json")
    assert json.loads(answer)["pipelines"][0]["frames"]["presented"] > 0
