"""The least period of a graph, from the times of its stages: the maximum ratio of a cycle (max-plus algebra).

The period is the time between two frames of the source. A job waits for other jobs: the jobs whose output it reads, the
stage's job before it, and the jobs that free its output slot. These waits form cycles. If the jobs of a cycle take w
ns, and the cycle ends s frames after its beginning, no period below w / s is possible. The bound is the largest ratio
w / s of all cycles. The work of a unit for one frame counts as a cycle, and the period of the source as another. With
constant times and one stage on each unit the bound is reached. If stages share a unit, their order may make the period
longer.

If frames can take a bypass, the bound ignores the slots. The period of a run may then be longer than the bound.

With `every` a stage takes one frame of several. The pattern of the jobs repeats after a hyperperiod, the least common
multiple of all values of `every`. Each job of a hyperperiod counts by itself. An input with `latest` never delays the
stage that writes its stream. The same holds for an edge whose rule replaces waiting frames (triple, orphan).

Rule: the arithmetic is exact, in whole ns and fractions. Newton's method finds the largest ratio. Each step looks for a
cycle whose ratio is above the largest ratio so far (Bellman and Ford). The search ends when there is no such cycle.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from math import ceil, lcm
from typing import Final, NamedTuple

from trilane.scheduler.events import Graph
from trilane.transport.slots import MAX_SLOTS, edge_rule

#: Most jobs of a hyperperiod for which cycles are searched. With more jobs, only units and source give the bound.
MOST_JOBS: Final = 4096
LEAST_SLOTS: Final = 2
NO_SHARES: Final[Mapping[str, Fraction]] = {}


@dataclass(frozen=True)
class PeriodBound:
    """The least period of a graph.

    `period_ns`: least time between two frames of the source.
    `stages`: stages of the cycle that sets the period, in the order of the graph.
    `limit`: cause of the period: `unit NAME`, `slots`, `in_flight` (limit of frames in flight), or `rate` (the
    source's); "" if no stage takes time.
    `streams`: stages of the cycle that wait for a free output slot.
    """

    period_ns: Fraction
    stages: tuple[str, ...]
    limit: str
    streams: tuple[str, ...] = ()


class _Arc(NamedTuple):
    """A wait of one job for another.

    `job`: index, in `_Waits.stages`, of the job that ends the wait.
    `to`: index of the waiting job, in the hyperperiod that is `tokens` hyperperiods later.
    `ns`: least time from the begin of `job` to the begin of `to`.
    `stream`: stage for whose output slot the job waits; "": it waits for something else.
    `in_flight`: whether the job waits because of the limit of frames in flight.
    """

    job: int
    to: int
    ns: int
    tokens: int
    stream: str = ""
    in_flight: bool = False


class _Waits:
    """The waits between the jobs of one hyperperiod of a graph.

    `arcs` computes the waits for slots, for given numbers of slots. All other waits are computed once, here.
    """

    def __init__(self, graph: Graph, times_ns: Mapping[str, int], in_flight: int) -> None:
        self.graph, self.times_ns = graph, times_ns
        self.names = [stage.name for stage in graph.stages]
        self.periods = _periods(graph)
        self.hyperperiod = lcm(*self.periods.values())
        self.is_small = sum(self.hyperperiod // period for period in self.periods.values()) <= MOST_JOBS
        self.stages: list[str] = []  # the stage of each job
        self._place: dict[tuple[str, int], int] = {}
        self._fixed: list[_Arc] = []
        if self.is_small:
            jobs = sorted(
                (frame, place)
                for place, name in enumerate(self.names)
                for frame in range(0, self.hyperperiod, self.periods[name])
            )
            self.stages = [self.names[place] for _, place in jobs]
            self._place = {(self.names[place], frame): index for index, (frame, place) in enumerate(jobs)}
            self._fixed = [*self._of_frames(), *(self._of_flight(in_flight) if in_flight else ())]

    def arcs(self, slots: Mapping[str, int]) -> list[_Arc]:
        """Return all waits, sorted by `_Arc.job`. `slots`: number of slots of each stream that can delay its writer."""
        found = [*self._fixed]
        for name, count in slots.items():
            for reader in self.frame_readers(name):
                found += self._behind(reader, name, count, self.periods[name], stream=name)
        return sorted(found, key=lambda arc: arc.job)

    def frame_readers(self, name: str) -> Iterator[str]:
        """Yield the names of the stages that read stage `name` by an input without `latest`."""
        for index, stage in enumerate(self.graph.stages):
            if any(each.stage == name and not each.latest for each in self.graph.inputs_of(index)):
                yield stage.name

    def _of_frames(self) -> Iterator[_Arc]:
        """Yield the waits of jobs for their inputs, and for the earlier job of the same stage."""
        for index, name in enumerate(self.names):
            for frame in range(0, self.hyperperiod, self.periods[name]):
                yield self._arc(name, frame, name, frame + self.periods[name])
                for each in self.graph.inputs_of(index):
                    if not each.latest:
                        yield self._arc(each.stage, frame, name, frame)

    def _of_flight(self, in_flight: int) -> Iterator[_Arc]:
        """Yield the waits of stages without inputs that come from the limit of frames in flight."""
        read = self.graph.streams
        ends = [name for name in self.names if name not in read]
        roots = [
            name for index, name in enumerate(self.names) if all(one.latest for one in self.graph.inputs_of(index))
        ]
        for end in ends:
            for root in roots:
                yield from self._behind(end, root, in_flight, 1, in_flight=True)

    def _behind(
        self, reader: str, writer: str, count: int, step: int, stream: str = "", in_flight: bool = False
    ) -> Iterator[_Arc]:
        """Yield the waits of `writer` for one of `count` places (slots, or frames in flight) that `reader` frees.

        If the reader takes every q-th frame, its frames f, f + q, ..., f + (count - 1) q fill all places. Therefore the
        writer's next frame, `step` frames after the last of these, waits until the reader has ended f.
        """
        period, own = self.periods[reader], self.periods[writer]
        for frame in range(0, self.hyperperiod, period):
            after = frame + (count - 1) * period + step
            yield self._arc(reader, frame, writer, own * ceil(Fraction(after, own)), stream, in_flight)

    def _arc(self, name: str, frame: int, to: str, later: int, stream: str = "", in_flight: bool = False) -> _Arc:
        tokens, phase = divmod(later, self.hyperperiod)
        places = self._place[name, frame], self._place[to, phase]
        return _Arc(*places, self.times_ns[name], tokens, stream, in_flight)


def _periods(graph: Graph) -> dict[str, int]:
    """Return the period of each stage, by its name. A stage of period n takes every n-th frame."""
    found: dict[str, int] = {}
    for index, stage in enumerate(graph.stages):
        found[stage.name] = lcm(stage.every, *(found[one.stage] for one in graph.inputs_of(index) if not one.latest))
    return found


def period_bound(
    graph: Graph,
    times_ns: Mapping[str, int],
    in_flight: int = 0,
    source_ns: int = 0,
    shares: Mapping[str, Fraction] = NO_SHARES,
) -> PeriodBound:
    """Return the least period of `graph`. With `shares`, or more than MOST_JOBS jobs a hyperperiod, slots do not count.

    `times_ns`: time of a job of each stage, in ns.
    `in_flight`: limit of frames in flight; 0: none.
    `source_ns`: period of the source in ns; 0: the source is always ready.
    `shares`: share (0 to 1) of the frames that do not skip a stage, by the names of the stages that some frames skip.
    Raises ValueError for an unknown rule of an edge.
    """
    return _bound(_Waits(graph, times_ns, in_flight), _slots(graph), source_ns, shares)


def _slots(graph: Graph) -> dict[str, int]:
    """Return the number of slots by stream, for the streams whose writer must wait for a free slot."""
    rules = {name: edge_rule(rule) for name, rule in zip(graph.streams, graph.edges, strict=True)}
    return {name: rule.slots for name, rule in rules.items() if not rule.yields}


def _bound(
    waits: _Waits, slots: Mapping[str, int], source_ns: int = 0, shares: Mapping[str, Fraction] = NO_SHARES
) -> PeriodBound:
    best = max(_of_units(waits, shares), key=lambda bound: bound.period_ns)
    # Without arcs, the work of the units alone bounds the period.
    arcs = waits.arcs(slots) if waits.is_small and not shares else []
    ratio = best.period_ns * waits.hyperperiod
    while cycle := _positive_cycle(len(waits.stages), arcs, ratio):
        ratio = Fraction(sum(arc.ns for arc in cycle), sum(arc.tokens for arc in cycle))
        best = _of_cycle(waits, cycle, ratio / waits.hyperperiod)
    if source_ns > best.period_ns:
        roots = tuple(name for index, name in enumerate(waits.names) if not waits.graph.inputs_of(index))
        return PeriodBound(Fraction(source_ns), roots, "rate")
    return best


def _of_units(waits: _Waits, shares: Mapping[str, Fraction]) -> Iterator[PeriodBound]:
    """Yield, for each unit, the bound that follows from its work for one frame. `shares`: as in `period_bound`."""
    for unit in waits.graph.units:
        names = tuple(stage.name for stage in waits.graph.stages if stage.unit == unit)
        each = {name: shares.get(name, 1) * Fraction(waits.times_ns[name], waits.periods[name]) for name in names}
        work = sum(each.values(), Fraction())
        busy = tuple(name for name, part in each.items() if part)
        yield PeriodBound(work, busy, f"unit {unit}" if work else "")


def _of_cycle(waits: _Waits, cycle: Sequence[_Arc], period_ns: Fraction) -> PeriodBound:
    places = {name: place for place, name in enumerate(waits.names)}
    stages = sorted({waits.stages[arc.job] for arc in cycle}, key=places.__getitem__)
    streams = tuple(dict.fromkeys(arc.stream for arc in cycle if arc.stream))
    limit = "in_flight" if any(arc.in_flight for arc in cycle) else "slots"
    return PeriodBound(period_ns, tuple(stages), limit, streams)


def _positive_cycle(jobs: int, arcs: Sequence[_Arc], ratio: Fraction) -> list[_Arc]:
    """Return the arcs of a cycle that takes longer than `ratio` ns for each hyperperiod; without one, an empty list.

    `arcs`: waits, sorted by `_Arc.job`, so that one round of the search follows most of them.
    """
    weights = [(arc.job, arc.to, arc.ns * ratio.denominator - arc.tokens * ratio.numerator) for arc in arcs]
    begin, before = [0] * jobs, [-1] * jobs
    changed = True
    while changed:
        changed = False
        for index, (job, to, weight) in enumerate(weights):
            if begin[job] + weight > begin[to]:
                begin[to], before[to], changed = begin[job] + weight, index, True
        if changed and (cycle := _circle(arcs, before)):
            return cycle
    return []


def _circle(arcs: Sequence[_Arc], before: Sequence[int]) -> list[_Arc]:
    """Return the arcs of a cycle among the arcs that `before` names; without one, an empty list.

    `before`: for each job, the index of the arc that last made its begin later; -1: no arc did.
    """
    seen = [-1] * len(before)
    for first in range(len(before)):
        job = first
        while seen[job] < 0 and before[job] >= 0:
            seen[job] = first
            job = arcs[before[job]].job
        if seen[job] == first and before[job] >= 0:
            found, place = [arcs[before[job]]], arcs[before[job]].job
            while place != job:
                found.append(arcs[before[place]])
                place = arcs[before[place]].job
            return found
    return []


def fewest_slots(
    graph: Graph, times_ns: Mapping[str, int], given: Collection[str] = (), in_flight: int = 0
) -> list[int]:
    """Return the fewest slots of each stream, at least two, with which the period is as short as possible.

    The numbers are in the order of `graph.edges`. With one slot fewer in any stream of more than two slots, the period
    would be longer. If even MAX_SLOTS slots are too few for a stream, the period stays longer.

    `times_ns`, `in_flight`: as in `period_bound`.
    `given`: names of the streams whose rule, and number of slots, stays as it is in `graph`.
    """
    waits, held = _Waits(graph, times_ns, in_flight), _slots(graph)
    rules = {name: edge_rule(rule).slots for name, rule in zip(graph.streams, graph.edges, strict=True)}
    free = [name for name in rules if name not in given]
    slots = {name: count for name, count in held.items() if name in given}
    least = _bound(waits, slots).period_ns
    slots |= dict.fromkeys(free, LEAST_SLOTS)
    while (now := _bound(waits, slots)).period_ns > least:
        growing = [name for name in now.streams if name in free and slots[name] < MAX_SLOTS]
        if not growing:
            break
        slots = min((_with_one(slots, name, 1) for name in growing), key=lambda each: _bound(waits, each).period_ns)
    least = _bound(waits, slots).period_ns
    # A slot that was added early may not be needed beside those that were added later.
    for name in reversed(free):
        while slots[name] > LEAST_SLOTS and _bound(waits, fewer := _with_one(slots, name, -1)).period_ns <= least:
            slots = fewer
    return [slots[name] if name in free else rules[name] for name in rules]


def _with_one(slots: Mapping[str, int], name: str, change: int) -> dict[str, int]:
    return {**slots, name: slots[name] + change}
