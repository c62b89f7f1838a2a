"""The words of placement (cores, places, needs of units), and a list of every way to place units.

Rule: plain data, and values that follow from it. In the list, one placement stands for all that differ only by an
exchange of equal cores.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from itertools import combinations
from typing import Final, NamedTuple

FULL: Final = 1000


class CpuCore(NamedTuple):
    """A core.

    `number`: number by which the system counts it.
    `physical`: number of the physical core, the same for siblings.
    `permille`: speed in thousandths, 1000 for the fastest core.
    """

    number: int
    physical: int
    permille: int = FULL


class UnitWork(NamedTuple):
    """The work of a unit for a frame, on cores of full speed that the unit has to itself.

    `serial_ns`: time of the unit's jobs.
    `core_ns`: time that the jobs take on each of the unit's cores; less than `serial_ns` if a device works for them.
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
Times = Mapping[str, Mapping[int, UnitWork]]


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


#: Most cores with which a unit may float; with more, there is a core for each unit.
MOST_FLOATING: Final = 4


def placements(cores: Sequence[CpuCore], times: Times, fixed: Placement) -> Iterator[Placement]:
    """Yield every way to place the units of `times`, one for all that differ only by an exchange of equal cores.

    Two cores are equal when they have the same speed and the same users, and equal siblings. Of equal cores the lowest
    number is taken. A unit with one thread has one core, or floats between two of the same speed.
    """
    users: dict[int, frozenset[str]] = {core.number: frozenset() for core in cores}
    for unit, place in fixed.items():
        users |= {core: users[core] | {unit} for core in place.cores}
    states = [(users, dict(fixed))]
    for unit in times:
        if unit not in fixed:
            states = [
                (after, {**placed, unit: Place(chosen, threads)})
                for users, placed in states
                for threads, count in _forms(times[unit], len(cores))
                for after, chosen in _choices(cores, users, unit, count)
                if threads == count or _equally_fast(cores, chosen)
            ]
    for _, placed in states:
        yield {unit: placed[unit] for unit in times}


def _forms(works: Mapping[int, UnitWork], most: int) -> Iterator[tuple[int, int]]:
    """Yield the threads and cores that a unit may have."""
    for threads in works:
        if threads <= most:
            yield threads, threads
    if 1 in works and 1 < most <= MOST_FLOATING:
        yield 1, 2


def _equally_fast(cores: Sequence[CpuCore], chosen: Sequence[int]) -> bool:
    return len({core.permille for core in cores if core.number in chosen}) == 1


#: The units that have each core.
_Users = Mapping[int, frozenset[str]]
#: A core's speed and users, and the same for all cores, grouped by physical core.
_CoreSignature = tuple[int, tuple[str, ...]]
_Signature = tuple[tuple[_CoreSignature, ...], ...]


def _choices(
    cores: Sequence[CpuCore], users: _Users, unit: str, count: int
) -> Iterator[tuple[dict[int, frozenset[str]], tuple[int, ...]]]:
    """Yield the users after `unit` was given `count` cores, and those cores, once for each choice that differs."""
    states = [dict(users)]
    for _ in range(count):
        different: dict[_Signature, dict[int, frozenset[str]]] = {}
        for before in states:
            for after in _with_one_more(cores, before, unit):
                different.setdefault(_signature(cores, after), after)
        states = list(different.values())
    for after in states:
        yield after, tuple(sorted(core for core, of in after.items() if unit in of))


def _with_one_more(cores: Sequence[CpuCore], users: _Users, unit: str) -> Iterator[dict[int, frozenset[str]]]:
    seen = set()
    for core in cores:
        kind = (_own_signature(core, users), _siblings(cores, core, users))
        if unit not in users[core.number] and kind not in seen:
            seen.add(kind)
            yield {**users, core.number: users[core.number] | {unit}}


def _own_signature(core: CpuCore, users: _Users) -> _CoreSignature:
    return core.permille, tuple(sorted(users[core.number]))


def _siblings(cores: Sequence[CpuCore], core: CpuCore, users: _Users) -> tuple[_CoreSignature, ...]:
    return tuple(
        sorted(_own_signature(other, users) for other in cores if other.physical == core.physical and other != core)
    )


def _signature(cores: Sequence[CpuCore], users: _Users) -> _Signature:
    """Return what stays the same when equal cores are exchanged: the multiset of physical cores."""
    groups: dict[int, list[_CoreSignature]] = {}
    for core in cores:
        groups.setdefault(core.physical, []).append(_own_signature(core, users))
    return tuple(sorted(tuple(sorted(group)) for group in groups.values()))
