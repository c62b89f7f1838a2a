"""Chooses how much work a frame gets, so that it is in time.

Rule: measured times decide; less work is chosen at once, more work only later. A ladder has rungs: rung 0 is all the
work, and each further rung is less work at the price of a worse picture. Some stages take less time for less work (the
network); the others are taken to need the same time.

The time of a stage on a rung is the time that it took there alone, times its load. The time alone comes from
`set_alone`, or else is proportional to the work. The load is the ratio of the stage's time to its time alone. The
median over its last three jobs counts, so that one slow job decides nothing.

The use of a rung is the larger of two shares:
- the busiest unit's time for a frame, as a share of the period;
- the time of all stages, as a share of the deadline.

The wanted rung is the first whose use is at most `FULL`. Without such a rung, it is the first rung whose use exceeds
the least use by at most a twentieth, because less work would save nothing.

The ladder steps down at once. It takes one step up after `patience` frames in which the use of the rung above was at
most `ROOM`. If the ladder steps down again sooner than that, the patience doubles, up to `MOST_PATIENCE`.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from typing import Final

from trilane.scheduler.state import StageState

FULL: Final = 900  # thousandths of the period or the deadline
ROOM: Final = 750
PATIENCE: Final = 30  # frames
MOST_PATIENCE: Final = 960
SAMPLES: Final = 3
ALL: Final = 1000  # thousandths: all the work
LOAD_ONE: Final = 1 << 20  # a load of 1
TWENTIETH: Final = 20


class WorkLadder:
    """The ladder of a run.

    `rung`: rung of the frames that begin from now on.
    `patience`: number of frames until the next step up.
    """

    def __init__(
        self,
        stages: Sequence[StageState],
        works: Sequence[int],
        follow: Sequence[str],
        period_ns: int,
        deadline_ns: int,
    ) -> None:
        """Begin at rung 0.

        `stages`: stages of the chain.
        `works`: work of each rung in thousandths, ALL first, falling.
        `follow`: names of the stages whose time follows the work.
        `period_ns`: period of frames, more than 0.
        `deadline_ns`: longest time from a frame's release to its presentation; 0: none.
        """
        self.rung = 0
        self.patience = PATIENCE
        self.last = max([stage.position for stage in stages if stage.name in follow], default=-1)
        self._stages = stages
        self._period_ns, self._deadline_ns = period_ns, deadline_ns
        self._rungs = len(works)
        self._alone = [list(works) if stage.name in follow else [ALL] * len(works) for stage in stages]
        self._loads: list[deque[int]] = [deque(maxlen=SAMPLES) for _ in stages]
        self._waited = 0
        self._since_up = MOST_PATIENCE

    def set_alone(self, position: int, rung: int, service_ns: int) -> None:
        """Set the time that the stage at `position` takes on `rung` alone; to be called for all rungs or for none."""
        self._alone[position][rung] = max(service_ns, 1)

    def learn(self, position: int, rung: int, service_ns: int) -> None:
        """Note that the stage at `position` took `service_ns` for a frame that began on `rung`."""
        self._loads[position].append(service_ns * LOAD_ONE // self._alone[position][rung])

    def service_ns(self, position: int, rung: int) -> int:
        """Return the time that the stage at `position` would take now on `rung`; 0 before its first job."""
        loads = sorted(self._loads[position])
        return self._alone[position][rung] * loads[len(loads) // 2] // LOAD_ONE if loads else 0

    def use(self, rung: int) -> int:
        """Return the use of `rung` in thousandths."""
        of_units: dict[str, int] = {}
        for stage in self._stages:
            name = stage.unit.name
            of_units[name] = of_units.get(name, 0) + self.service_ns(stage.position, rung)
        busiest = max(of_units.values()) * ALL // self._period_ns
        if not self._deadline_ns:
            return busiest
        return max(busiest, sum(of_units.values()) * ALL // self._deadline_ns)

    def consider(self) -> bool:
        """Choose the rung, once for each frame that was measured, and return whether it changed."""
        uses = [self.use(rung) for rung in range(self._rungs)]
        wanted = _first_that_does(uses)
        self._since_up += 1
        if wanted > self.rung:
            failed = self._since_up <= self.patience
            self.patience = min(2 * self.patience, MOST_PATIENCE) if failed else PATIENCE
            self.rung, self._waited, self._since_up = wanted, 0, MOST_PATIENCE
            return True
        has_room = self.rung > 0 and uses[self.rung - 1] <= ROOM
        self._waited = self._waited + 1 if has_room else 0
        if self._waited < self.patience:
            return False
        self.rung, self._waited, self._since_up = self.rung - 1, 0, 0
        return True


def _first_that_does(uses: Sequence[int]) -> int:
    """Return the first rung whose use is at most `FULL`; without one, the first that is about as good as the best."""
    for rung, use in enumerate(uses):
        if use <= FULL:
            return rung
    enough = min(uses) + min(uses) // TWENTIETH
    return [use <= enough for use in uses].index(True)
