"""The core's memory of units, stages and frames. Rule: it holds fields and what follows from them; core.py decides.

A time that is not set is NEVER. Only a table changes the state of a unit. An event that the table refuses is a driver's
defect.

    down --back-off over--> starting --UnitReady--> ready --too slow--> stopping --UnitDied--> down

A unit has one deadline, and its state says what happens when the deadline passes:
- `down`: the process is started again.
- `starting`: the start took too long, and the process is killed.
- `ready`: the running job or the answer to a ping took too long, and the process is killed.
- `stopping`: there is no deadline, because the process is about to end.

`verdict` says what is to be done with a unit now, and `next_alarm_ns` says when the next verdict is due.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable
from typing import Final

from trilane.scheduler.events import NEVER, Graph, Job, JobDone, JobFailed, Pinged, Pong, UnitDied, UnitReady
from trilane.scheduler.ledger import STARVED
from trilane.transport.slots import EdgeSlots, edge_rule

DOWN: Final = 0
STARTING: Final = 1
READY: Final = 2
STOPPING: Final = 3
STATES = ("down", "starting", "ready", "stopping")

IGNORED: Final = -1  # the event was under way when the unit's process was killed or died
REFUSED: Final = -2  # the event cannot happen


class DeadlinePassed:
    """The event that a unit's deadline has passed; the core finds it out itself, no driver sends it."""


class UnitLifeError(Exception):
    """An event that the table refuses in the unit's state: a defect of the driver, never of the user's input."""


# fmt: off
#: The state that follows each event. The job events move no unit, so core.py need not look them up. A job counts when
#: it is the first of its unit's queue, also while the unit is stopping; a unit that is down or starting has no jobs.
TABLE: dict[type, tuple[int, int, int, int]] = {
    #                from DOWN  STARTING  READY     STOPPING
    UnitReady:      (REFUSED,   READY,    REFUSED,  IGNORED),
    UnitDied:       (REFUSED,   DOWN,     DOWN,     DOWN),
    Pinged:         (IGNORED,   REFUSED,  READY,    IGNORED),
    Pong:           (IGNORED,   IGNORED,  READY,    IGNORED),
    JobDone:        (IGNORED,   IGNORED,  READY,    STOPPING),
    JobFailed:      (IGNORED,   IGNORED,  READY,    STOPPING),
    DeadlinePassed: (STARTING,  STOPPING, STOPPING, REFUSED),
}
# fmt: on


def state_after(unit: str, state: int, event: type) -> int:
    """Return the state that follows `state`, or IGNORED; raises UnitLifeError if the table refuses the event."""
    after = TABLE[event][state]
    if after == REFUSED:
        raise UnitLifeError(f"unit {unit} is {STATES[state]}: {event.__name__} cannot happen")
    return after


HELD_JOBS: Final = 2  # the one that runs and the one dispatched ahead
FULL_DUTY: Final = 1000


class UnitState:
    """The state of one unit.

    `life`: state in the table `TABLE`.
    `deadline_ns`: time from which on the event that this state waits for is late.
    `queue`: the running job, then the one dispatched ahead.
    `queue_capacity`: number of jobs that it may hold now (`update_queue_capacity`).
    `head_since_ns`: time since which the running job could run.
    `hold_until_ns`: end of the pause that its duty asks for.
    `duty`: share of the time for which it may work, in thousandths.
    `failures`: number of its deaths since it last ended a job.
    `account`: account of the ledger that gets its time now.
    `account_ns`: time since which that account gets it.
    """

    __slots__ = (
        "account",
        "account_ns",
        "deadline_ns",
        "duty",
        "failures",
        "head_since_ns",
        "hold_until_ns",
        "life",
        "name",
        "queue",
        "queue_capacity",
        "stages",
    )

    def __init__(self, name: str) -> None:
        self.name = name
        self.stages: list[StageState] = []
        self.queue: deque[Job] = deque()
        self.queue_capacity = 0
        self.life: int = STARTING
        self.deadline_ns: int = NEVER
        self.hold_until_ns: int = NEVER
        self.head_since_ns = 0
        self.failures = 0
        self.duty = FULL_DUTY
        self.account = STARVED
        self.account_ns = 0

    @property
    def is_ready(self) -> bool:
        """Whether its process is up and not being stopped."""
        return self.life == READY

    @property
    def awaits_nothing(self) -> bool:
        """Whether it is ready, has no job and was not pinged, so that only a ping can tell whether it lives."""
        return self.life == READY and not self.queue and self.deadline_ns == NEVER

    def move(self, event: type, deadline_ns: int) -> bool:
        """Take the table's row for `event` and set `deadline_ns`; return False if the event is ignored.

        Raises UnitLifeError for an event that cannot happen now.
        """
        after = state_after(self.name, self.life, event)
        if after == IGNORED:
            return False
        self.life, self.deadline_ns = after, deadline_ns
        return True

    def update_queue_capacity(self) -> None:
        """Set `queue_capacity` from `life`, `hold_until_ns` and `duty`; call this after a change of any of them."""
        if self.life != READY or self.hold_until_ns != NEVER:
            self.queue_capacity = 0
        else:
            # A capped unit pauses after each job, so it holds none ahead.
            self.queue_capacity = HELD_JOBS if self.duty == FULL_DUTY else 1

    def expected_end_ns(self) -> int:
        """Return when the running job should end by its stage's estimate; raises IndexError when no job runs."""
        name = self.queue[0].stage
        for stage in self.stages:
            if stage.name == name:
                return self.head_since_ns + stage.estimate_ns
        raise KeyError(name)


