"""The metrics of a run: a table of name, unit, meaning, labels and values, written as OpenMetrics text.

Rule: base units. No label names a frame, a job or a process number, so the number of rows does not grow with the run.
Busy and idle shares cover the last `WINDOW_NS` (live_figures.py). All other gauges are values of the moment. Histograms
and counters cover the whole run. The metric `trilane_source` names the source of each metric.
docs/metrics.md has the same table.
https://prometheus.io/docs/specs/om/open_metrics_spec/
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from datetime import datetime
from itertools import accumulate
from typing import Final, NamedTuple

from prometheus_client import metrics_core as families
from prometheus_client.openmetrics.exposition import CONTENT_TYPE_LATEST, generate_latest

from trilane.apps.watch.figures import Histogram, MomentFigures
from trilane.apps.watch.followed_run import RunState
from trilane.apps.watch.live_figures import LEAST, LEAST_KEY, WINDOW

CONTENT_TYPE: Final[str] = CONTENT_TYPE_LATEST
#: Values of a row's labels, and the row's value.
Row = tuple[tuple[str, ...], float]


def openmetrics(figures: MomentFigures) -> bytes:
    """Return `figures` as OpenMetrics text of type `CONTENT_TYPE`, in UTF-8."""
    document: bytes = generate_latest(_Collected(figures))
    return document


class _Collected:
    """The metrics of a followed run, in the form of a prometheus_client registry.

    It stands in for the default registry, which has the metrics of this process.
    """

    def __init__(self, figures: MomentFigures) -> None:
        self._figures = figures

    def collect(self) -> Iterator[families.Metric]:
        began = self._figures.began_at
        created = datetime.fromisoformat(began).timestamp() if began else None
        yield from (_histogram(each, self._figures, created) for each in HISTOGRAMS)
        yield from (_counter(each, self._figures, created) for each in COUNTERS)
        yield from (_gauge(each, self._figures) for each in GAUGES)
        yield _sources(self._figures)


def _histogram(times: Times, figures: MomentFigures, created: float | None) -> families.Metric:
    histogram = times.times(figures)
    names = [*map(str, histogram.bounds_s), "+Inf"]
    buckets = list(zip(names, map(float, accumulate(histogram.counts)), strict=True))
    family = families.HistogramMetricFamily(times.name, times.help, buckets, histogram.sum_s, unit="seconds")
    if created is not None:
        family.add_sample(f"{times.name}_created", {}, created)
    return family


def _counter(metric: Metric, figures: MomentFigures, created: float | None) -> families.Metric:
    family = families.CounterMetricFamily(metric.name, metric.help, labels=metric.labels, unit=metric.unit)
    for labels, value in metric.rows(figures):
        family.add_metric(labels, value, created)
    return family


def _gauge(metric: Metric, figures: MomentFigures) -> families.Metric:
    family = families.GaugeMetricFamily(metric.name, metric.help, labels=metric.labels, unit=metric.unit)
    for labels, value in metric.rows(figures):
        family.add_metric(labels, value)
    return family


def _sources(figures: MomentFigures) -> families.Metric:
    family = families.InfoMetricFamily(SOURCE.name, SOURCE.help, labels=("metric",))
    every: tuple[Times | Metric, ...] = (*HISTOGRAMS, *COUNTERS, *GAUGES)
    for metric in every:
        for part, source in _sources_of(figures, metric.source):
            family.add_metric((metric.name,), {"part": part, "source": source})
    return family


def _sources_of(figures: MomentFigures, key: str) -> Iterator[tuple[str, str]]:
    """Yield (part, source) for each source of the figures below `key`; nothing for an empty `key`.

    An empty part means all figures below `key`. Any other part is a place or an avatar with a source of its own.
    """
    for name, source in figures.sources.items():
        if key and (name == key or (name.startswith(f"{key}.") and "*" not in name)):
            yield name.removeprefix(key).removeprefix("."), source


class Metric(NamedTuple):
    """A gauge or counter.

    `name`: name of the metric.
    `unit`: unit at the end of `name`, or "" for a plain number.
    `help`: meaning in one sentence.
    `labels`: names of its labels.
    `rows`: function that returns the rows of the metric; a row has the values of the labels and the value.
    `source`: key of `MomentFigures.sources`; "" if the metric has no source there.
    """

    name: str
    unit: str
    help: str
    labels: tuple[str, ...]
    rows: Callable[[MomentFigures], Iterable[Row]]
    source: str = ""


class Times(NamedTuple):
    """A histogram of times in seconds.

    `name`, `help`, `source`: as in `Metric`. `times`: function that returns the histogram from the figures.
    """

    name: str
    help: str
    times: Callable[[MomentFigures], Histogram]
    source: str


def _bytes_moved(figures: MomentFigures) -> Iterator[Row]:
    for name, stage in figures.stages.items():
        yield from (((name, kind), moved.total) for kind, moved in stage.bytes.items() if kind != LEAST)


def _bytes_needed(figures: MomentFigures) -> Iterator[Row]:
    for name, stage in figures.stages.items():
        yield from (((name,), moved.total) for kind, moved in stage.bytes.items() if kind == LEAST)


def _idle(figures: MomentFigures) -> Iterator[Row]:
    for name, unit in figures.units.items():
        yield from (((name, cause), share) for cause, share in unit.window.idle.items())


def _psnr(figures: MomentFigures) -> Iterator[Row]:
    for name, facts in figures.accuracy.items():
        yield from (((name, band), value) for band, value in facts.get("psnr_db_by_band", {}).items())


class Info(NamedTuple):
    """A metric whose content is in its labels; its value is always 1. `name`, `help`: as in `Metric`."""

    name: str
    help: str


SOURCE = Info("trilane_source", "Where a metric, or a part of it, comes from: measured here, computed, validated.")

HISTOGRAMS = (
    Times("trilane_frame_time_seconds", "Time between presented frames.", lambda f: f.frame_times, "frame_times"),
    Times("trilane_latency_seconds", "From a frame's pose to its picture.", lambda f: f.latencies, "latencies"),
)

COUNTERS = (
    Metric(
        "trilane_frames_presented",
        "",
        "Frames that reached the end.",
        (),
        lambda f: [((), f.frames.presented)],
        "frames",
    ),
    Metric(
        "trilane_frames_skipped",
        "",
        "Presented frames that took the bypass.",
        (),
        lambda f: [((), f.frames.skipped)],
        "frames",
    ),
    Metric(
        "trilane_frames_dropped",
        "",
        "Waiting frames that were left out, by edge and cause.",
        ("edge", "cause"),
        lambda f: [((drop.edge, drop.cause), drop.frames) for drop in f.frames.dropped],
        "frames",
    ),
    Metric(
        "trilane_frames_lost",
        "",
        "Frames begun and never presented, by cause and where it was.",
        ("cause",),
        lambda f: [((cause,), count) for cause, count in f.frames.lost.items()],
        "frames",
    ),
    Metric(
        "trilane_unit_restarts",
        "",
        "Processes of a unit after its first.",
        ("unit",),
        lambda f: [((name,), unit.restarts) for name, unit in f.units.items()],
        "units",
    ),
    Metric(
        "trilane_bytes_moved",
        "",
        "Bytes that a stage read, wrote, uploaded and read back.",
        ("stage", "kind"),
        _bytes_moved,
        "stages",
    ),
    Metric(
        "trilane_bytes_needed",
        "",
        "Bytes that a stage would have needed to move at the least.",
        ("stage",),
        _bytes_needed,
        LEAST_KEY,
    ),
)

GAUGES = (
    Metric(
        "trilane_unit_busy_ratio",
        "ratio",
        f"Share of the {WINDOW} in which a job ran.",
        ("unit",),
        lambda f: [((name,), unit.window.busy) for name, unit in f.units.items()],
        "units",
    ),
    Metric(
        "trilane_unit_idle_ratio",
        "ratio",
        f"Share of the {WINDOW} in which none ran, by cause.",
        ("unit", "cause"),
        _idle,
        "units",
    ),
    Metric(
        "trilane_unit_up",
        "",
        "1 while the unit's process is there and ready; 0 once the run is over.",
        ("unit",),
        lambda f: [((name,), float(unit.is_up)) for name, unit in f.units.items()],
        "units",
    ),
    Metric(
        "trilane_unit_duty_ratio",
        "ratio",
        "Share of the time that a unit may work.",
        ("unit",),
        lambda f: [((unit,), duty) for unit, duty in f.duty.items()],
        "duty",
    ),
    Metric(
        "trilane_queue_depth",
        "",
        "Frames that wait before a stage.",
        ("stage",),
        lambda f: [((name,), stage.waiting) for name, stage in f.stages.items()],
        "stages",
    ),
    Metric(
        "trilane_frames_in_flight",
        "",
        "Frames begun and neither presented nor lost nor dropped.",
        (),
        lambda f: [((), f.frames.in_flight)],
        "frames",
    ),
    Metric(
        "trilane_temperature_celsius",
        "celsius",
        "Temperature by place; `sensor` is this machine's, the others are modelled.",
        ("place",),
        lambda f: [((place,), value) for place, value in f.temperature_c.items()],
        "temperature_c",
    ),
    Metric(
        "trilane_memory_bytes",
        "bytes",
        "Memory in use of the process of each unit and of the scheduler.",
        ("process",),
        lambda f: [((name,), value) for name, value in f.memory_bytes.items()],
        "memory_bytes",
    ),
    Metric(
        "trilane_avatar_psnr_decibels",
        "decibels",
        "Error of the avatar's pictures on views kept aside, by distance.",
        ("avatar", "band"),
        _psnr,
        "accuracy",
    ),
    Metric(
        "trilane_avatar_mask_iou_ratio",
        "ratio",
        "Overlap of the avatar's masks with the true ones on views kept aside.",
        ("avatar",),
        lambda f: [((name,), facts["iou"]) for name, facts in f.accuracy.items() if "iou" in facts],
        "accuracy",
    ),
    Metric(
        "trilane_avatar_error_known",
        "",
        "1 where figures of the avatar's error hold for this run; without them its speed says little.",
        ("avatar",),
        lambda f: [((name,), float("iou" in facts)) for name, facts in f.accuracy.items()],
    ),
    Metric(
        "trilane_run_ended",
        "",
        "1 once the run is over, also of one that was killed.",
        (),
        lambda f: [((), float(f.is_over or f.state != RunState.GOES_ON))],
    ),
    Metric(
        "trilane_run_state",
        "",
        "1 of what has become of the run: it goes on, is finished, was killed, or removed its folder.",
        ("state",),
        lambda f: [((state.value,), float(f.state == state)) for state in RunState],
    ),
)
