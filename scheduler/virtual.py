"""The driver of simulated time. Rule: a heap keyed (t_ns, priority, seq) decides ties, so equal inputs give equal runs.

The units are queues of jobs whose service times come from a function; everything else is the real core.
"""

from __future__ import annotations

import gc
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from heapq import heappop, heappush
from typing import Any, Final

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
    Settings,
    Start,
    UnitDied,
    UnitReady,
)
from trilane.scheduler.ledger import Books, JobRecord
from trilane.scheduler.recording import Recording

#: (stage, unit, frame, begin_ns) -> service time in ns.
Service = Callable[[str, str, int, int], int]
#: (frame, `Job.fresh`) -> whether the frame takes the bypass.
Skips = Callable[[int, bool], bool]

#: Priorities at equal times; the core's deadline comes after both.
FAULT: Final = 0
EVENT: Final = 1


def none_skips(_frame: int, _fresh: bool) -> bool:
    """Return False: no frame takes the bypass."""
    return False


@dataclass(frozen=True)
class Simulation:
    """The result of a simulated run.

    `report` has the keys of report.json. `shown_ns`: time in ns at which each frame was presented, by the frame's
    number.
    """

    report: dict[str, Any]
    recording: Recording | None
    jobs: tuple[JobRecord, ...]
    outcome: Outcome
    shown_ns: Mapping[int, int]


@dataclass
class _VirtualUnit:
    """A simulated unit.

    `up`: whether its process exists, starting or ready.
    `free_ns`: time from which it can begin another job.
    `epoch`: number of its deaths; events of an older epoch are void.
    """

    up: bool = True
    free_ns: int = 0
    epoch: int = 0


class VirtualDriver:
    """The clock of simulated time (`core.Clock`), and the core that it runs."""

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
        """Prepare a simulated run; all times are `int`, also those of `service` (no NumPy integers).

        `graph`, `settings`: graph and settings of the core.
        `service`: function that returns the service time of each job in ns.
        `message_delay_ns`: delay of a message, each way.
        `restart_ns`: start-up time of a unit.
        `faults`: deaths of units, as pairs (t_ns, unit).
        `inputs`: events from outside, such as SetDuty or Stop, as pairs (t_ns, event).
        `skips`: function that says which frames take the bypass of `graph`, if it has one.
        `keep`: whether to record steps and the jobs that end.
        `books`: how the core accounts for the run.

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
        """Run until the core finishes; raises RuntimeError when nothing can ever happen again."""
        collects = gc.isenabled()
        gc.disable()  # a run makes no cycles, and looking for them takes a tenth of its time
        try:
            return run_loop(self.core, self, self.recording)
        finally:
            if collects:
                gc.enable()

    def wait(self, deadline_ns: int) -> tuple[int, tuple[Event, ...]]:
        """Return the next valid event, or none at the core's deadline if that comes first."""
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
        """Put the events that follow from the actions on the heap."""
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
    """Simulate a run to its end.

    `graph`, `settings`, `service`, `keep`, `driver`: arguments of VirtualDriver.
    `target_period_ns`: as in `trilane.scheduler.ledger.Books`.

    Raises ValueError for an unknown policy or edge, and RuntimeError when nothing can ever happen again.
    """
    virtual = VirtualDriver(graph, settings, service, keep=keep, books=Books(target_period_ns), **driver)
    outcome = virtual.run()
    report = virtual.core.report(clock="virtual")
    return Simulation(report, virtual.recording, tuple(virtual.jobs), outcome, virtual.core.ledger.shown_ns)
