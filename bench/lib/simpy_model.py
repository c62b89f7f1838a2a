"""The avatar's pipeline in SimPy, for comparison: the same chain, slots, held jobs and order as the `pipelined` policy.

Rule: only what decides when a frame is presented; no ledger, no faults, no other policies.
"""

from __future__ import annotations

from collections.abc import Generator
from typing import Any

import simpy

from trilane.scheduler.events import Graph
from trilane.scheduler.state import HELD_JOBS
from trilane.scheduler.virtual import Service
from trilane.transport.slots import edge_rule


class SimpyPipeline:
    """Frames released every `period_ns`; after `run`, `presented_ns` are the ends of the last stage in order."""

    def __init__(self, graph: Graph, service: Service, frames: int, period_ns: int) -> None:
        self.env = simpy.Environment()
        self.presented_ns: list[int] = []
        self._chain = [(stage.name, stage.unit) for stage in graph.stages]
        self._service = service
        self._slots = [self._full(edge_rule(text).slots) for text in graph.edges]
        self._held = {unit: simpy.PriorityResource(self.env, HELD_JOBS) for unit in graph.units}
        self._runs = {unit: simpy.Resource(self.env, 1) for unit in graph.units}
        self.env.process(self._source(frames, period_ns))

    def run(self) -> list[int]:
        """Until the last frame is presented."""
        self.env.run()
        return self.presented_ns

    def _full(self, slots: int) -> simpy.Container:
        return simpy.Container(self.env, slots, init=slots)

    def _source(self, frames: int, period_ns: int) -> Generator[Any, Any, None]:
        for frame in range(frames):
            self.env.process(self._frame(frame))
            yield self.env.timeout(period_ns)

    def _frame(self, frame: int) -> Generator[Any, Any, None]:
        env, last = self.env, len(self._chain) - 1
        for position, (stage, unit) in enumerate(self._chain):
            if position < last:
                yield self._slots[position].get(1)
            with self._held[unit].request(priority=frame) as held:
                yield held
                with self._runs[unit].request() as runs:
                    yield runs
                    yield env.timeout(self._service(stage, unit, frame, int(env.now)))
            if position:
                self._slots[position - 1].put(1)
        self.presented_ns.append(int(env.now))
