"""Which cores and how many threads each unit gets. Rule: it follows from measured times alone, by one formula.

`places.py` has the words, `placement_list.py` the placements that there are, `placement_model.py` the formula. The
formula is not exact; where real frames can be had, the few placements that it cannot tell apart are told by them.
"""

from __future__ import annotations

from collections.abc import Sequence
from statistics import median
from typing import Final, NamedTuple

from trilane.scheduler.placement_list import placements
from trilane.scheduler.placement_model import Rules, frame_ns
from trilane.scheduler.places import Core, Placement, Times, shared_cores

#: Predictions this near to the shortest are as good: the model's own error is not less.
WORTH: Final = 0.03
#: Placements that are predicted so much longer than the shortest may be the best all the same; and so many are tried.
UNCERTAIN: Final = 0.25
MOST_TRIED: Final = 5
#: Measured frame times this near to each other are the same.
SAME: Final = 0.01


class Ranked(NamedTuple):
    """A placement and its predicted frame time."""

    placement: Placement
    frame_ns: int


def ranked(cores: Sequence[Core], times: Times, rules: Rules, fixed: Placement | None = None) -> list[Ranked]:
    """All placements, the smallest frame time first.

    Ties go to fewer shared cores, then less work that floats, less time in all stages (latency), lower numbers.

    `fixed`: places that are given. Raises ValueError for no cores, or a unit of which no number of threads fits.
    """
    found = [Ranked(each, frame_ns(each, cores, times, rules)) for each in placements(cores, times, fixed or {})]
    if not found:
        raise ValueError("no placement: a unit has no number of threads that fits the cores")
    return sorted(found, key=lambda each: (each.frame_ns, _tie(each.placement, times)))


def chosen(found: Sequence[Ranked], rule: Ranked) -> Ranked:
    """What to take of `found`, which is `ranked`: never one that is predicted longer than the `rule`'s.

    `rule`: the placement for any run; it stays unless another is shorter by more than WORTH. Then, of those within
    WORTH of the shortest, the one that shares least.
    """
    near = [each for each in found if each.frame_ns * (1 - WORTH) <= found[0].frame_ns]
    if rule.frame_ns * (1 - WORTH) <= found[0].frame_ns:
        return rule
    return min(near, key=lambda each: _sharing(each.placement))


def worth_trying(found: Sequence[Ranked], rule: Ranked) -> list[Ranked]:
    """Which of `found`, which is `ranked`, may be the best; the `chosen` one first, that of the `rule` always."""
    best, longest = chosen(found, rule), found[0].frame_ns * (1 + UNCERTAIN)
    first = [best] if best.placement == rule.placement else [best, rule]
    known = [each.placement for each in first]
    return [*first, *(each for each in found if each.placement not in known and each.frame_ns <= longest)][:MOST_TRIED]


def typical(rounds: Sequence[Sequence[float]]) -> list[float]:
    """The frame time of each placement, in the unit of `rounds`.

    `rounds`: of each the frame times of all placements. They count relative to the median of their round, so that a
    slow second of the machine slows all alike; what they are relative to is the median of these medians.
    """
    medians = [median(times) for times in rounds]
    relative = [[frame / middle for frame in times] for times, middle in zip(rounds, medians, strict=True)]
    return [median(of) * median(medians) for of in zip(*relative, strict=True)]


def fastest(frame_ns: Sequence[float]) -> int:
    """Place of the placement with the shortest measured frames; the first of those that are the `SAME`."""
    return next(place for place, value in enumerate(frame_ns) if value <= min(frame_ns) * (1 + SAME))


def _tie(placement: Placement, times: Times) -> tuple[tuple[int, ...], tuple[tuple[int, ...], ...]]:
    works = {unit: times[unit][place.threads] for unit, place in placement.items()}
    floating_ns = sum(works[unit].core_ns for unit, place in placement.items() if place.threads < len(place.cores))
    total_ns = sum(work.serial_ns for work in works.values())
    return (_sharing(placement), floating_ns, total_ns), tuple(place.cores for place in placement.values())


def _sharing(placement: Placement) -> int:
    """How often a unit has a core that is shared: more with each shared core, and with each unit that floats there."""
    shared = shared_cores(placement)
    return sum(len(shared.intersection(place.cores)) for place in placement.values())
