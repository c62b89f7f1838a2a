"""Computes what bounded a run and how well it used its cores, once for everyone who shows it.

Rule: report.json, the table, `trilane explain`, the dashboard and Python take these figures; nobody computes them
again. The memory for reading a run is bounded, however long the run lasts.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

from trilane.pipeline.critical_path import Budget, Part, Paths, Sharing, Taken
from trilane.pipeline.journal import Begun, Record, config_of
from trilane.pipeline.timeline import ExplainedJob, Timeline
from trilane.pipeline.what_if import SLOWER, Cost, Slowed, WhatIf
from trilane.scheduler.events import Graph, Settings
from trilane.scheduler.ledger import JobRecord
from trilane.scheduler.placement import Place, Placement, busiest_core_ns


class RunEfficiencies:
    """The shares of work in the time between the first and the last presented frame; no share exceeds 1.

    Jobs are added in the order of their ends. A job may begin before that time or end after it. Such a job counts only
    the CPU time that must lie within: its CPU time less the time that its cores had outside. Therefore the counted work
    of a unit or of a set of cores fits into the time.

    A unit's work counts the CPU time of a job divided by the unit's threads. It also counts the busy time beyond the
    CPU time, because a device of its own worked then while the threads slept.

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
        """Count a job; jobs come in the order of their ends.

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
        """Return `efficiency`, `core_efficiency` and `machine_efficiency` of a report; None for one frame.

        Called after all jobs.

        The first is the work of the slowest unit. The second is the CPU time on the fullest set of cores, of the units
        that have no other cores. No division of the work avoids it. The third is the CPU time of all units on all
        cores. Each is a share of the time that the unit or the cores had.
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
        """Book the part of each job that must lie between the first and the last presented frame."""
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

    `budget`: ns of the critical path by kind and stage.
    `taken`: for each stage, which stages had the core while its jobs lacked one.
    `figures`: `bottleneck`, `bound`, `efficiency`, `core_efficiency` and `machine_efficiency` of a report.
    """

    budget: Mapping[Part, int]
    taken: Mapping[str, Taken]
    figures: Mapping[str, Any]


class Reckoning:
    """Takes the jobs of a run in order, with their waits explained.

    `graph`, `settings`: graph and settings of the run.
    `places`: places of its units, as far as they are known.
    `timeline`: timeline of the run, whose explained jobs are added here.
    `paths`, `sharing`: paths and core sharing of the jobs so far.
    """

    def __init__(self, graph: Graph, settings: Settings, places: Placement, timeline: Timeline) -> None:
        self.paths = Paths(graph, settings, timeline.downs, timeline.stalls)
        self.sharing = Sharing({unit: place.cores for unit, place in places.items()})
        self._budget = Budget(self.paths, self.sharing)
        # as if each unit had a core of its own
        own = {unit: Place((-1 - number,), 1) for number, unit in enumerate(graph.units)}
        self._efficiencies = RunEfficiencies({**own, **places})
        self._what_if = WhatIf(graph, settings, places)
        self._unit_of = {stage.name: stage.unit for stage in graph.stages}

    @property
    def bound(self) -> Mapping[str, Any] | None:
        """The `bound` of a report, by the path so far; None until 63 frames were presented."""
        return _bound(self._budget, self._unit_of, None).get("bound")

    def add(self, explained: ExplainedJob) -> None:
        """Count a job; jobs come in the order of their ends."""
        self.paths.add(explained)
        self.sharing.add(explained.job)
        presents = explained.presented is not None
        self._efficiencies.add(explained.job, presents=presents)
        self._what_if.add(explained)
        if presents:
            self._budget.present(explained)

    def close(self) -> Reckoned:
        """Return the result; called after the last job."""
        budget = self._budget.close()
        bound = _bound(self._budget, self._unit_of, self._what_if.close())
        return Reckoned(budget, self.sharing.close(), {**self._efficiencies.close(), **bound})


def _bound(budget: Budget, unit_of: Mapping[str, str], slowed: Slowed | None) -> dict[str, Any]:
    """Return `bottleneck` and `bound` of a report; both None where there is no path.

    The bound is what costs most when it is slowed; without a replay that can be trusted, what has most of the path.
    Where most of the path is no unit's, that is the bottleneck, whatever slowing a unit costs.
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
    """Return the cost of `name`, which is the largest, and its rivals: the others whose cost may be as large."""
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
    """Return the cores and threads of each unit, as far as the journal's first record has them.

    They are those of `Pipeline.places`. Raises BadInputError for a configuration of another form.
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
    """Return what bounded a run. `records`: records of the run after the first."""
    timeline = Timeline(graph, settings, waits=True)
    reckoning = Reckoning(graph, settings, places, timeline)
    for record in records:
        for fact in timeline.add(record):
            if isinstance(fact, ExplainedJob):
                reckoning.add(fact)
    return reckoning.close()
