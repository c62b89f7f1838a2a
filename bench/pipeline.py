"""Does the pipeline keep its slowest unit busy, and what does that gain over one frame at a time?

Rule: every run is paired with its stages alone, measured just before and after on the same cores, and with the
`sequential` runs before and after it; configurations take turns, many and short, because a machine that is shared
grows slower and faster within seconds, and a row is the median of its turns.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise, product
from pathlib import Path
from statistics import fmean, median
from typing import Any

from trilane.bench.lib import full_width
from trilane.errors import BadInputError, TrilaneError
from trilane.hw_profiles.host import host_units, usable_cores
from trilane.pipeline.result import RunResult
from trilane.pipeline.run import run_pipeline
from trilane.scheduler.ledger import JobRecord
from trilane.scheduler.policy import policy_named
from trilane.scheduler.stats import median_interval
from trilane.stages.config import RunConfig
from trilane.stages.configure import Request, configure
from trilane.transport.slots import edge_rule
from trilane.unexpected import UnexpectedValue

SEQUENTIAL = "sequential"
MIN_FRAMES = 20
ALONE = 16  # frames measured alone in each run
PACE = 1.25  # of what the slowest unit can do: paced policies are always offered more than they can take
NO_ACCURACY = "untrained: its pictures mean nothing, it is here for its work"


@dataclass(frozen=True)
class Setting:
    """One configuration of the grid."""

    avatar: str
    size: str
    cores: int
    policy: str
    edge: str


def measure(
    avatar: tuple[str, ...] = ("default",),
    size: tuple[str, ...] = ("512x512",),
    policy: tuple[str, ...] = ("pipelined",),
    edge: tuple[str, ...] = ("double",),
    cores: tuple[int, ...] = (0,),
    frames: int = 60,
    turns: int = 9,
    runtime: str = "auto",
    video: bool = True,
) -> dict[str, Any]:
    """Policies x edges x cores; give an option once for each value. `avatar`: `default`, a bundle's folder, or
    `resnet18`, the full-width network untrained (made once, with PyTorch). `cores`: how many the three units have, 0
    for all of them.

    Rows, medians over the turns: `frame_ms`, `fps`, `efficiency` (slowest unit alone / frame time), `slowest` and
    `alone_ms` (that unit's stages alone), `busiest` unit, its `idle` from its first job's begin to its last one's end
    and the causes: `starved` (no input), `undispatched` (input, but no free slot, or not told yet), `overhead` (told,
    but not begun); `gain` over the mean of the `sequential` runs before and after, `bound` sum(t) / max(t): all stages
    alone beside this run (`all_alone_ms`) and those runs' hand-overs, over the slowest unit's; `gain_of_bound` and
    the ends of its 95 % interval, `of_bound_low`, `of_bound_high` (of the median over the turns; with fewer than
    six of them their least and largest). `hops_ms`: what a sequential run takes for a frame beyond its stages.
    `dropped`, `lost`: frames of all turns. `accuracy`: what the avatar's pictures are worth.
    `video`: write one, or present nothing. Raises BadInputError, MissingPartError, TrilaneError when a run fails.
    """
    if frames < MIN_FRAMES or turns < 1:
        raise BadInputError("bench pipeline", f"--frames {frames}, --turns {turns}", f"at least {MIN_FRAMES} and 1")
    cores = tuple(count or len(usable_cores()) for count in cores)
    _check(policy, edge, cores)
    rows: list[dict[str, Any]] = []
    accuracy: dict[str, Any] = {}
    for one_avatar, one_size, count in product(avatar, size, cores):
        config, accuracy[one_avatar] = _config(one_avatar, one_size, count, frames, runtime, video=video)
        plans = [Setting(one_avatar, one_size, count, *pair) for pair in _plans(policy, edge)]
        taken = [_turn(config, plans) for _ in range(turns)]
        closing = _run(config, plans[0])
        for turn, after in zip(taken, [*(turn[0] for turn in taken[1:]), closing], strict=True):
            _compare(turn, after)
        rows += [_summary(plan, list(turned)) for plan, turned in zip(plans, zip(*taken, strict=True), strict=True)]
    return {
        "rows": rows,
        "accuracy": accuracy,
        "config": {"frames": frames, "turns": turns, "runtime": config.runtime, "video": video},
    }


def _check(policies: Sequence[str], edges: Sequence[str], cores: Sequence[int]) -> None:
    for option, check, values in (("--policy", policy_named, policies), ("--edge", edge_rule, edges)):
        for value in values:
            try:
                check(value)
            except UnexpectedValue as error:
                raise BadInputError.at(option, error) from None
    have = len(usable_cores())
    if not all(1 <= count <= have for count in cores):
        raise BadInputError("--cores", str(list(cores)), f"numbers from 1 to the {have} that this process may use")


def _plans(policies: Sequence[str], edges: Sequence[str]) -> list[tuple[str, str]]:
    """`sequential` first: the others are set against it."""
    return [(SEQUENTIAL, "double"), *(pair for pair in product(policies, edges) if pair != (SEQUENTIAL, "double"))]


def _config(avatar: str, size: str, cores: int, frames: int, runtime: str, *, video: bool) -> tuple[RunConfig, Any]:
    folder = str(full_width.full_width_bundle()) if avatar == full_width.NAME else avatar
    checked = configure(Request(size=size, avatar=folder, frames=frames, runtime=runtime), Path.cwd())
    units = host_units(usable_cores()[:cores])
    accuracy = next(iter(checked.accuracy.values())) or NO_ACCURACY
    return checked.config.model_copy(update={"units": units, "record": video}), accuracy


def _turn(config: RunConfig, plans: list[Setting]) -> list[dict[str, Any]]:
    """One run of each; the `sequential` one says how much time the paced ones may take."""
    base = _run(config, plans[0])
    return [base, *(_run(config, plan, base["alone_ms"]) for plan in plans[1:])]


def _compare(turn: list[dict[str, Any]], after: dict[str, Any]) -> None:
    """Set the runs of a turn, `sequential` first, against that one and the one `after` them; itself against itself."""
    for place, row in enumerate(turn):
        beside = (turn[0], after if place else turn[0])
        row["gain"] = fmean(base["frame_ms"] for base in beside) / row["frame_ms"]
        row["bound"] = (row["all_alone_ms"] + fmean(base["hops_ms"] for base in beside)) / row["alone_ms"]
        row["gain_of_bound"] = row["gain"] / row["bound"]


def _run(config: RunConfig, plan: Setting, alone_ms: float = 0.0) -> dict[str, Any]:
    pace = PACE * 1e3 / alone_ms if policy_named(plan.policy).paced else None
    with tempfile.TemporaryDirectory(prefix="trilane-bench-") as folder:
        placed = config.model_copy(update={"out_dir": Path(folder)})
        result = run_pipeline(placed, policy=plan.policy, edge=plan.edge, pace_fps=pace, isolate_frames=ALONE)
    if result.interrupted:
        raise KeyboardInterrupt
    if result.failure is not None or result.presented < 2:
        raise TrilaneError(f"{plan}: {result.failure.message if result.failure else 'no frames were presented'}")
    return _figures(result)


def _figures(result: RunResult) -> dict[str, Any]:
    report = result.report
    alone = _alone_ms(report)
    slowest = max(alone, key=alone.__getitem__)
    stages_ms = sum(float(row["service_ms"]["mean"]) for row in report["stages"].values())
    busiest = max(report["units"], key=lambda unit: float(report["units"][unit]["busy"]))
    return {
        "fps": report["fps"],
        "frame_ms": report["frame_time_ms"]["mean"],
        "efficiency": report["efficiency"],
        "slowest": slowest,
        "alone_ms": alone[slowest],
        "all_alone_ms": sum(alone.values()),
        "hops_ms": report["frame_time_ms"]["mean"] - stages_ms if report["policy"] == SEQUENTIAL else None,
        "busiest": busiest,
        **idle_between_jobs([job for job in result.jobs if job.unit == busiest]),
        "in_run_over_alone": _in_run(report, slowest) / alone[slowest],
        "dropped": sum(result.dropped.values()),
        "lost": sum(result.lost.values()),
    }


def _alone_ms(report: dict[str, Any]) -> dict[str, float]:
    """Milliseconds of each unit for a frame: its stages alone; the last one is never run alone: as in the run."""
    times = dict.fromkeys(report["units"], 0.0)
    for name, stage in report["stages"].items():
        times[stage["unit"]] += report["isolated_ms"].get(name, stage["service_ms"]["mean"])
    return times


def _in_run(report: dict[str, Any], unit: str) -> float:
    return sum(float(row["service_ms"]["mean"]) for row in report["stages"].values() if row["unit"] == unit)


def idle_between_jobs(jobs: Sequence[JobRecord]) -> dict[str, float]:
    """Shares of the time between the first job's begin and the last one's end; `idle` is the sum of its causes."""
    ordered = sorted(jobs, key=lambda job: job.begin_ns)
    span = ordered[-1].end_ns - ordered[0].begin_ns
    parts = {"starved": 0, "undispatched": 0, "overhead": 0}
    for before, job in pairwise(ordered):
        ready = min(max(job.ready_ns, before.end_ns), job.begin_ns)
        told = min(max(job.dispatch_ns, ready), job.begin_ns)
        parts["starved"] += ready - before.end_ns
        parts["undispatched"] += told - ready
        parts["overhead"] += job.begin_ns - told
    shares = {cause: ns / span for cause, ns in parts.items()}
    return {"idle": sum(shares.values()), **shares}


def _summary(plan: Setting, turned: list[dict[str, Any]]) -> dict[str, Any]:
    """Medians of numbers, the commonest of names, sums of frames."""
    names = ("slowest", "busiest")
    sums = ("dropped", "lost")
    row: dict[str, Any] = {**vars(plan)}
    for key in turned[0]:
        values = [each[key] for each in turned]
        pick: Callable[[list[Any]], Any] = sum if key in sums else median
        row[key] = None if None in values else max(set(values), key=values.count) if key in names else pick(values)
    row["of_bound_low"], row["of_bound_high"] = median_interval([each["gain_of_bound"] for each in turned])
    return row
