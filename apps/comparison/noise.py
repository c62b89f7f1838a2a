"""What two runs of one kind differ by, beside what their frames show. Rule: each number has its source beside it.

Times on the host clock depend on what a process cannot see of itself: where its memory lies, how warm the caches are,
what other programs do on the cores, and other machines on what these cores share (Mytkowicz et al., "Producing wrong
data without doing anything obviously wrong!", ASPLOS 2009; Kalibera & Jones, "Rigorous benchmarking in reasonable
time", ISMM 2013). In virtual time there is no such thing, and a job that is held until its pace has passed is timed by
the clock alone.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from math import hypot
from typing import Any, Final, NamedTuple

from trilane.apps.comparison.configuration import changes

HOST: Final = "host"
#: Standard deviations between two runs of one kind on a quiet machine: of the logarithm of a stage's typical time on
#: its core, of that of other times, and of a share of the time. Assumed (docs/decisions/comparing-runs.md).
WORK, WALL, SHARE = 0.007, 0.02, 0.01
#: Of the logarithm of a held stage's time, assumed: a sleep may end a fraction of a millisecond late.
HELD = 0.002
#: The same for each share of the cores that other programs had, by pairs of runs: of times, and of shares of the time.
BESIDE_OTHERS, SHARE_BESIDE_OTHERS = 1.0, 0.5
#: Of a share of the time, for each share by which some cores were slower than others.
SHARE_OF_SPEED = 0.25
#: How many times as much a percentile differs as the mean: rare events make it.
TAILS: Final = {"p90": 1.5, "p99": 4.0}
#: Above this share a person is told.
BUSY_MACHINE = 0.05
#: Settings that leave the speed of a core as it is.
SAME_CORES: Final = ("policy", "edge", "made.", "config.pace_ns", "config.scene", "idle_cores")


class Noise(NamedTuple):
    """Standard deviations between two runs of one kind.

    `work`: of the logarithm of a stage's typical time on its core. `wall`: of that of other times. `share`: of shares
    of the time. `held`: stages whose jobs last as long as they were told to, in both runs.
    """

    work: Mapping[str, float]
    wall: float
    share: float
    held: frozenset[str] = frozenset()


def noise_between(base: Mapping[str, Any], other: Mapping[str, Any], effects: Mapping[str, float]) -> Noise:
    """Of two reports, as JSON. `effects`: logarithm of the ratio of each stage's typical times on its core."""
    if HOST not in (base["clock"], other["clock"]):
        return Noise(dict.fromkeys(effects, 0.0), 0.0, 0.0)
    others = max(each.get("other_programs") or 0.0 for each in (base, other))
    held = frozenset(_held(base) & _held(other))
    slower = _slower_cores(base, other, {stage: ratio for stage, ratio in effects.items() if stage not in held})
    most = max(slower.values(), default=0.0)
    return Noise(
        {stage: hypot(WORK, BESIDE_OTHERS * others, slower.get(stage, 0.0)) for stage in effects},
        hypot(WALL, BESIDE_OTHERS * others, most),
        hypot(SHARE, SHARE_BESIDE_OTHERS * others, SHARE_OF_SPEED * most),
        held,
    )


def _held(report: Mapping[str, Any]) -> set[str]:
    return {stage for stage, ns in report["config"].get("pace_ns", {}).items() if ns}


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
            said.append(
                f"{name}: other programs had {100 * others:.0f} % of its cores, so runs of one kind may differ "
                f"by {200 * BESIDE_OTHERS * others:.0f} %; a quiet machine, or several runs of each kind, tell more"
            )
    return said
