"""The figures of a run as OpenMetrics text, for Prometheus and what reads its format.

Rule: what is told is in metrics_table.py, and how it is written is prometheus_client's. Where each metric comes from is
a metric itself. https://prometheus.io/docs/specs/om/open_metrics_spec/
"""

from __future__ import annotations

from collections.abc import Iterator
from datetime import datetime
from itertools import accumulate
from typing import Final

from prometheus_client import metrics_core as families
from prometheus_client.openmetrics.exposition import CONTENT_TYPE_LATEST, generate_latest

from trilane.apps.live.figures import Figures
from trilane.apps.live.metrics_table import COUNTERS, GAUGES, HISTOGRAMS, SOURCE, Metric, Times

CONTENT_TYPE: Final[str] = CONTENT_TYPE_LATEST


def openmetrics(figures: Figures) -> bytes:
    """`figures` as a document of type `CONTENT_TYPE`, in UTF-8."""
    document: bytes = generate_latest(_Collected(figures))
    return document


class _Collected:
    """What prometheus_client writes: its registry holds a process's own metrics, and these are a run's."""

    def __init__(self, figures: Figures) -> None:
        self._figures = figures

    def collect(self) -> Iterator[families.Metric]:
        began = self._figures.began_at
        created = datetime.fromisoformat(began).timestamp() if began else None
        yield from (_histogram(each, self._figures, created) for each in HISTOGRAMS)
        yield from (_counter(each, self._figures, created) for each in COUNTERS)
        yield from (_gauge(each, self._figures) for each in GAUGES)
        yield _sources(self._figures)


def _histogram(times: Times, figures: Figures, created: float | None) -> families.Metric:
    histogram = times.times(figures)
    names = [*map(str, histogram.bounds_s), "+Inf"]
    buckets = list(zip(names, map(float, accumulate(histogram.counts)), strict=True))
    family = families.HistogramMetricFamily(times.name, times.help, buckets, histogram.sum_s, unit="seconds")
    if created is not None:
        family.add_sample(f"{times.name}_created", {}, created)
    return family


def _counter(metric: Metric, figures: Figures, created: float | None) -> families.Metric:
    family = families.CounterMetricFamily(metric.name, metric.help, labels=metric.labels, unit=metric.unit)
    for labels, value in metric.rows(figures):
        family.add_metric(labels, value, created)
    return family


def _gauge(metric: Metric, figures: Figures) -> families.Metric:
    family = families.GaugeMetricFamily(metric.name, metric.help, labels=metric.labels, unit=metric.unit)
    for labels, value in metric.rows(figures):
        family.add_metric(labels, value)
    return family


def _sources(figures: Figures) -> families.Metric:
    family = families.InfoMetricFamily(SOURCE.name, SOURCE.help, labels=("metric",))
    every: tuple[Times | Metric, ...] = (*HISTOGRAMS, *COUNTERS, *GAUGES)
    for metric in every:
        for part, source in _sources_of(figures, metric.source):
            family.add_metric((metric.name,), {"part": part, "source": source})
    return family


def _sources_of(figures: Figures, key: str) -> Iterator[tuple[str, str]]:
    """Those of the figures below `key`: "" and its own source, and each place or avatar that has another."""
    for name, source in figures.sources.items():
        if key and (name == key or (name.startswith(f"{key}.") and "*" not in name)):
            yield name.removeprefix(key).removeprefix("."), source
