"""Places units on cores: lists all placements, predicts the frame time of each, and chooses one.

Cores, places and needs of units are plain data. Placements that differ only by an exchange of equal cores count as one
placement.

Rule: one formula predicts frame times from the units' measured times; nothing is tried here. The formula is not exact.
If real frames can be run, a trial decides between the few placements that the formula cannot tell apart.

A placement gives each unit cores and threads. Its frame time is predicted from each unit's `UnitWork`: the time that
the unit needs for a frame, and the time that it takes on each core. Let T be the frame time. In a pipelined run these
conditions hold:

- *A unit does one job at a time.* Its jobs of a frame take at most T.
- *A core does one thing at a time.* The time that all units need on a core is at most T. A unit with one thread and
  several cores *floats*: the kernel runs it on any core that is free. For every set of cores, the work that cannot go
  to other cores is at most the work that the set can do in T. The kernel leaves a share of this time unused, so only
  `ROOM_USED` of it counts. By Hall's condition the work can be divided among the cores exactly if this holds for all
  sets.
- *Each of a job's parallel regions waits for its slowest thread.* Let other units have core c for the share o(c) of the
  time. A job of several threads goes on only while all its cores are free. If the other units come independently, the
  cores are all free for the share p, the product of 1 - o(c) over the cores. The job's time divided by p is at most T.
- *Siblings* are cores of one physical core. Together they do `SIBLINGS` times the work that one of them does alone.

The prediction is the least T that meets these conditions. In a sequential run one stage works at any time, and T is the
sum of all jobs' times.

A floating unit that has one core to itself *stays* there, because the kernel moves a thread only when it has to wait.

Every job of a unit on a shared core costs one more change of threads. A floating unit that does not stay is moved once
a frame. The scheduler's time counts as work on its cores, but no job waits for it.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import combinations
from math import prod
from statistics import median
from typing import Final, NamedTuple

FULL: Final = 1000


class CpuCore(NamedTuple):
    """A core of this machine, as the kernel counts cores.

    `number`: the kernel's number of the core.
    `physical`: number of its physical core, the same for siblings.
    `permille`: speed in thousandths, 1000 for the fastest core.
    """

    number: int
    physical: int
    permille: int = FULL


class UnitWork(NamedTuple):
    """The work of a unit for a frame, on cores of full speed that the unit has to itself.

    `serial_ns`: sum of the times of the unit's jobs, without preempted time.
    `core_ns`: mean CPU time of the unit's threads, summed over the jobs. A floating unit takes this time on all its
    cores together. It is less than `serial_ns` if threads wait, for example for a device.
    `jobs`: number of jobs for a frame.
    """

    serial_ns: int
    core_ns: int
    jobs: int = 1


class Place(NamedTuple):
    """The cores and threads of a unit.

    `cores`: numbers of its cores, ascending.
    `threads`: number of its threads: one for each core, or one that floats between the cores.
    """

    cores: tuple[int, ...]
    threads: int


#: The place of each unit, by the unit's name.
Placement = Mapping[str, Place]
#: The work of each unit, by its name and its number of threads. A unit can have only the listed numbers of threads.
Times = Mapping[str, Mapping[int, UnitWork]]


def shared_cores(placement: Placement) -> set[int]:
    """Return the numbers of the cores that several units have."""
    used = [core for place in placement.values() for core in place.cores]
    return {core for core in used if used.count(core) > 1}


def has_own_cores(unit: str, placement: Placement) -> bool:
    """Return whether the unit shares none of its cores; only then may its threads spin between jobs."""
    return not shared_cores(placement) & set(placement[unit].cores)


def busiest_core_ns(placement: Placement, core_ns: Mapping[str, float]) -> float:
    """Return the time in ns of a frame's work on the busiest core, if floating units are divided as evenly as possible.

    `core_ns`: time in ns that each unit takes on each of its cores; for a floating unit, on all its cores together.
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
    """Return the part of a unit's work that must be done on `these` cores, in ns.

    `cores`: cores of the unit.
    `core_ns`: time in ns that the work takes on each of `cores`; if it `floats`, on all of them together.
    """
    if floats:
        return core_ns if these.issuperset(cores) else 0.0
    return core_ns * len(these.intersection(cores))


#: Most cores of a run in which units may float. A run with more cores has a core for each unit.
MOST_FLOATING: Final = 4


