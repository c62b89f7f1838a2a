"""Computes what bounded a run, and how well the run used its cores.

Rule: report.json, the table, `trilane explain`, the dashboard and Python show these figures; no other module computes
them. The memory for reading a run is bounded, however long the run lasts. Nothing is measured here; equal journals give
equal answers.

The bound is found by replays in virtual time (`WhatIf`). Each replay makes one stage slower, and shows what this costs.
The stage that costs most bounds the run.

A share of the critical path says how the time was spent. It does not say how a run reacts to a longer job. The kernel
moves a longer job to another core more often, and takes that core from a unit that was on no path. Therefore
some of the run's frames are replayed (`trilane.scheduler.virtual`), with the CPU times of their own jobs, the run's
placement and the run's scheduler. For each stage these frames are replayed once more, with all jobs of the stage longer
by SLOWER.

A replay contains no other programs, caps or restarts. Therefore it is trusted only if its frame time is near the frame
time of the run.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
from random import Random
from statistics import median
from typing import Any, Final, NamedTuple

from trilane.pipeline.critical_path import Budget, Part, Paths, Sharing, Taken
from trilane.pipeline.journal import Begun, Record, config_of
from trilane.pipeline.run_metrics import Bound
from trilane.pipeline.timeline import ExplainedJob, Timeline
from trilane.pipeline.unit_history import OVERHEAD
from trilane.scheduler.events import NEVER, Graph, Settings
from trilane.scheduler.ledger import JobRecord
from trilane.scheduler.placement import SCHEDULER_NS, Place, Placement, busiest_core_ns
from trilane.scheduler.stats import LEAST_FRAMES, batch_interval
from trilane.scheduler.virtual import Need, SharedCores

SLOWER: Final = 0.2  # share by which the jobs of a stage take longer
#: Largest difference between the frame times of replay and run, as a share of the run's, at which a replay is trusted.
TRUSTED: Final = 0.15
#: Least cost of the bound, as a share of the frame time; if every stage costs less, no stage is the bound.
LEAST_COST: Final = 0.01
#: Most blocks of frames that are kept. If there are more, the kept blocks are drawn at random. Evenly spaced blocks
#: might all show the same part of a motion that repeats.
MOST_BLOCKS: Final = 12
HAND_OVERS: Final = 512  # measured times of hand-over that are kept
#: Number of later frames after which a frame that was not presented counts as lost; more than can be in flight.
MOST_OPEN: Final = 64


class Cost(NamedTuple):
    """The cost of slowing a stage, or all stages of a unit.

    `share`: growth of the frame time, as a share of the frame time.
    `of_blocks`: growth in each block of LEAST_FRAMES frames, as a share of the block's time.
    """

    share: float
    of_blocks: tuple[float, ...]

    def half_width(self, other: Cost | None = None) -> float | None:
        """Return half the 95 % interval of `share`, or of `share - other.share`; None for too few blocks."""
        others = other.of_blocks if other is not None else (0.0,) * len(self.of_blocks)
        return batch_interval([a - b for a, b in zip(self.of_blocks, others, strict=True)])


class ReplayFindings(NamedTuple):
    """The results of the replays.

    `costs`: cost of slowing each stage by SLOWER, by the stage's name.
    `frames`: number of frames that were replayed and counted.
    `over_measured`: frame time of the replay without a slower stage, divided by the same frames' time in the run.
    """

    costs: Mapping[str, Cost]
    frames: int
    over_measured: float

    @property
    def is_trusted(self) -> bool:
        """Whether the replay is near the run, and slowing one of the stages costs at least LEAST_COST."""
        worst = max(cost.share for cost in self.costs.values())
        return abs(self.over_measured - 1) <= TRUSTED and worst >= LEAST_COST

    def by(self, name_of: Mapping[str, str]) -> dict[str, Cost]:
        """Return the sum of the stages' costs for each group, such as a unit. `name_of`: group of each stage."""
        found: dict[str, Cost] = {}
        for stage, cost in self.costs.items():
            was = found.get(name_of[stage], Cost(0.0, (0.0,) * len(cost.of_blocks)))
            both = tuple(a + b for a, b in zip(was.of_blocks, cost.of_blocks, strict=True))
            found[name_of[stage]] = Cost(was.share + cost.share, both)
        return found


class _Block(NamedTuple):
    """LEAST_FRAMES presented frames in a row: needs of each frame's jobs by stage, and the time of the row.

    The time counts from the frame before the row to its last frame.
    """

    needs: tuple[Mapping[str, Need], ...]
    span_ns: int


