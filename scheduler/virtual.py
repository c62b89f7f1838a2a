"""Drivers of simulated time: units have cores of their own, or share cores as the kernel divides them.

Rule: the scheduler is the real `Core`; only the units and the cores are simulated. Equal inputs give equal runs.

With cores of their own (`VirtualDriver`), the units are queues of jobs whose service times come from a function. A heap
with the key (t_ns, priority, seq) orders the events.

On shared cores (`SharedCores`), two needs of each job are given: CPU time of its unit's threads, and time without a
core. In the time without a core, a device works or the unit sleeps. A unit with one thread is on one core at a time. It
wakes on the core where it was last. If another unit is there, it wakes on the one of its cores that has the fewest
units. A core that becomes idle pulls a unit that shares another core. If a core becomes shared while another core is
already idle, the idle core pulls a unit at the next tick (BALANCE_NS). The units on a core have equal shares of it. A
unit of several threads is on all of its cores at once. The core with the most units sets the unit's speed, because each
parallel region waits for its slowest thread.

Equal shares stand for the kernel's time slices. Moves and changes of threads cost nothing here, because the given CPU
times of jobs include them.
"""

from __future__ import annotations

import gc
from collections import deque
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from heapq import heappop, heappush
from math import ceil, inf
from typing import Any, Final, NamedTuple

from trilane.scheduler.core import Core, run_loop
from trilane.scheduler.events import (
    NEVER,
    Action,
    Dispatch,
    Event,
    Graph,
    Job,
    JobDone,
    Kill,
    Outcome,
    OutcomeKind,
    Settings,
    Start,
    UnitDied,
    UnitReady,
)
from trilane.scheduler.ledger import Books, JobRecord
from trilane.scheduler.placement import Placement
from trilane.scheduler.recording import Recording

#: Function of (stage, unit, number of the frame, begin in ns) that returns the service time in ns.
Service = Callable[[str, str, int, int], int]
#: Function of (number of the frame, `Job.fresh`) that returns whether the frame takes the bypass.
Skips = Callable[[int, bool], bool]

#: Priorities of events at equal times; the core's deadline comes after both.
FAULT: Final = 0
EVENT: Final = 1


def none_skips(_frame: int, _fresh: bool) -> bool:
    """Return False: no frame takes the bypass."""
    return False


@dataclass(frozen=True)
class Simulation:
    """The result of a simulated run.

    `report`: report with the keys of report.json.
    `recording`, `jobs`: recording and finished jobs, if they are kept; else None and empty.
    `shown_ns`: time in ns at which each frame was presented, by the frame's number.
    """

    report: dict[str, Any]
    recording: Recording | None
    jobs: tuple[JobRecord, ...]
    outcome: Outcome
    shown_ns: Mapping[int, int]


@dataclass
class _VirtualUnit:
    """A simulated unit.

    `up`: whether its process exists, and is starting or ready.
    `free_ns`: time from which it can begin another job.
    `epoch`: number of its deaths; events of an older epoch are void.
    """

    up: bool = True
    free_ns: int = 0
    epoch: int = 0


