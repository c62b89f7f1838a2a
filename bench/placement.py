"""Is the placement that a run chooses the fastest, what does it gain over the rule's, and are predictions right?

Rule: first a placement is chosen as in a run. After that, all placements are tried in interleaved rounds, a few frames
each. The fastest placements run in further rounds, and the further rounds decide. Whole runs compare the chosen
placement with the placement by the rule for any run. For other numbers of cores, frame times are computed in virtual
time, and the results say so.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from math import sqrt
from pathlib import Path
from statistics import median
from typing import Any

from trilane.bench.lib import networks
from trilane.bench.pipeline import finished_run
from trilane.errors import BadInputError
from trilane.hw_profiles.application import Plan, Variant, steady
from trilane.hw_profiles.host import described, host_cores, rule_placement, settings_of, usable_cores
from trilane.hw_profiles.host_model import on_cores, place_units
from trilane.hw_profiles.profile_files import load_profile
from trilane.hw_profiles.schema import corners_of
from trilane.pipeline.rehearsal import Round
from trilane.pipeline.run_metrics import RunMetrics
from trilane.pipeline.unit_starter import UnitStarter
from trilane.scheduler.placement import CpuCore, Placement, Ranked, Rules, frame_ns, ranked, worth_trying
from trilane.scheduler.stats import median_interval
from trilane.stages import PRELOAD
from trilane.stages.avatar_assets import networks_of, painting
from trilane.stages.avatar_pipeline import measured_times, tried
from trilane.stages.configure import Checked, configure
from trilane.stages.placing import FIRST, choice, considered, times_rows
from trilane.stages.run_options import RunOptions
from trilane.units import BURST, HOST, NS_PER_MS

MIN_FRAMES = 20
VIRTUAL_CORES = (1, 2, 3, 4, 8)
POLICY, EDGE = "pipelined", "double"


def measure(
    avatar: str = "default",
    size: tuple[str, ...] = ("256x256", "512x512"),
    cores: tuple[int, ...] = (0,),
    frames: int = 96,
    rounds: int = 6,
    finalists: int = 3,
    further: int = 24,
    runs: int = 4,
    runtime: str = "auto",
) -> dict[str, Any]:
    """Measure the frame times of all placements, and compare the chosen placement with the others.

    `rows` has a row for each size, number of cores and placement:
    `predicted_ms`: predicted frame time.
    `tried_ms`: median frame time of `rounds` rounds with all placements; a placement runs 16 frames in a round, and the
    last 10 count.
    `frame_ms`: median frame time of the `further` rounds; null for a placement without further rounds. These rounds
    have the chosen placement, the rule's placement, and the `finalists` fastest of the others.
    `is_chosen`, `is_rule`: whether the placement is the chosen one, or the rule's.

    `sizes` has a row for each size and number of cores.
    `chosen`, `best`, `rule`: the chosen, the fastest and the rule's placement, in words.
    `how`: reason of the choice: the run's own trial, or the prediction.
    `chosen_over_best`: frame time of the chosen placement divided by the frame time of the best other placement. It is
    the median over the further rounds; up to 1, the chosen placement is the best.
    `low`, `high`: 95 % interval of `chosen_over_best`; with fewer than six rounds, its least and largest value.
    `rule_over_chosen`: frame time of the rule's placement divided by the frame time of the chosen placement.
    `rule_low`, `rule_high`: 95 % interval of `rule_over_chosen`.
    `rank_correlation`: Spearman's rank correlation of the predicted and the tried times of all placements.
    `predicted_over_tried`, `predicted_least`, `predicted_largest`: median, least and largest ratio of these times.
    `others`: share of the cores that other programs had in the further rounds; above a tenth, the row says little.
    `run_ms`, `efficiency`, `machine_efficiency`: medians of `runs` whole runs of `frames` frames with the chosen
    placement.
    `rule_run_ms`, `rule_machine_efficiency`: the same with the rule's placement.
    `took_s`: time of a run's rehearsal and trial.

    `times`: measured times of the rehearsal.
    `virtual`: frame times for other numbers of cores, which the scheduler computes in virtual time with the profile
    `host`.
    `config`: settings of the bench.

    Raises BadInputError for an option out of range, MissingPartError if a library is not installed, TrilaneError if a
    run fails.
    """
    counts = tuple(count or len(usable_cores()) for count in cores)
    _check(counts, frames, rounds, finalists, further, runs)
    rows: list[dict[str, Any]] = []
    sizes: list[dict[str, Any]] = []
    times: list[dict[str, Any]] = []
    virtual: list[dict[str, Any]] = []
    folder = str(networks.full_width_bundle()) if avatar == networks.FULL_WIDTH else avatar
    with UnitStarter(PRELOAD) as starter:
        for tensor in size:
            checked = configure(RunOptions(size=tensor, avatar=folder, frames=frames, runtime=runtime), Path.cwd())
            for count in counts:
                trial = _Trial(checked, host_cores(usable_cores()[:count]), starter)
                trial.run(rounds, finalists, further, runs)
                named = {"size": tensor, "cores": count}
                rows += [{**named, **row} for row in trial.rows()]
                sizes.append({**named, **trial.summary()})
                times += [{**named, **row} for row in trial.times()]
            virtual += [{"size": tensor, **_virtual(checked, avatar, count)} for count in VIRTUAL_CORES]
    config = {"avatar": avatar, "frames": frames, "rounds": rounds, "finalists": finalists}
    config |= {"further": further, "runs": runs, "runtime": runtime}
    return {"rows": rows, "sizes": sizes, "times": times, "virtual": virtual, "config": config}


def _check(counts: Sequence[int], frames: int, rounds: int, finalists: int, further: int, runs: int) -> None:
    have = len(usable_cores())
    if not all(1 <= count <= have for count in counts):
        raise BadInputError("--cores", str(list(counts)), f"numbers from 1 to the {have} that this process may use")
    if frames < MIN_FRAMES or min(rounds, finalists, further, runs) < 1:
        found = f"--frames {frames}, --rounds {rounds}, --finalists {finalists}, --further {further}, --runs {runs}"
        raise BadInputError("bench placement", found, f"at least {MIN_FRAMES}, and 1 of each other")


class _Trial:
    """Chooses a placement for a scene on given cores, as a run does, and tries all placements.

    The constructor chooses the placement. It raises TrilaneError if a unit cannot start or a stage fails.
    """

    def __init__(self, checked: Checked, cores: Sequence[CpuCore], starter: UnitStarter) -> None:
        self._checked, self._starter = checked, starter
        begin_s = time.monotonic()
        where = rule_placement(tuple(core.number for core in cores))
        self._times = measured_times(checked, cores, where, starter).times
        self._found = ranked(considered(cores, {}), self._times, Rules(FIRST))
        self._rule = Ranked(where, frame_ns(where, cores, self._times, Rules(FIRST)))
        candidates = worth_trying(self._found, self._rule)
        self._choice = choice(checked, [core.number for core in cores], candidates, starter)
        self._chosen = candidates[self._choice.best]
        self._took_s = time.monotonic() - begin_s
        known = [each.placement for each in self._found]
        if where not in known:
            self._found.append(self._rule)
            known.append(where)
        self._places = {"chosen": known.index(self._chosen.placement), "rule": known.index(where)}
        self._rounds: Sequence[Round] = ()
        self._further: dict[int, list[float]] = {}
        self._others = 0.0
        self._runs: dict[str, list[RunMetrics]] = {of: [] for of in self._places}

    def run(self, rounds: int, finalists: int, further: int, runs: int) -> None:
        """Do `rounds` rounds with all placements, `further` rounds with the best placements, and `runs` whole runs.

        `finalists`: number of placements in the further rounds, besides the chosen placement and the rule's.
        Raises TrilaneError if a run fails.
        """
        self._rounds = self._try(range(len(self._found)), rounds)
        tried_ms = self._tried_ms()
        always = list(dict.fromkeys(self._places.values()))
        others = [place for place in sorted(range(len(self._found)), key=tried_ms.__getitem__) if place not in always]
        finals = [*always, *others[:finalists]]
        found = self._try(finals, further)
        self._further = {place: [each.frame_ns[n] / NS_PER_MS for each in found] for n, place in enumerate(finals)}
        self._others = median(each.others for each in found)
        for _ in range(runs):
            for of, place in self._places.items():
                self._runs[of].append(self._run(self._found[place].placement))

    def rows(self) -> list[dict[str, Any]]:
        """Return a row of `measure` for each placement, the shortest predicted frame time first.

        If the predictions do not consider the rule's placement, its row is the last.
        """
        return [
            {
                "placement": described(each.placement),
                "predicted_ms": each.frame_ns / NS_PER_MS,
                "tried_ms": tried_ms,
                "frame_ms": median(self._further[place]) if place in self._further else None,
                "is_chosen": place == self._places["chosen"],
                "is_rule": place == self._places["rule"],
            }
            for place, (each, tried_ms) in enumerate(zip(self._found, self._tried_ms(), strict=True))
        ]

    def summary(self) -> dict[str, Any]:
        """Return the row of `sizes` in `measure` for this scene and these cores."""
        place = self._places["chosen"]
        mine = self._further[place]
        best = min(self._further, key=lambda other: (median(self._further[other]), other != place))
        rivals = [other for other in self._further if other != place] or [place]
        rival = min(rivals, key=lambda other: median(self._further[other]))
        ratios = [a / b for a, b in zip(mine, self._further[rival], strict=True)]
        gains = [b / a for a, b in zip(mine, self._further[self._places["rule"]], strict=True)]
        predicted_ms, tried_ms = [each.frame_ns / NS_PER_MS for each in self._found], self._tried_ms()
        off = [a / b for a, b in zip(predicted_ms, tried_ms, strict=True)]
        return {
            "chosen": described(self._chosen.placement),
            "how": self._choice.why,
            "best": described(self._found[best].placement),
            "rule": described(self._rule.placement),
            "chosen_over_best": median(ratios),
            **_interval("", ratios),
            "rule_over_chosen": median(gains),
            **_interval("rule_", gains),
            "rank_correlation": rank_correlation(predicted_ms, tried_ms),
            "predicted_over_tried": median(off),
            "predicted_least": min(off),
            "predicted_largest": max(off),
            "others": self._others,
            "run_ms": median(run.frame_time_ms.mean or 0.0 for run in self._runs["chosen"]),
            "rule_run_ms": median(run.frame_time_ms.mean or 0.0 for run in self._runs["rule"]),
            "machine_efficiency": median(run.machine_efficiency or 0.0 for run in self._runs["chosen"]),
            "efficiency": median(run.efficiency or 0.0 for run in self._runs["chosen"]),
            "rule_machine_efficiency": median(run.machine_efficiency or 0.0 for run in self._runs["rule"]),
            "took_s": self._took_s,
        }

    def times(self) -> list[dict[str, Any]]:
        """Return a row with the rehearsal's measured times for each unit and number of threads."""
        return times_rows(self._times)

    def _tried_ms(self) -> list[float]:
        """Return the median frame time of each placement in the rounds with all placements, ms."""
        return [median(each.frame_ns[place] for each in self._rounds) / NS_PER_MS for place in range(len(self._found))]

    def _try(self, places: Sequence[int], rounds: int) -> Sequence[Round]:
        return tried(self._checked, [self._found[place].placement for place in places], rounds, self._starter)

    def _run(self, placement: Placement) -> RunMetrics:
        placed, what = self._checked.changed(units=settings_of(placement)), described(placement)
        options = {"policy": POLICY, "edge": EDGE, "starter": self._starter}
        return finished_run(placed, what, MIN_FRAMES, **options).report


