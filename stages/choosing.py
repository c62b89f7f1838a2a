"""Which of the placements that the model cannot tell apart a run gets. Rule: real frames decide, on a quiet machine.

While other programs use the cores, a unit that floats dodges them and one that does not waits: frame times then say
more of those programs than of the placements. So nothing is tried, and the prediction decides, which is of times
without that of others; it is said, and the next run looks again.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from statistics import median
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from trilane.hw_profiles.placement_facts import NS_PER_MS
from trilane.pipeline.other_programs import OtherPrograms
from trilane.pipeline.unit_starter import UnitStarter
from trilane.scheduler.placement import Ranked, fastest, typical
from trilane.stages.configure import Checked
from trilane.stages.rehearsing import tried

#: Rounds of trying placements; after TRY_S seconds no further one than LEAST_ROUNDS.
ROUNDS, LEAST_ROUNDS, TRY_S = 6, 3, 5.0
#: Share of the cores that other programs may have while placements are compared, and for how long that is looked at.
MOST_OTHERS, LOOK_S = 0.1, 0.25
PREDICTED = "the least predicted frame time"
TRYING = "trying {} placements with frames of the scene (once for this avatar, scene and machine) ..."

Arrays = Mapping[str, NDArray[Any]]


class Choice(NamedTuple):
    """`best`: place of the one to take. `why`: in words. `frame_ms`: of each that was tried, empty when none was."""

    best: int
    why: str
    frame_ms: tuple[float, ...] = ()


class _BusyError(Exception):
    """Other programs have so large a `share` of the cores that frame times cannot be compared."""

    def __init__(self, share: float) -> None:
        super().__init__()
        self.share = share


def choice(
    checked: Checked,
    cores: Sequence[int],
    candidates: Sequence[Ranked],
    starter: UnitStarter,
    say: Callable[[str], None] = lambda _: None,
    kept: Callable[[Callable[[], Arrays]], Arrays] = lambda make: make(),
) -> Choice:
    """Which of `candidates` has the shortest frames; where nothing is tried, the first.

    `checked`: what is to be run. `cores`: there are. `starter`: a fork server. `say`: is told before it takes seconds.
    `kept`: what its argument makes, or has made before. Raises TrilaneError when a unit cannot start or a stage fails,
    KeyboardInterrupt when interrupted.
    """
    if len(candidates) == 1:
        return Choice(0, PREDICTED)

    def measured() -> Arrays:
        others = OtherPrograms(cores)
        time.sleep(LOOK_S)
        _refuse_when_busy(others.share())
        say(TRYING.format(len(candidates)))
        rounds = tried(checked, [each.placement for each in candidates], ROUNDS, starter, TRY_S, LEAST_ROUNDS)
        _refuse_when_busy(median(each.others for each in rounds))
        return {"frame_ns": np.array([each.frame_ns for each in rounds])}

    try:
        frame_ns = typical(kept(measured)["frame_ns"].tolist())
    except _BusyError as busy:
        return Choice(0, f"{PREDICTED}; not tried while other programs have {busy.share:.0%} of the cores")
    frame_ms = tuple(value / NS_PER_MS for value in frame_ns)
    return Choice(fastest(frame_ns), f"the fastest of {len(candidates)} that were tried", frame_ms)


def _refuse_when_busy(share: float) -> None:
    if share > MOST_OTHERS:
        raise _BusyError(share)
