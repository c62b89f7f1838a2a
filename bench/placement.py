"""Is the placement that a run chooses the best one, and what does it gain over the rule for any run?

Rule: every placement is tried on this machine's processes, in turns; those that could be the best are then measured
against the chosen one in further rounds, which alone decide. Other numbers of cores are in virtual time, which is said.
"""

from __future__ import annotations

import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from statistics import median
from typing import Any

from trilane.avatars.network_reshape import reshaped
from trilane.bench.lib import full_width
from trilane.errors import BadInputError, TrilaneError
from trilane.hw_profiles.application import Plan, Variant, steady
from trilane.hw_profiles.host import host_cores, rule_placement, settings_of, usable_cores
from trilane.hw_profiles.load import HOST, load_profile
from trilane.hw_profiles.network_work import Network, count_work
from trilane.hw_profiles.performance_profiles import corners_of
from trilane.hw_profiles.placed_host import on_cores, place_units
from trilane.hw_profiles.placement_facts import NS_PER_MS, described
from trilane.pipeline.run_metrics import RunMetrics
from trilane.pipeline.unit_starter import UnitStarter
from trilane.scheduler.placement import Ranked, chosen, ranked
from trilane.scheduler.placement_model import Rules, frame_ns
from trilane.scheduler.places import Core, Placement
from trilane.scheduler.stats import median_interval
from trilane.stages.avatar_assets import network_of
from trilane.stages.avatar_pipeline import run_avatar
from trilane.stages.configure import Checked, Request, configure
from trilane.stages.factories import PRELOAD
from trilane.stages.placing import FIRST, measured_times, times_rows
from trilane.units import BURST

MIN_FRAMES = 20
ISOLATED = 2  # frames of each run of a finalist that are measured isolated
VIRTUAL_CORES = (1, 2, 3, 4, 8)
POLICY, EDGE = "pipelined", "double"


def measure(
    avatar: str = "default",
    size: tuple[str, ...] = ("256x256", "512x512"),
    cores: tuple[int, ...] = (0,),
    frames: int = 48,
    rounds: int = 6,
    finalists: int = 2,
    runtime: str = "auto",
) -> dict[str, Any]:
    """A row for each size, number of cores and placement; frame times are medians of the runs' means.

    Rows: `placement`; `predicted_ms`; `tried_ms`: of the one round in which all are tried; `frame_ms`: of the further
    `rounds`, null for placements that are not in them: in them are the chosen one, that of the rule for any run and the
    `finalists` that were fastest beside them; `is_chosen`, `is_rule`.

    `sizes`: a row for each size and number of cores. `chosen_over_best`: frame time of the chosen placement over that
    of the best other one in the further rounds, the median of the ratios within a round, with its 95 % interval `low`
    and `high` (with fewer than six rounds the least and largest); 1 and below: the chosen one is the best.
    `rule_over_chosen`: how many times faster than with the rule, `rule_low`, `rule_high`: its interval.
    `core_efficiency`, `rule_core_efficiency`: medians. `times`: what was measured first.

    `virtual`: the same for other numbers of cores, by the profile `host` in virtual time: `frame_ms` is computed by the
    scheduler, for every placement that virtual time knows.

    Raises BadInputError, MissingPartError, TrilaneError when a run fails.
    """
    counts = tuple(count or len(usable_cores()) for count in cores)
    _check(counts, frames, rounds, finalists)
    rows: list[dict[str, Any]] = []
    sizes: list[dict[str, Any]] = []
    virtual: list[dict[str, Any]] = []
    folder = str(full_width.full_width_bundle()) if avatar == full_width.NAME else avatar
    with UnitStarter(PRELOAD) as starter:
        for tensor in size:
            checked = configure(Request(size=tensor, avatar=folder, frames=frames, runtime=runtime), Path.cwd())
            for count in counts:
                tried = _Trial(checked, host_cores(usable_cores()[:count]), starter)
                tried.run(rounds, finalists)
                named = {"size": tensor, "cores": count}
                rows += [{**named, **row} for row in tried.rows()]
                sizes.append({**named, **tried.summary()})
            virtual += [{"size": tensor, **_virtual(checked, avatar, count)} for count in VIRTUAL_CORES]
    config = {"avatar": avatar, "frames": frames, "rounds": rounds, "finalists": finalists, "runtime": runtime}
    return {"rows": rows, "sizes": sizes, "virtual": virtual, "config": config}


def _check(counts: Sequence[int], frames: int, rounds: int, finalists: int) -> None:
    have = len(usable_cores())
    if not all(1 <= count <= have for count in counts):
        raise BadInputError("--cores", str(list(counts)), f"numbers from 1 to the {have} that this process may use")
    if frames < MIN_FRAMES or rounds < 1 or finalists < 1:
        found = f"--frames {frames}, --rounds {rounds}, --finalists {finalists}"
        raise BadInputError("bench placement", found, f"at least {MIN_FRAMES}, 1 and 1")


