"""Two avatars at once on this machine, beside what the virtual clock predicts for them: are the frame times the same?

Rule: the runs are measured, and before and after them the time of each stage while no other unit works. From these
times alone, the frame times of two such pipelines are computed, on cores that they divide in equal shares.

The scheduler's own time on its core, `SCHEDULER_NS` a job as in the model of placement, counts with the first stage,
which runs there. `strangers` says how quiet the machine was: the time that sequential stages wait for their cores, over
the time that they work. The virtual clock does not know other programs: the ratio says nothing when `strangers` is more
than a few hundredths.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager
from itertools import pairwise
from statistics import fmean, median
from typing import Any, NamedTuple

from trilane.bench.lib.avatar_process import Asked, AvatarProcess, Ran, avatar_processes
from trilane.errors import TrilaneError
from trilane.hw_profiles.application import application_graph
from trilane.scheduler.events import Settings, Stop
from trilane.scheduler.ledger import JobRecord
from trilane.scheduler.placement import SCHEDULER_NS
from trilane.scheduler.shared_units import Member, simulate_beside
from trilane.scheduler.stats import median_interval
from trilane.units import AFTER_INFER, BEFORE_INFER, NS_PER_MS

SEQUENTIAL, PIPELINED = "sequential", "pipelined"
FIRST, LAST = BEFORE_INFER[0][0], AFTER_INFER[-1][0]
SECONDS = 20.0  # virtual seconds of the simulated runs
ENDLESS = 1 << 40


class Isolated(NamedTuple):
    """The times of one pipeline alone.

    `stage_ns`: mean time of each stage, ns. `worked_ns`, `waited_ns`: time that all stages worked, and waited for a
    core, ns.
    """

    stage_ns: Mapping[str, float]
    worked_ns: int
    waited_ns: int


def measure_beside(
    asked: Sequence[Asked],
    rounds: int,
    processes: Any = avatar_processes,
) -> list[dict[str, Any]]:
    """Return a row for each of the two pipelines `asked`, medians over the `rounds`.

    `frame_ms`: mean time between presented frames while both ran. `virtual_ms`: the same, computed. `ratio`: measured
    over computed. `ratio_low`, `ratio_high`: 95 % interval of its median. `isolated_ms`: time of a frame's stages.
    `strangers`: mean number of other programs' threads that were ready where its stages worked. `processes`: makes the
    processes that run. Raises TrilaneError when a run fails.
    """
    found: list[list[dict[str, float]]] = []
    context: AbstractContextManager[list[AvatarProcess]] = processes(asked)
    with context as pair:
        before = [_ran(each, SEQUENTIAL) for each in pair]
        for _ in range(rounds):
            for each in pair:
                each.begin(PIPELINED)
            both = [each.result() for each in pair]
            after = [_ran(each, SEQUENTIAL) for each in pair]
            isolated = [isolated_of((*one.jobs, *other.jobs)) for one, other in zip(before, after, strict=True)]
            found.append(_round(both, isolated, asked))
            before = after
    return [_row(number, each, [rows[number] for rows in found]) for number, each in enumerate(asked)]


def _ran(process: AvatarProcess, policy: str) -> Ran:
    process.begin(policy)
    return process.result()


def isolated_of(jobs: Sequence[JobRecord]) -> Isolated:
    """Return the times of the stages in `jobs` of sequential runs, without their waits for cores."""
    times: dict[str, list[int]] = {}
    for job in jobs:
        times.setdefault(job.stage, []).append(job.end_ns - job.begin_ns - job.preempted_ns)
    worked_ns = sum(map(sum, times.values()))
    means = {stage: fmean(each) for stage, each in times.items()}
    return Isolated(means, worked_ns, sum(job.preempted_ns for job in jobs))


def _round(both: Sequence[Ran], isolated: Sequence[Isolated], asked: Sequence[Asked]) -> list[dict[str, float]]:
    measured = overlapping_ms([each.jobs for each in both])
    computed = computed_ms(isolated, [each.seats for each in both], asked)
    return [
        {
            "frame_ms": frame,
            "virtual_ms": virtual,
            "ratio": frame / virtual,
            "isolated_ms": sum(each.stage_ns.values()) / NS_PER_MS,
            "strangers": each.waited_ns / max(each.worked_ns, 1),
        }
        for frame, virtual, each in zip(measured, computed, isolated, strict=True)
    ]


def overlapping_ms(runs: Sequence[Sequence[JobRecord]]) -> list[float]:
    """Return the mean time between presented frames of each run, while all ran, in ms.

    Raises TrilaneError when they hardly overlapped.
    """
    ends = [sorted(job.end_ns for job in jobs if job.stage == LAST) for jobs in runs]
    first, last = max(each[0] for each in ends), min(each[-1] for each in ends)
    kept = [[end for end in each if first <= end <= last] for each in ends]
    if min(map(len, kept)) < 3:
        raise TrilaneError(f"the two runs met for {min(map(len, kept))} frames: more --frames are needed")
    return [fmean(after - before for before, after in pairwise(each)) / NS_PER_MS for each in kept]


def computed_ms(
    isolated: Sequence[Isolated], seats: Sequence[Mapping[str, str]], asked: Sequence[Asked]
) -> list[float]:
    """Return the mean virtual frame time of each pipeline in ms, when all run at once and divide the cores."""
    stop = (round(SECONDS * 1e9), Stop())
    members = [
        Member(
            application_graph(each.edge),
            Settings(ENDLESS, PIPELINED, hang_ns=ENDLESS),
            _service(times),
            own,
            inputs=(stop,),
        )
        for times, own, each in zip(isolated, seats, asked, strict=True)
    ]
    cores = {core for own in seats for core in own.values()}
    runs = simulate_beside(members, divided=cores)
    return [run.report["frame_time_ms"]["mean"] for run in runs]


def _service(isolated: Isolated) -> Any:
    times = {stage: round(ns) for stage, ns in isolated.stage_ns.items()}
    times[FIRST] += len(times) * SCHEDULER_NS
    return lambda stage, *_: times[stage]


def _row(number: int, asked: Asked, rounds: Sequence[Mapping[str, float]]) -> dict[str, Any]:
    low, high = median_interval([each["ratio"] for each in rounds])
    row: dict[str, Any] = {"pipeline": number + 1, "avatar": asked.avatar, "size": asked.size, "edge": asked.edge}
    row |= {key: median(each[key] for each in rounds) for key in rounds[0]}
    return {**row, "ratio_low": low, "ratio_high": high}
