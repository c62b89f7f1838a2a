"""The scheduling policies. Rule: a policy is a row of the table; what differs between policies differs here alone."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

from trilane.unexpected_value import UnexpectedValue


class Candidate(NamedTuple):
    """A job that could start now. `position`: of its stage in the chain. `deadline_ns`: of its frame, or NEVER."""

    frame: int
    position: int
    deadline_ns: int


def oldest_frame(candidates: Sequence[Candidate]) -> Candidate:
    """Finish what was begun first: along a chain this keeps the buffers drained and the latency low."""
    return min(candidates)


def furthest_stage(candidates: Sequence[Candidate]) -> Candidate:
    """What is nearest to the screen: newest-first would starve the later stages of a shared unit."""
    return max(candidates, key=lambda c: c.position)


def earliest_deadline(candidates: Sequence[Candidate]) -> Candidate:
    """Earliest deadline first; ties go to the older frame."""
    return min(candidates, key=lambda c: (c.deadline_ns, c.frame))


@dataclass(frozen=True)
class Policy:
    """One row.

    `choose`: which of its runnable jobs a shared unit takes. `in_flight`: frames between admission and presented, 0
    for no limit of its own. `newest`: of the frames that wait for a stage the newest is taken, the others are stale.
    `drop_late`: a frame that cannot make its deadline is dropped before its next stage. `lead_ns`: how long before
    the expected end of its job a unit is handed the next; 0: as soon as there is one. `paced`: frames need a rate.
    """

    choose: Callable[[Sequence[Candidate]], Candidate]
    in_flight: int = 0
    newest: bool = False
    drop_late: bool = False
    lead_ns: int = 0
    paced: bool = False


POLICIES = {
    "sequential": Policy(oldest_frame, in_flight=1),
    "pipelined": Policy(oldest_frame),
    "latest": Policy(furthest_stage, newest=True, lead_ns=1_000_000, paced=True),
    "deadline": Policy(earliest_deadline, drop_late=True, lead_ns=1_000_000, paced=True),
}


def policy_named(name: str) -> Policy:
    """The row of `POLICIES`. Raises UnexpectedValue."""
    if name not in POLICIES:
        raise UnexpectedValue(f"policy {name!r}", f"one of {', '.join(POLICIES)}")
    return POLICIES[name]
