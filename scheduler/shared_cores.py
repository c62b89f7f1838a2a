"""Runs a pipeline in virtual time on cores that its units share, as the kernel divides them.

Rule: the scheduler is the real `Core`; only the units and the cores are simulated. Every job's needs are given.

A job needs CPU time of its unit's threads, and time in which they need no core (a device works, or the unit sleeps). A
unit with one thread is on one core at a time. When it wakes, it goes where it was; if others are there, it goes to an
idle one of its cores. A core that becomes idle pulls a unit that shares another core. If a unit begins to share a core
while another core is already idle, the idle core pulls it at the next tick (BALANCE_NS). The units on a core have equal
shares of it. A unit of several threads is on all of its cores at once. It goes as fast as the slowest of them, because
each parallel region waits for its slowest thread.

Equal shares stand for the kernel's slices in turn. Moves and changes of threads cost nothing here, because the given
CPU times of jobs include them.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from math import ceil, inf
from typing import Any, Final, NamedTuple

from trilane.scheduler.core import Core
from trilane.scheduler.events import NEVER, Dispatch, Event, Graph, Job, JobDone, OutcomeKind, Settings, UnitReady
from trilane.scheduler.placement import Placement

#: Assumed: time between two looks of the kernel at cores that are idle while others are shared, a tick of 250 Hz.
BALANCE_NS: Final = 4_000_000
DONE_NS: Final = 1e-3  # what is left of a job that has ended, by the rounding of floating-point numbers


class Need(NamedTuple):
    """What a job needs, in ns.

    `cpu_ns`: CPU time of each of its unit's threads.
    `other_ns`: time in which it needs no core.
    `skips`: whether the frame takes the bypass that begins at the job's stage.
    """

    cpu_ns: float
    other_ns: float = 0.0
    skips: bool = False


#: (stage, frame) -> the job's needs.
Needs = Callable[[str, int], Need]


class _Unit:
    """A unit, or the scheduler.

    `queue`: jobs handed to it, or events that the scheduler hears of; the first is worked on.
    `on`: cores where its threads are while they compute.
    """

    __slots__ = ("begin_ns", "cores", "gangs", "last", "left", "name", "need", "on", "queue", "rate")

    def __init__(self, name: str, cores: tuple[int, ...], threads: int) -> None:
        self.name, self.cores, self.gangs = name, cores, threads > 1
        self.queue: deque[Any] = deque()
        self.need: Need | None = None
        self.on: tuple[int, ...] = ()
        self.last = cores[0]
        self.left = self.rate = 0.0
        self.begin_ns = 0


class SharedCores:
    """The `trilane.scheduler.core.Core` of one run on simulated cores. Equal inputs give equal runs.

    `places`: cores and threads of every unit. `needs`: needs of every job. `message_ns`: time from the end of a job
    until the scheduler hears of it. `scheduler_ns`: CPU time that the scheduler then takes on the cores of the first
    stage's unit; a job that it hands over begins at once when its unit is free.
    """

    def __init__(
        self,
        graph: Graph,
        settings: Settings,
        places: Placement,
        needs: Needs,
        message_ns: int = 0,
        scheduler_ns: int = 0,
    ) -> None:
        self._core, self._needs, self._message_ns = Core(graph, settings), needs, message_ns
        self._scheduler, self._scheduler_ns = _Unit("", places[graph.stages[0].unit].cores, 1), scheduler_ns
        self._units = {name: _Unit(name, *places[name]) for name in graph.units}
        self._queues: dict[int, list[_Unit]] = {core: [] for place in places.values() for core in place.cores}
        self._active: list[_Unit] = []
        self._heard: deque[tuple[int, tuple[Event, ...]]] = deque()
        self._deadline_ns: int = NEVER
        self._last_stage = graph.stages[-1].name
        self._now_ns, self._balance_ns = 0.0, inf
        self.presented: list[tuple[int, int]] = []

    def run(self) -> list[tuple[int, int]]:
        """Run to the end; return number and time in ns of each presented frame.

        Raises RuntimeError when nothing can ever happen again.
        """
        core, active, heard = self._core, self._active, self._heard
        self._step(0, tuple(UnitReady(unit) for unit in self._units))
        while not core.finished:
            at_ns = min(heard[0][0] if heard else NEVER, self._deadline_ns)
            end_ns = min((self._now_ns + unit.left / unit.rate for unit in active), default=inf)
            if at_ns >= NEVER and end_ns == inf:
                raise RuntimeError("the simulation stands still: no event and no deadline is left")
            now_ns = min(float(at_ns), end_ns, self._balance_ns)
            passed_ns, self._now_ns = now_ns - self._now_ns, now_ns
            for unit in active:
                unit.left -= passed_ns * unit.rate
            if self._balance_ns <= min(at_ns, end_ns):
                self._balance()
            elif end_ns <= at_ns:
                for unit in [unit for unit in active if unit.left <= DONE_NS]:
                    self._go_on(unit)
                self._set_rates()
            elif heard and heard[0][0] <= at_ns:
                self._hear(at_ns, heard.popleft()[1])
            else:
                self._step(at_ns, ())
        if core.outcome is None or core.outcome.kind is not OutcomeKind.DONE:
            raise RuntimeError(f"the simulated run ended so: {core.outcome}")
        return self.presented

    def _hear(self, now_ns: int, events: tuple[Event, ...]) -> None:
        """Let the scheduler take its time for `events`, behind those that it has heard of."""
        if not self._scheduler_ns:
            self._step(now_ns, events)
            return
        self._scheduler.queue.append(events)
        if self._scheduler.need is None:
            self._begin(self._scheduler, Need(self._scheduler_ns))
            self._set_rates()

    def _step(self, now_ns: int, events: tuple[Event, ...]) -> None:
        """Tell the scheduler, and carry out what it says."""
        actions, self._deadline_ns = self._core.step(now_ns, events)
        is_changed = False
        for action in actions:
            if type(action) is Dispatch:
                unit = self._units[action.job.unit]
                unit.queue.append(action.job)
                if unit.need is None:
                    self._begin(unit, self._needs(action.job.stage, action.job.frame))
                    is_changed = True
        if is_changed:
            self._set_rates()

    def _begin(self, unit: _Unit, need: Need) -> None:
        """Begin what is next in the unit's queue: it first computes."""
        unit.need, unit.begin_ns = need, ceil(self._now_ns)
        unit.left = max(need.cpu_ns, 2 * DONE_NS)
        unit.on = unit.cores if unit.gangs else (self._woken_on(unit),)
        for core in unit.on:
            self._queues[core].append(unit)
            if len(self._queues[core]) > 1 and self._balance_ns == inf and not all(self._queues.values()):
                # A tick matters only while one core is shared and another one is idle.
                self._balance_ns = (self._now_ns // BALANCE_NS + 1) * BALANCE_NS
        self._active.append(unit)

    def _woken_on(self, unit: _Unit) -> int:
        """Return the core on which a unit of one thread wakes, and keep it as its last."""
        if self._queues[unit.last]:
            # The core with the fewest units; of several, the one where the unit was.
            unit.last = min(unit.cores, key=lambda core: (len(self._queues[core]), core != unit.last))
        return unit.last

    def _go_on(self, unit: _Unit) -> None:
        """Do what follows when a unit has computed, or has waited for its device."""
        assert unit.need is not None
        if unit.on:
            self._leave(unit)
            if unit.need.other_ns:
                unit.left = unit.need.other_ns
                return
        # The core's time is in whole ns, and no end is told early.
        ended, now_ns, skips = unit.queue.popleft(), ceil(self._now_ns), unit.need.skips
        self._active.remove(unit)
        unit.need = None
        if unit is self._scheduler:
            self._step(now_ns, ended)
            if unit.queue:
                self._begin(unit, Need(self._scheduler_ns))
        else:
            self._end(unit, ended, now_ns, skips)

    def _end(self, unit: _Unit, job: Job, now_ns: int, skips: bool) -> None:
        """Send word that a job has ended, and begin the unit's next one."""
        done = JobDone(unit.name, job.id, unit.begin_ns, now_ns, unit.begin_ns, skips=skips)
        self._heard.append((now_ns + self._message_ns, (done,)))
        if job.stage == self._last_stage:
            self.presented.append((job.frame, now_ns))
        if unit.queue:
            self._begin(unit, self._needs(unit.queue[0].stage, unit.queue[0].frame))

    def _leave(self, unit: _Unit) -> None:
        """Take the unit off its cores; each that is idle now pulls a unit that shares another core."""
        for core in unit.on:
            self._queues[core].remove(unit)
        left, unit.on = unit.on, ()
        for core in left:
            if not self._queues[core]:
                self._pull(core)

    def _balance(self) -> None:
        """Let every idle core pull a unit, at a tick."""
        self._balance_ns = inf
        for core, queue in self._queues.items():
            if not queue:
                self._pull(core)
        self._set_rates()

    def _pull(self, core: int) -> None:
        """Move a unit that shares another core to `core`, which is idle."""
        for queue in self._queues.values():
            if len(queue) < 2:
                continue
            for other in queue:
                if not other.gangs and core in other.cores:
                    queue.remove(other)
                    self._queues[core].append(other)
                    other.on, other.last = (core,), core
                    return

    def _set_rates(self) -> None:
        for unit in self._active:
            # Each parallel region waits for the thread on the fullest core.
            unit.rate = 1 / max(len(self._queues[core]) for core in unit.on) if unit.on else 1.0
