"""The least period of a graph: by hand, against networkx, and against the scheduler in virtual time."""

from __future__ import annotations

import random
from fractions import Fraction

import pytest

from trilane.scheduler.events import Graph, Input, Settings, StageSpec, chain
from trilane.scheduler.period_bound import fewest_slots, period_bound
from trilane.scheduler.virtual import simulate
from trilane.transport.slots import edge_rule

FIVE = [2, 3, 5, 4, 1]
NAMES = [f"s{place}" for place in range(len(FIVE))]


def graph(edges: dict[str, str], *stages: StageSpec) -> Graph:
    """A graph whose streams have the rules `edges`, double where none is given."""
    read = {each.stage for stage in stages for each in stage.inputs or ()}
    bare = Graph(stages, ("double",) * len(read), stages[-1].name)
    return Graph(stages, tuple(edges.get(name, "double") for name in bare.streams), stages[-1].name)


def reads(name: str, *sources: str, unit: str = "", every: int = 1) -> StageSpec:
    return StageSpec(name, unit or f"u-{name}", tuple(map(Input, sources)), every)


DEPTH = (reads("frame"), reads("depth", "frame"), reads("seg", "frame"), reads("composite", "depth", "seg"))
DEPTH_NS = {"frame": 2, "depth": 14, "seg": 10, "composite": 3}


@pytest.mark.parametrize(
    ("edge", "in_flight", "period", "stages"),
    [
        ("single", 0, 9, ("s2", "s3")),
        ("double", 0, 5, ("s2",)),
        ("double", 1, 15, tuple(NAMES)),
        ("double", 2, Fraction(15, 2), tuple(NAMES)),
        ("double", 3, 5, ("s2",)),
    ],
)
def test_the_chain_of_five(edge: str, in_flight: int, period: float, stages: tuple[str, ...]) -> None:
    found = period_bound(
        chain([(n, f"u{n}") for n in NAMES], edge, "s4"), dict(zip(NAMES, FIVE, strict=True)), in_flight
    )
    assert (found.period_ns, found.stages) == (period, stages)


def test_a_join_and_the_rate_of_its_source() -> None:
    double, single = graph({}, *DEPTH), graph(dict.fromkeys(("frame", "depth", "seg"), "single"), *DEPTH)
    assert (period_bound(double, DEPTH_NS).period_ns, period_bound(double, DEPTH_NS).stages) == (14, ("depth",))
    found = period_bound(single, DEPTH_NS)
    assert (found.period_ns, found.stages, found.limit, found.streams) == (
        17,
        ("depth", "composite"),
        "slots",
        ("depth",),
    )
    paced = period_bound(double, DEPTH_NS, source_ns=20)
    assert (paced.period_ns, paced.stages, paced.limit) == (20, ("frame",), "rate")


def test_a_unit_shared_by_a_stage_of_each_frame_and_one_of_each_third() -> None:
    stages = (reads("frame"), reads("tracker", "frame", unit="npu"), reads("detector", "frame", unit="npu", every=3))
    found = period_bound(graph({}, *stages), {"frame": 0, "tracker": 12, "detector": 45})
    assert (found.period_ns, found.stages, found.limit) == (27, ("tracker", "detector"), "unit npu")


def test_a_rare_slow_reader_holds_its_slot_while_the_others_pass() -> None:
    """Single behind the camera: frame 4 waits until the slow stage has done frame 0, 1 ms + 20 ms after its begin."""
    stages = (reads("camera"), reads("fast", "camera"), reads("slow", "camera", every=4))
    times = {"camera": 1, "fast": 2, "slow": 20}
    found = period_bound(graph({"camera": "single"}, *stages), times)
    assert found.period_ns == Fraction(21 + 3 * 3, 4)  # frames 1 to 3 take 3 ms each
    assert period_bound(graph({}, *stages), times).period_ns == Fraction(20, 4)


