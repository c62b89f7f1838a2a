"""Computes what bounded a run and how well it used its cores, once for everyone who shows it.

Rule: report.json, the table, `trilane explain`, the dashboard and Python take these figures; nobody computes them
again. The memory for reading a run is bounded, however long the run lasts.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Reversible
from typing import Any, NamedTuple

from trilane.pipeline.cpu_use import Efficiencies
from trilane.pipeline.critical_path import Budget, Part, Paths
from trilane.pipeline.journal import Begun, Record, config_of
from trilane.pipeline.sharing import Sharing, Taken
from trilane.pipeline.timeline import Down, ExplainedJob, Timeline
from trilane.scheduler.events import Graph, Settings
from trilane.scheduler.places import Place, Placement


class Reckoned(NamedTuple):
    """What bounded a whole run.

    `budget`: ns of the critical path by kind and stage.
    `taken`: who had the core of each stage's unit, by stage.
    `figures`: `bottleneck`, `bound`, `efficiency`, `core_efficiency` and `machine_efficiency` of a report.
    """

    budget: Mapping[Part, int]
    taken: Mapping[str, Taken]
    figures: Mapping[str, Any]


class Reckoning:
    """Takes the jobs of a run in order, with their waits explained.

    `graph`, `settings`: graph and settings of the run.
    `places`: places of its units, as far as they are known.
    `downs`: times in which units were down so far, as `Timeline` notes them.
    `paths`, `sharing`: paths and core sharing of the jobs so far.
    """

    def __init__(self, graph: Graph, settings: Settings, places: Placement, downs: Reversible[Down]) -> None:
        self.paths = Paths(graph, settings, downs)
        self.sharing = Sharing({unit: place.cores for unit, place in places.items()})
        self._budget = Budget(self.paths, self.sharing)
        # as if each unit had a core of its own
        own = {unit: Place((-1 - number,), 1) for number, unit in enumerate(graph.units)}
        self._efficiencies = Efficiencies({**own, **places})
        self._unit_of = {stage.name: stage.unit for stage in graph.stages}

    @property
    def bound(self) -> Mapping[str, Any] | None:
        """The `bound` of a report, by the path so far; None until 63 frames were presented."""
        return self._budget.bound(self._unit_of).get("bound")

    def add(self, explained: ExplainedJob) -> None:
        """Take the next job that has ended."""
        self.paths.add(explained)
        self.sharing.add(explained.job)
        presents = explained.presented is not None
        self._efficiencies.add(explained.job, presents=presents)
        if presents:
            self._budget.present(explained)

    def close(self) -> Reckoned:
        """Return the result; called after the last job."""
        budget = self._budget.close()
        figures = {**self._efficiencies.close(), **self._budget.bound(self._unit_of)}
        return Reckoned(budget, self.sharing.close(), figures)


def places_of(begun: Begun) -> dict[str, Place]:
    """Return the cores and threads of each unit, as far as the journal's first record has them.

    They are those of `Pipeline.places`. Raises BadInputError for a configuration that is none of a run.
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
    reckoning = Reckoning(graph, settings, places, timeline.downs)
    for record in records:
        for fact in timeline.add(record):
            if isinstance(fact, ExplainedJob):
                reckoning.add(fact)
    return reckoning.close()
