"""`bench pipeline --beside`: what is made of two runs that are told, and what the command asks for."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import pytest

from trilane.bench import beside, pipeline
from trilane.bench.lib.avatar_process import Asked, Ran
from trilane.errors import TrilaneError
from trilane.hw_profiles.host import usable_cores
from trilane.scheduler.ledger import JobRecord
from trilane.scheduler.placement import SCHEDULER_NS

MS = 1_000_000
#: Milliseconds of each stage; the first has less, for what the scheduler takes counts with it.
STAGES = {"pose": 1.5, "raster": 3, "infer": 4, "composite": 2, "present": 1}
UNITS = {"pose": "cpu", "raster": "gpu", "infer": "dsp", "composite": "gpu", "present": "cpu"}
ONE_CORE = dict.fromkeys(("cpu", "gpu", "dsp"), "0")
ASKED = Asked("default", "64x64", 20, "ort", (0,), video=True)


def run_of(frame_ms: float, waits_ms: float = 0.0, frames: int = 11, begin_ms: float = 0.0) -> Ran:
    """A run whose frames are presented every so many ms; each job waits for its core so long."""
    jobs = []
    for frame in range(frames):
        for stage, ms in STAGES.items():
            end_ns = round((begin_ms + (frame + 1) * frame_ms) * MS)
            begin_ns = end_ns - round((ms + waits_ms) * MS)
            jobs.append(JobRecord(stage, UNITS[stage], frame, 0, 0, begin_ns, end_ns, round(waits_ms * MS)))
    return Ran(tuple(jobs), ONE_CORE)


class ToldProcess:
    """Answers with the runs that it was given, by their policies; `begun`: which were asked for, of all processes."""

    def __init__(self, runs: dict[str, list[Ran]], begun: list[str]) -> None:
        self.runs, self.begun, self.policy = runs, begun, ""

    def begin(self, policy: str) -> None:
        self.begun.append(policy)
        self.policy = policy

    def result(self) -> Ran:
        return self.runs[self.policy].pop(0)


def told(runs: Sequence[dict[str, list[Ran]]], begun: list[str]) -> Any:
    @contextmanager
    def processes(asked: Sequence[Asked]) -> Iterator[list[ToldProcess]]:
        assert len(asked) == len(runs)
        yield [ToldProcess(each, begun) for each in runs]

    return processes


def test_two_runs_on_one_core_are_set_against_twice_the_work_of_a_frame() -> None:
    """Both need 12 ms of one core for a frame, which is never idle: 24 ms a frame each. Measured: 26.4 and 21.6 ms."""
    assert len(STAGES) * SCHEDULER_NS == 0.5 * MS
    begun: list[str] = []
    runs = [{"sequential": [run_of(12), run_of(12)], "pipelined": [run_of(frame_ms)]} for frame_ms in (26.4, 21.6)]
    first, second = beside.measure_beside([ASKED, ASKED], 1, told(runs, begun))
    assert begun == ["sequential"] * 2 + ["pipelined"] * 2 + ["sequential"] * 2
    assert first["virtual_ms"] == pytest.approx(24, rel=0.01)
    assert first["ratio"] == pytest.approx(1.1, rel=0.01)
    assert second["ratio"] == pytest.approx(0.9, rel=0.01)
    assert first["isolated_ms"] == pytest.approx(11.5)
    assert (first["pipeline"], second["pipeline"], first["size"]) == (1, 2, "64x64")
    assert first["strangers"] == 0


def test_waits_for_a_core_are_no_work_and_say_how_quiet_the_machine_was() -> None:
    waits = [run_of(30, waits_ms=2.3) for _ in range(2)]
    row, _ = beside.measure_beside(
        [ASKED, ASKED], 1, told([{"sequential": list(waits), "pipelined": [run_of(24)]} for _ in range(2)], [])
    )
    assert row["isolated_ms"] == pytest.approx(11.5)
    assert row["strangers"] == pytest.approx(5 * 2.3 / 11.5)


def test_a_row_is_the_median_of_its_rounds() -> None:
    """Each round's stages are those of the sequential runs before and after it."""

    def runs() -> dict[str, list[Ran]]:
        return {"sequential": [run_of(12) for _ in range(4)], "pipelined": [run_of(ms) for ms in (24, 48, 25)]}

    row, _ = beside.measure_beside([ASKED, ASKED], 3, told([runs(), runs()], []))
    assert row["frame_ms"] == 25
    assert (row["ratio_low"], row["ratio_high"]) == pytest.approx((1, 2), rel=0.01)


def test_only_the_time_in_which_both_ran_counts() -> None:
    """The second begins 50 ms later: of the first 11 frames of 10 ms those from 60 to 110 ms count."""
    runs = [run_of(10).jobs, run_of(20, begin_ms=40).jobs]
    assert beside.overlapping_ms(runs) == [10, 20]


def test_runs_that_hardly_met_are_an_error() -> None:
    with pytest.raises(TrilaneError, match="met for 1 frames"):
        beside.overlapping_ms([run_of(10).jobs, run_of(10, begin_ms=100).jobs])


def test_the_command_asks_for_both_avatars(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[Any] = []
    monkeypatch.setattr(pipeline, "measure_beside", lambda which, rounds: asked.append((which, rounds)) or ["row"])
    result = pipeline.measure(
        size=("256",),
        frames=30,
        rounds=2,
        cores=(1,),
        edge=("single",),
        video=False,
        beside="default",
        beside_size="64",
    )
    cores = usable_cores()[:1]
    assert asked == [([Asked("default", size, 30, "auto", cores, False, "single") for size in ("256", "64")], 2)]
    assert result["rows"] == ["row"]
    assert result["config"] == {"frames": 30, "rounds": 2, "runtime": "auto", "video": False, "cores": 1}
