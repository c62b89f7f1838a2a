"""The avatar's pipeline in SimPy, for comparison: the same chain, slots, held jobs and order as the `pipelined` policy.

Rule: the models contain only what decides when a frame is presented: no ledger, no faults, no other policies.
`SimpyPipeline` is written as SimPy's users write; `LeanPipeline` is as lean as SimPy allows.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Generator
from typing import Any

import simpy

from trilane.scheduler.events import Graph
from trilane.scheduler.state import HELD_JOBS
from trilane.scheduler.virtual import Service
from trilane.transport.slots import edge_rule


class SimpyPipeline:
    """A model whose frames are released every `period_ns`.

    After `run`, `presented_ns` are the ends of the last stage in order.
    """

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
        """Run until the last frame is presented."""
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


class LeanPipeline:
    """The same model with one timeout for each job and callbacks instead of processes; nothing is checked.

    SimPy keeps the clock and the order of events; slots, held jobs and queues are plain numbers. The instants are the
    same to the nanosecond unless events tie, as with service times in whole milliseconds. It only suits chains whose
    frames stay in order: edges drop nothing, and a unit takes its oldest frame, which is at the last of its stages.
    """

    def __init__(self, graph: Graph, service: Service, frames: int, period_ns: int) -> None:
        self.env = simpy.Environment()
        self.presented_ns: list[int] = []
        self._chain = [(stage.name, stage.unit) for stage in graph.stages]
        self._last = len(self._chain) - 1
        self._positions = {
            unit: [position for position in range(self._last, -1, -1) if self._chain[position][1] == unit]
            for unit in graph.units
        }
        self._service, self._frames, self._period_ns = service, frames, period_ns
        self._released = 0
        self._waiting: list[deque[int]] = [deque() for _ in self._chain]
        self._free = [edge_rule(text).slots for text in graph.edges]
        self._held = dict.fromkeys(graph.units, 0)
        self._free_ns = dict.fromkeys(graph.units, 0)
        self._after(0, None, self._release)

    def run(self) -> list[int]:
        """Run until the last frame is presented."""
        self.env.run()
        return self.presented_ns

    def _after(self, delay_ns: int, value: Any, callback: Any) -> None:
        self.env.timeout(delay_ns, value).callbacks.append(callback)

    def _release(self, _event: Any) -> None:
        self._waiting[0].append(self._released)
        self._released += 1
        if self._released < self._frames:
            self._after(self._period_ns, None, self._release)
        self._fill(self._chain[0][1])

    def _fill(self, unit: str) -> None:
        """Hand jobs to the unit until it holds enough or nothing can run."""
        while self._held[unit] < HELD_JOBS:
            for position in self._positions[unit]:
                if self._waiting[position] and (position == self._last or self._free[position]):
                    break
            else:
                return
            self._dispatch(position, unit, self._waiting[position].popleft())

    def _dispatch(self, position: int, unit: str, frame: int) -> None:
        if position < self._last:
            self._free[position] -= 1
        self._held[unit] += 1
        now_ns = self.env.now
        begin_ns = max(now_ns, self._free_ns[unit])
        end_ns = self._free_ns[unit] = begin_ns + self._service(self._chain[position][0], unit, frame, begin_ns)
        self._after(end_ns - now_ns, (position, unit, frame), self._done)

    def _done(self, event: Any) -> None:
        position, unit, frame = event.value
        self._held[unit] -= 1
        if position == self._last:
            self.presented_ns.append(self.env.now)
        else:
            self._waiting[position + 1].append(frame)
            self._fill(self._chain[position + 1][1])
        if position:
            self._free[position - 1] += 1
            self._fill(self._chain[position - 1][1])
        self._fill(unit)
