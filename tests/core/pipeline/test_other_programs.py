"""Other programs' share of the cores, from what the kernel counts: by hand."""

from __future__ import annotations

import os
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import psutil
import pytest

from trilane.machine import Machine
from trilane.pipeline import surroundings
from trilane.pipeline.surroundings import OtherPrograms, busy_s

STEP_S = 1 / os.sysconf("SC_CLK_TCK")


def stat(*cores: tuple[int, ...]) -> str:
    rows = [f"cpu{number} {' '.join(map(str, fields))}" for number, fields in enumerate(cores)]
    return "\n".join(["cpu 9 9 9 9 9 9 9 9 9 9", *rows, "intr 5 cpu0", ""])


def test_what_cores_did_since_the_system_began() -> None:
    """user, nice, system, irq, softirq and steal; not idle, iowait, and what guests had of user and nice."""
    text = stat((1, 2, 4, 1000, 1000, 8, 16, 32, 1, 1), (100, 0, 0, 0, 0, 0, 0, 0, 0, 0))
    assert busy_s(text, [0]) == pytest.approx(63 * STEP_S)
    assert busy_s(text, [1, 0]) == pytest.approx(163 * STEP_S)
    assert busy_s(stat(*[(0,) * 10] * 10, (7, *(0,) * 9)), [1]) == 0  # cpu10 is not cpu1


def test_the_share_of_others_is_what_is_not_ours(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """In 2 s two cores were busy for 1.5 s, of which this process had 0.3 s and a unit 0.2 s: 1 s of 4 are others'."""
    file, now = tmp_path / "proc/stat", [10.0]
    file.parent.mkdir()
    monkeypatch.setattr("trilane.machine.here", Machine(tmp_path))
    used = {os.getpid(): 1.0, 77: 5.0}

    class Process:
        def __init__(self, pid: int) -> None:
            self._pid = pid

        def cpu_times(self) -> SimpleNamespace:
            return SimpleNamespace(user=used[self._pid] - 0.1, system=0.1)

    monkeypatch.setattr(surroundings, "psutil", SimpleNamespace(Process=Process))
    monkeypatch.setattr(surroundings, "time", SimpleNamespace(monotonic=lambda: now[0]))
    idle = (0,) * 9
    file.write_text(stat((round(8 / STEP_S), *idle), (0, *idle)))
    others = OtherPrograms((0, 1), [77])
    file.write_text(stat((round(9 / STEP_S), *idle), (round(0.5 / STEP_S), *idle)))
    used.update({os.getpid(): 1.3, 77: 5.2})
    now[0] = 12.0
    assert others.share() == pytest.approx(0.25)
    used[77] = 9.0
    assert others.share() == 0
    used[77] = -9.0
    assert others.share() == 1


def test_beside_units_that_live_others_have_a_share_and_beside_a_dead_one_nobody_knows(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    asked: list[Any] = []

    class Others:
        def __init__(self, cores: Any, pids: Any) -> None:
            asked.append((cores, pids))
            if 13 in pids:
                raise psutil.NoSuchProcess(13)

        def share(self) -> float:
            if len(asked) > 1:
                raise psutil.NoSuchProcess(12)
            return 0.5

    monkeypatch.setattr(surroundings, "OtherPrograms", Others)
    share = surroundings.beside_units((0, 1), {"cpu": 11, "gpu": 12})
    assert asked == [((0, 1), [11, 12])]
    assert (share({"cpu": 11, "gpu": 12}), share({"cpu": 11, "gpu": 14})) == (0.5, None)
    assert surroundings.beside_units((0,), {"cpu": 13})({"cpu": 13}) is None
    assert share({"cpu": 11, "gpu": 12}) is None
