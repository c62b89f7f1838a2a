"""What is compared of two runs, a row for each figure. Rule: a table says which statistics a measure has.

Of runs with a journal every figure comes from their frames. Of reports alone and of predictions it is the summary that
they hold: its uncertainty is that of the mean frame time, for nothing else is known.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from math import inf, log
from statistics import fmean
from typing import Any, Final, NamedTuple

import numpy as np

from trilane.apps.comparison.difference import (
    MATTERS,
    Chance,
    Difference,
    difference,
    judged,
    settled,
    student_quantile,
    unsure,
)
from trilane.apps.comparison.noise import WAIT_FLOOR_MS, Noise, noise_between
from trilane.apps.comparison.run_frames import INSTRUCTION_TIME, INSTRUCTIONS, Key
from trilane.apps.comparison.sides import Kind, Side, Told

Z_80: Final = 1.281552
FRAME_TIME, LATENCY, WORK, SERVICE, WAIT, BUSY, IDLE = (
    "frame time", "latency", "work", "service", "wait", "busy", "idle",
)  # fmt: skip
LOST, DROPPED, ERROR = "lost", "dropped", "error"
MS, NS, SHARE, BYTES = "ms", "ns", "share", "bytes"
#: Measure: its statistics, of runs with a journal.
MEASURES: Final = {
    FRAME_TIME: ("mean", "p50", "p90", "p99"),
    LATENCY: ("mean", "p50", "p90", "p99"),
    INSTRUCTIONS: ("mean",),
    INSTRUCTION_TIME: ("typical",),
    WORK: ("typical", "p90", "p99"),
    SERVICE: ("mean", "typical"),
    WAIT: ("mean", "p90"),
    BUSY: ("share",),
    IDLE: ("share",),
}
UNITS: Final = {
    **dict.fromkeys((FRAME_TIME, LATENCY, WORK, SERVICE, WAIT), MS),
    **dict.fromkeys((BUSY, IDLE), SHARE),
    INSTRUCTIONS: "",
    INSTRUCTION_TIME: NS,
}
#: Statistics of a summary whose uncertainty is about that of a mean.
LIKE_THE_MEAN: Final = ("mean", "p50")


class Figure(NamedTuple):
    """What a row is of. `measure` of `of` (a stage, a unit, an avatar, or empty) and `cause`; `unit`: ms, share, ..."""

    measure: str
    of: str
    cause: str
    statistic: str
    unit: str


Rows = dict[Figure, Difference]


def rows_of(base: Side, other: Side) -> Rows:
    """Every figure that all runs of both sides have."""
    noise = _noise(base, other)
    is_known = all(told.frames is not None for told in (*base.runs, *other.runs))
    rows = dict(_of_frames(base, other, noise) if is_known else _of_summaries(base, other, noise))
    rows.update(_of_counts(base, other, noise))
    rows.update(_of_errors(base, other))
    return rows


def named(rows: Rows) -> list[Figure]:
    """The figures that a verdict rests on; all others are there to explain them.

    A stage's program is its instructions where they were counted, and then the time of one is the machine's; else it is
    its time on its core, or its service where nobody knows that.
    """
    counted, worked = ({figure.of for figure in rows if figure.measure == each} for each in (INSTRUCTION_TIME, WORK))

    def is_named(figure: Figure) -> bool:
        if figure.measure in (FRAME_TIME, LATENCY):
            return figure.statistic == "mean"
        if figure.measure == WORK:
            return figure.statistic == "typical" and figure.of not in counted
        if figure.measure == SERVICE:
            return figure.statistic == "mean" and figure.of not in worked
        return figure.measure not in (WAIT, BUSY, IDLE)

    return [figure for figure in rows if is_named(figure)]


def margin_of(figure: Figure, row: Difference) -> float:
    """The least change that matters, as the row's `change` has it."""
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
    return noise_between([told.document for told in base.runs], [told.document for told in other.runs], effects)


def _shared(base: Side, other: Side) -> list[Key]:
    """What series all runs have; none where one has no frames."""
    first, *rest = [told.frames.series if told.frames else {} for side in (base, other) for told in side.runs]
    return [key for key in first if all(key in each for each in rest)]


def _difference(base: Side, other: Side, key: Key, statistic: str, chance: Chance) -> Difference:
    first, second = ([told.frames.series[key] for told in side.runs if told.frames] for side in (base, other))
    is_ratio = statistic != SHARE and key.measure != WAIT
    return difference(first, second, statistic, is_ratio=is_ratio, chance=chance)


def _of_frames(base: Side, other: Side, noise: Noise) -> Iterator[tuple[Figure, Difference]]:
    for key in _shared(base, other):
        if key.measure == INSTRUCTION_TIME and key.of in noise.held:
            continue  # it sleeps until its time is over
        for statistic in MEASURES.get(key.measure, ("mean",)):
            change = _difference(base, other, key, statistic, _chance(key.measure, key.of, statistic, noise))
            yield Figure(*key, statistic, UNITS.get(key.measure, BYTES)), change


