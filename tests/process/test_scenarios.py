"""Scenarios through real processes of mock units: patterns, verdicts, LoadGen, and runs that end too soon."""

from __future__ import annotations

import os
import signal

import pytest

from support.doubles import pipeline_of_doubles as doubles
from trilane.bench import scenario
from trilane.bench.scenario import Load
from trilane.errors import TrilaneError
from trilane.pipeline.controls import FrameRequestQueue

pytestmark = pytest.mark.usefixtures("nothing_left")


@pytest.mark.parametrize(("name", "queries"), [("single-stream", 64), ("server", 662), ("offline", 64)])
def test_every_query_is_answered_and_judged(name: str, queries: int) -> None:
    asked = Load(name, seconds=0.1, rate=300, limit_ms=60_000)  # 64 frames take 0.128 s at least: two stages of 1 ms
    row, summary = scenario.run_scenario(doubles(), {}, asked, "trilane", "pipelined")
    assert (row["verdict"], row["because"], summary) == ("VALID", "", "")
    assert row["queries"] >= queries
    assert 0 < row["p50_ms"] <= row["percentile_ms"] <= row["max_ms"]


def test_a_query_of_several_frames_takes_longer_than_one(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(scenario.PERCENTILES, "multi-stream", 0.9)
    pipeline = doubles(infer=5)
    one, _ = scenario.run_scenario(pipeline, {}, Load("single-stream", seconds=0.1), "trilane", "pipelined")
    four, _ = scenario.run_scenario(pipeline, {}, Load("multi-stream", seconds=0.1, samples=4), "trilane", "pipelined")
    assert one["p50_ms"] >= 5 + 4  # infer and four stages of 1 ms
    assert four["p50_ms"] >= 4 * 5 + 4  # the DSP makes one frame at a time


def test_a_server_that_is_too_slow_is_invalid_and_says_why() -> None:
    asked = Load("server", seconds=0.1, rate=500, limit_ms=1)
    row, _ = scenario.run_scenario(doubles(), {}, asked, "trilane", "pipelined")
    assert row["verdict"] == "INVALID"
    assert "took longer than 1 ms" in row["because"]


@pytest.mark.parametrize("name", ["single-stream", "server"])
def test_loadgen_finds_it_valid(name: str) -> None:
    pytest.importorskip("mlperf_loadgen")
    asked = Load(name, seconds=0.2, rate=300, limit_ms=60_000)
    row, summary = scenario.run_scenario(doubles(), {}, asked, "loadgen", "pipelined")
    assert row["verdict"] == "VALID"
    assert "Result is : VALID" in summary


@pytest.mark.parametrize("judge", ["trilane", "loadgen"])
def test_a_stage_that_fails_ends_the_scenario_with_its_sentence(judge: str) -> None:
    if judge == "loadgen":
        pytest.importorskip("mlperf_loadgen")
    asked = Load("single-stream", seconds=0.1)
    with pytest.raises(TrilaneError, match=r"mock\.npz: found nothing"):
        scenario.run_scenario(doubles(raster="raise"), {}, asked, judge, "pipelined")


@pytest.mark.parametrize("judge", ["trilane", "loadgen"])
@pytest.mark.parametrize("edge", ["triple", "orphan"])
def test_a_frame_that_an_edge_drops_ends_the_scenario_at_once_with_its_cause(
    edge: str, judge: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Poses wait for a slow raster: the mailbox keeps the newest alone, so the eight queries of the warm-up have no
    eight answers. Before, the bench waited until nothing had been answered for `STALLED_S`."""
    if judge == "loadgen":
        pytest.importorskip("mlperf_loadgen")
    monkeypatch.setattr(scenario, "STALLED_S", 30.0)
    pipeline = doubles(raster=20).with_rule(edge)
    with pytest.raises(TrilaneError, match=r"dropped or lost \(.*pose->raster:\w+ \d.*every query must be answered"):
        scenario.run_scenario(pipeline, {}, Load("server", seconds=60, rate=300), judge, "pipelined")


def test_an_interrupt_ends_a_scenario(monkeypatch: pytest.MonkeyPatch) -> None:
    def ask_and_interrupt(_load: Load, requests: FrameRequestQueue, queries: scenario.Queries) -> None:
        queries.ask(requests, 5)
        os.kill(os.getpid(), signal.SIGINT)

    monkeypatch.setitem(scenario.PATTERNS, "offline", ask_and_interrupt)
    with pytest.raises(KeyboardInterrupt):
        scenario.run_scenario(doubles(), {}, Load("offline", seconds=60), "trilane", "pipelined")
