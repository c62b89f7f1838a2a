"""The life of a unit's process. Rule: a unit moves by the table alone; an event that it refuses is a driver's defect.

    down --back-off over--> starting --UnitReady--> ready --too slow--> stopping --UnitDied--> down

A unit has one deadline, and its state says what happens when the deadline passes:
- `down`: the process is started again.
- `starting`: the start took too long, and the process is killed.
- `ready`: the running job or the answer to a ping took too long, and the process is killed.
- `stopping`: there is no deadline, because the process is about to end.
"""

from __future__ import annotations

from typing import Final

from trilane.scheduler.events import JobDone, JobFailed, Pinged, Pong, UnitDied, UnitReady

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
