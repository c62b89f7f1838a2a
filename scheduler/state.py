"""What the core remembers of stages, units and frames. Rule: fields only; core.py and faults.py decide."""

from __future__ import annotations

from collections import deque

from trilane.scheduler.events import Graph, Job
from trilane.scheduler.ledger import STARVED
from trilane.transport.slots import EdgeSlots, edge_rule

HELD_JOBS = 2  # the one that runs and the one dispatched ahead
FULL_DUTY = 1000
NEVER = 1 << 62  # ns


class UnitState:
    """`queue`: the running job, then the held one. `head_since_ns`: since when the first of them could run.

    `pinged_ns`: since when it was asked whether it lives, 0 when it has answered. `state`: the one that the ledger has
    it in. `room`: how many jobs it may have, see `set_room`.
    """

    __slots__ = (
        "alive",
        "duty",
        "failures",
        "head_since_ns",
        "hold_until_ns",
        "killing",
        "name",
        "pinged_ns",
        "queue",
        "restart_at_ns",
        "room",
        "stages",
        "starting_ns",
        "state",
    )

    def __init__(self, name: str) -> None:
        self.name = name
        self.stages: list[StageState] = []
        self.queue: deque[Job] = deque()
        self.alive = self.killing = False
        self.room = 0
        self.head_since_ns = self.pinged_ns = self.hold_until_ns = 0
        self.restart_at_ns: int | None = None
        self.starting_ns: int | None = None
        self.failures = 0
        self.duty = FULL_DUTY
        self.state = STARVED

    def set_room(self, now_ns: int) -> None:
        """To be called when one of the fields was set that it depends on, and when a hold ends."""
        if not self.alive or self.killing or self.hold_until_ns > now_ns:
            self.room = 0
        else:
            self.room = HELD_JOBS if self.duty == FULL_DUTY else 1


class StageState:
    """`estimate_ns`: running mean of its service time (weight 1/8), 0 before the first."""

    __slots__ = ("estimate_ns", "input", "name", "output", "position", "unit")

    def __init__(self, name: str, unit: UnitState, position: int) -> None:
        self.name, self.unit, self.position = name, unit, position
        self.input: EdgeSlots | None = None
        self.output: EdgeSlots | None = None
        self.estimate_ns = 0

    def learn(self, service_ns: int) -> None:
        self.estimate_ns += (service_ns - self.estimate_ns) >> 3 if self.estimate_ns else service_ns


class FrameState:
    """`position`: of its next stage. `ready_ns`: when its last stage ended.

    `latency_ns`: from the pose to the composited frame, once known.
    """

    __slots__ = ("deadline_ns", "latency_ns", "pose_ns", "position", "ready_ns")

    def __init__(self, release_ns: int, deadline_ns: int) -> None:
        self.position, self.ready_ns = 0, release_ns
        self.deadline_ns = deadline_ns
        self.pose_ns = self.latency_ns = 0


def build(graph: Graph) -> tuple[list[StageState], dict[str, UnitState], list[EdgeSlots]]:
    """States of a graph, joined up."""
    units = {name: UnitState(name) for name in graph.units}
    edges = [EdgeSlots(edge_rule(text)) for text in graph.edges]
    stages = []
    for position, spec in enumerate(graph.stages):
        stage = StageState(spec.name, units[spec.unit], position)
        stage.input = edges[position - 1] if position else None
        stage.output = edges[position] if position < len(edges) else None
        units[spec.unit].stages.append(stage)
        stages.append(stage)
    return stages, units, edges
