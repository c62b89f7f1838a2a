"""Cores, places and what units need of them: the words of placement. Rule: plain data, and what follows from it."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import combinations
from typing import Final, NamedTuple

FULL: Final = 1000


class Core(NamedTuple):
    """A core as the system counts them. `physical`: the same for siblings. `permille`: its speed, 1000 the fastest."""

    number: int
    physical: int
    permille: int = FULL


class Work(NamedTuple):
    """A frame's, on cores of full speed that the unit has to itself.

    `serial_ns`: how long the unit's jobs take. `core_ns`: how long they take each of its cores; less where a device
    works. `jobs`: how many there are.
    """

    serial_ns: int
    core_ns: int
    jobs: int = 1


class Place(NamedTuple):
    """`cores`, ascending, of a unit, and its `threads`: as many, or one that floats between them."""

    cores: tuple[int, ...]
    threads: int


#: Unit to its place.
Placement = Mapping[str, Place]
#: Unit, then threads, to what is known of it. A unit can have no other number of threads.
Times = Mapping[str, Mapping[int, Work]]


def shared_cores(placement: Placement) -> set[int]:
    """Cores that more than one unit has."""
    used = [core for place in placement.values() for core in place.cores]
    return {core for core in used if used.count(core) > 1}


def has_own_cores(unit: str, placement: Placement) -> bool:
    """Whether no other unit has one of its cores: only then may its threads spin between jobs."""
    return not shared_cores(placement) & set(placement[unit].cores)


def busiest_core_ns(placement: Placement, core_ns: Mapping[str, float]) -> float:
    """The work of the busiest core for a frame: what no way to divide the units' work among their cores avoids.

    `core_ns`: of each unit, how long it takes each of its cores, or in all where it floats.
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
    """What must be done on `these` cores of a load that takes `core_ns` of each of `cores`, or in all if it floats."""
    if floats:
        return core_ns if these.issuperset(cores) else 0.0
    return core_ns * len(these.intersection(cores))
