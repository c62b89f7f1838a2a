"""The same model as simpy_model.py, as lean as SimPy allows: one timeout for each job, callbacks instead of processes.

Rule: SimPy keeps the clock and the order of events; slots, held jobs and queues are plain numbers. Nothing is checked.
The frames' instants are those of simpy_model.py to the nanosecond unless events tie, as with service times in whole
milliseconds: which of two events at one instant comes first may differ.
"""

from __future__ import annotations

from collections import deque
from typing import Any

import simpy

from trilane.scheduler.events import Graph
from trilane.scheduler.state import HELD_JOBS
from trilane.scheduler.virtual import Service
from trilane.transport.slots import edge_rule


class LeanPipeline:
    """Frames released every `period_ns`; after `run`, `presented_ns` are the ends of the last stage in order.

    Only for chains whose frames stay in order: edges that drop nothing, and units that take the oldest frame, which is
    the one at the last of their stages.
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
        """Until the last frame is presented."""
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
        """Hand the unit jobs until it holds enough or nothing can run."""
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
