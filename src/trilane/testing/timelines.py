"""A small example of every policy and edge, by the scheduler in virtual time, drawn as text.

Rule: what is drawn is what the real core did; docs/policies-and-edges.md holds these texts, and a test compares them.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache
from string import ascii_letters, digits

from trilane.scheduler.events import chain
from trilane.scheduler.ledger import JobRecord
from trilane.scheduler.policy import POLICIES
from trilane.scheduler.release import run_settings
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
def example(policy: str, edge: str) -> Simulation:
    """`FRAMES` frames of the example; all times of its jobs are whole milliseconds."""
    times = {stage: ms * NS_PER_MS for stage, _, ms in STAGES}
    graph = chain(((stage, unit) for stage, unit, _ in STAGES), edge, LATENCY_TO)
    settings = run_settings(policy, FRAMES, PERIOD_MS * NS_PER_MS)
    return simulate(graph, settings, lambda stage, *_: times[stage], keep=True)


def timeline(policy: str, edge: str) -> str:
    """The first `DRAWN_MS` milliseconds of the example: a line for each stage, a character for each millisecond."""
    run = example(policy, edge)
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
