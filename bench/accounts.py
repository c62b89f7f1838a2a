"""Do the accounts of time hold, in runs drawn at random, on both clocks?

Rule: pipelines, policies, edges, rates, caps and deaths of units are drawn from the seed; every run is judged by what
must hold in any of them.
"""

from __future__ import annotations

import contextlib
import os
import random
from collections.abc import Callable, Iterable
from typing import Any

import psutil

from trilane.bench.faults import unit_process
from trilane.bench.lib.cpu_load import FACTORY
from trilane.errors import BadInputError
from trilane.hw_profiles.host import usable_cores
from trilane.pipeline.description import Pipeline, PipelineEdge, PipelineStage, UnitSettings
from trilane.pipeline.run import run_pipeline
from trilane.pipeline.unit_starter import UnitStarter
from trilane.scheduler.accounts import compared, second_accounts
from trilane.scheduler.events import Event, Graph, SetDuty, Settings, StageSpec
from trilane.scheduler.policy import POLICIES
from trilane.scheduler.virtual import simulate

MS = 1_000_000
EDGES = ("single", "double", "triple", "fifo:1", "fifo:3", "orphan", "orphan:4")
UNITS = ("a", "b", "c")
LEAST_FRAMES = 2  # a unit is killed after the first and before the last


def measure(runs: int = 50, frames: int = 40, seed: int = 1) -> dict[str, Any]:
    """`runs` runs on each clock, those of the host of stages that compute and sleep.

    `frames`: of a run on the host; a run in virtual time has ten times as many.

    A row per clock. `largest_difference`: between the shares of the ledger and those added up from the slices of the
    trace, over all units and causes. `sum_error`: the largest by which the shares of a unit do not sum to 1.
    `core_cpu`, `core_busy`: the largest CPU time, and the largest busy time of units without a device of their own,
    that the units of some cores had, as a share of the time of these cores; null in virtual time.
    `preempted`: the largest share of a unit. `deaths`: of units.
    Raises BadInputError.
    """
    if runs < 1:
        raise BadInputError("--runs", str(runs), "at least 1")
    if frames < LEAST_FRAMES:
        raise BadInputError("--frames", str(frames), f"at least {LEAST_FRAMES}")
    draws = [random.Random(f"{seed} {run}") for run in range(runs)]
    with UnitStarter([FACTORY.partition(":")[0]]) as starter:
        host = [host_run(draw, frames, starter) for draw in draws]
    virtual = [virtual_run(draw, 10 * frames) for draw in draws]
    return {
        "rows": [_row("virtual", virtual), _row("host", host)],
        "config": {"runs": runs, "frames": frames, "seed": seed, "cores": usable_cores()},
    }


