"""A graph on real processes: forks without copies, joins, newest inputs, slow branches, and units that die."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from support.faults import unit_process
from support.graph_stages import graph, stage
from trilane.pipeline.description import Pipeline, StageInput
from trilane.pipeline.journal import journal_of
from trilane.pipeline.run import run_pipeline
from trilane.pipeline.timeline import Gone, Presented, Timeline
from trilane.pipeline.unit_starter import UnitStarter
from trilane.scheduler.recording import replay

pytestmark = pytest.mark.usefixtures("nothing_left")


def branches(folder: Path, ms: float = 0) -> Pipeline:
    """A source, two branches that meet, and a slow branch whose newest result the sink takes."""
    return graph(
        stage("source", "a", "frame"),
        stage("twice", "b", "twice", "source", ms=ms),
        stage("plus", "c", "plus", "source", ms=ms + 4),
        stage("slow", "d", "plus", "source", every=3, ms=ms),
        stage("meet", "e", "sum", "twice", "plus"),
        stage("sink", "b", "sum", "meet", StageInput(stage="slow", latest=True), log=str(folder / "sink.txt")),
    )


def lines(file: Path) -> np.ndarray:
    return np.loadtxt(file, np.int64, ndmin=2)


def test_branches_meet_frame_by_frame_and_a_slow_one_gives_its_newest(starter: UnitStarter, tmp_path: Path) -> None:
    """Frame n: the join has 2n + n + 1000, and the sink adds m + 1000 of the newest m, a multiple of 3."""
    result = run_pipeline(branches(tmp_path), frames=60, starter=starter)
    assert (result.presented, result.lost, result.dropped, result.failure) == (60, {}, {}, None)
    frame, value, met, newest = lines(tmp_path / "sink.txt").T
    assert frame.tolist() == met.tolist() == list(range(60))
    held = newest >= 0
    assert held[10:].all() and (newest[held] % 3 == 0).all() and (newest[held] <= frame[held] + 6).all()
    assert (value == 3 * frame + 1000 + np.where(held, newest + 1000, 0)).all()
    assert {name: row.jobs for name, row in result.report.stages.items()} == {
        name: 20 if name == "slow" else 60 for name in ("source", "twice", "plus", "slow", "meet", "sink")
    }
    assert result.report.streams["slow"].age_ms.samples == held.sum()
    assert 0 < result.report.latency_ms.mean < 10_000
    assert list(replay(result.recording)) == []
    told = [record for record in journal_of(result.recording, result.jobs, {}, {})]
    timeline = Timeline(result.recording.graph, result.recording.settings, waits=True, idle=True)
    shown = [fact for record in told[1:] for fact in timeline.add(record) if isinstance(fact, Presented)]
    assert [fact.frame for fact in shown] == list(range(60)) and timeline.frames == {}
    assert np.mean([fact.latency_ns for fact in shown]) / 1e6 == pytest.approx(result.report.latency_ms.mean)
    assert result.report.units["e"].idle.join > 0.1 and "join" not in result.report.units["d"].as_json()["idle"]


@pytest.mark.parametrize("unit", ["b", "c", "d", "e"])
def test_a_unit_killed_again_and_again_in_a_branch_comes_back(unit: str, starter: UnitStarter, tmp_path: Path) -> None:
    """Five deaths in each of four branches: no deadlock, every frame is counted once, and values stay right."""
    killed: list[int] = []

    def kill(presented: int, _requested: int) -> None:
        if len(killed) < 5 and presented >= 15 * (len(killed) + 1):
            killed.append(presented)
            unit_process(unit).kill()

    result = run_pipeline(branches(tmp_path, ms=2), frames=100, pace_fps=100, starter=starter, on_progress=kill)
    assert (len(killed), result.failure) == (5, None)
    assert result.report.units[unit].restarts == 5
    lost = sum(result.lost.values())
    assert result.presented + lost == 100 and not result.dropped
    assert lost <= 5  # a dead unit loses the frame that it worked on, and none when that was side work
    frame, value, met, newest = lines(tmp_path / "sink.txt").T
    assert (frame == met).all() and len(set(frame)) == len(frame)
    assert (value == 3 * frame + 1000 + np.where(newest >= 0, newest + 1000, 0)).all()
    assert list(replay(result.recording)) == []
    timeline = Timeline(result.recording.graph, result.recording.settings, waits=True)
    facts = [
        fact
        for record in list(journal_of(result.recording, result.jobs, {}, {}))[1:]
        for fact in timeline.add(record)
        if isinstance(fact, Presented | Gone)
    ]
    numbers = [fact.frame for fact in facts]
    assert sorted(numbers) == list(range(100)), "each frame is presented or lost, and the journal says which"
    assert len(timeline.downs) in (4, 5), "the run may end before the unit is back from its last death"
    assert max(down.end_ns - down.begin_ns for down in timeline.downs) < 1_000_000_000