class StageState:
    """The state of one stage.

    `estimate_ns`: running mean of its service time in ns (weight 1/8); 0 before the first job.
    `bypassed`: for the stage at which a bypass ends, the edge whose frames may skip to it.
    """

    __slots__ = ("bypassed", "estimate_ns", "input", "name", "output", "position", "unit")

    def __init__(self, name: str, unit: UnitState, position: int) -> None:
        self.name, self.unit, self.position = name, unit, position
        self.input: EdgeSlots | None = None
        self.output: EdgeSlots | None = None
        self.bypassed: EdgeSlots | None = None
        self.estimate_ns = 0

    def learn(self, service_ns: int) -> None:
        """Take one more measured service time into the estimate."""
        self.estimate_ns += (service_ns - self.estimate_ns) >> 3 if self.estimate_ns else service_ns

    def lower_estimate(self) -> None:
        """Lower the estimate by a sixteenth.

        It may rest on one slow job, and no job corrects it while every frame is given up.
        """
        self.estimate_ns -= self.estimate_ns >> 4


class FrameState:
    """The state of one frame in flight.

    `position`: position of its next stage.
    `release_ns`: time of its release.
    `ready_ns`: time at which its last stage ended.
    `latency_ns`: time from the pose to the composited frame, once known.
    `skips`: whether it takes the bypass.
    `rung`: rung of its work.
    """

    __slots__ = ("deadline_ns", "latency_ns", "pose_ns", "position", "ready_ns", "release_ns", "rung", "skips")

    def __init__(self, release_ns: int, deadline_ns: int, rung: int = 0) -> None:
        self.position, self.release_ns, self.ready_ns = 0, release_ns, release_ns
        self.deadline_ns, self.rung = deadline_ns, rung
        self.pose_ns = self.latency_ns = 0
        self.skips = False

    def end_stage(self, position: int, latency_position: int, pose_ns: int, end_ns: int) -> None:
        """Note that the stage at `position` has ended; latency ends with the stage at `latency_position`.

        `pose_ns`: time at which the first stage sampled the pose.
        """
        self.position, self.ready_ns = position + 1, end_ns
        if position == 0:
            self.pose_ns = pose_ns
        if position == latency_position:
            self.latency_ns = end_ns - self.pose_ns


def build(graph: Graph) -> tuple[list[StageState], dict[str, UnitState], list[EdgeSlots]]:
    """Return the joined states of a graph's stages, units and edges; raises ValueError for an unknown edge."""
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


#: Verdicts: leave the unit alone, kill its process, start it again, let it work after a hold, see if it takes a job.
NOTHING: Final = 0
KILL: Final = 1
START: Final = 2
RESUME: Final = 3
LOOK: Final = 4

#: Waits before a restart, by the number of failures in a row without a finished job; the last repeats.
BACK_OFF_NS = (0, 100_000_000, 400_000_000, 1_600_000_000)


def verdict(unit: UnitState, now_ns: int, lead_ns: int) -> int:
    """Return what is to be done with the unit now.

    `lead_ns`: lead of the policy; with a lead, the unit's next job may be due.
    """
    if unit.deadline_ns <= now_ns:
        return START if unit.life == DOWN else KILL
    if unit.hold_until_ns <= now_ns:
        return RESUME
    return LOOK if lead_ns and len(unit.queue) == 1 else NOTHING


def next_alarm_ns(units: Iterable[UnitState], now_ns: int, lead_ns: int) -> int:
    """Return when the first verdict other than NOTHING is due, or NEVER.

    Until a deadline or a hold is set, no verdict can be due earlier: a job's end and a Pong only put deadlines off.
    """
    alarm_ns = NEVER
    for unit in units:
        alarm_ns = min(alarm_ns, unit.deadline_ns, unit.hold_until_ns)
        if lead_ns and len(unit.queue) == 1:
            lead_from_ns = unit.expected_end_ns() - lead_ns
            if now_ns < lead_from_ns < alarm_ns:
                alarm_ns = lead_from_ns
    return alarm_ns


def back_off_ns(failures: int) -> int:
    """Return how long a unit stays down after `failures` failures in a row, 1 or more."""
    return BACK_OFF_NS[min(failures, len(BACK_OFF_NS)) - 1]


def extended_deadline_ns(unit: UnitState, ns: int) -> int:
    """Return the unit's deadline, put off by the `ns` for which the scheduler did nothing; a restart is not put off."""
    if unit.deadline_ns == NEVER or unit.life not in (STARTING, READY):
        return unit.deadline_ns
    return unit.deadline_ns + ns
