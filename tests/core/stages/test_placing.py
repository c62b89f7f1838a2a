"""How a run is placed: what is kept, tried and said, and when real frames are asked; what takes time is a double."""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from trilane.pipeline.rehearsal import Round
from trilane.scheduler.placement import CpuCore, Place, Ranked
from trilane.stages import placing
from trilane.stages.placing import TriedPlacement, choice

ANY: Any = None
CORES = (CpuCore(0, 0), CpuCore(1, 1))


def asked(frames: int = 100, pace_ns: Any = (), **cores: tuple[int, ...]) -> Any:
    config = SimpleNamespace(pace_ns=pace_ns, scene=SimpleNamespace(frames=frames))
    return SimpleNamespace(config=config, asked_cores=cores)


@pytest.mark.parametrize(
    ("run", "cores", "why"),
    [
        (asked(), CORES[:1], "there is one core"),
        (asked(), CORES, ""),
        (asked(99), CORES, "fewer than 100 frames, too short to measure"),
        (asked(pace_ns={"infer": 1}), CORES, "the units are held to the pace of a chip"),
        (asked(cpu=(0,), gpu=(0,), dsp=(0, 1)), CORES, "as asked"),
    ],
)
def test_why_nothing_is_measured(run: Any, cores: Any, why: str) -> None:
    assert placing._why_not(run, cores) == why


PLACES = [{"cpu": Place((0,), 1), "dsp": Place(cores, 1)} for cores in ((1,), (0,), (0, 1))]
CANDIDATES = [Ranked(place, 1000 + n) for n, place in enumerate(PLACES)]


@pytest.fixture
def machine(monkeypatch: pytest.MonkeyPatch) -> Callable[..., list[str]]:
    """Other programs have `shares` of the cores, one look after the other; the rounds are `frame_ns`. What was said."""

    def made(shares: list[float], *frame_ns: tuple[float, ...]) -> list[str]:
        left, said = list(shares), list[str]()
        monkeypatch.setattr(placing, "OtherPrograms", lambda _: SimpleNamespace(share=lambda: left.pop(0)))
        monkeypatch.setattr(placing.time, "sleep", lambda seconds: said.append(f"looks for {seconds} s"))

        def tried(
            _checked: Any, placements: Any, rounds: int, _starter: Any, limit_s: float, least: int
        ) -> list[Round]:
            assert (placements, rounds, limit_s, least) == (PLACES, 6, 5.0, 3)
            return [Round(each, left.pop(0)) for each in frame_ns]

        monkeypatch.setattr(placing, "tried", tried)
        return said

    return made


def test_frames_decide_on_a_quiet_machine(machine: Callable[..., list[str]]) -> None:
    said = machine([0.02, 0.05, 0.3, 0.0], (9e6, 6e6, 8e6), (30e6, 20e6, 10e6), (9e6, 7e6, 8e6))
    found = choice(ANY, (0, 1), CANDIDATES, ANY, said.append)
    assert found == TriedPlacement(1, "the fastest of 3 that were tried", (9.0, 7.0, 8.0))
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

    assert choice(ANY, (0, 1), CANDIDATES, ANY, said.append, kept) == TriedPlacement(
        0, f"the least predicted frame time; {why}"
    )
    assert (stored, len(said)) == ([], 2 if len(shares) > 1 else 1)


def test_what_was_found_before_is_taken_as_it_is(machine: Callable[..., list[str]]) -> None:
    machine([])
    found = choice(ANY, (0, 1), CANDIDATES, ANY, kept=lambda _: {"frame_ns": np.array([[3e6, 2e6, 1e6]])})
    assert (found.best, found.frame_ms) == (2, (3.0, 2.0, 1.0))
    assert choice(ANY, (0, 1), CANDIDATES[:1], ANY) == TriedPlacement(0, "the least predicted frame time")