class VirtualDriver:
    """A `trilane.scheduler.core.Clock` of simulated time, together with the core that it drives."""

    def __init__(
        self,
        graph: Graph,
        settings: Settings,
        service: Service,
        *,
        message_delay_ns: int = 0,
        restart_ns: int = 1_000_000_000,
        faults: Iterable[tuple[int, str]] = (),
        inputs: Iterable[tuple[int, Event]] = (),
        skips: Skips = none_skips,
        keep: bool = False,
        books: Books | None = None,
    ) -> None:
        """Prepare a simulated run. All times must be `int`, not NumPy integers, also those from `service`.

        `graph`, `settings`: graph and settings of the core.
        `service`: function that returns the service time of each job in ns.
        `message_delay_ns`: delay of a message, each way.
        `restart_ns`: time that a unit takes to start again.
        `faults`: deaths of units, as pairs (t_ns, unit).
        `inputs`: events from outside, such as SetDuty or Stop, as pairs (t_ns, event).
        `skips`: function that says which frames take the bypass of `graph`, if it has one.
        `keep`: whether to record the core's steps, and the jobs that end.
        `books`: settings of the ledger; None: the default settings.

        Raises ValueError for an unknown policy or edge.
        """
        self.core = Core(graph, settings, books)
        self.recording = Recording(graph, settings) if keep else None
        self.jobs: list[JobRecord] = []
        self._service, self._message_delay_ns, self._restart_ns = service, message_delay_ns, restart_ns
        self._skips, self._bypass_begin = skips, graph.bypass[0] if graph.bypass is not None else ""
        self._heap: list[tuple[int, int, int, Event, int]] = []
        self._sequence = 0
        self._woken_ns = -1  # the last deadline that came without an event
        self._begun: dict[int, JobRecord] = {}
        self._units = {unit: _VirtualUnit() for unit in graph.units}
        for unit in graph.units:
            self._push(0, EVENT, UnitReady(unit))
        for at_ns, unit in faults:
            self._push(at_ns, FAULT, UnitDied(unit))
        for at_ns, event in inputs:
            self._push(at_ns, FAULT, event)

    def run(self) -> Outcome:
        """Run until the core finishes. Raises RuntimeError if nothing can ever happen again."""
        collects = gc.isenabled()
        gc.disable()  # a run makes no cycles, and looking for them takes a tenth of its time
        try:
            return run_loop(self.core, self, self.recording)
        finally:
            if collects:
                gc.enable()

    def wait(self, deadline_ns: int) -> tuple[int, tuple[Event, ...]]:
        """Return (time in ns, the next valid event). If the core's deadline comes first, return it with no event.

        Raises RuntimeError if nothing can ever happen again.
        """
        heap = self._heap
        while heap and heap[0][0] <= deadline_ns:
            at_ns, _, _, event, epoch = heappop(heap)
            if type(event) is JobDone:
                if epoch == self._units[event.unit].epoch:
                    if self._begun:
                        self.jobs.append(self._begun.pop(event.job))
                    return at_ns, (event,)
            elif self._accept(event, epoch):
                return at_ns, (event,)
        if deadline_ns == NEVER:
            raise RuntimeError("the simulation stands still: no event and no deadline is left")
        if deadline_ns <= self._woken_ns:
            raise RuntimeError(f"the simulation stands still: the core asks for {deadline_ns} ns again and again")
        self._woken_ns = deadline_ns
        return deadline_ns, ()

    def perform(self, now_ns: int, actions: tuple[Action, ...]) -> None:
        """Put the events that result from the actions on the heap."""
        for action in actions:
            if type(action) is Dispatch:
                self._dispatch(now_ns, action.job)
            elif type(action) is Kill:
                self._push(now_ns, FAULT, UnitDied(action.unit))
            elif type(action) is Start:
                self._start(now_ns, action)

    def _accept(self, event: Event, epoch: int) -> bool:
        if type(event) is UnitReady:
            return epoch == self._units[event.unit].epoch
        if type(event) is UnitDied:
            unit = self._units[event.unit]
            was_up, unit.up = unit.up, False
            unit.epoch += was_up
            return was_up
        return True

    def _push(self, at_ns: int, priority: int, event: Event, epoch: int = 0) -> None:
        self._sequence += 1
        heappush(self._heap, (at_ns, priority, self._sequence, event, epoch))

    def _dispatch(self, now_ns: int, job: Job) -> None:
        job_id, name, stage, frame, _, _, _, fresh, _ = job
        unit = self._units[name]
        begin_ns = now_ns + self._message_delay_ns
        if begin_ns < unit.free_ns:
            begin_ns = unit.free_ns
        end_ns = unit.free_ns = begin_ns + self._service(stage, name, frame, begin_ns)
        skips = stage == self._bypass_begin and self._skips(frame, fresh)
        done = JobDone(name, job_id, begin_ns, end_ns, begin_ns, 0, 0, 0, skips)
        self._sequence += 1
        heappush(self._heap, (end_ns + self._message_delay_ns, EVENT, self._sequence, done, unit.epoch))
        if self.recording is not None:
            times = (self.core.ready_ns(job) or 0, now_ns, begin_ns, end_ns, 0, 0, 0, end_ns - begin_ns)
            self._begun[job_id] = JobRecord(stage, name, frame, *times)

    def _start(self, now_ns: int, action: Start) -> None:
        unit = self._units[action.unit]
        unit.up, unit.free_ns = True, 0  # its jobs were lost with the old process
        self._push(now_ns + self._restart_ns, EVENT, UnitReady(action.unit), unit.epoch)


def simulate(
    graph: Graph,
    settings: Settings,
    service: Service,
    *,
    target_period_ns: int = 0,
    keep: bool = False,
    **driver: Any,
) -> Simulation:
    """Simulate a run to its end, and return the result.

    `graph`, `settings`, `service`, `keep`, `driver`: arguments of VirtualDriver.
    `target_period_ns`: longest frame time that counts as in time; 0: the frames' deadlines count.

    Raises ValueError for an unknown policy or edge, RuntimeError if nothing can ever happen again.
    """
    virtual = VirtualDriver(graph, settings, service, keep=keep, books=Books(target_period_ns), **driver)
    outcome = virtual.run()
    report = virtual.core.report(clock="virtual")
    return Simulation(report, virtual.recording, tuple(virtual.jobs), outcome, virtual.core.ledger.shown_ns)


