"""The figures of two sides as rows, each with its random variation.

Rule: `MEASURES` names the statistics of each measure. If all runs have a journal, the differences come from the frames.
Otherwise, they come from the summaries in reports and predictions. Means, medians and shares then get the uncertainty
of the mean frame time, because no other uncertainty is known.

`Noise` says how much more a figure differs between runs of one kind than their frames show. "Runs of one kind" are runs
of the same configuration.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from math import inf, log, log1p
from statistics import fmean
from typing import Any, Final, NamedTuple

import numpy as np

from trilane.apps.compare.difference import (
    COMPARED,
    MATTERS,
    Chance,
    Difference,
    difference,
    judged,
    settled,
    unsure,
)
from trilane.apps.compare.overview import number_of
from trilane.apps.compare.run_frames import CPU, INSTRUCTION_TIME, INSTRUCTIONS, Key
from trilane.apps.compare.sides import ComparedFigures, ComparedRun, RunKind, Side, Statistics, changes
from trilane.apps.run.verdict import MOST_OTHERS
from trilane.hw_profiles.schema import SIGMAS
from trilane.scheduler.stats import student_quantile
from trilane.units import HOST_CLOCK

FRAME_TIME, LATENCY, WORK, SERVICE, WAIT, BUSY, IDLE = (
    "frame time", "latency", "work", "service", "wait", "busy", "idle",
)  # fmt: skip
LOST, DROPPED, ERROR, CHECKED = "lost", "dropped", "error", "check"
MS, NS, SHARE, BYTES = "ms", "ns", "share", "bytes"
#: Measure -> its statistics, for runs with a journal.
MEASURES: Final = {
    FRAME_TIME: ("mean", *COMPARED),
    LATENCY: ("mean", *COMPARED),
    INSTRUCTIONS: ("mean",),
    INSTRUCTION_TIME: ("typical",),
    CPU: ("mean", "typical"),
    WORK: ("typical", "p90", "p99"),
    SERVICE: ("mean", "typical"),
    WAIT: ("mean", "p90"),
    BUSY: ("share",),
    IDLE: ("share",),
}
UNITS: Final = {
    **dict.fromkeys((FRAME_TIME, LATENCY, CPU, WORK, SERVICE, WAIT), MS),
    **dict.fromkeys((BUSY, IDLE), SHARE),
    INSTRUCTIONS: "",
    INSTRUCTION_TIME: NS,
}
#: Statistics of a summary that are about as uncertain as a mean.
LIKE_THE_MEAN: Final = ("mean", "p50")
#: Standard deviations between runs of one kind (docs/decisions/comparing-runs.md): for the logarithm of a stage's
#: typical time on its core, the logarithm of other times, a share, and the logarithm of counted instructions.
WORK_DEVIATION, WALL_DEVIATION, SHARE_DEVIATION, COUNT_DEVIATION = 0.042, 0.03, 0.015, 0.001
#: These deviations count as if they were the scatter of so many further runs.
FREEDOM = 5
#: Standard deviation of the logarithm of a held stage's time, assumed: a sleep may end a little late.
HELD_DEVIATION = 0.002
#: Change that other programs explain if they had all cores on one side and none on the other: of the logarithm of a
#: stage's time on its core, and of a share of the time. Smaller differences explain proportionally less.
WORK_BESIDE_OTHERS, SHARE_BESIDE_OTHERS = 0.3, 0.5
#: A run is taken to have had at least this share of the cores.
LEAST_LEFT = 0.01
#: Deviation of a percentile, as a multiple of the deviation of the mean: rare events decide a percentile.
TAILS: Final = {"p90": 1.5, "p99": 4.0}
WAIT_FLOOR_MS: Final = 0.05  # least deviation of a wait: the time of a message varies by so much
#: Settings that do not change the speed of a core.
SAME_CORES: Final = ("policy", "edge", "made.", "config.pace_ns", "config.scene", "idle_cores")
#: Prefix of the settings' keys that give a stage's jobs a set length.
PACE: Final = "config.pace_ns."
Runs = Sequence[ComparedRun]


class Figure(NamedTuple):
    """The subject of one row of a comparison.

    `measure`: what is measured.
    `of`: stage, unit, avatar with the key of its accuracy, or cause of lost or dropped frames; "" for the whole run.
    `cause`: cause of idle time, "" for other measures.
    `statistic`: as in `MEASURES`; for `check`, the key in the report; "" for an accuracy.
    `unit`: unit of the value, such as ms or share.
    """

    measure: str
    of: str
    cause: str
    statistic: str
    unit: str


Rows = dict[Figure, Difference]


def rows_of(base: Side, other: Side) -> Rows:
    """Return the difference of every figure that all runs of the sides `base` and `other` have."""
    noise = _noise(base, other)
    is_known = all(told.frames is not None for told in (*base.runs, *other.runs))
    rows = dict(_of_frames(base, other, noise) if is_known else _of_summaries(base, other, noise))
    rows.update(_of_counts(base, other, noise))
    rows.update(_of_errors(base, other))
    return rows


def named(rows: Rows) -> list[Figure]:
    """Return the figures that decide a verdict, without the figures that only explain it.

    For a stage, the number of instructions and the time of one instruction decide. If instructions are not counted, the
    stage's typical time on its core decides. If this time is unknown too, the mean service time decides.
    """
    counted, worked = ({figure.of for figure in rows if figure.measure == each} for each in (INSTRUCTION_TIME, WORK))

    def is_named(figure: Figure) -> bool:
        if figure.measure in (FRAME_TIME, LATENCY):
            return figure.statistic == "mean"
        if figure.measure == WORK:
            return figure.statistic == "typical" and figure.of not in counted
        if figure.measure == SERVICE:
            return figure.statistic == "mean" and figure.of not in worked
        return figure.measure not in (CPU, WAIT, BUSY, IDLE)

    return [figure for figure in rows if is_named(figure)]


def margin_of(figure: Figure, row: Difference) -> float:
    """Return the least change that matters for `figure`, in the unit of `row.change`."""
    if row.is_ratio or figure.unit == SHARE:
        return MATTERS
    return max(MATTERS * max(abs(row.base), abs(row.other)), WAIT_FLOOR_MS if figure.unit == MS else 0.0)


def _noise(base: Side, other: Side) -> Noise:
    effects = {}
    for key in _shared(base, other):
        if key.measure == WORK:
            change = _difference(base, other, key, "typical", Chance())
            if change.is_ratio:
                effects[key.of] = change.effect
    return noise_between(base.runs, other.runs, effects)


def _shared(base: Side, other: Side) -> list[Key]:
    """Return the keys of the series that all runs of both sides have; empty if a run has no frames."""
    first, *rest = [told.frames.series if told.frames else {} for side in (base, other) for told in side.runs]
    return [key for key in first if all(key in each for each in rest)]


def _difference(base: Side, other: Side, key: Key, statistic: str, chance: Chance) -> Difference:
    first, second = ([told.frames.series[key] for told in side.runs if told.frames] for side in (base, other))
    is_ratio = statistic != SHARE and key.measure != WAIT
    return difference(first, second, statistic, is_ratio=is_ratio, chance=chance)


def _of_frames(base: Side, other: Side, noise: Noise) -> Iterator[tuple[Figure, Difference]]:
    for key in _shared(base, other):
        if key.measure in (INSTRUCTION_TIME, CPU) and key.of in noise.held:
            continue  # a held stage waits until its time is over, so the time says nothing about its program
        for statistic in MEASURES.get(key.measure, ("mean",)):
            change = _difference(base, other, key, statistic, _chance(key.measure, key.of, statistic, noise))
            yield Figure(*key, statistic, UNITS.get(key.measure, BYTES)), change


def _chance(measure: str, of: str, statistic: str, noise: Noise) -> Chance:
    if measure in (BUSY, IDLE):
        return noise.of_share()
    if measure == WAIT:
        return noise.of_wait(statistic)
    if measure in (CPU, WORK, INSTRUCTION_TIME) or (measure == SERVICE and of in noise.held):
        return noise.of_work(of, statistic)
    if measure == INSTRUCTIONS:
        return noise.of_count()
    return noise.of_time(statistic) if measure in MEASURES else Chance()


def _of_summaries(base: Side, other: Side, noise: Noise) -> Iterator[tuple[Figure, Difference]]:
    """Yield each figure that the summaries of all runs have, with its difference.

    Means, medians and shares scatter within a run like the mean frame time. If the scatter of the mean frame time is
    unknown, their uncertainty is unknown too. The uncertainty of all other statistics is always unknown.
    `base`, `other`: runs of each side.
    `noise`: noise between the runs of the two sides.
    """
    sides = [[_summaries(told.figures) for told in side.runs] for side in (base, other)]
    within = _relative_variance(base, other)
    for figure in sides[0][0]:
        if any(figure not in run for side in sides for run in side):
            continue
        values = [[run[figure] for run in side] for side in sides]
        is_ratio = figure.unit == MS and figure.measure != WAIT
        if within is None or figure.statistic not in (*LIKE_THE_MEAN, SHARE):
            yield figure, unsure(fmean(values[0]), fmean(values[1]), is_ratio=is_ratio)
            continue
        is_ratio = is_ratio and min(map(min, values)) > 0
        effects = [np.array([log(value) if is_ratio else value for value in side]) for side in values]
        scale = 1.0 if is_ratio or figure.unit == SHARE else max(map(max, values))
        chance = _chance(figure.measure, figure.of, figure.statistic, noise)
        yield figure, settled(values, effects, within * scale**2, chance, is_ratio=is_ratio)


def _relative_variance(base: Side, other: Side) -> float | None:
    """Return the variance of the logarithm of the ratio of the two sides' mean frame times, due to scatter within runs.

    The variance comes from the intervals in the documents or, for imported times, from the standard errors. It is 0 for
    predictions of one chip, because they share the model's error. A run in virtual time without an interval adds 0. The
    result is None if any other document has no interval or standard error.
    """
    runs = [*base.runs, *other.runs]
    if all(told.kind == RunKind.PREDICTION and told.figures.machine == runs[0].figures.machine for told in runs):
        return 0.0
    found = [[_deviation_of(told) for told in side.runs] for side in (base, other)]
    if any(value is None for side in found for value in side):
        return None
    return sum((value or 0.0) ** 2 / len(side) ** 2 for side in found for value in side)


def _deviation_of(told: ComparedRun) -> float | None:
    if told.kind is RunKind.TIMES:
        return told.figures.deviation
    times = told.figures.frame_time_ms
    is_computed = told.kind is RunKind.PREDICTION
    names, quantile = (("low", "high"), SIGMAS) if is_computed else (("mean_low", "mean_high"), student_quantile(inf))
    low, high = map(times.get, names)
    if low is None or high is None or not (mean := times.get("mean")):
        return 0.0 if told.figures.clock == "virtual" else None
    return (high - low) / (2 * quantile * mean)


def _summaries(figures: ComparedFigures) -> dict[Figure, float]:
    found: dict[Figure, float] = {}
    for measure, times in ((FRAME_TIME, figures.frame_time_ms), (LATENCY, figures.latency_ms)):
        found.update(_statistics(measure, "", times, MEASURES[measure]))
    for name, stage in figures.stages.items():
        found.update(_statistics(CPU, name, stage.cpu_ms or {}, ("mean",)))
        found.update(_statistics(SERVICE, name, stage.service_ms, MEASURES[SERVICE]))
        found.update(_statistics(WAIT, name, stage.wait_ms, MEASURES[WAIT]))
    for name, unit in figures.units.items():
        found[Figure(BUSY, name, "", SHARE, SHARE)] = unit.busy
        for cause, share in unit.idle.items():
            if share is not None:
                found[Figure(IDLE, name, cause, SHARE, SHARE)] = share
    return found


def _statistics(measure: str, of: str, times: Statistics, names: Sequence[str]) -> dict[Figure, float]:
    return {Figure(measure, of, "", name, MS): ms for name in names if (ms := times.get(name)) is not None}


def _of_counts(base: Side, other: Side, noise: Noise) -> Iterator[tuple[Figure, Difference]]:
    """Yield the lost and dropped frames by cause, as shares of the requested frames, with their differences.

    Nothing is yielded if a document has no counts of frames.
    `base`, `other`: runs of each side.
    `noise`: noise between the runs of the two sides.
    """
    sides = [[told.figures.frames for told in side.runs if told.figures.frames] for side in (base, other)]
    if sum(map(len, sides)) < len(base.runs) + len(other.runs):
        return
    for measure, causes in ((LOST, "lost_by_cause"), (DROPPED, DROPPED)):
        by_cause = [[getattr(frames, causes) for frames in side] for side in sides]
        for cause in dict.fromkeys(cause for side in by_cause for found in side for cause in found):
            counts = [[found.get(cause, 0) for found in side] for side in by_cause]
            asked = [[frames.requested or 1 for frames in side] for side in sides]
            values = [np.divide(*both) for both in zip(counts, asked, strict=True)]
            pooled = sum(map(sum, counts)) / sum(map(sum, asked))
            within = pooled * max(1 - pooled, 0.0) * sum(1 / sum(each) for each in asked)
            row = settled([side.tolist() for side in values], values, within, noise.of_share(), is_ratio=False)
            yield Figure(measure, cause, "", SHARE, SHARE), row


def _of_errors(base: Side, other: Side) -> Iterator[tuple[Figure, Difference]]:
    """Yield the figures of the avatars' accuracy in the first run of each side, with their differences.

    The accuracy was measured once and does not scatter, so every change counts.
    """
    first, second = (dict(_numbers("", side.runs[0].figures.accuracy)) for side in (base, other))
    for name, value in first.items():
        if name in second:
            unit = "dB" if "psnr" in name else ""
            yield Figure(ERROR, name, "", "", unit), judged(value, second[name], 0.0, is_ratio=False)


def check_rows(base: Side, other: Side) -> Rows:
    """Return the differences of the float values under `check` of the reports, without scatter within a run.

    The result is empty if a report lacks the key, or if integers, lists or texts under the key differ, such as the
    checked frames.
    `base`, `other`: runs of each side.
    """
    sides = [[told.figures.check or {} for told in side.runs] for side in (base, other)]
    every = [found for side in sides for found in side]
    about = (str, list, tuple, int)
    alike = {str(sorted((name, value) for name, value in each.items() if isinstance(value, about))) for each in every}
    if not all(every) or len(alike) > 1:
        return {}
    rows = {}
    for name in (name for name, value in every[0].items() if isinstance(value, float)):
        values = [[found[name] for found in side] for side in sides if all(name in found for found in side)]
        if len(values) < 2:
            continue
        if len(every) == 2:
            row = judged(values[0][0], values[1][0], 0.0, is_ratio=False)
        else:
            row = settled(values, [np.array(side) for side in values], 0.0, Chance(freedom=0), is_ratio=False)
        rows[Figure(CHECKED, "", "", name, "dB")] = row
    return rows


def _numbers(name: str, value: Any) -> Iterator[tuple[str, float]]:
    if isinstance(value, Mapping):
        for key, inner in value.items():
            if key not in ("by_seed", "worst", "samples"):
                yield from _numbers(f"{name} {key}".strip(), inner)
    elif (number := number_of(value)) is not None:
        yield name, number


class Noise(NamedTuple):
    """The noise: how much runs of one kind differ in addition to what their frames show.

    Times on the host clock depend on facts that a process cannot see [1, 2]. Examples are the place of its memory, the
    state of caches, other programs on its cores, and other machines on the same hardware. In virtual time, this noise
    does not exist. The length of a held job depends only on the clock. Counted instructions hardly depend on the
    machine.

    [1] Mytkowicz et al., "Producing wrong data without doing anything obviously wrong!", ASPLOS 2009.
    [2] Kalibera and Jones, "Rigorous benchmarking in reasonable time", ISMM 2013.

    `is_real`: whether a run was on the host clock.
    `others`: changes that different shares of other programs explain: of times on the clock, of a stage's time on its
    core, of shares of time. The first two are logarithms.
    `slower`: change that the speed of a stage's cores explains, by stage, as a logarithm.
    `held`: stages whose jobs have a set length in all runs.
    """

    is_real: bool
    others: tuple[float, float, float] = (0.0, 0.0, 0.0)
    slower: Mapping[str, float] = {}
    held: frozenset[str] = frozenset()

    def of_time(self, statistic: str = "mean") -> Chance:
        """Return the `Chance` of times on the clock. `statistic`: as in `MEASURES`.

        The speed of the cores explains no change here, because it is known only for stages.
        """
        return self._chance(TAILS.get(statistic, 1.0) * WALL_DEVIATION, explained=self.others[0])

    def of_wait(self, statistic: str) -> Chance:
        """Return the `Chance` of a wait in ms. The wait may be almost 0. No known cause explains a change of the wait.

        `statistic`: as in `MEASURES`.
        """
        return self._chance(TAILS.get(statistic, 1.0) * (WALL_DEVIATION + self.others[0]), WAIT_FLOOR_MS)

    def of_share(self) -> Chance:
        """Return the `Chance` of a share of the time, such as a busy share."""
        return self._chance(0.0, SHARE_DEVIATION, explained=self.others[2])

    def of_work(self, stage: str, statistic: str) -> Chance:
        """Return the `Chance` of a stage's time on its core.

        `stage`: name of the stage.
        `statistic`: as in `MEASURES`.
        """
        tail = TAILS.get(statistic, 1.0)
        if stage in self.held:
            return self._chance(tail * HELD_DEVIATION)
        return self._chance(tail * WORK_DEVIATION, explained=max(self.others[1], self.slower.get(stage, 0.0)))

    def of_count(self) -> Chance:
        """Return the `Chance` of a stage's number of instructions. No known cause explains a change of it."""
        return self._chance(COUNT_DEVIATION)

    def _chance(self, relative: float, absolute: float = 0.0, explained: float = 0.0) -> Chance:
        return Chance(relative, absolute, FREEDOM, explained) if self.is_real else Chance()