def _chance(measure: str, of: str, statistic: str, noise: Noise) -> Chance:
    if measure in (BUSY, IDLE):
        return noise.of_share()
    if measure == WAIT:
        return noise.of_wait(statistic)
    if measure in (WORK, INSTRUCTION_TIME) or (measure == SERVICE and of in noise.held):
        return noise.of_work(of, statistic)
    if measure == INSTRUCTIONS:
        return noise.of_count()
    return noise.of_time(statistic) if measure in MEASURES else Chance()


def _of_summaries(base: Side, other: Side, noise: Noise) -> Iterator[tuple[Figure, Difference]]:
    """What reports or predictions say of their runs; each as sure as it says that its mean frame time is."""
    sides = [[_summaries(told.document) for told in side.runs] for side in (base, other)]
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
    """Of the mean frame times' ratio, by the intervals that the documents give; predictions of one chip have the

    model's error in common, and so none between them. None where one has no interval.
    """
    runs = [*base.runs, *other.runs]
    if all(told.kind == Kind.PREDICTION and told.document["machine"] == runs[0].document["machine"] for told in runs):
        return 0.0
    found = [[_deviation_of(told) for told in side.runs] for side in (base, other)]
    if any(value is None for side in found for value in side):
        return None
    return sum((value or 0.0) ** 2 / len(side) ** 2 for side in found for value in side)


def _deviation_of(told: Told) -> float | None:
    times = told.document["frame_time_ms"]
    low, high, quantile = (
        (times["low"], times["high"], Z_80)
        if told.kind is Kind.PREDICTION
        else (times.get("mean_low"), times.get("mean_high"), student_quantile(inf))
    )
    if low is None or high is None or not times["mean"]:
        return 0.0 if told.document["clock"] == "virtual" else None
    return float((high - low) / (2 * quantile * times["mean"]))


def _summaries(document: Mapping[str, Any]) -> dict[Figure, float]:
    found: dict[Figure, float] = {}
    for measure, times in ((FRAME_TIME, document["frame_time_ms"]), (LATENCY, document["latency_ms"])):
        found.update(_statistics(measure, "", times, MEASURES[measure]))
    for stage, row in document["stages"].items():
        found.update(_statistics(SERVICE, stage, row.get("service_ms", {}), MEASURES[SERVICE]))
        found.update(_statistics(WAIT, stage, row.get("wait_ms", {}), MEASURES[WAIT]))
    for unit, row in document["units"].items():
        found[Figure(BUSY, unit, "", SHARE, SHARE)] = row["busy"]
        for cause, share in row["idle"].items():
            if share is not None:
                found[Figure(IDLE, unit, cause, SHARE, SHARE)] = share
    return found


def _statistics(measure: str, of: str, times: Mapping[str, Any], names: Sequence[str]) -> dict[Figure, float]:
    return {Figure(measure, of, "", name, MS): float(times[name]) for name in names if name in times}


def _of_counts(base: Side, other: Side, noise: Noise) -> Iterator[tuple[Figure, Difference]]:
    """Frames lost and dropped, as shares of those asked for."""
    if any("frames" not in told.document for told in (*base.runs, *other.runs)):
        return
    sides = [[told.document["frames"] for told in side.runs] for side in (base, other)]
    for measure, causes in ((LOST, "lost_by_cause"), (DROPPED, DROPPED)):
        for cause in dict.fromkeys(cause for side in sides for frames in side for cause in frames.get(causes, {})):
            counts = [[frames.get(causes, {}).get(cause, 0) for frames in side] for side in sides]
            asked = [[frames["requested"] or 1 for frames in side] for side in sides]
            values = [np.divide(*both) for both in zip(counts, asked, strict=True)]
            pooled = sum(map(sum, counts)) / sum(map(sum, asked))
            within = pooled * max(1 - pooled, 0.0) * sum(1 / sum(each) for each in asked)
            row = settled([side.tolist() for side in values], values, within, noise.of_share(), is_ratio=False)
            yield Figure(measure, cause, "", SHARE, SHARE), row


def _of_errors(base: Side, other: Side) -> Iterator[tuple[Figure, Difference]]:
    """The avatars' figures of accuracy, which are as they were measured once: every change counts."""
    first, second = (dict(_numbers("", side.runs[0].document.get("accuracy", {}))) for side in (base, other))
    for name, value in first.items():
        if name in second:
            unit = "dB" if "psnr" in name else ""
            yield Figure(ERROR, name, "", "", unit), judged(value, second[name], 0.0, is_ratio=False)


def _numbers(name: str, value: Any) -> Iterator[tuple[str, float]]:
    if isinstance(value, Mapping):
        for key, inner in value.items():
            if key not in ("by_seed", "worst", "samples"):
                yield from _numbers(f"{name} {key}".strip(), inner)
    elif isinstance(value, int | float) and not isinstance(value, bool):
        yield name, float(value)
