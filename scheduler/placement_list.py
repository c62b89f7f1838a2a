"""Lists every way to place units on cores. Rule: one stands for all that differ only by an exchange of equal cores."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Final

from trilane.scheduler.places import Core, Place, Placement, Times, Work

#: Most cores with which a unit may float; with more, there is a core for each unit.
MOST_FLOATING: Final = 4


def placements(cores: Sequence[Core], times: Times, fixed: Placement) -> Iterator[Placement]:
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


def _forms(works: Mapping[int, Work], most: int) -> Iterator[tuple[int, int]]:
    """Yield the threads and cores that a unit may have."""
    for threads in works:
        if threads <= most:
            yield threads, threads
    if 1 in works and 1 < most <= MOST_FLOATING:
        yield 1, 2


def _equally_fast(cores: Sequence[Core], chosen: Sequence[int]) -> bool:
    return len({core.permille for core in cores if core.number in chosen}) == 1


#: The units that have each core.
Users = Mapping[int, frozenset[str]]
#: A core's speed and users, and the same for all cores, grouped by physical core.
CoreSignature = tuple[int, tuple[str, ...]]
Signature = tuple[tuple[CoreSignature, ...], ...]


def _choices(
    cores: Sequence[Core], users: Users, unit: str, count: int
) -> Iterator[tuple[dict[int, frozenset[str]], tuple[int, ...]]]:
    """Yield the users after `unit` was given `count` cores, and those cores, once for each choice that differs."""
    states = [dict(users)]
    for _ in range(count):
        different: dict[Signature, dict[int, frozenset[str]]] = {}
        for before in states:
            for after in _with_one_more(cores, before, unit):
                different.setdefault(_signature(cores, after), after)
        states = list(different.values())
    for after in states:
        yield after, tuple(sorted(core for core, of in after.items() if unit in of))


def _with_one_more(cores: Sequence[Core], users: Users, unit: str) -> Iterator[dict[int, frozenset[str]]]:
    seen = set()
    for core in cores:
        kind = (_own_signature(core, users), _siblings(cores, core, users))
        if unit not in users[core.number] and kind not in seen:
            seen.add(kind)
            yield {**users, core.number: users[core.number] | {unit}}


def _own_signature(core: Core, users: Users) -> CoreSignature:
    return core.permille, tuple(sorted(users[core.number]))


def _siblings(cores: Sequence[Core], core: Core, users: Users) -> tuple[CoreSignature, ...]:
    return tuple(
        sorted(_own_signature(other, users) for other in cores if other.physical == core.physical and other != core)
    )


def _signature(cores: Sequence[Core], users: Users) -> Signature:
    """Return what stays the same when equal cores are exchanged: the multiset of physical cores."""
    groups: dict[int, list[CoreSignature]] = {}
    for core in cores:
        groups.setdefault(core.physical, []).append(_own_signature(core, users))
    return tuple(sorted(tuple(sorted(group)) for group in groups.values()))