def noise_between(base: Runs, other: Runs, effects: Mapping[str, float]) -> Noise:
    """Return the noise between the runs of two sides.

    `base`, `other`: runs of each side.
    `effects`: logarithm of the ratio of the typical times on the core, other side to base, by stage.
    """
    runs = [*base, *other]
    if all(run.figures.clock != HOST_CLOCK for run in runs):
        return Noise(is_real=False)
    first, second = (_others(side) for side in (base, other))
    more, wall = abs(fmean(second) - fmean(first)), abs(_wall(first, second))
    held = frozenset.intersection(*map(_held, runs))
    free = {stage: ratio for stage, ratio in effects.items() if stage not in held}
    slower = _slower_cores(base[0], other[0], free)
    return Noise(True, (wall, WORK_BESIDE_OTHERS * more, SHARE_BESIDE_OTHERS * more), slower, held)


def relief_of(base: Side, other: Side) -> float:
    """Return the largest change of the ratio of times `other` / `base` if no other programs had run, as a logarithm.

    The result is negative if other programs had more of the cores in `other`, because frames would take less time there
    without them. It is 0 if a side has no run on the host clock.
    `base`, `other`: runs of each side.
    """
    sides = [[told for told in side.runs if told.figures.clock == HOST_CLOCK] for side in (base, other)]
    return _wall(*map(_others, sides)) if all(sides) else 0.0


