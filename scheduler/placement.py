"""Which cores and how many threads each unit gets. Rule: it follows from measured times alone, by one formula.

A placement gives each unit cores and threads. Its frame time is predicted from `Work`: how long the unit needs for a
frame, and how long each of its cores is taken meanwhile. With T the frame time, of a pipelined run these must hold:

- *A unit does one job at a time.* Its jobs of a frame take at most T.
- *A core does one thing at a time.* What the units need of it is at most T. A unit with one thread and several cores
  *floats*: the kernel runs it where there is room. So for every set of cores, what cannot go elsewhere is at most what
  they can do in T (Hall's condition: then, and only then, is there a way to divide it), less what the kernel misses.
- *Each of a job's parallel regions waits for its slowest thread.* Where others have core c for the share o(c) of the
  time, a job of several threads goes on only while all its cores are free: a share of the product of 1 - o(c) over its
  cores, as if the others came independently. So much longer it takes, and that is at most T too.
- *Siblings* of one physical core do together `SIBLINGS` times what one does alone.

The least such T is the answer. A sequential run has one stage at work at any time: T is the sum, and nothing waits.

Every job of a unit on a shared core costs a change of threads more; and a floating unit is moved by every job of others
that begins where it runs. What the scheduler takes of its cores counts like work that nothing waits for.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import combinations
from math import prod
from typing import Final, NamedTuple

FULL: Final = 1000
#: Assumed: what two threads on the siblings of a physical core do together, over what one alone does.
SIBLINGS: Final = 1.25
#: Assumed: a change of threads, with the first-level cache; a move, with a second-level one of 2 MiB at 8 GB/s.
CHANGE_NS: Final = 30_000
MOVE_NS: Final = 250_000
#: Predictions this near to the shortest are as good: the model's own error is not less.
WORTH: Final = 0.03
#: Assumed, of what several cores can do for units that float: the kernel moves a waiting thread to a core that has just
#: become idle, a running one hardly ever; so a core may idle while a unit that has no other one waits.
ROOM_USED: Final = 0.9
#: What the scheduler takes for a job: measured as CPU time of its process (docs/decisions/placement.md).
SCHEDULER_NS: Final = 100_000
#: With more cores than this, no unit floats: there is a core for each.
MOST_FLOATING: Final = 4
LEAST_FREE: Final = 1e-9  # of a core's time: none


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


class Rules(NamedTuple):
    """What else decides. `sequential`: one stage at a time. `first`: the unit on whose cores the scheduler runs."""

    first: str
    sequential: bool = False


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


def _tie(placement: Placement, times: Times) -> tuple[tuple[int, ...], tuple[tuple[int, ...], ...]]:
    works = {unit: times[unit][place.threads] for unit, place in placement.items()}
    floating_ns = sum(works[unit].core_ns for unit, place in placement.items() if place.threads < len(place.cores))
    total_ns = sum(work.serial_ns for work in works.values())
    return (_sharing(placement), floating_ns, total_ns), tuple(place.cores for place in placement.values())


def _sharing(placement: Placement) -> int:
    """How often a unit has a core that is shared: more with each shared core, and with each unit that floats there."""
    shared = shared_cores(placement)
    return sum(len(shared.intersection(place.cores)) for place in placement.values())


def shared_cores(placement: Placement) -> set[int]:
    """Cores that more than one unit has."""
    used = [core for place in placement.values() for core in place.cores]
    return {core for core in used if used.count(core) > 1}


def has_own_cores(unit: str, placement: Placement) -> bool:
    """Whether no other unit has one of its cores: only then may its threads spin between jobs."""
    return not shared_cores(placement) & set(placement[unit].cores)


def placements(cores: Sequence[Core], times: Times, fixed: Placement) -> Iterator[Placement]:
    """Every way to place the units of `times`, but one of those that differ only by which of equal cores is which.

    Two cores are equal when they have the same speed, the same users, and siblings that are equal too. Of equal ones
    the lowest number is taken. A unit with one thread has one core, or floats between two of the same speed.
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
    """Threads and cores that a unit may have."""
    for threads in works:
        if threads <= most:
            yield threads, threads
    if 1 in works and 1 < most <= MOST_FLOATING:
        yield 1, 2


