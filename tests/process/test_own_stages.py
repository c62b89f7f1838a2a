"""docs/own-stages.md does what it says: its file is run as it stands there, and killed as the avatar's units are."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

DOCUMENT = Path(__file__).resolve().parents[2] / "docs" / "own-stages.md"
#: No part of the avatar's is loaded for it, neither here nor in a unit.
AVATAR_PARTS = ("trilane.scene", "trilane.avatars", "trilane.stages", "trilane.hw_profiles", "moderngl", "onnxruntime")
RUN = """
import json, os, signal, sys
from pathlib import Path
import psutil
import brightness
from trilane.pipeline.run import run_pipeline
from trilane.scheduler.recording import replay

log = Path(sys.argv[1])
killed = []
def kill_once(presented, _requested):
    if presented >= 30 and not killed:
        killed.append(next(p for p in psutil.Process().children(recursive=True) if p.name() == "trilane-right"))
        killed[0].send_signal(signal.SIGKILL)

result = run_pipeline(brightness.pipeline(log), frames=120, pace_fps=100, on_progress=kill_once)
loaded = [line for line in log.with_suffix(".modules").read_text().split()]
print(json.dumps({
    "presented": result.presented, "requested": result.requested,
    "lost": {str(cause): count for cause, count in result.lost.items()},
    "restarts": {unit: row.restarts for unit, row in result.report.units.items()},
    "shares": {unit: row.busy + sum(row.idle.as_json().values()) for unit, row in result.report.units.items()},
    "efficiency": result.report.efficiency, "brightness": result.metrics["sink"]["brightness"],
    "failure": result.failure and result.failure.message, "replayed": list(replay(result.recording)),
    "here": sorted(sys.modules), "unit": loaded,
}))
"""
SPY = """
import sys
from pathlib import Path
def sink(settings, unit):
    log = Path(settings["log"])
    made = Sink(log)
    log.with_suffix(".modules").write_text(" ".join(sys.modules))
    return made
"""


@pytest.fixture
def module(tmp_path: Path) -> Path:
    """The file of the document, in a folder of its own."""
    code = re.findall(r"```python\n(.*?)```", DOCUMENT.read_text(encoding="utf-8"), re.DOTALL)
    assert len(code) == 1
    path = tmp_path / "brightness.py"
    path.write_text(code[0], encoding="utf-8")
    return path


def started(arguments: list[str], folder: Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, *arguments],
        cwd=folder,
        env={**os.environ, "PYTHONDONTWRITEBYTECODE": "1"},
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )


def run(arguments: list[str], folder: Path) -> str:
    done = started(arguments, folder)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_the_file_runs_as_it_stands(module: Path) -> None:
    fps, efficiency, *_ = run([str(module)], module.parent).split()
    assert float(fps) > 0
    assert 0 < float(efficiency) <= 1
    rows = [line.split() for line in (module.parent / "brightness.txt").read_text().splitlines()]
    assert [(int(frame), float(value)) for frame, value in rows] == [(n, 2.0 * (n % 100)) for n in range(200)]
    assert (module.parent / "brightness.pftrace").stat().st_size > 1000


def test_a_killed_unit_comes_back_and_no_part_of_the_avatar_is_loaded(module: Path) -> None:
    module.write_text(module.read_text() + SPY, encoding="utf-8")
    seen = json.loads(run(["-c", RUN, str(module.parent / "log.txt")], module.parent))
    assert seen["restarts"] == {"left": 0, "right": 1}
    assert set(seen["lost"]) <= {"died:right"}
    assert seen["presented"] + sum(seen["lost"].values()) == seen["requested"] == 120
    assert seen["failure"] is None and seen["replayed"] == []
    assert seen["shares"] == {unit: pytest.approx(1) for unit in ("left", "right")}
    assert seen["efficiency"] > 0
    for modules in (seen["here"], seen["unit"]):
        loaded = {part for part in AVATAR_PARTS for name in modules if name == part or name.startswith(part + ".")}
        assert loaded == set()
    assert "trilane.pipeline.unit_loop" in seen["unit"]


def test_without_the_guard_no_unit_starts_units(module: Path) -> None:
    module.write_text(module.read_text().replace('if __name__ == "__main__":', "if True:"), encoding="utf-8")
    done = started([str(module)], module.parent)
    assert done.returncode == 1
    assert "run_pipeline was called while a unit imported its stages" in done.stderr
    assert 'expected a call under `if __name__ == "__main__":`' in done.stderr
