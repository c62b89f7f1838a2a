"""Chooses cores and the number of threads of each unit. Rule: measured times alone decide, by one formula.

`places.py` defines the words, `placement_list.py` lists the possible placements, and `placement_model.py` has the
formula. The formula is not exact. Where real frames can be had, they decide between the few placements that it cannot
tell apart.
"""

from __future__ import annotations

from collections.abc import Sequence
from statistics import median
from typing import Final, NamedTuple

from trilane.scheduler.placement_list import placements
from trilane.scheduler.placement_model import Rules, frame_ns
from trilane.scheduler.places import Core, Placement, Times, shared_cores

#: Relative difference from the shortest within which predictions are as good; the model's own error is not smaller.
WORTH: Final = 0.03
#: Relative difference from the shortest prediction up to which a placement may still be the best, and how many are
#: tried.
UNCERTAIN: Final = 0.25
MOST_TRIED: Final = 5
#: Relative difference within which measured frame times are the same.
SAME: Final = 0.01


class Ranked(NamedTuple):
    """A placement and its predicted frame time."""

    placement: Placement
    frame_ns: int


def ranked(cores: Sequence[Core], times: Times, rules: Rules, fixed: Placement | None = None) -> list[Ranked]:
    """Return all placements, the smallest frame time first.

    Ties go to fewer shared cores, then less floating work, less time in all stages (latency), lower core numbers.

    `fixed`: places that are given.

    Raises ValueError for no cores, or for a unit of which no number of threads fits.
    """
    found = [Ranked(each, frame_ns(each, cores, times, rules)) for each in placements(cores, times, fixed or {})]
    if not found:
        raise ValueError("no placement: a unit has no number of threads that fits the cores")
    return sorted(found, key=lambda each: (each.frame_ns, _tie(each.placement, times)))


def chosen(found: Sequence[Ranked], rule: Ranked) -> Ranked:
    """Return the placement of `found` to take; `found` is in the order of `ranked`.

    It is never predicted longer than `rule`, the placement for any run. The rule stays unless another placement is
    shorter by more than WORTH. Otherwise the choice is the placement within WORTH of the shortest that shares least.
    """
    near = [each for each in found if each.frame_ns * (1 - WORTH) <= found[0].frame_ns]
    if rule.frame_ns * (1 - WORTH) <= found[0].frame_ns:
        return rule
    return min(near, key=lambda each: _sharing(each.placement))


def worth_trying(found: Sequence[Ranked], rule: Ranked) -> list[Ranked]:
    """Return the placements of `found` that may be the best; `found` is in the order of `ranked`.

    The `chosen` one comes first, and the `rule` is always among them.
    """
    best, longest = chosen(found, rule), found[0].frame_ns * (1 + UNCERTAIN)
    first = [best] if best.placement == rule.placement else [best, rule]
    known = [each.placement for each in first]
    return [*first, *(each for each in found if each.placement not in known and each.frame_ns <= longest)][:MOST_TRIED]


def typical(rounds: Sequence[Sequence[float]]) -> list[float]:
    """Return the typical frame time of each placement, in the unit of `rounds`.

    `rounds`: frame times of all placements, for each round. They count relative to the median of their round, so that a
    slow second of the machine slows all alike. The relative times are scaled by the median of these medians.
    """
    medians = [median(times) for times in rounds]
    relative = [[frame / middle for frame in times] for times, middle in zip(rounds, medians, strict=True)]
    return [median(of) * median(medians) for of in zip(*relative, strict=True)]


def fastest(frame_ns: Sequence[float]) -> int:
    """Return the index of the placement with the shortest measured frames; the first of those that are the `SAME`."""
    return next(place for place, value in enumerate(frame_ns) if value <= min(frame_ns) * (1 + SAME))


def _tie(placement: Placement, times: Times) -> tuple[tuple[int, ...], tuple[tuple[int, ...], ...]]:
    works = {unit: times[unit][place.threads] for unit, place in placement.items()}
    floating_ns = sum(works[unit].core_ns for unit, place in placement.items() if place.threads < len(place.cores))
    total_ns = sum(work.serial_ns for work in works.values())
    return (_sharing(placement), floating_ns, total_ns), tuple(place.cores for place in placement.values())


def _sharing(placement: Placement) -> int:
    """Count how often a unit has a shared core: each shared core counts for each unit that has it."""
    shared = shared_cores(placement)
    return sum(len(shared.intersection(place.cores)) for place in placement.values())