def _equally_fast(cores: Sequence[Core], chosen: Sequence[int]) -> bool:
    return len({core.permille for core in cores if core.number in chosen}) == 1


#: Core to the units that have it.
Users = Mapping[int, frozenset[str]]
#: Of a core: its speed and its users; of all: those of each physical core's.
CoreSignature = tuple[int, tuple[str, ...]]
Signature = tuple[tuple[CoreSignature, ...], ...]


def _choices(
    cores: Sequence[Core], users: Users, unit: str, count: int
) -> Iterator[tuple[dict[int, frozenset[str]], tuple[int, ...]]]:
    """The users after `unit` was given `count` cores, and those cores, once for each that differs."""
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
    """What stays the same when equal cores are exchanged: the multiset of physical cores."""
    groups: dict[int, list[CoreSignature]] = {}
    for core in cores:
        groups.setdefault(core.physical, []).append(_own_signature(core, users))
    return tuple(sorted(tuple(sorted(group)) for group in groups.values()))


def frame_ns(placement: Placement, cores: Sequence[Core], times: Times, rules: Rules) -> int:
    """The predicted time from a frame to the next, in ns."""
    model = _Model(placement, cores, times, rules)
    return model.sum_ns() if rules.sequential else model.pipelined_ns()


class _Load(NamedTuple):
    """What a unit, or the scheduler, needs of its cores: `core_ns` of each, or in all where it `floats`.

    `work_ns`: the same if siblings did not slow each other.
    """

    cores: tuple[int, ...]
    serial_ns: float
    core_ns: float
    work_ns: float
    floats: bool

    def on(self, core: int) -> float:
        """What it needs of one core; of one that floats, an even part."""
        if core not in self.cores:
            return 0.0
        return self.core_ns / len(self.cores) if self.floats else self.core_ns


