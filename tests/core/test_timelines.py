"""docs/policies-and-edges.md shows what the scheduler does with a small example of every policy and edge, as text.

Rule: `TRILANE_WRITE_PRINTED=1` writes the texts anew; their difference is then read.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from dataclasses import replace
from functools import cache
from pathlib import Path
from string import ascii_letters, digits

import pytest

from trilane.scheduler.events import chain
from trilane.scheduler.ledger import JobRecord
from trilane.scheduler.policy import POLICIES, run_settings
from trilane.scheduler.virtual import Simulation, simulate

NS_PER_MS = 1_000_000
#: Stage, its unit, and how long a job takes, ms: the slowest unit needs 6 ms a frame, a frame alone 13 ms.
STAGES = (("pose", "cpu", 1), ("raster", "gpu", 3), ("infer", "dsp", 6), ("composite", "gpu", 2), ("present", "cpu", 1))
LATENCY_TO = "composite"
#: Of policies that need a rate: more frames than the slowest unit can do, so that some are left out.
PERIOD_MS = 5
FRAMES, DRAWN_MS = 300, 60
EDGES = ("single", "double", "triple", "fifo:4", "orphan")
LABELS = digits + ascii_letters  # enough for a frame each millisecond
LEFT = 15  # characters before the first millisecond


@cache
def example(policy: str, edge: str, skipping: str = "") -> Simulation:
    """`FRAMES` frames of the example; all times of its jobs are whole milliseconds.

    `skipping`: a 1 for each frame that skips raster and infer, from the first one on and again from the start.
    """
    times = {stage: ms * NS_PER_MS for stage, _, ms in STAGES}
    graph = chain(((stage, unit) for stage, unit, _ in STAGES), edge, LATENCY_TO)
    settings = run_settings(policy, FRAMES, PERIOD_MS * NS_PER_MS)
    if not skipping:
        return simulate(graph, settings, lambda stage, *_: times[stage], keep=True)
    graph = replace(graph, bypass=("pose", "composite"))
    return simulate(
        graph,
        settings,
        lambda stage, *_: times[stage],
        skips=lambda frame, _fresh: skipping[frame % len(skipping)] == "1",
        keep=True,
    )


def timeline(policy: str, edge: str, skipping: str = "") -> str:
    """The first `DRAWN_MS` milliseconds of the example: a line for each stage, a character for each millisecond."""
    run = example(policy, edge, skipping)
    lines = ["".ljust(LEFT) + "".join(f"{ms:<10}" for ms in range(0, DRAWN_MS, 10)).rstrip() + " ms"]
    if POLICIES[policy].paced:
        released = {frame * PERIOD_MS: LABELS[frame] for frame in range(DRAWN_MS // PERIOD_MS + 1)}
        lines.append(_line("released", (released.get(ms, " ") for ms in range(DRAWN_MS))))
    lines += [_line(f"{stage:<10}{unit}", _cells(run.jobs, stage)) for stage, unit, _ in STAGES]
    return "\n".join([*lines, *_dropped(run)])


def _line(name: str, cells: Iterator[str]) -> str:
    return (name.ljust(LEFT) + "".join(cells)).rstrip()


def _cells(jobs: tuple[JobRecord, ...], stage: str) -> Iterator[str]:
    """Of each millisecond the frame that the stage works on, or a dot."""
    cells = ["."] * DRAWN_MS
    for job in jobs:
        begin, end = job.begin_ns // NS_PER_MS, job.end_ns // NS_PER_MS
        if job.stage == stage and begin < DRAWN_MS:
            cells[begin:end] = LABELS[job.frame] * (end - begin)
    return iter(cells[:DRAWN_MS])


def _dropped(run: Simulation) -> Iterator[str]:
    """A line for each edge and cause: the frames before the last one shown that were dropped there."""
    stages = [stage for stage, _, _ in STAGES]
    done = {job.frame: stages.index(job.stage) for job in sorted(run.jobs, key=lambda job: job.end_ns)}
    shown = max(job.frame for job in run.jobs if job.stage == stages[-1] and job.end_ns <= DRAWN_MS * NS_PER_MS)
    for drop in sorted(run.report["frames"]["dropped"]):
        behind = stages.index(drop.partition("->")[0]) if not drop.startswith("source") else -1
        frames = [LABELS[frame] for frame in range(shown) if done.get(frame, -1) == behind]
        if frames:
            yield f"{'dropped':<{LEFT}}{''.join(frames)} ({drop})"


def figures() -> str:
    """A row of a Markdown table for each policy and edge: what `FRAMES` frames of the example come to."""
    rows = [
        "| policy | edge | frames a second | latency, mean ms | latency, largest ms | dropped |",
        "|---|---|--:|--:|--:|--:|",
    ]
    for policy in POLICIES:
        for edge in EDGES:
            report = example(policy, edge).report
            latency, dropped = report["latency_ms"], sum(report["frames"]["dropped"].values())
            numbers = f"{report['fps']:.0f} | {latency['mean']:.1f} | {latency['max']:.0f} | {dropped / FRAMES:.0%}"
            rows.append(f"| `{policy}` | `{edge}` | {numbers} |")
    return "\n".join(rows)


PAGE = Path(__file__).parents[2] / "docs" / "policies-and-edges.md"
BLOCK = re.compile(r"(<!-- (timeline (\w+) (\S+)(?: ([01]+))?|figures) -->\n)(.*?)(<!-- end -->)", re.DOTALL)


def drawn(found: re.Match[str]) -> str:
    """The block anew."""
    text = figures() + "\n" if found[2] == "figures" else f"```\n{timeline(found[3], found[4], found[5] or '')}\n```\n"
    return found[1] + text + found[7]


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


def test_frames_that_skip_by_hand() -> None:
    """Pose has two slots. Frames 2 and 3 wait in them for frame 1, whose infer ends at 16.

    Composite has done frame 2 at 20, and the CPU has shown it at 21. Therefore pose 4 begins at 21.
    """
    run = example("pipelined", "double", "0011")
    done = {(job.stage, job.frame): (job.begin_ns // NS_PER_MS, job.end_ns // NS_PER_MS) for job in run.jobs}
    assert [done["composite", frame] for frame in range(4)] == [(10, 12), (16, 18), (18, 20), (20, 22)]
    assert done["pose", 4][0] == 21 and not {("raster", 2), ("infer", 3)} & {*done}
    assert run.report["frames"]["skipped"] == FRAMES // 2