class WhatIf:
    """Takes the jobs of a run in order, and replays a bounded number of the run's frames, spread over the run.

    Only chains are replayed, and only if all places are known. Runs with frame requests or random arrivals are not.

    `graph`, `settings`: graph and settings of the run.
    `places`: cores and threads of the run's units; a unit whose place is not known is missing.
    """

    def __init__(self, graph: Graph, settings: Settings, places: Placement) -> None:
        self._graph, self._settings, self._places = graph, settings, places
        is_timed_here = not settings.asked and not settings.arrivals_ns
        self._is_known = graph.is_chain and set(graph.units) <= places.keys() and is_timed_here
        self._open: dict[int, dict[str, Need]] = {}
        self._presented: list[Mapping[str, Need]] = []
        self._blocks: list[_Block] = []
        self._count, self._draw = 0, Random(0)
        self._first_ns: int | None = None
        self._handed_ns: list[int] = []

    def add(self, explained: ExplainedJob) -> None:
        """Note the needs of a job for the replays; call this in the order of the jobs' ends.

        The needs of a frame's jobs count only if the frame is presented. Nothing is noted if the run cannot be
        replayed.
        """
        if not self._is_known:
            return
        job = explained.job
        cpu_ns = job.cpu_ns / self._places[job.unit].threads
        other_ns = max(job.end_ns - job.begin_ns - job.preempted_ns - cpu_ns, 0.0)
        self._open.setdefault(job.frame, {})[job.stage] = Need(cpu_ns, other_ns, explained.skips)
        waited_ns = explained.waits_ns.get(OVERHEAD, 0)
        if waited_ns and len(self._handed_ns) < HAND_OVERS:
            self._handed_ns.append(waited_ns)
        if explained.presented is not None:
            self._present(self._open.pop(job.frame), job.end_ns)
            for lost in [frame for frame in self._open if frame < job.frame - MOST_OPEN]:
                del self._open[lost]

    def _present(self, needs: Mapping[str, Need], end_ns: int) -> None:
        if self._first_ns is None:  # the block before which nothing was presented has no span
            self._first_ns = end_ns
        self._presented.append(needs)
        if len(self._presented) < LEAST_FRAMES:
            return
        self._count += 1
        self._blocks.append(_Block(tuple(self._presented), end_ns - self._first_ns))
        if len(self._blocks) > MOST_BLOCKS:
            # Vitter's algorithm R: the last block replaces a kept one at random, or is thrown away.
            place = self._draw.randrange(self._count)
            del self._blocks[place if place < MOST_BLOCKS else MOST_BLOCKS]
        self._first_ns = end_ns
        self._presented = []

    def close(self) -> ReplayFindings | None:
        """Return the results of the replays; None for too few frames, no CPU times, or a run that is not replayed."""
        if len(self._blocks) < 2:
            return None
        # While the first frames fill the pipeline and the last ones empty it, frame times do not count.
        frames = [needs for block in [*self._blocks, self._blocks[0]] for needs in block.needs]
        measured_ns = sum(block.span_ns for block in self._blocks[1:])
        message_ns = round(median(self._handed_ns)) if self._handed_ns else 0
        names = [stage.name for stage in self._graph.stages]
        replays = {name: self._replayed(frames, name, message_ns) for name in ["", *names]}
        count = min(len(spans_ns) for spans_ns in replays.values())
        if not count or not measured_ns or not any(need.cpu_ns for needs in frames for need in needs.values()):
            return None
        plain_ns = replays.pop("")
        costs = {}
        for name, spans_ns in replays.items():
            each = tuple(slow / plain - 1 for slow, plain in zip(spans_ns[:count], plain_ns[:count], strict=True))
            costs[name] = Cost(sum(spans_ns[:count]) / sum(plain_ns[:count]) - 1, each)
        whole_ns = measured_ns / ((len(self._blocks) - 1) * LEAST_FRAMES)
        return ReplayFindings(costs, count * LEAST_FRAMES, sum(plain_ns) / len(plain_ns) / LEAST_FRAMES / whole_ns)

    def _replayed(self, frames: Sequence[Mapping[str, Need]], slowed: str, message_ns: int) -> list[int]:
        """Replay frames, and return the time in ns of each block of LEAST_FRAMES frames but the first and the last.

        `slowed`: name of the slowed stage; "" for none.
        `message_ns`: time from the end of a job until the next job is handed over.
        """

        def need(stage: str, frame: int) -> Need:
            found = frames[frame].get(stage, Need(0.0))
            if stage != slowed:
                return found
            return Need(found.cpu_ns * (1 + SLOWER), found.other_ns * (1 + SLOWER), found.skips)

        settings = replace(self._settings, frames=len(frames), works=(), follow=(), hang_ns=NEVER // 2)
        scheduler_ns = min(SCHEDULER_NS, message_ns)
        run = SharedCores(self._graph, settings, self._places, need, message_ns - scheduler_ns, scheduler_ns)
        ends_ns = [end_ns for _, end_ns in run.run()]
        cuts = ends_ns[LEAST_FRAMES - 1 :: LEAST_FRAMES]
        return [after - before for before, after in pairwise(cuts[:-1])]


class RunEfficiencies:
    """Computes the three efficiencies: work as a share (0 to 1) of the time from first to last presented frame.

    If a job begins before this time or ends after it, only the CPU time that must lie within this time counts. It is
    the job's CPU time less the time that the unit's cores had outside. Therefore the work of a unit, or of a set of
    cores, is never longer than the time.

    A unit's work is the CPU time of its jobs, divided by the number of the unit's threads. Busy time beyond the CPU
    time is added, because a device of the unit worked then while the threads slept.

    `places`: cores and threads of each unit.
    """

    def __init__(self, places: Placement) -> None:
        self._places = places
        self._work_ns: dict[str, float] = dict.fromkeys(places, 0.0)
        self._cpu_ns: dict[str, float] = dict.fromkeys(places, 0.0)
        self._first_ns: int | None = None
        self._last_ns = 0
        self._unsettled: list[JobRecord] = []  # jobs since the last presented frame

    def add(self, job: JobRecord, *, presents: bool) -> None:
        """Take a job; call this in the order of the jobs' ends.

        A job counts as soon as a frame is presented at the job's end or later.

        `presents`: whether this job presents a frame.
        """
        self._unsettled.append(job)
        if not presents:
            return
        self._first_ns = self._first_ns or job.end_ns
        self._last_ns = job.end_ns
        settled = [each for each in self._unsettled if each.end_ns <= job.end_ns]
        self._unsettled = [each for each in self._unsettled if each.end_ns > job.end_ns]
        self._book(settled, self._first_ns)

    def close(self) -> dict[str, float | None]:
        """Return `efficiency`, `core_efficiency` and `machine_efficiency` of a report; called after all jobs.

        `efficiency` is the work of the slowest unit, as a share of the time. `core_efficiency` is the CPU time of the
        units that run only on the fullest set of cores, as a share of that set's time.
        `machine_efficiency` is the CPU time of all units, as a share of the time that all cores had. All are None for
        fewer than two presented frames.
        """
        had_ns = self._last_ns - (self._first_ns or 0)
        if self._first_ns is None or had_ns <= 0:
            return dict.fromkeys(("efficiency", "core_efficiency", "machine_efficiency"))
        self._book(self._unsettled, self._first_ns)
        anywhere = {unit: Place(place.cores, 1) for unit, place in self._places.items()}
        cores = {core for place in anywhere.values() for core in place.cores}
        return {
            "efficiency": max(self._work_ns.values()) / had_ns,
            "core_efficiency": busiest_core_ns(anywhere, self._cpu_ns) / had_ns,
            "machine_efficiency": sum(self._cpu_ns.values()) / len(cores) / had_ns,
        }

    def _book(self, jobs: Sequence[JobRecord], first_ns: int) -> None:
        """Add the work and CPU time of `jobs` that must lie between the first and the last presented frame."""
        for job in jobs:
            cores, threads = self._places[job.unit]
            length_ns = job.end_ns - job.begin_ns
            outside_ns = max(first_ns - job.begin_ns, 0) + max(job.end_ns - self._last_ns, 0)
            busy_ns = length_ns - job.preempted_ns - job.asleep_ns
            work_ns = min(job.cpu_ns / threads, length_ns) + max(busy_ns - job.cpu_ns, 0)
            self._work_ns[job.unit] += max(work_ns - outside_ns, 0)
            self._cpu_ns[job.unit] += max(job.cpu_ns - outside_ns * len(cores), 0)


class Reckoned(NamedTuple):
    """What bounded a whole run.

    `budget`: time of the critical path in ns, by (kind, stage).
    `taken`: for each stage, its time without a core, and the stages that had the core then.
    `figures`: `bottleneck`, `bound`, `efficiency`, `core_efficiency` and `machine_efficiency` of a report.
    """

    budget: Mapping[Part, int]
    taken: Mapping[str, Taken]
    figures: Mapping[str, Any]


class Reckoning:
    """Takes the explained jobs of a run in order, and computes what bounded the run.

    `graph`, `settings`: graph and settings of the run.
    `places`: cores and threads of the run's units; a unit whose place is not known is missing.
    `timeline`: timeline of the run, which gives the explained jobs.
    `paths`, `sharing`: paths and core sharing of the jobs so far.
    """

    def __init__(self, graph: Graph, settings: Settings, places: Placement, timeline: Timeline) -> None:
        self.paths = Paths(graph, settings, timeline.downs, timeline.stalls)
        self.sharing = Sharing({unit: place.cores for unit, place in places.items()})
        self._budget = Budget(self.paths, self.sharing)
        # A unit whose place is not known counts as having a core of its own.
        own = {unit: Place((-1 - number,), 1) for number, unit in enumerate(graph.units)}
        self._efficiencies = RunEfficiencies({**own, **places})
        self._what_if = WhatIf(graph, settings, places)
        self._unit_of = {stage.name: stage.unit for stage in graph.stages}

    @property
    def bound(self) -> Bound | None:
        """The bound of the run, from the path so far and without replays; None until 63 frames are presented."""
        found = _bound(self._budget, self._unit_of, None)["bound"]
        return found and Bound.model_validate(found)

    def add(self, explained: ExplainedJob) -> None:
        """Take a job into all figures of the run; call this in the order of the jobs' ends."""
        self.paths.add(explained)
        self.sharing.add(explained.job)
        presents = explained.presented is not None
        self._efficiencies.add(explained.job, presents=presents)
        self._what_if.add(explained)
        if presents:
            self._budget.present(explained)

    def close(self) -> Reckoned:
        """Return what bounded the run; called after the last job."""
        budget = self._budget.close()
        bound = _bound(self._budget, self._unit_of, self._what_if.close())
        return Reckoned(budget, self.sharing.close(), {**self._efficiencies.close(), **bound})


def _bound(budget: Budget, unit_of: Mapping[str, str], slowed: ReplayFindings | None) -> dict[str, Any]:
    """Return the keys `bottleneck` and `bound` of a report; both values are None if there is no path.

    The bound is the unit, and the stage, whose slowing costs most. If the replays cannot be trusted, the bound is the
    unit, and the stage, with the largest share of the path. If the largest share belongs to no unit (other programs,
    release), its name is the bottleneck even if the replays can be trusted.
    """
    names = budget.names(unit_of)
    path = {kind: budget.largest(name_of) for kind, name_of in names.items()}
    if path["unit"] is None:
        return {"bottleneck": None, "bound": None}
    bound: dict[str, Any] = dict(path)
    if slowed is not None and slowed.is_trusted:
        costs = {"unit": slowed.by(unit_of), "stage": slowed.costs}
        if path["unit"]["name"] not in costs["unit"]:
            del costs["unit"]
        for kind, of in costs.items():
            name = max(of, key=lambda each: of[each].share)
            bound[kind] = {**budget.share(names[kind], name), **_costs_most(of, name)}
        if any((path[kind] or {}).get("name") != bound[kind]["name"] for kind in costs):
            bound["path"] = path
    bound["stages"] = budget.shares(names["stage"])
    if slowed is not None:
        bound["slowed"] = {
            "by": SLOWER,
            "frames": slowed.frames,
            "over_measured": slowed.over_measured,
            "is_trusted": slowed.is_trusted,
            "costs": {stage: _cost(cost) for stage, cost in slowed.costs.items()},
        }
    return {"bottleneck": bound["unit"]["name"], "bound": bound}


def _costs_most(costs: Mapping[str, Cost], name: str) -> dict[str, Any]:
    """Return the keys of `_cost` for `name`, which costs most, and `rivals`: other names that may cost as much."""
    most = costs[name]
    rivals = None
    if most.half_width() is not None:
        near = {other: most.half_width(cost) or 0.0 for other, cost in costs.items()}
        rivals = [other for other, cost in costs.items() if other != name and most.share - cost.share <= near[other]]
    return {"rivals": rivals, **_cost(most)}


def _cost(cost: Cost) -> dict[str, float | None]:
    half = cost.half_width()
    low, high = (None, None) if half is None else (cost.share - half, cost.share + half)
    return {"cost": cost.share, "cost_low": low, "cost_high": high}


def places_of(begun: Begun) -> dict[str, Place]:
    """Return the cores and threads of each unit (`Pipeline.places`) from the journal's first record.

    A unit that the record does not describe is missing. Raises BadInputError for a configuration of another form.
    """
    config = config_of(begun)
    units, pace_ns = config.get("units", {}), config.get("pace_ns", {})
    paced = {stage.unit for stage in begun.graph.stages if pace_ns.get(stage.name)}
    return {
        unit: Place(tuple(own["cores"]), 1 if unit in paced else own.get("threads", 1))
        for unit, own in units.items()
        if unit in begun.graph.units and own.get("cores")
    }


def reckoned(graph: Graph, settings: Settings, places: Placement, records: Iterable[Record]) -> Reckoned:
    """Return what bounded a run. `records`: all records of the run but the first."""
    timeline = Timeline(graph, settings, waits=True)
    reckoning = Reckoning(graph, settings, places, timeline)
    for record in records:
        for fact in timeline.add(record):
            if isinstance(fact, ExplainedJob):
                reckoning.add(fact)
    return reckoning.close()