def placements(cores: Sequence[CpuCore], times: Times, fixed: Placement) -> Iterator[Placement]:
    """Yield each placement of the units of `times`. Placements that differ only by exchanging equal cores count once.

    Cores are equal if they have the same speed, the same units and equal siblings. The core with the lowest number
    stands for all equal cores. A unit with one thread has one core, or floats between two cores of the same speed.

    `fixed`: places of units that stay where they are.
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
                if threads == count or len({core.permille for core in cores if core.number in chosen}) == 1
            ]
    for _, placed in states:
        yield {unit: placed[unit] for unit in times}


def _forms(works: Mapping[int, UnitWork], most: int) -> Iterator[tuple[int, int]]:
    """Yield the pairs (number of threads, number of cores) that a unit may have, with at most `most` cores."""
    for threads in works:
        if threads <= most:
            yield threads, threads
    if 1 in works and 1 < most <= MOST_FLOATING:
        yield 1, 2


#: The units that have each core, by the core's number.
_Users = Mapping[int, frozenset[str]]
#: A core's speed in thousandths, and the names of its units.
_CoreSignature = tuple[int, tuple[str, ...]]
#: The signatures of all cores, grouped by physical core.
_Signature = tuple[tuple[_CoreSignature, ...], ...]


def _choices(
    cores: Sequence[CpuCore], users: _Users, unit: str, count: int
) -> Iterator[tuple[dict[int, frozenset[str]], tuple[int, ...]]]:
    """Yield each choice of `count` cores for `unit`, as (`users` after the choice, numbers of the chosen cores).

    Choices that differ only by an exchange of equal cores count as one.
    """
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
    """Return a value that stays the same if equal cores are exchanged: the sorted signatures of all physical cores."""
    groups: dict[int, list[_CoreSignature]] = {}
    for core in cores:
        groups.setdefault(core.physical, []).append(_own_signature(core, users))
    return tuple(sorted(tuple(sorted(group)) for group in groups.values()))


#: Assumed: work of two threads on the siblings of a physical core, divided by the work of one thread alone.
SIBLINGS: Final = 1.25
#: Assumed cost of a change of threads on a core, with the refill of the first-level cache.
CHANGE_NS: Final = 30_000
#: Assumed cost of a move to another core, with the refill of a second-level cache of 2 MiB at 8 GB/s. A simulated fair
#: scheduler moved floating units 0.5 to 1.2 times a frame (docs/decisions/placement.md).
MOVE_NS: Final = 250_000
#: Assumed share of the time of several cores that floating units can use. The kernel moves a waiting thread to a core
#: that has just become idle, but hardly ever a running one. Therefore a core may idle while a unit waits for another
#: core.
ROOM_USED: Final = 0.9
#: Time that the scheduler takes for a job, measured as CPU time of its process (docs/decisions/placement.md).
SCHEDULER_NS: Final = 100_000
LEAST_FREE: Final = 1e-9  # least free share of a unit's cores, so that a full core is no division by 0


class Rules(NamedTuple):
    """Properties of the run that change the frame time of a placement.

    `first`: unit on whose cores the scheduler runs.
    `sequential`: whether one stage works at a time.
    """

    first: str
    sequential: bool = False


def frame_ns(placement: Placement, cores: Sequence[CpuCore], times: Times, rules: Rules) -> int:
    """Return the predicted frame time in ns of `placement` on `cores`, by the units' `times` and the run's `rules`."""
    model = _Model(placement, cores, times, rules)
    return model.sum_ns() if rules.sequential else model.pipelined_ns()


class _Load(NamedTuple):
    """The work of a unit, or of the scheduler, for a frame on its cores.

    `serial_ns`: time that the unit needs for its jobs; 0 for the scheduler.
    `core_ns`: time that the work takes on each of `cores`; if it `floats`, on all of them together.
    `work_ns`: like `core_ns`, but as if siblings did not slow each other.
    """

    cores: tuple[int, ...]
    serial_ns: float
    core_ns: float
    work_ns: float
    floats: bool

    def on(self, core: int) -> float:
        """Return the time in ns that the load takes on `core`; a floating load is divided evenly."""
        if core not in self.cores:
            return 0.0
        return self.core_ns / len(self.cores) if self.floats else self.core_ns


def _settled(placement: Placement) -> Placement:
    """Return `placement`, with one change: a floating unit that has one core to itself has only this core."""
    shared = shared_cores(placement)
    settled = dict(placement)
    for unit, place in placement.items():
        own = [core for core in place.cores if core not in shared]
        if len(own) == 1 and place.threads < len(place.cores):
            settled[unit] = Place((own[0],), 1)
    # A unit that leaves a core may leave it to one other unit alone, which can then stay there.
    return settled if settled == placement else _settled(settled)


class _Model:
    """Predicts the frame time of one placement, by the conditions in the module's docstring."""

    def __init__(self, placement: Placement, cores: Sequence[CpuCore], times: Times, rules: Rules) -> None:
        self._speed = {core.number: core.permille / FULL for core in cores}
        self._physical = {core.number: core.physical for core in cores}
        works = {unit: times[unit][place.threads] for unit, place in placement.items()}
        self._units = []
        settled = _settled(placement)
        for unit, place in settled.items():
            changes = 0 if has_own_cores(unit, settled) else works[unit].jobs
            moves = place.threads < len(place.cores)
            self._units.append(self._load(place, works[unit], changes * CHANGE_NS + moves * MOVE_NS))
        jobs = sum(work.jobs for work in works.values())
        where = placement[rules.first].cores
        self._scheduler_ns = float(jobs * SCHEDULER_NS)
        taken_ns = self._scheduler_ns / min(self._speed[core] for core in where)
        self._loads = [*self._units, _Load(where, 0.0, taken_ns, taken_ns, len(where) > 1)]

    def _load(self, place: Place, work: UnitWork, cost_ns: int) -> _Load:
        """Return the load of a unit. The slowest of its cores sets the speed, and two used siblings slow each other.

        `cost_ns`: time in ns of a frame that changes of threads, and moves to other cores, take.
        """
        floats = place.threads < len(place.cores)
        speed = min(self._speed[core] for core in place.cores)
        physical = [self._physical[core] for core in place.cores]
        # A unit with more threads than there are physical cores could only be measured on siblings.
        was_measured_so = len(physical) > len(list(self._physical_cores))
        both = not floats and len(set(physical)) < len(physical) and not was_measured_so
        slower = 2 / SIBLINGS if both else 1.0
        serial_ns, core_ns = work.serial_ns / speed + cost_ns, work.core_ns / speed + cost_ns
        return _Load(place.cores, serial_ns * slower, core_ns * slower, core_ns, floats)

    def sum_ns(self) -> int:
        """Return the frame time of a sequential run in ns."""
        return round(sum(unit.serial_ns for unit in self._units) + self._scheduler_ns)

    def pipelined_ns(self) -> int:
        """Return the frame time of a pipelined run: the least whole number of ns that meets all conditions."""
        high = low = int(max([*self._crowded(), *(unit.serial_ns for unit in self._units)]))
        gangs = [self._gang(unit) for unit in self._units if len(unit.cores) > 1 and not unit.floats]
        # If a time is long enough, every longer time is, so bisection finds the least.
        while not all(gang.fits(high) for gang in gangs):
            low, high = high, 2 * high + 1
        while high - low > 1:
            middle = (low + high) // 2
            low, high = (low, middle) if all(gang.fits(middle) for gang in gangs) else (middle, high)
        return high

    def _crowded(self) -> Iterator[float]:
        """Yield, for each set of cores that can limit the run, the least frame time in ns that its work allows."""
        floating = [load for load in self._loads if load.floats]
        sets = {frozenset([core]): 1.0 for core in self._speed}
        for one in self._physical_cores:
            sets[frozenset(core for core in self._speed if self._physical[core] == one)] = 1.0
        for count in range(1, len(floating) + 1):
            for some in combinations(floating, count):
                sets[frozenset().union(*(load.cores for load in some))] = ROOM_USED
        for these, used in sets.items():
            within_ns = sum(
                share_ns(load.cores, load.core_ns if len(these) == 1 else load.work_ns, load.floats, these)
                for load in self._loads
            )
            # The cores' speeds do not matter here, because the loads are already scaled to them.
            counts = [sum(self._physical[core] == one for core in these) for one in self._physical_cores]
            yield within_ns / (sum(SIBLINGS if count > 1 else count for count in counts) * used)

    @property
    def _physical_cores(self) -> Iterable[int]:
        return dict.fromkeys(self._physical.values())

    def _gang(self, unit: _Load) -> _Gang:
        others = [load for load in self._loads if load is not unit]
        on = {core: sum(load.on(core) for load in others) for core in self._speed}
        beside = {
            core: sum(on[other] for other, physical in self._physical.items() if physical == own and other != core)
            for core, own in self._physical.items()
        }
        return _Gang(unit.serial_ns, unit.core_ns, [(on[core], beside[core]) for core in unit.cores])


