"""The notebooks of docs/examples run as they stand there, as a file or from standard input, and keep their promises."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

import trilane

EXAMPLES = Path(__file__).resolve().parents[2] / "docs" / "examples"


def ran(name: str, folder: Path, *, frames: int = 1, as_input: bool = False, timeout_s: float = 110) -> str:
    """What the script prints; its run folder is `folder` / "out"."""
    script = EXAMPLES / name
    done = subprocess.run(
        [sys.executable, "-" if as_input else str(script)],
        input=script.read_text() if as_input else None,
        cwd=folder,
        env={**os.environ, "FRAMES": str(frames), "OUT": str(folder / "out")},
        capture_output=True,
        text=True,
        check=False,
        timeout=timeout_s,
    )
    assert (done.returncode, done.stderr) == (0, "")
    return done.stdout


def test_every_example_is_run_here() -> None:
    assert {script.name for script in EXAMPLES.glob("*.py")} == {"first_run.py", "chips.py", "own_experiment.py"}


def test_a_first_run(tmp_path: Path, nothing_left: Path) -> None:  # noqa: ARG001 - looks after the test
    """From standard input: the units' processes never import the script."""
    out = ran("first_run.py", tmp_path, frames=8, as_input=True)
    assert "frames a second on" in out
    assert "error of default: {'far':" in out
    run = trilane.load_run(tmp_path / "out")
    assert run.report.frames.presented == len(run.frames()) == 8
    assert len(run.jobs) == 8 * 5
    assert run.report.made is not None
    assert run.report.made.command[:2] == ("trilane.run", "frames=8")
    budget = run.explain()
    assert sum(row["ms"] for row in budget["budget"]) == pytest.approx(budget["frame_ms"])
    assert budget["frame_ms"] == pytest.approx(run.report.frame_time_ms.mean)


def test_chips(tmp_path: Path) -> None:
    rows = ran("chips.py", tmp_path).splitlines()
    assert [row.split()[0] for row in rows] == [
        "chip",
        "snapdragon-865",
        "snapdragon-888",
        "snapdragon-8-gen-2",
        "snapdragon-8-gen-3",
    ]
    assert "as fast as the display shows" in rows[-1]


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_an_experiment_of_ones_own(tmp_path: Path) -> None:
    out = ran("own_experiment.py", tmp_path, frames=12, timeout_s=590)
    assert sum("of the frame time" in line for line in out.splitlines()) == 6
    assert sorted(path.name for path in (tmp_path / "out").iterdir() if path.is_dir()) == [
        f"{policy}-{edge}" for policy in ("latest", "pipelined", "sequential") for edge in ("double", "single")
    ]
