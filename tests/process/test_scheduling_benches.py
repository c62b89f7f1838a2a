"""The benches of the scheduler, with few repeats: they answer, agree with their peers, and say who is absent."""

from __future__ import annotations

import os
import re
import sys
from pathlib import Path

import pytest

from trilane.bench import handoff, pipeline, scheduler
from trilane.bench.lib import handoff_variants
from trilane.errors import BadInputError
from trilane.scheduler.ledger import JobRecord
from trilane.units import NO_FIGURES


def job(ready: int, dispatch: int, begin: int, end: int) -> JobRecord:
    return JobRecord("infer", "dsp", 0, ready, dispatch, begin, end)


def test_idle_time_between_jobs_has_one_cause_for_every_nanosecond() -> None:
    jobs = [
        job(0, 0, 0, 10),
        job(5, 6, 12, 20),  # held: 2 until it began
        job(30, 33, 37, 60),  # 10 without input, 3 until the scheduler told, 4 until it began
        job(50, 65, 65, 100),  # 5 with input, not told
    ]
    shares = pipeline.idle_between_jobs(jobs)
    assert shares == pytest.approx({"idle": 0.24, "starved": 0.10, "undispatched": 0.08, "overhead": 0.06})


def test_the_pipeline_is_set_against_its_stages_alone(drawable_bundle: Path) -> None:
    result = pipeline.measure(
        avatar=(str(drawable_bundle),), size=("64x64",), edge=("double", "orphan"), frames=20, rounds=1, runtime="ort"
    )
    rows = {(row["policy"], row["edge"]): row for row in result["rows"]}
    assert set(rows) == {("sequential", "double"), ("pipelined", "double"), ("pipelined", "orphan")}
    for row in rows.values():
        assert 0 < row["idle"] < 1
        assert row["idle"] == pytest.approx(row["starved"] + row["undispatched"] + row["overhead"])
        assert row["bound"] > 1
        assert row["of_bound_low"] <= row["gain_of_bound"] <= row["of_bound_high"]
        assert row["gain_of_bound"] == pytest.approx(row["gain"] / row["bound"])
    assert rows["sequential", "double"]["gain"] == 1
    (accuracy,) = result["accuracy"].values()
    assert accuracy["source"] == NO_FIGURES
    assert "never validated" in accuracy["why"]


@pytest.mark.parametrize(
    "asked",
    [{"frames": 3}, {"rounds": 0}, {"cores": (99,)}, {"size": ("63x64",)}, {"policy": ("x",)}, {"edge": ("x",)}],
)
def test_a_pipeline_that_cannot_be_measured_is_refused(asked: dict[str, object]) -> None:
    with pytest.raises(BadInputError):
        pipeline.measure(**asked)  # type: ignore[arg-type]


def peers_files() -> set[Path]:
    """What iceoryx2 keeps in memory and on disk, but for the channels of other processes."""
    found = {*handoff_variants.SHM.glob("io*"), *Path("/tmp").glob("io*")}  # noqa: S108 - looked at
    own = f"iox-{os.getpid()}-"
    return {path for path in found if path.name.startswith(own) or not re.match(r"iox-\d+-", path.name)}


def test_every_way_hands_over_the_same_bytes() -> None:
    before = peers_files()
    result = handoff.measure(kib=(256,), frames=10, rounds=1)
    ways = {row["way"] for row in result["rows"]}
    assert {"slot", handoff.PIPELINE, "pickled queue"} <= ways
    assert ways | set(result["absent"]) == {*handoff.CHANNELS, handoff.PIPELINE}
    for row in result["rows"]:
        assert row["frames"] == 10
        assert 0 < row["p50_low_us"] <= row["p50_us"] <= row["p50_high_us"] <= row["max_us"]
        assert row["p99_us"] is row["read_p99_us"] is None  # of ten frames
        assert row["read_p50_us"] > row["p50_us"]
    assert result["met"] == {"slot": None, handoff.PIPELINE: None}
    assert peers_files() == before


def test_virtual_time_agrees_with_simpy_and_repeats_itself() -> None:
    pytest.importorskip("simpy")
    result = scheduler.measure(minutes=0.1, rounds=1, seeds=3)
    ways = ["trilane", "trilane, no report", "trilane, recorded", "simpy", "simpy lean"]
    assert [row["way"] for row in result["rows"]] == ways
    assert set(result["over_trilane"]) == {*ways[1:]}
    assert {row["way"]: row["processed"] for row in result["rows"]}["simpy lean"] == 360 * 6  # a timeout for each event
    assert result["agree"] == 360
    assert result["same_traces"] == result["different_traces"] == 3


def test_without_simpy_the_bench_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "simpy", None)
    result = scheduler.measure(minutes=0.05, rounds=1, seeds=1)
    assert {row["way"].partition(",")[0] for row in result["rows"]} == {"trilane"}
    assert result["over_simpy"] is result["over_simpy_lean"] is None
    assert "pip install" in result["absent"]["simpy"]