class _Model:
    """One placement."""

    def __init__(self, placement: Placement, cores: Sequence[Core], times: Times, rules: Rules) -> None:
        self._speed = {core.number: core.permille / FULL for core in cores}
        self._physical = {core.number: core.physical for core in cores}
        works = {unit: times[unit][place.threads] for unit, place in placement.items()}
        self._units = []
        for unit, place in placement.items():
            beside = [other for other, its in placement.items() if other != unit and set(its.cores) & set(place.cores)]
            moves = sum(works[other].jobs for other in beside) if place.threads < len(place.cores) else 0
            changes = works[unit].jobs if beside else 0
            self._units.append(self._load(place, works[unit], changes * CHANGE_NS + moves * MOVE_NS))
        jobs = sum(work.jobs for work in works.values())
        where = placement[rules.first].cores
        self._scheduler_ns = float(jobs * SCHEDULER_NS)
        taken_ns = self._scheduler_ns / min(self._speed[core] for core in where)
        self._loads = [*self._units, _Load(where, 0.0, taken_ns, taken_ns, len(where) > 1)]

    def _load(self, place: Place, work: Work, cost_ns: int) -> _Load:
        """The unit's needs on these very cores: the slowest decides, and siblings of which both are used are slower.

        `cost_ns`: what others on its cores cost it.
        """
        floats = place.threads < len(place.cores)
        speed = min(self._speed[core] for core in place.cores)
        physical = [self._physical[core] for core in place.cores]
        was_measured_so = len(physical) > len(list(self._physical_cores))
        both = not floats and len(set(physical)) < len(physical) and not was_measured_so
        slower = 2 / SIBLINGS if both else 1.0
        serial_ns, core_ns = work.serial_ns / speed + cost_ns, work.core_ns / speed + cost_ns
        return _Load(place.cores, serial_ns * slower, core_ns * slower, core_ns, floats)

    def sum_ns(self) -> int:
        """Of a sequential run."""
        return round(sum(unit.serial_ns for unit in self._units) + self._scheduler_ns)

    def pipelined_ns(self) -> int:
        """The least whole number of ns that is long enough, from what every frame needs upwards."""
        high = low = int(max([*self._crowded(), *(unit.serial_ns for unit in self._units)]))
        gangs = [self._gang(unit) for unit in self._units if len(unit.cores) > 1 and not unit.floats]
        while not all(gang.fits(high) for gang in gangs):
            low, high = high, 2 * high + 1
        while high - low > 1:
            middle = (low + high) // 2
            low, high = (low, middle) if all(gang.fits(middle) for gang in gangs) else (middle, high)
        return high

    def _crowded(self) -> Iterator[float]:
        """For each set of cores that can be too full, what it needs over what it can do."""
        floating = [load for load in self._loads if load.floats]
        sets = {frozenset([core]): 1.0 for core in self._speed}
        for one in self._physical_cores:
            sets[frozenset(core for core in self._speed if self._physical[core] == one)] = 1.0
        for count in range(1, len(floating) + 1):
            for some in combinations(floating, count):
                sets[frozenset().union(*(load.cores for load in some))] = ROOM_USED
        for these, used in sets.items():
            yield sum(self._within(load, these) for load in self._loads) / (self._capacity(these) * used)

    @property
    def _physical_cores(self) -> Iterable[int]:
        return dict.fromkeys(self._physical.values())

    @staticmethod
    def _within(load: _Load, these: frozenset[int]) -> float:
        """What of a load must be done on `these` cores."""
        return _share_ns(load.cores, load.core_ns if len(these) == 1 else load.work_ns, load.floats, these)

    def _capacity(self, these: frozenset[int]) -> float:
        """How many cores' worth of work the set does: loads are in the time of the very cores, so each counts 1."""
        counts = [sum(self._physical[core] == one for core in these) for one in self._physical_cores]
        return sum(SIBLINGS if count > 1 else count for count in counts)

    def _gang(self, unit: _Load) -> _Gang:
        others = [load for load in self._loads if load is not unit]
        on = {core: sum(load.on(core) for load in others) for core in self._speed}
        beside = {
            core: sum(on[other] for other, physical in self._physical.items() if physical == own and other != core)
            for core, own in self._physical.items()
        }
        return _Gang(unit.serial_ns, unit.core_ns, [(on[core], beside[core]) for core in unit.cores])


class _Gang(NamedTuple):
    """A unit of several threads, each on a core: the times of its jobs, and what others do on each core and beside."""

    serial_ns: float
    core_ns: float
    others_ns: Sequence[tuple[float, float]]

    def fits(self, frame: int) -> bool:
        """Whether its jobs, stretched by their waits, end within a frame of so many ns."""
        free = prod(
            max(1 - on / frame, 0.0) * (1 - (1 - SIBLINGS / 2) * min(beside / frame, 1.0))
            for on, beside in self.others_ns
        )
        return self.serial_ns - self.core_ns + self.core_ns / max(free, LEAST_FREE) <= frame


def busiest_core_ns(placement: Placement, core_ns: Mapping[str, float]) -> float:
    """The work of the busiest core for a frame: what no way to divide the units' work among their cores avoids.

    `core_ns`: of each unit, how long it takes each of its cores, or in all where it floats.
    """
    floating = [place.cores for place in placement.values() if place.threads < len(place.cores)]
    sets = {frozenset([core]) for place in placement.values() for core in place.cores}
    for count in range(1, len(floating) + 1):
        sets |= {frozenset().union(*some) for some in combinations(floating, count)}
    return max(
        sum(
            _share_ns(cores, core_ns[unit], threads < len(cores), these) for unit, (cores, threads) in placement.items()
        )
        / len(these)
        for these in sets
    )


def _share_ns(cores: tuple[int, ...], core_ns: float, floats: bool, these: frozenset[int]) -> float:
    """What must be done on `these` cores of a load that takes `core_ns` of each of `cores`, or in all if it floats."""
    if floats:
        return core_ns if these.issuperset(cores) else 0.0
    return core_ns * len(these.intersection(cores))
