"""How much work a frame is given, so that it is in time. Rule: measured times decide; less work at once, more late.

A ladder has rungs: 0 is all the work, each further one is less of it, at the price of a worse picture. Some stages take
less time for less work (the network), the others are taken to need the same. What a stage takes on a rung is what it
took there alone (`set_alone`; where that is not known, in proportion to the work), times its load: how many times as
long its last jobs took as alone, in the median of three, so that one slow job decides nothing.

The use of a rung is the largest of: each unit's time for a frame as a share of the period, and the time of all stages
as a share of the deadline. The rung is the first whose use is at most `FULL`; where there is none, the first that no
other betters by more than a twentieth, so that no work is left out that saves nothing. It is stepped down to at once.
One rung up is taken after as many frames as `patience` in which the use of that rung was at most `ROOM`; a step up that
did not last as long doubles the patience, up to `MOST_PATIENCE`.
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
    """`rung`: of the frames that begin from now on. `patience`: frames until the next step up."""

    def __init__(
        self,
        stages: Sequence[StageState],
        works: Sequence[int],
        follow: Sequence[str],
        period_ns: int,
        deadline_ns: int,
    ) -> None:
        """The one of a run, at rung 0.

        `stages`: the chain.
        `works`: of each rung in thousandths, ALL first, falling.
        `follow`: names of the stages whose time follows the work.
        `period_ns`: of frames, more than 0. `deadline_ns`: from a frame's release until it is presented; 0: none.
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
        """What the stage at `position` takes on `rung`, alone. To be said of all rungs, or of none."""
        self._alone[position][rung] = max(service_ns, 1)

    def learn(self, position: int, rung: int, service_ns: int) -> None:
        """The stage at `position` took so long for a frame that began on `rung`."""
        self._loads[position].append(service_ns * LOAD_ONE // self._alone[position][rung])

    def service_ns(self, position: int, rung: int) -> int:
        """What the stage at `position` would take now on `rung`; 0 before its first job."""
        loads = sorted(self._loads[position])
        return self._alone[position][rung] * loads[len(loads) // 2] // LOAD_ONE if loads else 0

    def use(self, rung: int) -> int:
        """The use of `rung`, in thousandths."""
        of_units: dict[str, int] = {}
        for stage in self._stages:
            name = stage.unit.name
            of_units[name] = of_units.get(name, 0) + self.service_ns(stage.position, rung)
        busiest = max(of_units.values()) * ALL // self._period_ns
        if not self._deadline_ns:
            return busiest
        return max(busiest, sum(of_units.values()) * ALL // self._deadline_ns)

    def consider(self) -> bool:
        """Choose the rung, once for each frame that was measured; whether it is another now."""
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
    """The rung with the most work whose use is at most `FULL`; without one, the first about as good as the best."""
    for rung, use in enumerate(uses):
        if use <= FULL:
            return rung
    enough = min(uses) + min(uses) // TWENTIETH
    return [use <= enough for use in uses].index(True)