class _Trial:
    """All placements of one scene on some cores."""

    def __init__(self, checked: Checked, cores: Sequence[Core], starter: UnitStarter) -> None:
        self._checked, self._starter = checked, starter
        where = rule_placement(tuple(core.number for core in cores))
        self._times = measured_times(checked, cores, where, starter)
        rules = Rules(FIRST)
        self._found = ranked(cores, self._times, rules)
        self._rule = Ranked(where, frame_ns(where, cores, self._times, rules))
        self._chosen = chosen(self._found, self._rule)
        if self._rule.placement not in [each.placement for each in self._found]:
            self._found.append(self._rule)
        self._tried_ms: list[float] = []
        self._runs: dict[int, list[RunMetrics]] = {}

    def run(self, rounds: int, finalists: int) -> None:
        """One round of all, then `rounds` of those that could be the best."""
        self._tried_ms = [self._run(each.placement, 0).frame_time_ms.mean for each in self._found]
        always = [self._place(self._chosen), self._place(self._rule)]
        fastest = sorted(range(len(self._found)), key=self._tried_ms.__getitem__)
        others = [place for place in fastest if place not in always][:finalists]
        self._runs = {place: [] for place in dict.fromkeys([*always, *others])}
        for _ in range(rounds):
            for place, runs in self._runs.items():
                runs.append(self._run(self._found[place].placement, ISOLATED))

    def rows(self) -> list[dict[str, Any]]:
        """One of each placement, in the order of the predictions."""
        return [
            {
                "placement": described(each.placement),
                "predicted_ms": each.frame_ns / NS_PER_MS,
                "tried_ms": self._tried_ms[place],
                "frame_ms": median(self._frames_ms(place)) if place in self._runs else None,
                "is_chosen": place == self._place(self._chosen),
                "is_rule": place == self._place(self._rule),
            }
            for place, each in enumerate(self._found)
        ]

    def summary(self) -> dict[str, Any]:
        """The chosen placement beside the best of the others and beside the rule's."""
        place, by_rule = self._place(self._chosen), self._place(self._rule)
        mine = self._frames_ms(place)
        best = min(self._runs, key=lambda other: (median(self._frames_ms(other)), other != place))
        rivals = [other for other in self._runs if other != place] or [place]
        rival = min(rivals, key=lambda other: median(self._frames_ms(other)))
        ratios = [a / b for a, b in zip(mine, self._frames_ms(rival), strict=True)]
        gains = [b / a for a, b in zip(mine, self._frames_ms(by_rule), strict=True)]
        return {
            "chosen": described(self._chosen.placement),
            "best": described(self._found[best].placement),
            "rule": described(self._rule.placement),
            "chosen_over_best": median(ratios),
            **_interval("", ratios),
            "rule_over_chosen": median(gains),
            **_interval("rule_", gains),
            "core_efficiency": self._core_efficiency(place),
            "rule_core_efficiency": self._core_efficiency(by_rule),
            "times": times_rows(self._times),
        }

    def _frames_ms(self, place: int) -> list[float]:
        return [run.frame_time_ms.mean for run in self._runs[place]]

    def _core_efficiency(self, place: int) -> float:
        return median(run.core_efficiency or 0.0 for run in self._runs[place])

    def _place(self, one: Ranked) -> int:
        """Where a placement stands among those that were found."""
        return [each.placement for each in self._found].index(one.placement)

    def _run(self, placement: Placement, isolated: int) -> RunMetrics:
        with tempfile.TemporaryDirectory(prefix="trilane-bench-") as folder:
            placed = self._checked.changed(out_dir=Path(folder), units=settings_of(placement))
            result = run_avatar(
                placed.config,
                placed.assets,
                policy=POLICY,
                edge=EDGE,
                isolated_frames=isolated,
                starter=self._starter,
            )
        if result.interrupted:
            raise KeyboardInterrupt
        if result.failure is not None or result.presented < MIN_FRAMES:
            reason = result.failure.message if result.failure else f"{result.presented} frames were presented"
            raise TrilaneError(f"{described(placement)}: {reason}")
        return result.report


def _interval(prefix: str, values: Sequence[float]) -> dict[str, float]:
    low, high = median_interval(values)
    return {f"{prefix}low": low, f"{prefix}high": high}


def _virtual(checked: Checked, avatar: str, count: int) -> Mapping[str, Any]:
    """What virtual time says of the placements on `count` equal cores without siblings."""
    height, width = min(checked.config.buckets, key=lambda shape: (abs(shape[0] - shape[1]), shape))
    network = reshaped(network_of(checked.assets), height, width)
    _, _, _, channels = network.shape
    work = Network({"avatar": avatar}, height, width, channels, "packed", count_work(network.model))
    profile, plan = load_profile(HOST), Plan(work, "dsp", Variant(POLICY, EDGE))
    corners = corners_of(profile, BURST)
    placed = place_units(profile, plan, corners, [Core(number, number) for number in range(count)])

    def frame_ms(placement: Placement) -> float:
        return steady(on_cores(profile, placement), plan, corners).frame_ms

    frames = {described(each.placement): frame_ms(each.placement) for each in placed.found}
    best = min(frames, key=frames.__getitem__)
    mine = frame_ms(placed.best.placement)
    return {
        "cores": count,
        "clock": "virtual",
        "placements": len(frames),
        "chosen": described(placed.best.placement),
        "predicted_ms": placed.best.frame_ns / NS_PER_MS,
        "frame_ms": mine,
        "best": best,
        "chosen_over_best": mine / frames[best],
        "rule": described(placed.rule.placement),
        "rule_over_chosen": frame_ms(placed.rule.placement) / mine,
    }