class _Gang(NamedTuple):
    """A unit of several threads, each on a core of its own.

    `serial_ns`, `core_ns`: times of its jobs, as in `_Load`.
    `others_ns`: for each of its cores, the time in ns of other loads on (this core, the core's siblings).
    """

    serial_ns: float
    core_ns: float
    others_ns: Sequence[tuple[float, float]]

    def fits(self, frame: int) -> bool:
        """Return whether the unit's jobs, lengthened by their waits for cores, end within `frame` ns."""
        # Beside a busy sibling, a core does SIBLINGS / 2 of its work.
        free = prod(
            max(1 - on / frame, 0.0) * (1 - (1 - SIBLINGS / 2) * min(beside / frame, 1.0))
            for on, beside in self.others_ns
        )
        return self.serial_ns - self.core_ns + self.core_ns / max(free, LEAST_FREE) <= frame


#: Predictions whose relative difference from the shortest is at most this count as equal; the model is not more exact.
WORTH: Final = 0.03
#: Relative difference from the shortest prediction up to which a placement may still be the best.
UNCERTAIN: Final = 0.25
#: Most placements that a trial runs.
MOST_TRIED: Final = 5
#: Relative difference within which measured frame times count as equal.
SAME: Final = 0.01


class Ranked(NamedTuple):
    """A placement and its predicted frame time."""

    placement: Placement
    frame_ns: int


