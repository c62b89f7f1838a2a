"""Decides whose job a unit takes next that several pipelines share. Rule: a rule of turns is a row of the table.

Each pipeline hands its unit jobs by its own policy and knows nothing of the others. The first waiting job of each
pipeline is a candidate. A running job is never taken off its unit.

Source of `deadline`: Liu and Layland, Journal of the ACM 20 (1973).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Final, NamedTuple

from trilane.unexpected_value import UnexpectedValue

ROUND_ROBIN: Final = "round-robin"


class Waiting(NamedTuple):
    """The first job of a pipeline that waits for the unit.

    `behind`: number of pipelines before this one, counted in turn from the one that had the unit last. 0 is the next in
    turn; the pipeline that had the unit last comes last.
    `deadline_ns`: deadline of the job's frame, or NEVER.
    `order`: number that grows with each job handed out.
    """

    behind: int
    deadline_ns: int
    order: int


def in_turn(waiting: Sequence[Waiting]) -> Waiting:
    """Choose the next pipeline in turn: between two jobs of one pipeline, each other waiting pipeline gets one job."""
    return min(waiting, key=lambda job: (job.behind, job.order))


def earliest_deadline(waiting: Sequence[Waiting]) -> Waiting:
    """Choose the job whose frame must be presented first; of equal deadlines, the next in turn.

    Jobs without a deadline come last. When the pipelines ask for more than the unit can do, these may never have it.
    """
    return min(waiting, key=lambda job: (job.deadline_ns, job.behind, job.order))


TURNS: Final[dict[str, Callable[[Sequence[Waiting]], Waiting]]] = {
    ROUND_ROBIN: in_turn,
    "deadline": earliest_deadline,
}


def turns_named(name: str) -> Callable[[Sequence[Waiting]], Waiting]:
    """Return the row of `TURNS`; raises UnexpectedValue for an unknown name."""
    if name not in TURNS:
        raise UnexpectedValue(f"turns {name!r}", f"one of {', '.join(TURNS)}")
    return TURNS[name]
