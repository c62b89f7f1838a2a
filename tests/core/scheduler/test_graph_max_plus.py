"""The period of a graph is its greatest cycle ratio in max-plus algebra, which networkx finds here.

With a unit for each stage, slots and frames in flight, a job's dispatch waits for the end of other jobs alone, plus the
delay d of a message there and back. So its time is a maximum of sums, and the period is the greatest ratio of the times
on a cycle of such waits to the frames between its two ends. The waits of stage i's job for frame k are:

- for the end of each input's job for frame k;
- for the end of each reader's job for frame k - n, which gives the slot back, n being the slots of the stream;
- for the end of its own job for frame k - 2, because a unit holds two jobs; the job begins when k - 1 has ended. So
  dispatch ahead hides the messages: the cycle of a unit alone takes the greater of its service time and of half its
  service time and two messages. Without delays nothing is won: what a job waits for is over when it could begin.
- of the source, for the last stages' ends of frame k - L, L being the limit of frames in flight.
"""

from __future__ import annotations

import random
from dataclasses import dataclass
from fractions import Fraction
from itertools import pairwise

import networkx as nx
import pytest

from trilane.scheduler.events import Graph, Input, Settings, StageSpec
from trilane.scheduler.virtual import simulate

MS = 1_000_000
FRAMES = 700


@dataclass(frozen=True)
class Drawn:
    graph: Graph
    slots: dict[str, int]
    times: dict[str, int]
    delay_ns: int
    in_flight: int


def drawn(seed: int, units: int = 0) -> Drawn:
    """Up to 12 stages behind one source, streams of 1 to 4 slots. `units`: how many they share; 0: each has its own.

    Times are whole ms, or two cycles may have nearly the same ratio, and the run finds its period after very long.
    """
    draw = random.Random(f"{seed} max-plus")
    stages = []
    for place in range(draw.randint(2, 12)):
        read = sorted(draw.sample(range(place), min(place, draw.choice([1, 1, 2, 3]))))
        unit = f"u{draw.randrange(units)}" if units else f"u{place}"
        stages.append(StageSpec(f"s{place}", unit, tuple(Input(f"s{each}") for each in read)))
    read_of = {each.stage for stage in stages for each in stage.inputs or ()}
    slots = {stage.name: draw.randint(1, 4) for stage in stages if stage.name in read_of}
    edges = tuple(f"fifo:{count}" for count in slots.values())
    times = {stage.name: draw.randint(1, 12) * MS for stage in stages}
    delay_ns = draw.choice([0, 0, MS // 2, 3 * MS])
    return Drawn(Graph(tuple(stages), edges, "s0"), slots, times, delay_ns, draw.choice([0, 0, 0, 2, 4]))


def waits(case: Drawn) -> list[tuple[str, str, int, int]]:
    """Waits as (waited for, waiting, ns, frames between), of the dispatches and begins of the stages."""
    found = []
    ends = [stage.name for stage in case.graph.stages if stage.name not in case.slots]
    for stage in case.graph.stages:
        name, after_ns = stage.name, case.times[stage.name] + case.delay_ns
        dispatch, begin = f"dispatch {name}", f"begin {name}"
        found.append((dispatch, begin, case.delay_ns, 0))
        found.append((begin, begin, case.times[name], 1))
        found.append((begin, dispatch, after_ns, 2))
        for each in stage.inputs or ():
            found.append((f"begin {each.stage}", dispatch, case.times[each.stage] + case.delay_ns, 0))
            found.append((begin, f"dispatch {each.stage}", after_ns, case.slots[each.stage]))
        if case.in_flight and name in ends:
            found.append((begin, "dispatch s0", after_ns, case.in_flight))
    return found


def greatest_ratio(found: list[tuple[str, str, int, int]]) -> Fraction:
    """Of the ns to the frames of a cycle, by halving: does some cycle have a greater ratio?

    A ratio's denominator is at most the sum of all frames, so that two ratios differ by 1 / sum^2 at least.
    """

    def is_exceeded(ratio: Fraction) -> bool:
        graph = nx.DiGraph()
        for begin, end, ns, frames in found:
            cost = ratio.numerator * frames - ratio.denominator * ns
            if not graph.has_edge(begin, end) or cost < graph.edges[begin, end]["weight"]:
                graph.add_edge(begin, end, weight=cost)
        return bool(nx.negative_edge_cycle(graph, heuristic=False))

    most = sum(frames for *_, frames in found)
    low = max(Fraction(ns, frames) for begin, end, ns, frames in found if begin == end)
    if not is_exceeded(low):
        return low
    high = Fraction(sum(ns for _, _, ns, _ in found))
    while high - low > Fraction(1, 2 * most**2):
        middle = ((low + high) / 2).limit_denominator(8 * most**2)
        low, high = (middle, high) if is_exceeded(middle) else (low, middle)
    return high.limit_denominator(most)


def last_ends(case: Drawn, frames: int) -> list[int]:
    done = simulate(
        case.graph,
        Settings(frames, in_flight=case.in_flight),
        lambda stage, *_: case.times[stage],
        message_delay_ns=case.delay_ns,
        keep=True,
    )
    return [job.end_ns for job in done.jobs if job.stage == case.graph.stages[-1].name]


def simulated_period(case: Drawn) -> Fraction:
    """Of the last frames: the shortest sequence of intervals that is there three times in a row."""
    steps = [later - earlier for earlier, later in pairwise(last_ends(case, FRAMES))]
    for length in range(1, len(steps) // 4):
        if steps[-length:] == steps[-2 * length : -length] == steps[-3 * length : -2 * length]:
            return Fraction(sum(steps[-length:]), length)
    raise AssertionError("the run does not repeat itself")


@pytest.mark.parametrize("seed", range(40))
def test_a_unit_for_each_stage_has_exactly_the_period_of_max_plus(seed: int) -> None:
    case = drawn(seed)
    assert simulated_period(case) == greatest_ratio(waits(case))


@pytest.mark.parametrize("seed", range(40))
def test_shared_units_are_never_faster_than_the_bound(seed: int) -> None:
    """A unit that several stages share adds the sum of their times for each frame.

    At the beginning no frame is in the graph, and at the end as many are gone as its slots and units could hold.
    """
    case = drawn(seed, units=random.Random(seed).randint(1, 4))
    work = dict.fromkeys(case.graph.units, 0)
    for stage in case.graph.stages:
        work[stage.unit] += case.times[stage.name]
    bound = max(greatest_ratio(waits(case)), Fraction(max(work.values())))
    held = sum(case.slots.values()) + 2 * len(work)
    ends = last_ends(case, FRAMES)
    assert ends[-1] - ends[0] >= bound * (len(ends) - 1 - held)


def test_messages_are_hidden_behind_the_running_job() -> None:
    """A stage of 3 ms alone: a message of 1 ms each way costs nothing, one of 2 ms makes half of 3 + 4."""
    graph = Graph((StageSpec("s0", "u0", ()),), (), "s0")
    for delay_ms, period_ns in ((1, 3 * MS), (2, 7 * MS // 2)):
        case = Drawn(graph, {}, {"s0": 3 * MS}, delay_ms * MS, 0)
        assert simulated_period(case) == greatest_ratio(waits(case)) == period_ns
