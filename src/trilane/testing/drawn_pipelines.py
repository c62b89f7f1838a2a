"""Pipelines, settings and faults drawn at random. Rule: the same seed draws the same."""

from __future__ import annotations

import random
from typing import Any

from trilane.scheduler.events import Graph, Settings, StageSpec
from trilane.testing.plain_state import SLOTS


def service_of(seed: int) -> Any:
    """0.2 to 5 ms, other for each stage and frame, so that hardly two jobs end in one instant."""
    return lambda stage, _unit, frame, _begin_ns: random.Random(f"{seed} {stage} {frame}").randint(200_000, 5_000_000)


def drawn(seed: int) -> tuple[Graph, Settings, int, list[tuple[int, str]], dict[str, int]]:
    draw = random.Random(seed)
    policy = draw.choice(["sequential", "pipelined", "pipelined", "latest", "deadline"])
    count = draw.randint(1, 5)
    stages = tuple(StageSpec(f"s{i}", draw.choice(["cpu", "gpu", "dsp"])) for i in range(count))
    # a frame that waits for a slot of the next edge is given up as late when its unit is looked at, which need not be
    # the first instant in which it is late: so the edges of `deadline` are never full
    rules = ["fifo:64"] if policy == "deadline" else [rule for rule in SLOTS if rule != "fifo:64"]
    graph = Graph(stages, tuple(draw.choice(rules) for _ in stages[1:]), draw.choice(stages).name)
    paced = policy in ("latest", "deadline") or draw.random() < 0.5
    rate = draw.choice(["period_ns", "arrivals_ns"]) if paced else None
    period_ns = draw.randint(2_000_000, 9_000_000)
    frames = 40
    arrivals_ns = tuple(sorted(draw.randint(0, frames * period_ns) for _ in range(frames)))
    settings = Settings(
        frames,
        policy,
        period_ns=period_ns if rate == "period_ns" else 0,
        arrivals_ns=arrivals_ns if rate == "arrivals_ns" else (),
        latch_ns=draw.choice([0, 0, 700_001]) if policy == "pipelined" else 0,
        deadline_ns=draw.choice([0, 9_000_000, 16_000_001, 30_000_000]) if paced or policy == "pipelined" else 0,
        in_flight=draw.choice([0, 0, 2, 3, 5]),
        in_queue=draw.choice([0, 0, 1, 2]),
        queue_timeout_ns=draw.choice([0, 0, 6_000_001]) if rate else 0,
    )
    faults = [(draw.randint(1, 150_000_000), draw.choice(graph.units)) for _ in range(draw.choice([0, 0, 1, 3]))]
    yields = any(rule.startswith(("triple", "orphan")) for rule in graph.edges)
    duties = {name: draw.choice([1000, 1000, 500, 333]) for name in graph.units} if not yields and count > 1 else {}
    return graph, settings, draw.choice([0, 50_001]), faults, duties


def skips_of(seed: int) -> Any:
    """Six of ten frames skip; of those that are told to be fresh one of ten, as one in which there is nobody."""

    def skips(frame: int, fresh: bool) -> bool:
        return random.Random(f"{seed} skip {frame}").random() < (0.1 if fresh else 0.6)

    return skips


def with_bypass(seed: int, graph: Graph) -> Graph:
    """`graph` with a bypass between two stages drawn at random, if it is long enough for one."""
    draw, count = random.Random(f"{seed} bypass"), len(graph.stages)
    ends = [(begin, end) for begin in range(count) for end in range(begin + 2, count)]
    if not ends:
        return graph
    begin, end = draw.choice(ends)
    names = [stage.name for stage in graph.stages]
    return Graph(graph.stages, graph.edges, draw.choice(names[: begin + 1] + names[end:]), (names[begin], names[end]))