def ranked(cores: Sequence[CpuCore], times: Times, rules: Rules, fixed: Placement | None = None) -> list[Ranked]:
    """Return all placements with their predicted frame times, the shortest first.

    Of equal frame times, the placement with fewer shared cores comes first. Further ties go to less floating work, less
    time of all stages together (latency), lower core numbers.

    `fixed`: places of units that stay where they are.

    Raises ValueError if there are no cores, or if every listed number of threads of a unit exceeds the cores.
    """
    found = [Ranked(each, frame_ns(each, cores, times, rules)) for each in placements(cores, times, fixed or {})]
    if not found:
        raise ValueError("no placement: a unit has no number of threads that fits the cores")
    return sorted(found, key=lambda each: (each.frame_ns, _tie(each.placement, times)))


def chosen(found: Sequence[Ranked], rule: Ranked) -> Ranked:
    """Return the placement of `found` to use.

    If no frame time is shorter than the one of `rule` by more than WORTH, `rule` is used. Otherwise the placement with
    the fewest shared cores is used, among the placements whose frame times are within WORTH of the shortest.

    `found`: placements in the order of `ranked`.
    `rule`: default placement, which suits any run.
    """
    near = [each for each in found if each.frame_ns * (1 - WORTH) <= found[0].frame_ns]
    if rule.frame_ns * (1 - WORTH) <= found[0].frame_ns:
        return rule
    return min(near, key=lambda each: _sharing(each.placement))


def worth_trying(found: Sequence[Ranked], rule: Ranked) -> list[Ranked]:
    """Return at most MOST_TRIED placements that may be the best.

    The placement that `chosen` returns comes first, and then `rule`, if it differs. The others are within
    UNCERTAIN of the shortest prediction, in the order of `found`.

    `found`, `rule`: as for `chosen`.
    """
    best, longest = chosen(found, rule), found[0].frame_ns * (1 + UNCERTAIN)
    first = [best] if best.placement == rule.placement else [best, rule]
    known = [each.placement for each in first]
    return [*first, *(each for each in found if each.placement not in known and each.frame_ns <= longest)][:MOST_TRIED]


def typical(rounds: Sequence[Sequence[float]]) -> list[float]:
    """Return a frame time for each placement, in the unit of measure of `rounds`. Slow rounds do not distort it.

    Each time is divided by the median of its round, because a slow second of the machine slows all placements alike.
    The result is the median of these ratios over the rounds, times the median of the rounds' medians.

    `rounds`: for each round, the frame times of all placements, in the same order.
    """
    medians = [median(times) for times in rounds]
    relative = [[frame / middle for frame in times] for times, middle in zip(rounds, medians, strict=True)]
    return [median(of) * median(medians) for of in zip(*relative, strict=True)]


def fastest(frame_ns: Sequence[float]) -> int:
    """Return the index of the first placement whose measured frame time is within `SAME` of the shortest."""
    return next(place for place, value in enumerate(frame_ns) if value <= min(frame_ns) * (1 + SAME))


def _tie(placement: Placement, times: Times) -> tuple[tuple[int, ...], tuple[tuple[int, ...], ...]]:
    works = {unit: times[unit][place.threads] for unit, place in placement.items()}
    floating_ns = sum(works[unit].core_ns for unit, place in placement.items() if place.threads < len(place.cores))
    total_ns = sum(work.serial_ns for work in works.values())
    return (_sharing(placement), floating_ns, total_ns), tuple(place.cores for place in placement.values())


def _sharing(placement: Placement) -> int:
    """Return for how many pairs (unit, core) the unit shares the core with another unit."""
    shared = shared_cores(placement)
    return sum(len(shared.intersection(place.cores)) for place in placement.values())
