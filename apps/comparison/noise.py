"""What two runs of one kind differ by, beside what their frames show. Rule: each number has its source beside it.

Times on the host clock depend on what a process cannot see of itself: where its memory lies, how warm the caches are,
what other programs do on the cores, and other machines on what these cores share (Mytkowicz et al., "Producing wrong
data without doing anything obviously wrong!", ASPLOS 2009; Kalibera & Jones, "Rigorous benchmarking in reasonable
time", ISMM 2013). In virtual time there is no such thing, and a job that is held until its pace has passed is timed by
the clock alone. Instructions that a processor counted are the program's, whatever the machine does.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from math import log1p
from statistics import fmean
from typing import Any, Final, NamedTuple

from trilane.apps.comparison.configuration import changes
from trilane.apps.comparison.difference import Chance

HOST: Final = "host"
#: Standard deviations of one run's figure, of its logarithm or of a share of the time, and how many runs these numbers
#: are worth (docs/decisions/comparing-runs.md has the measurements). Of a stage's typical time on its core, of other
#: times on the clock, of shares, and of counted instructions.
WORK, WALL, SHARE, COUNTED = 0.042, 0.03, 0.015, 0.001
FREEDOM = 5
#: Of the logarithm of a held stage's time, assumed: a sleep may end a fraction of a millisecond late.
HELD = 0.002
#: What other programs that had more of the cores explain: of a stage's time on its core, and of a share of the time,
#: for each share of the cores.
WORK_BESIDE_OTHERS, SHARE_BESIDE_OTHERS = 0.3, 0.5
#: The share of the cores that is left to a run at the least.
LEAST_LEFT = 0.01
#: How many times as much a percentile differs as the mean: rare events make it.
TAILS: Final = {"p90": 1.5, "p99": 4.0}
WAIT_FLOOR_MS: Final = 0.05  # of a wait: a message takes so long more or less
#: Above this share a person is told.
BUSY_MACHINE = 0.05
#: Settings that leave the speed of a core as it is.
SAME_CORES: Final = ("policy", "edge", "made.", "config.pace_ns", "config.scene", "idle_cores")

Documents = Sequence[Mapping[str, Any]]


class Noise(NamedTuple):
    """What makes runs of one kind differ. `others`: how much more of the cores other programs had, as what they explain

    of times on the clock, of a stage's time on its core, and of shares of the time. `slower`: of each stage, what its
    cores' own speed explains. `held`: stages whose jobs last as long as they were told to, in all runs.
    """

    is_real: bool
    others: tuple[float, float, float] = (0.0, 0.0, 0.0)
    slower: Mapping[str, float] = {}
    held: frozenset[str] = frozenset()

    def of_time(self, statistic: str = "mean") -> Chance:
        """Of times on the clock. That they differ is said whatever the cores' speed did, which stages alone show."""
        return self._chance(TAILS.get(statistic, 1.0) * WALL, explained=self.others[0])

    def of_wait(self, statistic: str) -> Chance:
        """Of a wait in ms, which may be next to nothing; of what it may have grown by nothing is known."""
        return self._chance(TAILS.get(statistic, 1.0) * (WALL + self.others[0]), WAIT_FLOOR_MS)

    def of_share(self) -> Chance:
        """Of shares of the time."""
        return self._chance(0.0, SHARE, explained=self.others[2])

    def of_work(self, stage: str, statistic: str) -> Chance:
        """Of a stage's time on its core."""
        tail = TAILS.get(statistic, 1.0)
        if stage in self.held:
            return self._chance(tail * HELD)
        return self._chance(tail * WORK, explained=max(self.others[1], self.slower.get(stage, 0.0)))

    def of_count(self) -> Chance:
        """Of counted instructions."""
        return self._chance(COUNTED)

    def _chance(self, relative: float, absolute: float = 0.0, explained: float = 0.0) -> Chance:
        return Chance(relative, absolute, FREEDOM, explained) if self.is_real else Chance()


def noise_between(base: Documents, other: Documents, effects: Mapping[str, float]) -> Noise:
    """Of the runs of two sides, by their reports as JSON.

    `effects`: logarithm of the ratio of each stage's typical times on its core.
    """
    runs = [*base, *other]
    if all(run["clock"] != HOST for run in runs):
        return Noise(is_real=False)
    first, second = ([run.get("other_programs") or 0.0 for run in side] for side in (base, other))
    more = abs(fmean(second) - fmean(first))
    wall = abs(fmean(map(_left, second)) - fmean(map(_left, first)))
    held = frozenset.intersection(*map(_held, runs))
    free = {stage: ratio for stage, ratio in effects.items() if stage not in held}
    slower = _slower_cores(base[0], other[0], free)
    return Noise(True, (wall, WORK_BESIDE_OTHERS * more, SHARE_BESIDE_OTHERS * more), slower, held)


def _left(others: float) -> float:
    """Logarithm of the share of the cores that other programs left: frames take so much longer where cores are full."""
    return log1p(-min(others, 1 - LEAST_LEFT))


def _held(report: Mapping[str, Any]) -> frozenset[str]:
    return frozenset(stage for stage, ns in report["config"].get("pace_ns", {}).items() if ns)


def _slower_cores(base: Mapping[str, Any], other: Mapping[str, Any], effects: Mapping[str, float]) -> dict[str, float]:
    """Of each stage, by which logarithm every stage on its unit's cores has changed, at the least, in one direction.

    On one machine with one placement that is the cores' own speed: another machine beside this one, its clock, its
    temperature. A single stage on its cores says nothing of them.
    """
    if any(not change.key.startswith(SAME_CORES) for change in changes(base, other)):
        return {}
    found = {}
    for stages in _stages_by_cores(base):
        ratios = [effects[stage] for stage in stages if stage in effects]
        alike = len(ratios) > 1 and (min(ratios) > 0 or max(ratios) < 0)
        found.update(dict.fromkeys(stages, min(map(abs, ratios)) if alike else 0.0))
    return found


def _stages_by_cores(report: Mapping[str, Any]) -> Iterable[list[str]]:
    found: dict[tuple[int, ...], list[str]] = {}
    for stage, row in report["stages"].items():
        found.setdefault(tuple(report["units"][row["unit"]].get("cores", ())), []).append(stage)
    return found.values()


def remarks(reports: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """What a person should know of the machine, of reports by the names of their runs."""
    said = []
    for name, report in reports.items():
        others = report.get("other_programs")
        if report["clock"] == HOST and others is None:
            said.append(f"{name}: what other programs had of its cores is not known; they are taken to have had none")
        elif others is not None and others > BUSY_MACHINE:
            longer = 1 / max(1 - others, LEAST_LEFT) - 1
            said.append(
                f"{name}: other programs had {100 * others:.0f} % of its cores, by which frames may take up to "
                f"{100 * longer:.0f} % longer; only what the other run did not have of that counts"
            )
    return said
