"""docs/policies-and-edges.md shows what the scheduler does with its small example, letter for letter.

Rule: `TRILANE_WRITE_PRINTED=1` writes the texts anew; their difference is then read.
"""

from __future__ import annotations

import os
import re
from pathlib import Path

import pytest

from trilane.scheduler.policy import POLICIES
from trilane.testing.timelines import EDGES, FRAMES, NS_PER_MS, PERIOD_MS, STAGES, example, figures, timeline

PAGE = Path(__file__).parents[2] / "docs" / "policies-and-edges.md"
BLOCK = re.compile(r"(<!-- (timeline (\S+) (\S+)|figures) -->\n)(.*?)(<!-- end -->)", re.DOTALL)


def drawn(found: re.Match[str]) -> str:
    """The block anew."""
    text = figures() + "\n" if found[2] == "figures" else f"```\n{timeline(found[3], found[4])}\n```\n"
    return found[1] + text + found[6]


def test_the_page_shows_what_the_scheduler_does() -> None:
    page = PAGE.read_text(encoding="utf-8")
    anew = BLOCK.sub(drawn, page)
    if "TRILANE_WRITE_PRINTED" in os.environ:
        PAGE.write_text(anew, encoding="utf-8")
    assert anew.splitlines() == PAGE.read_text(encoding="utf-8").splitlines()
    shown = {(found[3], found[4]) for found in BLOCK.finditer(page)}
    assert shown >= {*((policy, "double") for policy in POLICIES), *(("pipelined", edge) for edge in EDGES)}


def test_one_frame_at_a_time_by_hand() -> None:
    """1 + 3 + 6 + 2 + 1 = 13 ms a frame, whatever the edge; latency ends with composite, after 12."""
    report = example("sequential", "triple").report
    assert report["fps"] == pytest.approx(1000 / 13, rel=1e-3)
    assert report["latency_ms"]["mean"] == report["latency_ms"]["max"] == 12
    lines = timeline("sequential", "double").splitlines()
    assert lines[3] == "infer     dsp  ....000000.......111111.......222222.......333333.......4444"


def test_one_slot_between_stages_by_hand() -> None:
    """Raster cannot write while infer reads, nor infer while composite reads: 3 + 6 + 2 = 11 ms a frame."""
    assert example("pipelined", "single").report["fps"] == pytest.approx(1000 / 11, rel=1e-2)
    assert example("pipelined", "double").report["fps"] == pytest.approx(1000 / 6, rel=1e-2)


@pytest.mark.parametrize("edge", EDGES)
def test_the_newest_frame_waits_for_nobody(edge: str) -> None:
    """Under `latest` every frame is released at its time, and none but the newest waits for a stage."""
    run = example("latest", edge)
    for job in run.jobs:
        if job.stage == "pose":
            assert job.begin_ns >= job.frame * PERIOD_MS * NS_PER_MS
    for stage, _, _ in STAGES[1:]:
        frames = [job.frame for job in run.jobs if job.stage == stage]
        assert frames == sorted(frames)
    presented = sum(job.stage == "present" for job in run.jobs)
    assert presented + sum(run.report["frames"]["dropped"].values()) == FRAMES


def test_no_frame_is_presented_late_under_deadline() -> None:
    """Three periods of 5 ms after its release; a frame alone needs 13."""
    run = example("deadline", "double")
    ends = {job.frame: job.end_ns for job in run.jobs if job.stage == "present"}
    assert all(end <= (frame * PERIOD_MS + 15) * NS_PER_MS for frame, end in ends.items())
    assert run.report["deadline_misses"] == 0
