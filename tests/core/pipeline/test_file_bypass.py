"""The bypass of a pipeline file: what a run of it gets, where arrays come from, and what is told of it."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from support.pipeline_files import write_file
from trilane.apps.run.run_file import pipeline_of
from trilane.pipeline.file_graph import bypass_of, edge_rules, graph_of, settings_of, skips_of
from trilane.pipeline.journal import journal_of
from trilane.pipeline.pipeline_file import PipelineFile, read_pipeline
from trilane.pipeline.stage import PortedStage, Skip
from trilane.pipeline.timeline import Presented, Timeline
from trilane.scheduler.virtual import simulate
from trilane.stages.blocks.own_code import Busy
from trilane.transport.packets import header_dtype

TEXT = """
[run]
fps = 50
edge = "fifo:3"
[stages]
look = { python = "own:look", unit = "cpu", out = { picture = "u8 2x3x3", heat = "f32 4" }, bypass = "draw" }
find = { python = "own:find", unit = "dsp", in = { x = "look.picture" }, out = { picture = "u8 2x3x3", heat = "i8 4" } }
draw = { python = "own:draw", unit = "cpu", in = { p = "find.picture", h = "find.heat" } }
"""
MS = 1_000_000


def read(folder: Path, text: str = TEXT) -> PipelineFile:
    return read_pipeline(write_file(folder, text))


def test_a_run_has_a_chain_whose_ends_know_the_bypass(tmp_path: Path) -> None:
    """Nothing is called before the run, as stages may count their calls."""
    made = pipeline_of(read(tmp_path), tmp_path)
    assert made.graph() == graph_of(read(tmp_path), edge_rules(read(tmp_path)))
    assert (made.bypass, made.graph().is_chain, made.warms_up) == (("look", "draw"), True, False)
    assert made.edges_into("draw") == ("find->draw", "look->find")
    look, find, draw = (stage.settings for stage in made.stages)
    assert look["keys"]["bypass"]["to"] == "draw" and "bypass" not in find["keys"] | draw["keys"]
    assert draw["bypass"] == {"behind": 3, "ports": {"picture": "u8 2x3x3", "heat": "f32 4"}}
    assert (look.get("bypass"), find.get("bypass")) == (None, None)


class Kept(PortedStage):
    """Keeps what it gets."""

    def work(self, frame: int, arrays: Any, outputs: Any) -> dict[str, float]:  # noqa: ARG002
        self.got = arrays
        return {}


def test_at_the_end_a_port_comes_from_the_begin_where_it_is_the_same(tmp_path: Path) -> None:
    """The picture has the same name and type on both ways; the heat has another type, so there is none."""
    draw = Kept(pipeline_of(read(tmp_path), tmp_path).stages[2].settings)
    slots = [SimpleNamespace(header=np.zeros((), header_dtype()), payload=np.full(128, n, np.uint8)) for n in range(6)]
    draw.bind(slots, [])
    draw.run(0, 2, None)
    picture, heat = draw.got
    assert (picture.shape, heat.shape, picture[0, 0, 0]) == ((2, 3, 3), (4,), 2)
    draw.run(1, 4, None)
    picture, heat = draw.got
    assert (picture.shape, picture[1, 2, 2], heat, picture.flags.writeable) == ((2, 3, 3), 4, None, False)


def test_a_load_sends_round_the_frames_that_the_file_says(tmp_path: Path) -> None:
    text = '[stages]\na = { block = "busy", unit = "u", load_ms = 0, bypass = { to = "c", pattern = "011" } }\n'
    text += "".join(
        f'{name} = {{ block = "busy", unit = "u", load_ms = 0, in = "{of}" }}\n' for of, name in ("ab", "bc")
    )
    file = read(tmp_path, text)
    stage = Busy(pipeline_of(file, tmp_path).stages[0].settings)
    sent = [isinstance(stage.work(frame, (), {}), Skip) for frame in range(6)]
    assert sent == [False, True, True] * 2 == [skips_of(file)(frame, False) for frame in range(6)]
    assert bypass_of(file) == ("a", "c")


def test_random_frames_are_as_many_as_the_share_says_and_the_same_for_a_seed(tmp_path: Path) -> None:
    """Of 40,000 frames 10,000 are expected, with a standard deviation of 87; of pairs 2,500, with about 60."""
    file = read(tmp_path, TEXT.replace('"draw" }', '{ to = "draw", share = 0.25 } }'))
    first, second = ([skips_of(file, seed)(frame, False) for frame in range(40_000)] for seed in (0, 1))
    assert first == [skips_of(file)(frame, False) for frame in range(40_000)] != second
    for drawn in (first, second):
        assert sum(drawn) == pytest.approx(10_000, abs=3 * 87)
    pairs = sum(one and other for one, other in pairwise(first))
    assert pairs == pytest.approx(2_500, abs=3 * 60), "a frame says nothing of the next"


def test_the_latency_that_is_told_begins_with_the_release_as_the_schedulers_does(tmp_path: Path) -> None:
    """look 12, find 30 ms and draw 1 ms at 50 fps: the source is faster than find, so that frames wait before look."""
    file = read(tmp_path, TEXT.replace('"draw" }', '{ to = "draw", pattern = "0001" } }'))
    times = {"look": 12 * MS, "find": 30 * MS, "draw": MS}
    graph = graph_of(file, edge_rules(file))
    done = simulate(graph, settings_of(file, 40), lambda stage, *_: times[stage], skips=skips_of(file), keep=True)
    assert done.recording is not None
    timeline = Timeline(graph, done.recording.settings, waits=True)
    facts = [
        fact
        for record in list(journal_of(done.recording, done.jobs, {}, {}))[1:]
        for fact in timeline.add(record)
        if isinstance(fact, Presented)
    ]
    told = [fact.latency_ns for fact in facts if fact.latency_ns is not None]
    assert len(told) == 40
    assert sum(told) / 40 / MS == pytest.approx(done.report["latency_ms"]["mean"])
    assert done.report["latency_ms"]["max"] > 100, "the wait for the first stage counts"
