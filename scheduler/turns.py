"""Whose job a unit takes next that several pipelines share. Rule: a rule of turns is a row of the table.

Each pipeline hands its unit jobs by its own policy and knows nothing of the others; of those that wait, the first job
of each pipeline is a candidate. A job that runs is never taken off its unit.

Source of `deadline`: Liu and Layland, Journal of the ACM 20 (1973).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Final, NamedTuple

from trilane.unexpected_value import UnexpectedValue

ROUND_ROBIN: Final = "round-robin"


class Waiting(NamedTuple):
    """The first job of a pipeline that waits for the unit.

    `behind`: how many pipelines come before this one, counted in turn from the one that had the unit last; so 0 is the
    next in turn, and the one that had it last comes last. `deadline_ns`: of the job's frame, or NEVER. `order`: a
    number that grows with each job handed out.
    """

    behind: int
    deadline_ns: int
    order: int


def in_turn(waiting: Sequence[Waiting]) -> Waiting:
    """Each pipeline one job, in turn: between two jobs of one pipeline each other one that waits has had one."""
    return min(waiting, key=lambda job: (job.behind, job.order))


def earliest_deadline(waiting: Sequence[Waiting]) -> Waiting:
    """The job whose frame must be presented first; those without a deadline come last; of equal ones the next in turn.

    When more is asked for than the unit can do, those without a deadline may never have it.
    """
    return min(waiting, key=lambda job: (job.deadline_ns, job.behind, job.order))


TURNS: Final[dict[str, Callable[[Sequence[Waiting]], Waiting]]] = {
    ROUND_ROBIN: in_turn,
    "deadline": earliest_deadline,
}


def turns_named(name: str) -> Callable[[Sequence[Waiting]], Waiting]:
    """The row of `TURNS`. Raises UnexpectedValue."""
    if name not in TURNS:
        raise UnexpectedValue(f"turns {name!r}", f"one of {', '.join(TURNS)}")
    return TURNS[name]
