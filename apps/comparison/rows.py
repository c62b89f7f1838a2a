"""What is compared of two runs, a row for each figure. Rule: a table says which statistics a measure has.

Of runs with a journal every figure comes from their frames. Of reports alone and of predictions it is the summary that
they hold: its uncertainty is that of the mean frame time, for nothing else is known.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from math import hypot, sqrt
from typing import Any, Final, NamedTuple

from trilane.apps.comparison.difference import Z_95, Difference, combined, difference, judged, unsure
from trilane.apps.comparison.noise import HELD, TAILS, Noise, noise_between
from trilane.apps.comparison.run_frames import Key, RunFrames
from trilane.apps.comparison.sides import Kind, Side, Told

Z_80: Final = 1.281552
WAIT_FLOOR_MS: Final = 0.05  # of a wait: a message takes so long more or less
FRAME_TIME, LATENCY, WORK, SERVICE, WAIT, BUSY, IDLE = (
    "frame time", "latency", "work", "service", "wait", "busy", "idle",
)  # fmt: skip
LOST, DROPPED, ERROR = "lost", "dropped", "error"
MS, SHARE, BYTES = "ms", "share", "bytes"
#: Measure: its statistics, of runs with a journal.
MEASURES: Final = {
    FRAME_TIME: ("mean", "p50", "p90", "p99"),
    LATENCY: ("mean", "p50", "p90", "p99"),
    WORK: ("typical", "p90", "p99"),
    SERVICE: ("mean", "typical"),
    WAIT: ("mean", "p90"),
    BUSY: ("share",),
    IDLE: ("share",),
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
    """Every figure that both sides have; of several runs a side, pair by pair, in order, and these combined.

    Raises ValueError for sides of unequal count: a run that stood in two pairs would make them depend on each other.
    """
    pairs = [rows_between(*pair) for pair in zip(base.runs, other.runs, strict=True)]
    if len(pairs) == 1:
        return pairs[0]
    shared = [figure for figure in pairs[0] if all(figure in rows for rows in pairs)]
    return {figure: combined([rows[figure] for rows in pairs]) for figure in shared}


def rows_between(base: Told, other: Told) -> Rows:
    """Of two runs."""
    noise = _noise(base, other)
    if base.frames is not None and other.frames is not None:
        rows = dict(_of_frames(base.frames, other.frames, noise))
    else:
        rows = dict(_of_summaries(base, other, noise))
    rows.update(_of_counts(base.document, other.document, noise))
    rows.update(_of_errors(base.document, other.document))
    return rows


def _noise(base: Told, other: Told) -> Noise:
    if base.frames is None or other.frames is None:
        return noise_between(base.document, other.document, {})
    first, second = base.frames.series, other.frames.series
    effects = {}
    for key, series in first.items():
        if key.measure == WORK and key in second:
            change = difference(series, second[key], "typical", is_ratio=True)
            if change.is_ratio:
                effects[key.of] = change.effect
    return noise_between(base.document, other.document, effects)


def _of_frames(base: RunFrames, other: RunFrames, noise: Noise) -> Iterator[tuple[Figure, Difference]]:
    for key, series in base.series.items():
        if key not in other.series:
            continue
        for statistic in MEASURES.get(key.measure, ("mean",)):
            relative, absolute = _between(key, statistic, noise)
            is_share = statistic == SHARE
            change = difference(
                series, other.series[key], statistic, is_ratio=not is_share and key.measure != WAIT,
                relative=relative, absolute=absolute,
            )  # fmt: skip
            yield Figure(*key, statistic, _unit(key)), change


def _unit(key: Key) -> str:
    if key.measure in (BUSY, IDLE):
        return SHARE
    return MS if key.measure in MEASURES else BYTES


def _between(key: Key, statistic: str, noise: Noise) -> tuple[float, float]:
    """Standard deviations between runs of one kind: of the logarithm, and in the unit of the figure."""
    if key.measure in (BUSY, IDLE):
        return 0.0, noise.share
    if key.measure not in MEASURES:
        return 0.0, 0.0
    tail = TAILS.get(statistic, 1.0)
    if key.measure == WAIT:
        return tail * noise.wall, WAIT_FLOOR_MS if noise.wall else 0.0
    if key.measure in (WORK, SERVICE) and key.of in noise.held:
        return tail * HELD, 0.0
    return noise.work.get(key.of, noise.wall) if statistic == "typical" else tail * noise.wall, 0.0


def _of_summaries(base: Told, other: Told, noise: Noise) -> Iterator[tuple[Figure, Difference]]:
    spread = _relative_deviation(base, other)
    first, second = _summaries(base.document), _summaries(other.document)
    for figure, value in first.items():
        if figure not in second:
            continue
        is_ratio = figure.unit == MS and figure.measure != WAIT
        if spread is None or figure.statistic not in (*LIKE_THE_MEAN, SHARE):
            yield figure, unsure(value, second[figure], is_ratio=is_ratio)
            continue
        relative = hypot(spread, noise.share if figure.unit == SHARE else noise.wall)
        largest = max(value, second[figure])
        if is_ratio and min(value, second[figure]) > 0:
            yield figure, judged(value, second[figure], relative, is_ratio=True)
        else:
            scale = 1.0 if figure.unit == SHARE else largest
            yield figure, judged(value, second[figure], relative * scale, is_ratio=False)


def _relative_deviation(base: Told, other: Told) -> float | None:
    """Of the mean frame times' ratio, by the intervals that the documents give; two predictions of one chip have the

    model's error in common, and so none between them. None where one has no interval.
    """
    if base.kind == other.kind == Kind.PREDICTION and base.document["machine"] == other.document["machine"]:
        return 0.0
    found = [_deviation_of(told) for told in (base, other)]
    known = [value for value in found if value is not None]
    return hypot(*known) if len(known) == len(found) else None


def _deviation_of(told: Told) -> float | None:
    times = told.document["frame_time_ms"]
    low, high, quantile = (
        (times["low"], times["high"], Z_80)
        if told.kind is Kind.PREDICTION
        else (times.get("mean_low"), times.get("mean_high"), Z_95)
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


def _of_counts(base: Mapping[str, Any], other: Mapping[str, Any], noise: Noise) -> Iterator[tuple[Figure, Difference]]:
    """Frames lost and dropped, as shares of those asked for."""
    if "frames" not in base or "frames" not in other:
        return
    first, second = base["frames"], other["frames"]
    asked = [frames["requested"] or 1 for frames in (first, second)]
    for measure, causes in ((LOST, "lost_by_cause"), (DROPPED, DROPPED)):
        for cause in dict.fromkeys([*first.get(causes, {}), *second.get(causes, {})]):
            counts = [frames.get(causes, {}).get(cause, 0) for frames in (first, second)]
            shares = [count / all_ for count, all_ in zip(counts, asked, strict=True)]
            pooled = sum(counts) / sum(asked)
            scatter = sqrt(pooled * max(1 - pooled, 0.0) * sum(1 / all_ for all_ in asked))
            deviation = hypot(scatter, noise.share)
            yield Figure(measure, cause, "", SHARE, SHARE), judged(shares[0], shares[1], deviation, is_ratio=False)


def _of_errors(base: Mapping[str, Any], other: Mapping[str, Any]) -> Iterator[tuple[Figure, Difference]]:
    """The avatars' figures of accuracy, which are as they were measured once: every change counts."""
    first, second = (dict(_numbers("", each.get("accuracy", {}))) for each in (base, other))
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