def virtual_run(draw: random.Random, frames: int) -> dict[str, Any]:
    """The report of a simulated run, with `accounts`."""
    units = [draw.choice(UNITS) for _ in range(draw.randint(1, 6))]
    graph = Graph(
        tuple(StageSpec(f"s{index}", unit) for index, unit in enumerate(units)),
        tuple(draw.choice(EDGES) for _ in units[1:]),
        f"s{draw.randrange(len(units))}",
    )
    policy = draw.choice(list(POLICIES))
    is_paced = POLICIES[policy].paced or draw.random() < 0.5
    settings = Settings(
        frames,
        policy,
        period_ns=draw.randint(5, 25) * MS if is_paced else 0,
        deadline_ns=60 * MS,
        in_flight=draw.randint(0, 4),
        in_queue=draw.randint(0, 3),
        queue_timeout_ns=draw.choice((0, 30 * MS)),
        latch_ns=draw.choice((0, 0, 2 * MS)),
        hang_ns=draw.choice((12 * MS, 200 * MS)),
        max_failures=frames,
    )
    longest_ns = {f"s{index}": draw.randint(1, 14) * MS for index in range(len(units))}
    duties: list[tuple[int, Event]] = [
        (draw.randint(0, frames * 10 * MS), SetDuty(draw.choice(units), draw.randint(300, 1000)))
        for _ in range(draw.randint(0, 3))
    ]
    done = simulate(
        graph,
        settings,
        lambda stage, _unit, _frame, _begin_ns: draw.randint(MS // 20, longest_ns[stage]),
        message_delay_ns=draw.choice((0, 50_000)),
        restart_ns=draw.randint(10, 300) * MS,
        faults=[(draw.randint(0, frames * 10 * MS), draw.choice(units)) for _ in range(draw.randint(0, 4))],
        inputs=duties,
        keep=True,
    )
    assert done.recording is not None
    return {**done.report, "accounts": compared(done.report["units"], second_accounts(done.recording, done.jobs))}


def host_run(draw: random.Random, frames: int, starter: UnitStarter) -> dict[str, Any]:
    """The report of a run of real processes that compute and sleep; in one of four a unit is killed."""
    policy = draw.choice(list(POLICIES))
    pipeline = random_pipeline(draw)
    dies_at = draw.randrange(1, frames) if draw.random() < 0.25 else frames
    victim = draw.choice(list(pipeline.graph().units))
    result = run_pipeline(
        pipeline,
        frames,
        policy=policy,
        fps=draw.choice((60.0, 120.0, 240.0)),
        pace_fps=draw.choice((None, 100.0)),
        starter=starter,
        on_progress=_Killer(dies_at, lambda: unit_process(victim)),
    )
    devices = {stage.unit for stage in pipeline.stages if stage.settings["device"]}
    return {**result.report.as_json(), "devices": devices}


def random_pipeline(draw: random.Random) -> Pipeline:
    """One to five stages on up to three units, each on one core or on several, which they may share."""
    cores = usable_cores()
    units = {}
    for name in UNITS:
        own = tuple(sorted(draw.sample(cores, draw.randint(1, min(2, len(cores))))))
        units[name] = UnitSettings(cores=own, threads=draw.randint(1, len(own)))
    device = {name: draw.random() < 0.25 for name in UNITS}
    names = [draw.choice(UNITS) for _ in range(draw.randint(1, 5))]
    stages = tuple(
        PipelineStage(
            name=f"s{index}",
            unit=name,
            factory=FACTORY,
            settings={
                "cpu_ms": draw.uniform(0.1, 3.0),
                "sleep_ms": draw.choice((0.0, 0.0, draw.uniform(0.1, 2.0))),
                "device": device[name],
            },
        )
        for index, name in enumerate(names)
    )
    edges = tuple(PipelineEdge(payload_bytes=4096, rule=draw.choice(EDGES)) for _ in names[1:])
    return Pipeline(stages=stages, edges=edges, units={name: units[name] for name in dict.fromkeys(names)})


class _Killer:
    """For `on_progress`: kills a process once, when so many frames have been presented."""

    def __init__(self, frames: int, process: Callable[[], psutil.Process]) -> None:
        self._left, self._process = frames, process

    def __call__(self, presented: int, requested: int) -> None:
        if self._left <= presented < requested:
            self._left = requested
            with contextlib.suppress(LookupError, psutil.Error):
                os.kill(self._process().pid, 9)


def _row(clock: str, reports: Iterable[dict[str, Any]]) -> dict[str, Any]:
    reports = list(reports)
    units = [unit for report in reports for unit in report["units"].values()]
    uses = [
        use
        for report in reports
        for use in report.get("core_shares", ())
        if not report["devices"].intersection(use["units"])
    ]
    return {
        "clock": clock,
        "runs": len(reports),
        "largest_difference": max(report["accounts"]["largest_difference"] for report in reports),
        "sum_error": max(abs(unit["busy"] + sum(_known(unit["idle"].values())) - 1) for unit in units),
        "core_cpu": max((use["cpu"] for report in reports for use in report.get("core_shares", ())), default=None),
        "core_busy": max((use["busy"] for use in uses), default=None),
        "preempted": max(_known(unit["idle"]["preempted"] for unit in units), default=None),
        "deaths": sum(unit["restarts"] for unit in units),
    }


def _known(values: Iterable[float | None]) -> list[float]:
    return [value for value in values if value is not None]
