"""Does the pipeline keep its slowest unit busy, and what does that gain over one frame at a time?

Rule: every run is compared with the `sequential` runs before and after it on the same cores. In a sequential run, every
stage does the same frames in the same order while the other units are quiet. The settings run in many short interleaved
rounds, because the speed of a shared machine changes within seconds. A row has medians over the rounds.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from itertools import pairwise, product
from multiprocessing.connection import Connection
from pathlib import Path
from statistics import fmean, median
from typing import Any, NamedTuple

from trilane.bench.lib import networks
from trilane.bench.lib.interleaved_processes import answer_of, asked_processes
from trilane.errors import BadInputError, TrilaneError
from trilane.hw_profiles.application import application_graph
from trilane.hw_profiles.host import host_units, usable_cores
from trilane.pipeline.journal import records_of
from trilane.pipeline.result import RunResult
from trilane.pipeline.timeline import Presented, Timeline
from trilane.scheduler.events import Settings, Stop
from trilane.scheduler.ledger import JobRecord
from trilane.scheduler.placement import SCHEDULER_NS
from trilane.scheduler.policy import policy_named
from trilane.scheduler.recording import Recording
from trilane.scheduler.shared_units import Member, simulate_beside
from trilane.scheduler.stats import median_interval, percentile, samples_needed
from trilane.stages.avatar_pipeline import run_avatar
from trilane.stages.configure import Checked, configure
from trilane.stages.run_options import RunOptions
from trilane.transport.slots import edge_rule
from trilane.unexpected_value import UnexpectedValue
from trilane.units import AFTER_INFER, BEFORE_INFER, COMPARED, COMPUTED, MEASURED, NS_PER_MS

SEQUENTIAL, PIPELINED = "sequential", "pipelined"
MIN_FRAMES = 20
LATENCIES = "latencies_ns"  # key of a run's latencies; a row has their percentiles over all rounds
UNITS_MS = "units_ms"  # key of the time that each unit takes for a frame in a run
PACE = 1.25  # factor on the slowest unit's rate: more frames are released than paced policies can present


@dataclass(frozen=True)
class Setting:
    """The settings of the runs of one row.

    `avatar`: name or folder of the avatar. `size`: tensor size. `cores`: number of cores of the units together.
    `policy`: policy of the scheduler. `edge`: rule of all edges.
    """

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
    rounds: int = 9,
    runtime: str = "auto",
    video: bool = True,
    beside: str = "",
    beside_size: str = "512x512",
) -> dict[str, Any]:
    """Measure the avatar's pipeline for each avatar, size, number of cores, policy and edge.

    `rows` has a row for each of these settings. Its figures are medians over the `rounds`.
    `frame_ms`, `fps`: frame time and rate.
    `latency_p50_ms`, `latency_p99_ms`: percentiles of the latency, over the presented frames of all rounds; with fewer
    than 299 frames, the p99 is null.
    `efficiency`: CPU time of the slowest unit for a frame, divided by the frame time.
    `slowest`: unit that takes longest for a frame in the `sequential` runs before and after.
    `alone_ms`: time of `slowest` for a frame in those runs, without the time in which the unit had no core.
    `busiest`: unit with the most work in this run.
    `idle`: share of time without a job, between the first and the last job of `busiest`. The causes of this share are
    `starved` (no input), `undispatched` (input, but no free slot, or not dispatched yet) and `overhead` (dispatched,
    but not begun).

    `gain`: mean frame time of the `sequential` runs before and after, divided by `frame_ms`.
    `bound`: largest possible gain, which is (`all_alone_ms` + `hops_ms` of those runs) / `alone_ms`.
    `all_alone_ms`: time of all units for a frame in those runs.
    `hops_ms`: frame time of a sequential run minus the times of its stages, which is the time of hand-overs; null for
    other runs.
    `in_run_over_alone`: time of the unit `slowest` in this run, without the time in which it had no core, divided by
    `alone_ms`.
    `gain_of_bound`: `gain` divided by `bound`.
    `of_bound_low`, `of_bound_high`: 95 % interval of `gain_of_bound`; with fewer than six rounds, its least and largest
    value.
    `dropped`, `lost`: numbers of frames in all rounds.
    `accuracy`: image error of each avatar and its source, or why there are no figures.

    If `beside` names a second avatar, of the size `beside_size`, two `pipelined` runs go on at once on the same cores.
    Each has its own scheduler and units. In this case, `rows` has a row for each run.
    `frame_ms`: mean frame time while both ran.
    `isolated_ms`: time of the stages for a frame, in sequential runs before and after.
    `virtual_ms`: frame time that the virtual clock computes from these times.
    `ratio`: measured frame time divided by the computed one; `ratio_low`, `ratio_high`: its 95 % interval.
    `strangers`: time for which stages had no core in the sequential runs, divided by the time for which they worked. If
    it is above a few hundredths, the ratio says nothing.

    Raises BadInputError for an option out of range, MissingPartError if a library is not installed, TrilaneError if a
    run fails.
    """
    if frames < MIN_FRAMES or rounds < 1:
        raise BadInputError("bench pipeline", f"--frames {frames}, --rounds {rounds}", f"at least {MIN_FRAMES} and 1")
    cores = tuple(count or len(usable_cores()) for count in cores)
    _check(policy, edge, cores)
    if beside:
        _check_single({"--avatar": avatar, "--size": size, "--edge": edge, "--cores": cores, "--policy": policy})
        one, other = (avatar[0], size[0]), (beside, beside_size)
        return _measure_two([one, other], edge[0], cores[0], frames, rounds, runtime, video=video)
    rows: list[dict[str, Any]] = []
    accuracy: dict[str, Any] = {}
    for name, tensor_size, count in product(avatar, size, cores):
        checked = _config(name, tensor_size, usable_cores()[:count], frames, runtime, video)
        accuracy[name if len(size) == 1 else f"{name} at {tensor_size}"] = next(iter(checked.accuracy.values()))
        settings = [Setting(name, tensor_size, count, *pair) for pair in _pairs(policy, edge)]
        rows += _measure_rounds(checked, settings, rounds)
    facts = {"frames": frames, "rounds": rounds, "runtime": checked.config.runtime, "video": video}
    return {"rows": rows, "accuracy": accuracy, "config": facts}


def _measure_two(
    which: Sequence[tuple[str, str]], edge: str, cores: int, frames: int, rounds: int, runtime: str, *, video: bool
) -> dict[str, Any]:
    """Measure two avatars, (avatar, size) each, at once on the same cores, and return the result of `measure`."""
    asked = [
        Asked(_folder(name), size, frames, runtime, usable_cores()[:cores], video=video, edge=edge)
        for name, size in which
    ]
    facts = {"frames": frames, "rounds": rounds, "runtime": runtime, "video": video, "cores": cores}
    sources = {"frame_ms, isolated_ms, strangers": MEASURED, "virtual_ms": COMPUTED, "ratio": COMPARED}
    return {"rows": measure_beside(asked, rounds), "sources": sources, "config": facts}


def _folder(avatar: str) -> str:
    return str(networks.full_width_bundle()) if avatar == networks.FULL_WIDTH else avatar


def _measure_rounds(checked: Checked, settings: list[Setting], rounds: int) -> list[dict[str, Any]]:
    """Return a row of `measure` for each of `settings`. The first setting is `sequential`.

    One more sequential run ends the last round, because every run is compared with the sequential runs around it.
    """
    measured = [_run_round(checked, settings) for _ in range(rounds)]
    closing = _run(checked, settings[0])
    for runs, after in zip(measured, [*(runs[0] for runs in measured[1:]), closing], strict=True):
        _compare(runs, after)
    by_setting = zip(*measured, strict=True)
    return [_summary(setting, list(runs)) for setting, runs in zip(settings, by_setting, strict=True)]


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


def _check_single(options: Mapping[str, Sequence[Any]]) -> None:
    """Raise BadInputError for an option that the runs with `beside` would ignore. `options`: values by option."""
    for option, values in options.items():
        if len(values) > 1:
            raise BadInputError(option, f"{len(values)} values with --beside", "one")
    if options["--policy"][0] != PIPELINED:
        raise BadInputError("--policy", f"{options['--policy'][0]} with --beside", PIPELINED)


def _pairs(policies: Sequence[str], edges: Sequence[str]) -> list[tuple[str, str]]:
    """Return all (policy, edge) pairs; `sequential` with `double` is the first, as all others are compared with it."""
    return [(SEQUENTIAL, "double"), *(pair for pair in product(policies, edges) if pair != (SEQUENTIAL, "double"))]


def _config(avatar: str, size: str, cores: tuple[int, ...], frames: int, runtime: str, video: bool) -> Checked:
    checked = configure(RunOptions(size=size, avatar=_folder(avatar), frames=frames, runtime=runtime), Path.cwd())
    return checked.changed(units=host_units(cores), record=video)


def _run_round(checked: Checked, settings: list[Setting]) -> list[dict[str, Any]]:
    """Run each of `settings` once, and return the figures of each run.

    The first run, which is `sequential`, determines the rate at which paced policies release frames.
    """
    base = _run(checked, settings[0])
    slowest_ms = max(base[UNITS_MS].values())
    return [base, *(_run(checked, setting, slowest_ms) for setting in settings[1:])]


def _compare(runs: list[dict[str, Any]], after: dict[str, Any]) -> None:
    """Add the comparisons of `measure` to the figures of each run of a round. The first of `runs` is `sequential`.

    The first run is compared only with itself. Each other run is compared with the first run and with `after`, the next
    sequential run.
    """
    for place, row in enumerate(runs):
        beside = (runs[0], after if place else runs[0])
        units_ms = {unit: fmean(base[UNITS_MS][unit] for base in beside) for unit in runs[0][UNITS_MS]}
        slowest = max(units_ms, key=units_ms.__getitem__)
        row |= {"slowest": slowest, "alone_ms": units_ms[slowest], "all_alone_ms": sum(units_ms.values())}
        row["in_run_over_alone"] = row[UNITS_MS][slowest] / row["alone_ms"]
        row["gain"] = fmean(base["frame_ms"] for base in beside) / row["frame_ms"]
        row["bound"] = (row["all_alone_ms"] + fmean(base["hops_ms"] for base in beside)) / row["alone_ms"]
        row["gain_of_bound"] = row["gain"] / row["bound"]


def _run(checked: Checked, plan: Setting, slowest_ms: float = 0.0) -> dict[str, Any]:
    pace = PACE * 1e3 / slowest_ms if policy_named(plan.policy).paced else None
    return _figures(finished_run(checked, str(plan), policy=plan.policy, edge=plan.edge, pace_fps=pace))


def finished_run(checked: Checked, what: str, least: int = 2, **options: Any) -> RunResult:
    """Run `checked` in a temporary run folder, and return the result of the run.

    `what`: name of the run in error messages. `least`: least number of presented frames. `options`: further arguments
    of `run_avatar`.
    Raises TrilaneError if the run fails or presents too few frames, KeyboardInterrupt if a signal ends the run.
    """
    with tempfile.TemporaryDirectory(prefix="trilane-bench-") as folder:
        placed = checked.changed(out_dir=Path(folder))
        result = run_avatar(placed.config, placed.assets, **options)
    if result.interrupted:
        raise KeyboardInterrupt
    if result.failure is not None:
        raise TrilaneError(f"{what}: {result.failure.message}")
    if result.presented < least:
        raise TrilaneError(f"{what}: {result.presented} of at least {least} frames were presented")
    return result


def _figures(result: RunResult) -> dict[str, Any]:
    """Return the figures of one run that need no comparison, under the keys of `measure`, LATENCIES and UNITS_MS."""
    metrics = result.report
    frame_ms = metrics.frame_time_ms.mean
    assert frame_ms is not None  # two frames were presented
    stages_ms = sum(stage.service_ms.mean or 0.0 for stage in metrics.stages.values())
    busiest = max(metrics.units, key=lambda unit: metrics.units[unit].busy)
    return {
        "fps": metrics.fps,
        "frame_ms": frame_ms,
        LATENCIES: latencies_ns(result.recording, result.jobs),
        "efficiency": metrics.efficiency,
        UNITS_MS: _units_ms(result),
        "hops_ms": frame_ms - stages_ms if metrics.policy == SEQUENTIAL else None,
        "busiest": busiest,
        **idle_between_jobs([job for job in result.jobs if job.unit == busiest]),
        "dropped": sum(result.dropped.values()),
        "lost": sum(result.lost.values()),
    }


def _units_ms(result: RunResult) -> dict[str, float]:
    """Return the time of each unit for a frame in ms, by unit: mean service times without preempted time."""
    times = dict.fromkeys(result.report.units, 0.0)
    for name, stage in result.report.stages.items():
        preempted = [job.preempted_ns for job in result.jobs if job.stage == name]
        times[stage.unit] += (stage.service_ms.mean or 0.0) - (fmean(preempted) / NS_PER_MS if preempted else 0.0)
    return times


def idle_between_jobs(jobs: Sequence[JobRecord]) -> dict[str, float]:
    """Return the idle shares of a unit, `starved`, `undispatched` and `overhead` as in `measure`, and their sum `idle`.

    The shares refer to the time from the begin of the unit's first job to the end of its last. `jobs`: all its jobs.
    """
    ordered = sorted(jobs, key=lambda job: job.begin_ns)
    span = ordered[-1].end_ns - ordered[0].begin_ns
    parts = {"starved": 0, "undispatched": 0, "overhead": 0}
    for before, job in pairwise(ordered):
        ready = min(max(job.ready_ns, before.end_ns), job.begin_ns)
        dispatched = min(max(job.dispatch_ns, ready), job.begin_ns)
        parts["starved"] += ready - before.end_ns
        parts["undispatched"] += dispatched - ready
        parts["overhead"] += job.begin_ns - dispatched
    shares = {cause: ns / span for cause, ns in parts.items()}
    return {"idle": sum(shares.values()), **shares}


def latencies_ns(recording: Recording, jobs: Sequence[JobRecord]) -> list[int]:
    """Return the latency of each presented frame that has one, in ns.

    `recording`: recording of the run. `jobs`: all jobs of the run.
    """
    timeline = Timeline(recording.graph, recording.settings)
    facts = (fact for record in records_of(recording, jobs) for fact in timeline.add(record))
    return [fact.latency_ns for fact in facts if isinstance(fact, Presented) and fact.latency_ns is not None]


def _latency_ms(runs: list[dict[str, Any]]) -> dict[str, float | None]:
    """Return the keys `latency_p50_ms` and `latency_p99_ms` over all frames of `runs`; None for too few frames."""
    ordered = sorted(ns for run in runs for ns in run[LATENCIES])
    enough = {percent: len(ordered) >= samples_needed(percent / 100) for percent in (50, 99)}
    return {
        f"latency_p{percent}_ms": percentile(ordered, percent / 100) / NS_PER_MS if fine else None
        for percent, fine in enough.items()
    }


def _summary(setting: Setting, runs: list[dict[str, Any]]) -> dict[str, Any]:
    """Return the row of `setting` over its runs: medians, most frequent names, sums of dropped and lost frames."""
    names, sums = ("slowest", "busiest"), ("dropped", "lost")
    row: dict[str, Any] = {**vars(setting)}
    for key in (key for key in runs[0] if key not in (LATENCIES, UNITS_MS)):
        values = [run[key] for run in runs]
        pick: Callable[[list[Any]], Any] = sum if key in sums else median
        row[key] = None if None in values else max(set(values), key=values.count) if key in names else pick(values)
    row |= _latency_ms(runs)
    row["of_bound_low"], row["of_bound_high"] = median_interval([run["gain_of_bound"] for run in runs])
    return row


# Runs of an avatar, each in a process of its own, so that two can go on at once on the same cores.
#
# Rule: each process does what `trilane run` does, with its own scheduler and its own units. Two processes share only
# the machine.

START_S, RUN_S = 120.0, 600.0


@dataclass(frozen=True)
class Asked:
    """The settings of a run of the default scene in a process of its own.

    `avatar`, `size`, `frames`, `runtime`: options as in `trilane.stages.run_options.RunOptions`. `cores`: numbers of
    the cores on which the units are placed, by the rule for any run. `video`: whether a video is encoded. `edge`: rule
    of all edges.
    """

    avatar: str
    size: str
    frames: int
    runtime: str
    cores: tuple[int, ...]
    video: bool
    edge: str = "double"


class Ran(NamedTuple):
    """The result of a run. `jobs`: all jobs that ended. `seats`: cores of each unit, as text such as "0,1", by unit."""

    jobs: tuple[JobRecord, ...]
    seats: dict[str, str]


class AvatarProcess:
    """A process that runs an avatar, as the parent process sees it.

    `pipe`: pipe to the process. `name`: name of the process in error messages.
    """

    def __init__(self, pipe: Connection, name: str) -> None:
        self._pipe, self._name = pipe, name

    def begin(self, policy: str) -> None:
        """Tell the process to begin a run under `policy`."""
        self._pipe.send(policy)

    def result(self) -> Ran:
        """Wait until the begun run ends, and return its result. Raises TrilaneError if it fails or exceeds `RUN_S`."""
        jobs, seats = self.receive(RUN_S)
        return Ran(tuple(JobRecord(*job) for job in jobs), seats)

    def receive(self, wait_s: float) -> Any:
        """Return the next answer of the process. Raises TrilaneError for an error message or no answer in `wait_s`."""
        return answer_of(self._pipe, self._name, wait_s)


@contextmanager
def avatar_processes(asked: Sequence[Asked]) -> Iterator[list[AvatarProcess]]:
    """Start a process for each run in `asked`, and yield the processes, which are ready to run.

    All processes end with the `with` block. Raises TrilaneError if a process does not start.
    """
    with asked_processes() as start:
        found = [AvatarProcess(start(serve, each), f"{each.avatar} at {each.size}") for each in asked]
        for one in found:
            one.receive(START_S)
        yield found


def serve(pipe: Connection, asked: Asked) -> None:
    """Run the process: report that it is ready, and do a run for each policy that it receives, until `pipe` closes.

    The answer to a policy is (jobs as tuples, seats of `Ran`), or an error message if the run fails, which ends the
    process.
    """
    try:
        checked = _config(asked.avatar, asked.size, asked.cores, asked.frames, asked.runtime, asked.video)
        seats = {unit: ",".join(map(str, settings.cores)) for unit, settings in checked.config.units.items()}
        pipe.send(True)
        while True:
            policy = pipe.recv()
            with tempfile.TemporaryDirectory(prefix="trilane-bench-") as folder:
                placed = checked.changed(out_dir=Path(folder))
                result = run_avatar(placed.config, placed.assets, policy=policy, edge=asked.edge)
            if result.failure is not None:
                pipe.send(result.failure.message)
                return
            pipe.send(([tuple(job) for job in result.jobs], seats))
    except (EOFError, BrokenPipeError, KeyboardInterrupt):
        return
    except Exception as error:
        pipe.send(f"{type(error).__name__}: {error}")


# Two avatars at once on this machine: are the measured frame times the same as the virtual clock's?
#
# Rule: both runs are measured at once. Before and after them, sequential runs measure each stage while no other unit
# works. Both frame times are computed only from these times, on cores that the two pipelines share equally.
#
# The scheduler's own time, `SCHEDULER_NS` a job as in the model of placement, is added to the first stage, which runs
# on the same core. `strangers` says how busy the machine was: the time for which sequential stages had no core, divided
# by the time for which they worked. The virtual clock does not know other programs: if `strangers` is above a few
# hundredths, the ratio says nothing.

FIRST, LAST = BEFORE_INFER[0][0], AFTER_INFER[-1][0]
SECONDS = 20.0  # virtual seconds of the simulated runs
ENDLESS = 1 << 40


class Isolated(NamedTuple):
    """The times of one pipeline's stages in sequential runs, in ns.

    `stage_ns`: mean time of a job, by stage. `worked_ns`: total time for which stages worked. `waited_ns`: total time
    for which stages had a job but no core.
    """

    stage_ns: Mapping[str, float]
    worked_ns: int
    waited_ns: int


def measure_beside(
    asked: Sequence[Asked],
    rounds: int,
    processes: Callable[[Sequence[Asked]], AbstractContextManager[list[AvatarProcess]]] = avatar_processes,
) -> list[dict[str, Any]]:
    """Run the two pipelines `asked` at once, and return the row of `measure` for each, with medians over the `rounds`.

    `processes`: function that starts the processes. Raises TrilaneError if a process or a run fails.
    """
    found: list[list[dict[str, float]]] = []
    with processes(asked) as pair:
        before = [_ran_alone(each) for each in pair]
        for _ in range(rounds):
            for each in pair:
                each.begin(PIPELINED)
            both = [each.result() for each in pair]
            after = [_ran_alone(each) for each in pair]
            isolated = [isolated_of((*one.jobs, *other.jobs)) for one, other in zip(before, after, strict=True)]
            found.append(_round(both, isolated, asked))
            before = after
    return [_row(number, each, [rows[number] for rows in found]) for number, each in enumerate(asked)]


def _ran_alone(process: AvatarProcess) -> Ran:
    process.begin(SEQUENTIAL)
    return process.result()


def isolated_of(jobs: Sequence[JobRecord]) -> Isolated:
    """Return the times of the stages in sequential runs. `jobs`: all jobs of these runs."""
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
    """Return the mean frame time of each run in ms, over the time in which all runs presented frames.

    `runs`: jobs of each run. Raises TrilaneError if a run presented fewer than three frames in this time.
    """
    ends = [sorted(job.end_ns for job in jobs if job.stage == LAST) for jobs in runs]
    if not all(ends):
        raise TrilaneError("one of the two runs presented no frame")
    first, last = max(each[0] for each in ends), min(each[-1] for each in ends)
    kept = [[end for end in each if first <= end <= last] for each in ends]
    if min(map(len, kept)) < 3:
        raise TrilaneError(f"the two runs met for {min(map(len, kept))} frames: more --frames are needed")
    return [fmean(after - before for before, after in pairwise(each)) / NS_PER_MS for each in kept]


def computed_ms(
    isolated: Sequence[Isolated], seats: Sequence[Mapping[str, str]], asked: Sequence[Asked]
) -> list[float]:
    """Return the mean frame time of each pipeline in ms, computed in virtual time. All run at once and share cores.

    Each parameter has an element for each pipeline. `isolated`: times of the stages. `seats`: cores of each unit, as
    text, by unit. `asked`: settings of the run.
    """
    stop = (round(SECONDS * 1e9), Stop())
    settings = Settings(ENDLESS, PIPELINED, hang_ns=ENDLESS)
    members = [
        Member(application_graph(each.edge), settings, _service(times), own, inputs=(stop,))
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