def test_newest_inputs_and_replacing_rules_hold_back_nobody() -> None:
    stages = (reads("camera"), StageSpec("slow", "u", (Input("camera", latest=True),)))
    assert period_bound(graph({}, *stages), {"camera": 2, "slow": 7}).period_ns == 7  # its own unit
    skip = (reads("camera"), reads("a", "camera"), reads("b", "a"), reads("c", "b"), reads("join", "camera", "c"))
    times = dict.fromkeys(("camera", "a", "b", "c", "join"), 1)
    assert period_bound(graph({"camera": "fifo:3"}, *skip), times).period_ns == Fraction(5, 3)
    assert period_bound(graph({"camera": "triple"}, *skip), times).period_ns == 1


def _random(seed: int, most_every: int = 1) -> tuple[Graph, dict[str, int], int]:
    """A graph of up to seven stages on a unit each, its times, and a limit of frames in flight."""
    rng = random.Random(seed)
    stages: list[StageSpec] = []
    for place in range(rng.randint(2, 7)):
        known = [stage.name for stage in stages]
        sources = rng.sample(known, min(len(known), rng.choice((1, 1, 2, 3)))) if known else []
        stages.append(reads(f"s{place}", *sources, every=rng.randint(1, most_every)))
    rules = {stage.name: rng.choice(("single", "double", "fifo:3", "fifo:4")) for stage in stages}
    times = {stage.name: rng.randint(1, 40) for stage in stages}
    return graph(rules, *stages), times, rng.choice((0, 0, 1, 2, 5))


@pytest.mark.parametrize("seed", range(60))
def test_it_is_the_largest_ratio_of_networkx_cycles(seed: int) -> None:
    """The waits are written down once more here, and every simple cycle is looked at."""
    networkx = pytest.importorskip("networkx", reason="networkx is in the extra peers")
    known, times, in_flight = _random(seed)
    slots = {name: edge_rule(rule).slots for name, rule in zip(known.streams, known.edges, strict=True)}
    waits = networkx.DiGraph()  # of the ends of jobs: an arc takes the time of the later job

    def wait(before: str, after: str, frames: int) -> None:
        old = waits.get_edge_data(before, after, {"frames": frames})["frames"]
        waits.add_edge(before, after, frames=min(frames, old))

    for name in times:
        wait(f"begin {name}", f"end {name}", 0)
        wait(f"end {name}", f"begin {name}", 1)
    for name, readers in known.streams.items():
        for reader in readers:
            wait(f"end {name}", f"begin {reader}", 0)
            wait(f"end {reader}", f"begin {name}", slots[name])
    for end in set(times) - set(known.streams):
        if in_flight:
            wait(f"end {end}", "begin s0", in_flight)
    ratios = []
    for cycle in networkx.simple_cycles(waits):
        pairs = [(cycle[place - 1], cycle[place]) for place in range(len(cycle))]
        frames = sum(waits.edges[pair]["frames"] for pair in pairs)
        ratios.append(Fraction(sum(times[b[6:]] for b in cycle if b.startswith("begin")), frames))
    assert period_bound(known, times, in_flight).period_ns == max(ratios)


@pytest.mark.parametrize("seed", range(40))
def test_the_scheduler_reaches_it(seed: int) -> None:
    """Over 240 frames after 240: what a beat of several frames leaves open is less than the work of one frame."""
    known, times, in_flight = _random(seed)
    done = simulate(known, Settings(480, in_flight=in_flight), lambda stage, *_: times[stage], keep=True)
    last = [job.end_ns for job in done.jobs if job.stage == known.latency_to]
    bound = period_bound(known, times, in_flight).period_ns
    assert abs(last[479] - last[239] - 240 * bound) < sum(times.values())


