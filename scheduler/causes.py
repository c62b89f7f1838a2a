"""The reasons why a run ended and why a frame was lost or dropped.

Rule: a reason is a kind and where it happened, so nobody parses a string. `str()` of each is its key in the report and
in messages.
"""

from __future__ import annotations

from enum import StrEnum
from typing import NamedTuple


class OutcomeKind(StrEnum):
    """How a run ended.

    - DONE: every frame went through.
    - STOPPED: `Stop` was asked for.
    - ABORTED: `Abort` was asked for.
    - GAVE_UP: a unit failed too often.
    """

    DONE = "done"
    STOPPED = "stopped"
    ABORTED = "aborted"
    GAVE_UP = "gave_up"


class Outcome(NamedTuple):
    """How a run ended. `unit`: unit that could not be kept alive, for GAVE_UP alone."""

    kind: OutcomeKind
    unit: str = ""

    def __str__(self) -> str:
        return _joined(self.kind.value, self.unit)


class LossKind(StrEnum):
    """What ended a frame in flight.

    - DIED, HUNG, GAVE_UP: its unit died, hung, or was given up.
    - FAILED: its stage raised an error.
    - ABORTED: the run was aborted.
    """

    DIED = "died"
    HUNG = "hung"
    GAVE_UP = "gave_up"
    FAILED = "failed"
    ABORTED = "aborted"


class Loss(NamedTuple):
    """Why a frame in flight was lost. `where`: name of the unit; of the stage for FAILED; empty for ABORTED."""

    kind: LossKind
    where: str = ""

    def __str__(self) -> str:
        return _joined(self.kind.value, self.where)


class DropCause(StrEnum):
    """Why a waiting frame was taken out.

    - STALE: a newer frame took its place.
    - LATE: it could not be in time.
    - POOL: an edge had no other slot.
    - QUEUE_FULL: it was turned away before the first stage.
    - TIMEOUT: it waited too long before the first stage.
    """

    STALE = "stale"
    LATE = "late"
    POOL = "pool"
    QUEUE_FULL = "queue_full"
    TIMEOUT = "timeout"


class Drop(NamedTuple):
    """A reason to drop a frame. `edge`: place of the drop, as `producer->consumer`."""

    edge: str
    cause: DropCause

    def __str__(self) -> str:
        return _joined(self.edge, self.cause.value)


def _joined(first: str, second: str) -> str:
    return f"{first}:{second}" if second else first