def _interval(prefix: str, values: Sequence[float]) -> dict[str, float]:
    low, high = median_interval(values)
    return {f"{prefix}low": low, f"{prefix}high": high}


def _virtual(checked: Checked, avatar: str, count: int) -> Mapping[str, Any]:
    """Return a row of `virtual` in `measure`: computed frame times on `count` equal physical cores."""
    shape = min(checked.config.buckets, key=lambda shape: (abs(shape[0] - shape[1]), shape))
    work = painting(networks_of(checked.assets), shape, {"avatar": avatar})
    profile, plan = load_profile(HOST), Plan(work, "dsp", Variant(POLICY, EDGE))
    corners = corners_of(profile, BURST)
    placed = place_units(profile, plan, corners, [CpuCore(number, number) for number in range(count)])

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


def rank_correlation(first: Sequence[float], second: Sequence[float]) -> float | None:
    """Return Spearman's rank correlation of two lists, from -1 to 1; None if a list only has equal values.

    Spearman, American Journal of Psychology 15 (1904), 72-101. Raises ValueError for lists of different lengths.
    """
    pairs = list(zip(_ranks(first), _ranks(second), strict=True))
    middle = (len(pairs) + 1) / 2
    covariance = sum((a - middle) * (b - middle) for a, b in pairs)
    spread = sum((a - middle) ** 2 for a, _ in pairs) * sum((b - middle) ** 2 for _, b in pairs)
    return covariance / sqrt(spread) if spread else None


def _ranks(values: Sequence[float]) -> list[float]:
    ordered = sorted(values)
    return [ordered.index(value) + (ordered.count(value) + 1) / 2 for value in values]
