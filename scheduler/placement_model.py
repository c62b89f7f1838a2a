"""The frame time of a placement, predicted from what its units need. Rule: one formula; nothing is tried.

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

A floating unit of which one core is nobody else's *stays* there: the kernel moves a thread only when it has to wait.

Every job of a unit on a shared core costs a change of threads more; a floating unit that does not stay is moved once a
frame. What the scheduler takes of its cores counts like work that nothing waits for.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from itertools import combinations
from math import prod
from typing import Final, NamedTuple

from trilane.scheduler.places import FULL, Core, Place, Placement, Times, Work, has_own_cores, share_ns, shared_cores

#: Assumed: what two threads on the siblings of a physical core do together, over what one alone does.
SIBLINGS: Final = 1.25
#: Assumed: a change of threads, with the first-level cache; a move, with a second-level one of 2 MiB at 8 GB/s. A
#: simulated fair scheduler moved units that float 0.5 to 1.2 times a frame (docs/decisions/placement.md).
CHANGE_NS: Final = 30_000
MOVE_NS: Final = 250_000
#: Assumed, of what several cores can do for units that float: the kernel moves a waiting thread to a core that has just
#: become idle, a running one hardly ever; so a core may idle while a unit that has no other one waits.
ROOM_USED: Final = 0.9
#: What the scheduler takes for a job: measured as CPU time of its process (docs/decisions/placement.md).
SCHEDULER_NS: Final = 100_000
LEAST_FREE: Final = 1e-9  # of a core's time: none


class Rules(NamedTuple):
    """What else decides. `sequential`: one stage at a time. `first`: the unit on whose cores the scheduler runs."""

    first: str
    sequential: bool = False


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


def _settled(placement: Placement) -> Placement:
    """`placement` with each floating unit that has one core to itself on that one alone; it leaves the others free."""
    shared = shared_cores(placement)
    settled = dict(placement)
    for unit, place in placement.items():
        own = [core for core in place.cores if core not in shared]
        if len(own) == 1 and place.threads < len(place.cores):
            settled[unit] = Place((own[0],), 1)
    return settled if settled == placement else _settled(settled)


class _Model:
    """One placement."""

    def __init__(self, placement: Placement, cores: Sequence[Core], times: Times, rules: Rules) -> None:
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
        return share_ns(load.cores, load.core_ns if len(these) == 1 else load.work_ns, load.floats, these)

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