def _others(runs: Runs) -> list[float]:
    return [run.figures.other_programs or 0.0 for run in runs]


def _wall(base: Sequence[float], other: Sequence[float]) -> float:
    return fmean(map(_left, other)) - fmean(map(_left, base))


def _left(others: float) -> float:
    """Return the logarithm of the share of the cores left to a run. `others`: share that other programs had."""
    return log1p(-min(others, 1 - LEAST_LEFT))


def _held(run: ComparedRun) -> frozenset[str]:
    return frozenset(key.removeprefix(PACE) for key, ns in run.settings.items() if key.startswith(PACE) and ns)


def _slower_cores(base: ComparedRun, other: ComparedRun, effects: Mapping[str, float]) -> dict[str, float]:
    """Return, by stage, the change that the speed of the stage's cores explains, as a logarithm.

    If all stages on the same cores changed in one direction, this is the smallest of their changes. Possible causes are
    the clock, the temperature, or another machine on the same hardware. For a single stage on its cores, and for
    changes in both directions, it is 0. The result is empty if a setting differs that may change the cores' speed.
    `base`, `other`: first run of each side.
    `effects`: as in `noise_between`.
    """
    if any(not change.key.startswith(SAME_CORES) for change in changes(base, other)):
        return {}
    found = {}
    for stages in _stages_by_cores(base.figures):
        ratios = [effects[stage] for stage in stages if stage in effects]
        alike = len(ratios) > 1 and (min(ratios) > 0 or max(ratios) < 0)
        found.update(dict.fromkeys(stages, min(map(abs, ratios)) if alike else 0.0))
    return found


def _stages_by_cores(figures: ComparedFigures) -> Iterable[list[str]]:
    found: dict[tuple[int, ...], list[str]] = {}
    for name, stage in figures.stages.items():
        unit = figures.units.get(stage.unit)
        found.setdefault(unit.cores if unit else (), []).append(name)
    return found.values()


def remarks(runs: Iterable[ComparedRun]) -> list[str]:
    """Return sentences about `runs` for which the share of other programs is unknown or large."""
    said = []
    for run in runs:
        name, others = run.name, run.figures.other_programs
        if run.figures.clock == HOST_CLOCK and others is None:
            said.append(f"{name}: what other programs had of its cores is not known; they are taken to have had none")
        elif others is not None and others > MOST_OTHERS:
            longer = 1 / max(1 - others, LEAST_LEFT) - 1
            said.append(
                f"{name}: other programs had {100 * others:.0f} % of its cores, by which frames may take up to "
                f"{100 * longer:.0f} % longer; only what the other run did not have of that counts"
            )
    return said
