"""Cores that units share, against times by hand and against a kernel that gives slices in turn."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import pairwise
from random import Random

import pytest

from support.sliced_kernel import STAGES, placed_frame_ms
from trilane.scheduler.events import Graph, Settings, chain
from trilane.scheduler.placement import Place, Placement
from trilane.scheduler.virtual import BALANCE_NS, Need, SharedCores

#: Frames that fill the pipeline, and as many at the end, behind which it runs empty, do not count.
MS, FRAMES, WARM = 1_000_000, 72, 12
NAMES = ("pose", "raster", "infer", "composite", "present")
ON_0, ON_1, FLOATS = Place((0,), 1), Place((1,), 1), Place((0, 1), 1)


def graph_of(stages: Mapping[str, str]) -> Graph:
    return chain(stages.items(), "double", [*stages][-1])


def frame_ms(
    stages: Mapping[str, str], places: Placement, ms: Mapping[str, tuple[float, float]], message_ms: float = 0.0
) -> float:
    """Mean frame time. `ms`: of each stage, CPU time and time without a core."""
    needs = {stage: Need(cpu_ms * MS, other_ms * MS) for stage, (cpu_ms, other_ms) in ms.items()}
    run = SharedCores(graph_of(stages), Settings(FRAMES), places, lambda stage, _: needs[stage], round(message_ms * MS))
    ends_ns = [end_ns for _, end_ns in run.run()]
    assert len(ends_ns) == FRAMES
    return (ends_ns[-WARM] - ends_ns[WARM]) / (FRAMES - 2 * WARM) / MS


TWO = {"a": "one", "b": "two"}


@pytest.mark.parametrize(
    ("places", "a", "b", "expected"),
    [
        ({"one": ON_0, "two": ON_1}, (4, 0), (6, 0), 6),  # the longer of two, each on a core of its own
        ({"one": ON_0, "two": ON_0}, (4, 0), (6, 0), 10),  # both on one core
        # a begins when b takes its slot, so b computes on half of the core; then b needs none, and a is done before
        ({"one": ON_0, "two": ON_0}, (4, 0), (1, 5), 2 * 1 + 5),
        ({"one": ON_0, "two": ON_0}, (4, 0), (3, 5), 2 * 3 + 5),
        ({"one": ON_0, "two": FLOATS}, (4, 0), (6, 0), 6),  # the one that floats goes where nobody is
        ({"one": Place((0, 1), 2), "two": ON_1}, (4, 0), (6, 0), 10),  # its threads go on when core 1 is theirs
        ({"one": Place((0, 1), 2), "two": Place((0, 1), 2)}, (4, 0), (6, 0), 10),
    ],
)
def test_two_units(places: Placement, a: tuple[float, float], b: tuple[float, float], expected: float) -> None:
    assert frame_ms(TWO, places, {"a": a, "b": b}) == pytest.approx(expected, rel=1e-6)


def test_a_message_delays_a_unit_that_has_nothing_else_to_do() -> None:
    """Sequential, so each of two jobs waits for the message of the other; pipelined, a job waits in its unit."""
    needs = {"a": Need(2 * MS), "b": Need(3 * MS)}
    run = SharedCores(
        graph_of(TWO), Settings(10, "sequential"), {"one": ON_0, "two": ON_1}, lambda stage, _: needs[stage], MS // 2
    )
    ends_ns = [end_ns for _, end_ns in run.run()]
    assert {after - before for before, after in pairwise(ends_ns)} == {6 * MS}
    assert frame_ms(TWO, {"one": ON_0, "two": ON_1}, {"a": (2, 0), "b": (3, 0)}, 0.5) == pytest.approx(3)


def test_a_job_longer_than_its_core_waits_for_one_is_a_defect_of_the_caller() -> None:
    run = SharedCores(graph_of(TWO), Settings(1), {"one": ON_0, "two": ON_1}, lambda *_: Need(11_000 * MS))
    with pytest.raises(RuntimeError, match=r"Kill\(unit='one'\): hang_ns"):
        run.run()


def test_a_core_that_becomes_idle_pulls_the_unit_that_floats() -> None:
    """Both cores do 16 ms a frame together. One core at most idles until the next tick, once a frame."""
    stages = {"a": "one", "b": "two", "c": "three"}
    places = {"one": ON_0, "two": ON_1, "three": FLOATS}
    ms = {"a": (5.0, 0.0), "b": (5.0, 0.0), "c": (6.0, 0.0)}
    assert 8 <= frame_ms(stages, places, ms) <= 8 + BALANCE_NS / MS / 2
    pinned = {**places, "three": ON_1}
    assert frame_ms(stages, pinned, ms) == pytest.approx(11, rel=1e-6)


@pytest.mark.parametrize("seed", range(24))
def test_it_is_near_a_kernel_that_gives_slices_in_turn(seed: int) -> None:
    """A second implementation in steps of 0.1 ms: a job ends with a step, five jobs a frame, so at most 0.5 ms more.

    A slice of 1 ms may end a job later than an equal share would, by a slice. The other kernel lets an idle core pull
    at any time and only what waits, so with units that float the two differ by up to a tenth.
    """
    draw = Random(seed)
    ms = {unit: draw.uniform(3.0, 20.0) for unit in ("cpu", "gpu", "dsp")}
    places = {unit: draw.choice([ON_0, ON_1, FLOATS]) for unit in ms}
    floats = FLOATS in places.values()
    stages = dict(zip(NAMES, (unit for unit, _ in STAGES), strict=True))
    parts = {name: (ms[unit] * part, 0.0) for name, (unit, part) in zip(NAMES, STAGES, strict=True)}
    theirs = placed_frame_ms(places, ms, 0.0)
    mine = frame_ms(stages, places, parts)
    assert mine == pytest.approx(theirs, **({"rel": 0.1} if floats else {"abs": 0.5 + 1.0}))
    # the frames under way at both ends of what counts may differ by one
    most = mine * (1 + 1 / (FRAMES - 2 * WARM))
    assert most >= max(sum(ms[unit] for unit, place in places.items() if place == own) for own in (ON_0, ON_1))
    assert 2 * most >= sum(ms.values())


def test_a_unit_that_wakes_goes_to_a_core_of_its_own_that_is_idle() -> None:
    """a: 0 to 4 and 4 to 8 ms on core 0, so b begins at 4 on core 1, and has it for 6 ms a frame."""
    needs = {"a": Need(4 * MS), "b": Need(6 * MS)}
    places = {"one": ON_0, "two": FLOATS}
    run = SharedCores(graph_of(TWO), Settings(2), places, lambda stage, _: needs[stage])
    assert run.run() == [(0, 10 * MS), (1, 16 * MS)]


@pytest.mark.parametrize(
    ("scheduler_ms", "places", "expected"),
    [
        (0.5, {"one": ON_0, "two": ON_1}, 6.0),  # it has room beside a
        (1.5, {"one": ON_0, "two": ON_1}, 4 + 2 * 1.5),  # it takes more of core 0 than a leaves
        (0.5, {"one": ON_0, "two": ON_0}, 4 + 6 + 2 * 0.5),
    ],
)
def test_the_scheduler_takes_cpu_time_of_the_first_units_cores(
    scheduler_ms: float, places: Placement, expected: float
) -> None:
    """Two jobs a frame, of 4 and 6 ms, and a step for each."""
    needs = {"a": Need(4 * MS), "b": Need(6 * MS)}
    run = SharedCores(
        graph_of(TWO), Settings(FRAMES), places, lambda stage, _: needs[stage], scheduler_ns=round(scheduler_ms * MS)
    )
    ends_ns = [end_ns for _, end_ns in run.run()]
    assert (ends_ns[-WARM] - ends_ns[WARM]) / (FRAMES - 2 * WARM) / MS == pytest.approx(expected, rel=0.01)
