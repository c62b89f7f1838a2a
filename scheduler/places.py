"""The words of placement: cores, places and what units need of them. Rule: plain data, and what follows from it."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import combinations
from typing import Final, NamedTuple

FULL: Final = 1000


class Core(NamedTuple):
    """A core.

    `number`: number by which the system counts it.
    `physical`: number of the physical core, the same for siblings.
    `permille`: speed in thousandths, 1000 for the fastest core.
    """

    number: int
    physical: int
    permille: int = FULL


class Work(NamedTuple):
    """The work of a unit for a frame, on cores of full speed that the unit has to itself.

    `serial_ns`: time of the unit's jobs.
    `core_ns`: time that they take of each of its cores; less where a device works.
    `jobs`: number of jobs.
    """

    serial_ns: int
    core_ns: int
    jobs: int = 1


class Place(NamedTuple):
    """The place of a unit.

    `cores`: numbers of its cores, ascending.
    `threads`: number of its threads: one for each core, or one that floats between the cores.
    """

    cores: tuple[int, ...]
    threads: int


#: The place of each unit.
Placement = Mapping[str, Place]
#: The work of each unit by number of threads; a unit can have no other number of threads.
Times = Mapping[str, Mapping[int, Work]]


def shared_cores(placement: Placement) -> set[int]:
    """Return the cores that more than one unit has."""
    used = [core for place in placement.values() for core in place.cores]
    return {core for core in used if used.count(core) > 1}


def has_own_cores(unit: str, placement: Placement) -> bool:
    """Return whether no other unit has one of its cores; only then may its threads spin between jobs."""
    return not shared_cores(placement) & set(placement[unit].cores)


def busiest_core_ns(placement: Placement, core_ns: Mapping[str, float]) -> float:
    """Return the work of the busiest core for a frame in ns.

    No division of the work among the units' cores avoids it.

    `core_ns`: time that each unit takes of each of its cores, or of all together where it floats.
    """
    floating = [place.cores for place in placement.values() if place.threads < len(place.cores)]
    sets = {frozenset([core]) for place in placement.values() for core in place.cores}
    for count in range(1, len(floating) + 1):
        sets |= {frozenset().union(*some) for some in combinations(floating, count)}
    return max(
        sum(share_ns(cores, core_ns[unit], threads < len(cores), these) for unit, (cores, threads) in placement.items())
        / len(these)
        for these in sets
    )


def share_ns(cores: tuple[int, ...], core_ns: float, floats: bool, these: frozenset[int]) -> float:
    """Return the part of a load that must be done on `these` cores, in ns.

    The load takes `core_ns` of each of `cores`, or of all together if it floats.
    """
    if floats:
        return core_ns if these.issuperset(cores) else 0.0
    return core_ns * len(these.intersection(cores))
