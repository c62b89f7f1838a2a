"""Which placement real frames choose, and when they are not asked; everything that takes time is a double."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import psutil
import pytest

from trilane.bench.placement import rank_correlation
from trilane.machine import Machine
from trilane.pipeline import other_programs
from trilane.pipeline.other_programs import OtherPrograms, busy_s
from trilane.pipeline.trial import Round
from trilane.scheduler.placement import Ranked
from trilane.scheduler.places import Place
from trilane.stages import choosing
from trilane.stages.choosing import Choice, choice

STEP_S = 1 / os.sysconf("SC_CLK_TCK")
PLACES = [{"cpu": Place((0,), 1), "dsp": Place(cores, 1)} for cores in ((1,), (0,), (0, 1))]
CANDIDATES = [Ranked(place, 1000 + n) for n, place in enumerate(PLACES)]
ANY: Any = None


@pytest.fixture
def machine(monkeypatch: pytest.MonkeyPatch) -> Callable[..., list[str]]:
    """Other programs have `shares` of the cores, one look after the other; the rounds are `frame_ns`. What was said."""

    def made(shares: list[float], *frame_ns: tuple[float, ...]) -> list[str]:
        left, said = list(shares), list[str]()
        monkeypatch.setattr(choosing, "OtherPrograms", lambda _: SimpleNamespace(share=lambda: left.pop(0)))
        monkeypatch.setattr(choosing.time, "sleep", lambda seconds: said.append(f"looks for {seconds} s"))

        def tried(
            _checked: Any, placements: Any, rounds: int, _starter: Any, limit_s: float, least: int
        ) -> list[Round]:
            assert (placements, rounds, limit_s, least) == (PLACES, 6, 5.0, 3)
            return [Round(each, left.pop(0)) for each in frame_ns]

        monkeypatch.setattr(choosing, "tried", tried)
        return said

    return made


def test_frames_decide_on_a_quiet_machine(machine: Callable[..., list[str]]) -> None:
    said = machine([0.02, 0.05, 0.3, 0.0], (9e6, 6e6, 8e6), (30e6, 20e6, 10e6), (9e6, 7e6, 8e6))
    found = choice(ANY, (0, 1), CANDIDATES, ANY, said.append)
    assert found == Choice(1, "the fastest of 3 that were tried", (9.0, 7.0, 8.0))
    assert said[0] == "looks for 0.25 s"
    assert said[1:] == ["trying 3 placements with frames of the scene (once for this avatar, scene and machine) ..."]


def test_what_is_shown_is_what_decides(machine: Callable[..., list[str]]) -> None:
    """The second is a tenth faster in two rounds of three; the medians of its times alone, 12 and 14, say otherwise.

    Medians of the rounds: 10, 30, 14. Times over them: 1, 1, 6/7; 0.9, 0.9, 1; 2, 2, 2.
    """
    machine([0.0] * 5, (10e6, 9e6, 20e6), (30e6, 27e6, 60e6), (12e6, 14e6, 28e6))
    found = choice(ANY, (0, 1), CANDIDATES, ANY)
    assert found.best == 1
    assert found.frame_ms == pytest.approx((14.0, 12.6, 28.0))


@pytest.mark.parametrize(
    ("shares", "why"),
    [
        ([0.45], "not tried while other programs have 45% of the cores"),
        ([0.0, 0.2, 0.0, 0.3], "not tried while other programs have 20% of the cores"),
    ],
)
def test_on_a_busy_machine_the_prediction_decides_and_nothing_is_kept(
    machine: Callable[..., list[str]], shares: list[float], why: str
) -> None:
    said = machine(shares, (9e6, 6e6, 8e6), (9e6, 6e6, 8e6), (9e6, 6e6, 8e6))
    stored: list[Any] = []

    def kept(make: Callable[[], Any]) -> Any:
        stored.append(make())
        return stored[-1]

    assert choice(ANY, (0, 1), CANDIDATES, ANY, said.append, kept) == Choice(
        0, f"the least predicted frame time; {why}"
    )
    assert (stored, len(said)) == ([], 2 if len(shares) > 1 else 1)


def test_what_was_found_before_is_taken_as_it_is(machine: Callable[..., list[str]]) -> None:
    machine([])
    found = choice(ANY, (0, 1), CANDIDATES, ANY, kept=lambda _: {"frame_ns": np.array([[3e6, 2e6, 1e6]])})
    assert (found.best, found.frame_ms) == (2, (3.0, 2.0, 1.0))
    assert choice(ANY, (0, 1), CANDIDATES[:1], ANY) == Choice(0, "the least predicted frame time")


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

    monkeypatch.setattr(other_programs, "psutil", SimpleNamespace(Process=Process))
    monkeypatch.setattr(other_programs, "time", SimpleNamespace(monotonic=lambda: now[0]))
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

    monkeypatch.setattr(other_programs, "OtherPrograms", Others)
    share = other_programs.beside_units((0, 1), {"cpu": 11, "gpu": 12})
    assert asked == [((0, 1), [11, 12])]
    assert (share({"cpu": 11, "gpu": 12}), share({"cpu": 11, "gpu": 14})) == (0.5, None)
    assert other_programs.beside_units((0,), {"cpu": 13})({"cpu": 13}) is None
    assert share({"cpu": 11, "gpu": 12}) is None


def test_ranks_that_agree_and_ranks_that_do_not() -> None:
    """By hand: 1 - 6 sum(d^2) / (n (n^2 - 1)) without equal values."""
    assert rank_correlation([1, 5, 9, 700], [2, 3, 4, 5]) == pytest.approx(1)
    assert rank_correlation([1, 2, 3], [9, 8, 7]) == pytest.approx(-1)
    assert rank_correlation([1, 2, 3, 4, 5], [2, 1, 4, 3, 5]) == pytest.approx(1 - 6 * 4 / (5 * 24))
    # ranks 1, 2.5, 2.5, 4 and 1, 2, 3, 4: covariance 2.25 + 0 + 0 + 2.25 = 4.5, spreads 4.5 and 5
    assert rank_correlation([1, 2, 2, 3], [1, 2, 3, 4]) == pytest.approx(4.5 / (4.5 * 5) ** 0.5)
    assert rank_correlation([1, 1], [1, 2]) is None
    with pytest.raises(ValueError, match="argument 2"):
        rank_correlation([1, 2], [1])