@pytest.mark.parametrize("seed", range(40))
def test_the_scheduler_is_never_faster_with_slow_branches(seed: int) -> None:
    known, times, in_flight = _random(seed, most_every=3)
    frames = 480
    done = simulate(known, Settings(frames, in_flight=in_flight), lambda stage, *_: times[stage], keep=True)
    first = [job.begin_ns for job in done.jobs if job.stage == "s0"]
    period = known.stages[0].every  # of the only source, so of all frames
    bound = period_bound(known, times, in_flight).period_ns
    assert first[-1] - first[len(first) // 2] > (len(first) // 2 - 2) * period * bound - 4 * period * sum(
        times.values()
    )


def test_slots_where_branches_meet_are_the_fewest() -> None:
    """A side of one stage beside a side of three: the camera's slot is held for four stages of 1 ms."""
    stages = (
        *(reads("camera"), reads("side", "camera"), reads("a", "camera"), reads("b", "a"), reads("c", "b")),
        reads("join", "side", "c"),
    )
    times = dict.fromkeys(("camera", "side", "a", "b", "c", "join"), 1)
    known = graph({}, *stages)
    assert fewest_slots(known, times) == [4, 2, 2, 2, 2]
    assert period_bound(graph({"camera": "fifo:4"}, *stages), times).period_ns == 1
    assert period_bound(graph({"camera": "fifo:3"}, *stages), times).period_ns > 1
    slow = {**times, "join": 4}
    assert fewest_slots(known, slow) == [2, 2, 2, 2, 2]  # the join is slower than what two slots lose


def _large(seed: int) -> tuple[Graph, dict[str, int], int]:
    """A graph of up to 16 stages on a unit each, double everywhere."""
    rng = random.Random(seed)
    stages: list[StageSpec] = []
    for place in range(rng.randint(9, 16)):
        known = [stage.name for stage in stages]
        stages.append(
            reads(f"s{place}", *(rng.sample(known, min(len(known), rng.choice((1, 1, 2, 3)))) if known else []))
        )
    return graph({}, *stages), {stage.name: rng.choice((1, 2, 3, 5, 8)) for stage in stages}, 0


#: In the last one a slot that was added becomes superfluous by a later one.
GRAPHS = [*(_random(seed) for seed in range(40)), *(_large(seed) for seed in range(20, 28))]


@pytest.mark.parametrize("case", GRAPHS)
def test_no_slot_of_the_fewest_can_be_left_out(case: tuple[Graph, dict[str, int], int]) -> None:
    known, times, in_flight = case

    def period(slots: list[int]) -> Fraction:
        rules = tuple(f"fifo:{count}" for count in slots)
        return period_bound(Graph(known.stages, rules, known.latency_to), times, in_flight).period_ns

    slots = fewest_slots(known, times, (), in_flight)
    most = period([64] * len(slots))
    assert period(slots) == most
    for place, count in enumerate(slots):
        if count > 2:
            assert period([*slots[:place], count - 1, *slots[place + 1 :]]) > most


def test_a_given_rule_stays() -> None:
    assert fewest_slots(graph({"depth": "single"}, *DEPTH), DEPTH_NS, ["depth"]) == [2, 1, 2]


def test_stages_that_frames_skip_count_by_the_share_of_those_that_do_not() -> None:
    """By one slot b 10 and c 3 take turns, 13. With a fifth of the frames at b, its unit works 2 a frame, c 3."""
    stages = tuple(StageSpec(name, name) for name in "abc")
    known = Graph(stages, ("single", "single"), "c", ("a", "c"))
    times = {"a": 2, "b": 10, "c": 3}
    assert period_bound(known, times).period_ns == 13
    some = period_bound(known, times, shares={"b": Fraction(1, 5)})
    assert (some.period_ns, some.stages, some.limit) == (3, ("c",), "unit c")
    assert period_bound(known, times, shares={"b": Fraction(1, 2)}).period_ns == 5
    assert period_bound(known, times, 0, 7, {"b": Fraction(1, 2)}).limit == "rate"