#: Assumed: time after which the kernel looks again for idle cores while other cores are shared, a tick of 250 Hz.
BALANCE_NS: Final = 4_000_000
DONE_NS: Final = 1e-3  # what is left of a job that has ended, by the rounding of floating-point numbers


class Need(NamedTuple):
    """The needs of a job.

    `cpu_ns`: CPU time of each thread of its unit.
    `other_ns`: time in which the job needs no core.
    `skips`: whether the frame takes the bypass that begins at the job's stage.
    """

    cpu_ns: float
    other_ns: float = 0.0
    skips: bool = False


#: Function of (stage, number of the frame) that returns the job's needs.
Needs = Callable[[str, int], Need]


class _Unit:
    """A unit, or the scheduler.

    `gangs`: whether it has several threads, each on a core of its own.
    `queue`: jobs handed to the unit, or groups of events that the scheduler hears of. The first element is in work.
    `need`: needs of the first element; None if the queue is empty.
    `on`: cores where its threads are while they compute; else empty.
    `last`: core where its only thread was last.
    `left`: time in ns at full speed until its computation, or its time without a core, ends.
    `rate`: its present speed, 1 for full speed.
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
    """Runs one `trilane.scheduler.core.Core` on simulated cores. Equal inputs give equal runs.

    A job begins as soon as the scheduler has handed it over and its unit is free. Raises ValueError as `Core` does.

    `places`: cores and threads of every unit.
    `needs`: function that returns the needs of a job.
    `message_ns`: time from the end of a job until the scheduler hears of it.
    `scheduler_ns`: CPU time that the scheduler then takes for the message, on the cores of the first stage's unit.
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
        """Run to the end; return a pair (number, time in ns) for each presented frame, in order.

        Raises RuntimeError if nothing can ever happen again, if a job takes longer than the `hang_ns` of the settings,
        or if the run ends before its last frame.
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
        """Let the scheduler spend its CPU time on `events`, after the events that it heard of earlier."""
        if not self._scheduler_ns:
            self._step(now_ns, events)
            return
        self._scheduler.queue.append(events)
        if self._scheduler.need is None:
            self._begin(self._scheduler, Need(self._scheduler_ns))
            self._set_rates()

    def _step(self, now_ns: int, events: tuple[Event, ...]) -> None:
        """Take a step of the core at `now_ns` with `events`, and begin the jobs that it hands over."""
        actions, self._deadline_ns = self._core.step(now_ns, events)
        is_changed = False
        for action in actions:
            if type(action) is Dispatch:
                unit = self._units[action.job.unit]
                unit.queue.append(action.job)
                if unit.need is None:
                    self._begin(unit, self._needs(action.job.stage, action.job.frame))
                    is_changed = True
            elif not self._core.finished:
                # A core kills only a unit that seems to hang, and in virtual time every job ends.
                raise RuntimeError(f"{action}: hang_ns is shorter than a job takes")
        if is_changed:
            self._set_rates()

    def _begin(self, unit: _Unit, need: Need) -> None:
        """Begin the first job of the unit's queue with its computation."""
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
        """Return the core on which a unit of one thread wakes, and store it in `last`."""
        if self._queues[unit.last]:
            # The core with the fewest units; of several such cores, the one where the unit was last.
            unit.last = min(unit.cores, key=lambda core: (len(self._queues[core]), core != unit.last))
        return unit.last

    def _go_on(self, unit: _Unit) -> None:
        """Go on after a unit's computation, or after its time without a core."""
        assert unit.need is not None
        if unit.on:
            self._leave(unit)
            if unit.need.other_ns:
                unit.left = unit.need.other_ns
                return
        # The scheduler's time is in whole ns; rounded up, no end is reported early.
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
        """Send the end of a job to the scheduler, and begin the unit's next job."""
        done = JobDone(unit.name, job.id, unit.begin_ns, now_ns, unit.begin_ns, skips=skips)
        self._heard.append((now_ns + self._message_ns, (done,)))
        if job.stage == self._last_stage:
            self.presented.append((job.frame, now_ns))
        if unit.queue:
            self._begin(unit, self._needs(unit.queue[0].stage, unit.queue[0].frame))

    def _leave(self, unit: _Unit) -> None:
        """Take the unit off its cores; each core that becomes idle pulls a unit that shares another core."""
        for core in unit.on:
            self._queues[core].remove(unit)
        left, unit.on = unit.on, ()
        for core in left:
            if not self._queues[core]:
                self._pull(core)

    def _balance(self) -> None:
        """Do the work of a tick: let every idle core pull a unit that shares another core."""
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
