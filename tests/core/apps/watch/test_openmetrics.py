"""`/metrics`: what a journal made by hand says, read by Prometheus's parser, and what documents say of each metric."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from itertools import combinations, pairwise
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("prometheus_client", reason="the extra dashboard is not installed")

from support.run_report import make_metrics
from trilane.apps.watch.followed_run import RunState
from trilane.apps.watch.live_figures import LiveFigures
from trilane.apps.watch.metrics import COUNTERS, GAUGES, HISTOGRAMS, SOURCE
from trilane.pipeline.journal import SCHEMA, Accounted, Begun, Counted, Ended, Sampled, Stepped, Worked
from trilane.scheduler.events import Dispatch, Job, JobDone, Settings, UnitReady, chain
from trilane.scheduler.ledger import ASSIGNED, STARVED, JobRecord

MS = 1_000_000
GRAPH = chain((("a", "u"), ("b", "v")), "double", "b")
ACCURACY = {
    "default": {
        "source": "from the avatar's validation of today",
        "psnr_db_by_band": {"far": 31.7, "face": 28.3},
        "iou": 0.98,
    },
    'own "one"\n': {"source": "no figures", "why": "never validated"},
}
FACTS = {"clock": "host", "began_at": "2026-11-22T10:00:00+00:00", "accuracy": ACCURACY}
BEGAN = 1_795_341_600  # seconds of the Unix epoch at FACTS["began_at"]


def run(frames: int, frame_ms: int = 20) -> LiveFigures:
    """So many frames, one every `frame_ms`: 5 ms on u, where the pose is sampled after 1, and then 10 ms on v."""
    figures = LiveFigures(Begun(SCHEMA, GRAPH, Settings(frames), FACTS))
    figures.add(Stepped(0, (UnitReady("u"), UnitReady("v")), ()))
    for frame in range(frames):
        t = frame * frame_ms * MS
        jobs = (Job(2 * frame, "u", "a", frame, -1, 0, 0), Job(2 * frame + 1, "v", "b", frame, 0, -1, 0))
        figures.add(Stepped(t, (), (Dispatch(jobs[0]),)))
        figures.add(Accounted(t, "u", ASSIGNED))
        ended = JobDone("u", 2 * frame, t, t + 5 * MS, t + MS)
        figures.add(Stepped(t + 5 * MS, (ended,), (Dispatch(jobs[1]),)))
        figures.add(Accounted(t + 5 * MS, "u", STARVED))
        figures.add(Accounted(t + 5 * MS, "v", ASSIGNED))
        figures.add(Worked(JobRecord("a", "u", frame, t, t, t, t + 5 * MS), {"bytes_written": 8, "bytes_least": 6}))
        figures.add(Stepped(t + 15 * MS, (JobDone("v", 2 * frame + 1, t + 5 * MS, t + 15 * MS, 0),), ()))
        figures.add(Accounted(t + 15 * MS, "v", STARVED))
    figures.add(Counted(0, {"died:v": 2}, {"a->b:stale": 3, "source->a:late": 4}))
    figures.add(Sampled(0, {"temperature_c.sensor": 61.5, "duty.v": 0.25, "memory_bytes.v": 5e6}))
    figures.add(Ended(frames * frame_ms * MS, make_metrics()))
    return figures


def parsed(figures: LiveFigures, state: RunState | None = None) -> dict[str, Any]:
    from prometheus_client.openmetrics.parser import text_string_to_metric_families

    from trilane.apps.watch.metrics import openmetrics

    text = openmetrics(figures.now(state=state)).decode()
    return {family.name: family for family in text_string_to_metric_families(text)}


def value(families: dict[str, Any], family: str, sample: str, **labels: str) -> float:
    [found] = [each.value for each in families[family].samples if (each.name, each.labels) == (sample, labels)]
    return float(found)


def test_every_metric_is_there_with_its_unit_and_kind() -> None:
    families = parsed(run(3))
    every = {each.name for each in (*HISTOGRAMS, *COUNTERS, *GAUGES, SOURCE)}
    assert families.keys() == every
    assert len(every) == len(HISTOGRAMS) + len(COUNTERS) + len(GAUGES) + 1
    for metric in (*COUNTERS, *GAUGES):
        family = families[metric.name]
        assert (family.type, family.unit) == ("counter" if metric in COUNTERS else "gauge", metric.unit)
        assert family.documentation == metric.help
        assert family.samples, metric.name
        assert {frozenset(sample.labels) for sample in family.samples} == {frozenset(metric.labels)}


def test_the_histograms_hold_the_whole_run_and_are_cumulative() -> None:
    families = parsed(run(300))  # 6 s, of which the window is 5
    for name, count, total_s, bound in (
        ("trilane_frame_time_seconds", 299, 299 * 0.020, "0.02"),
        ("trilane_latency_seconds", 300, 300 * 0.014, "0.015"),
    ):
        assert value(families, name, f"{name}_count") == count
        assert value(families, name, f"{name}_sum") == pytest.approx(total_s)
        assert value(families, name, f"{name}_created") == BEGAN
        buckets = [each for each in families[name].samples if each.name.endswith("_bucket")]
        assert all(less.value <= more.value for less, more in pairwise(buckets))
        below = [each.labels["le"] for each in buckets if each.value == 0]
        assert buckets[len(below)].labels["le"] == bound
        assert (buckets[-1].labels["le"], buckets[-1].value) == ("+Inf", count)


def test_counters_and_gauges_by_hand() -> None:
    families = parsed(run(300))
    for sample, labels, wanted in (
        ("trilane_frames_presented_total", {}, 300),
        ("trilane_frames_dropped_total", {"edge": "a->b", "cause": "stale"}, 3),
        ("trilane_frames_dropped_total", {"edge": "source->a", "cause": "late"}, 4),
        ("trilane_frames_dropped_created", {"edge": "source->a", "cause": "late"}, BEGAN),
        ("trilane_frames_lost_total", {"cause": "died:v"}, 2),
        ("trilane_bytes_moved_total", {"stage": "a", "kind": "written"}, 2400),
        ("trilane_bytes_needed_total", {"stage": "a"}, 1800),
        ("trilane_unit_busy_ratio", {"unit": "u"}, 0.25),
        ("trilane_unit_busy_ratio", {"unit": "v"}, 0.5),
        ("trilane_unit_idle_ratio", {"unit": "u", "cause": "starved"}, 0.75),
        ("trilane_unit_duty_ratio", {"unit": "v"}, 0.25),
        ("trilane_unit_up", {"unit": "v"}, 0),
        ("trilane_temperature_celsius", {"place": "sensor"}, 61.5),
        ("trilane_memory_bytes", {"process": "v"}, 5e6),
        ("trilane_avatar_psnr_decibels", {"avatar": "default", "band": "face"}, 28.3),
        ("trilane_avatar_mask_iou_ratio", {"avatar": "default"}, 0.98),
        ("trilane_avatar_error_known", {"avatar": "default"}, 1),
        ("trilane_avatar_error_known", {"avatar": 'own "one"\n'}, 0),
        ("trilane_run_ended", {}, 1),
        ("trilane_run_state", {"state": "finished"}, 1),
        ("trilane_run_state", {"state": "killed"}, 0),
    ):
        family = sample.removesuffix("_total").removesuffix("_created")
        assert value(families, family, sample, **labels) == pytest.approx(wanted), (sample, labels)


def test_each_metric_says_where_it_comes_from() -> None:
    sources = {
        (each.labels["metric"], each.labels["part"]): each.labels["source"]
        for each in parsed(run(3))["trilane_source"].samples
    }
    assert (
        sources["trilane_frame_time_seconds", ""]
        == sources["trilane_temperature_celsius", "sensor"]
        == "measured in this run"
    )
    assert sources["trilane_temperature_celsius", ""] == sources["trilane_bytes_needed", ""] == "computed"
    assert sources["trilane_avatar_psnr_decibels", "default"] == "from the avatar's validation of today"
    unsaid = {each.name for each in (*HISTOGRAMS, *COUNTERS, *GAUGES)} - {metric for metric, _ in sources}
    assert unsaid == {"trilane_avatar_error_known", "trilane_run_ended", "trilane_run_state"}


@pytest.mark.parametrize("state", RunState)
def test_units_are_up_in_a_run_that_goes_on_alone(state: RunState) -> None:
    """A journal without an end says nothing of what became of its run."""
    figures = LiveFigures(Begun(SCHEMA, GRAPH, Settings(1), FACTS))
    figures.add(Stepped(0, (UnitReady("u"), UnitReady("v")), ()))
    families = parsed(figures, state)
    goes_on = state is RunState.GOES_ON
    assert [value(families, "trilane_unit_up", "trilane_unit_up", unit=unit) for unit in "uv"] == [goes_on] * 2
    assert value(families, "trilane_run_ended", "trilane_run_ended") == (not goes_on)
    for each in RunState:
        assert value(families, "trilane_run_state", "trilane_run_state", state=each.value) == (each is state)


def test_a_longer_run_has_no_more_rows() -> None:
    short, long = parsed(run(3)), parsed(run(600))
    assert sum(len(family.samples) for family in long.values()) == sum(len(family.samples) for family in short.values())


def test_without_a_beginning_there_are_no_creation_times() -> None:
    figures = LiveFigures(Begun(SCHEMA, GRAPH, Settings(1), {}))
    assert not [
        each for family in parsed(figures).values() for each in family.samples if each.name.endswith("_created")
    ]


def test_the_document_ends_as_the_format_asks() -> None:
    from trilane.apps.watch.metrics import CONTENT_TYPE, openmetrics

    assert openmetrics(run(1).now()).endswith(b"\n# EOF\n")
    assert CONTENT_TYPE.startswith("application/openmetrics-text; version=1.0.0")


DOCS = Path(__file__).parents[4] / "docs"
PAGE = (DOCS / "metrics.md").read_text(encoding="utf-8")
DASHBOARD = json.loads((DOCS / "grafana" / "trilane.json").read_text(encoding="utf-8"))
#: Name of the samples to labels and kind.
SHOWN = {
    **{each.name: ((), "histogram") for each in HISTOGRAMS},
    **{f"{each.name}_total": (each.labels, "counter") for each in COUNTERS},
    **{each.name: (each.labels, "gauge") for each in GAUGES},
    f"{SOURCE.name}_info": (("metric", "part", "source"), "info"),
}
PARTS = ("_bucket", "_sum", "_count")


def queries(value: Any) -> Iterator[str]:
    """Every text in the dashboard that Prometheus is asked."""
    if isinstance(value, dict):
        yield from (
            text for key, text in value.items() if key in ("expr", "definition", "query") and isinstance(text, str)
        )
    for below in value.values() if isinstance(value, dict) else value if isinstance(value, list) else ():
        yield from queries(below)


def test_the_page_lists_each_metric_with_its_labels_and_kind() -> None:
    rows = [re.split(r" *\| *", line)[1:-1] for line in PAGE.splitlines() if line.startswith("| `trilane_")]
    listed = {row[0].strip("`"): (tuple(re.findall(r"`(\w+)`", row[1])), row[2]) for row in rows}
    assert len(rows) == len(listed)
    assert listed == SHOWN


def test_the_dashboard_asks_for_every_metric_and_for_no_other() -> None:
    asked = set(re.findall(r"trilane_\w+", " ".join(queries(DASHBOARD))))
    histograms = {f"{each.name}{part}" for each in HISTOGRAMS for part in PARTS}
    assert asked - histograms <= set(SHOWN)
    assert {name.removesuffix("_bucket") for name in asked} >= set(SHOWN)


def test_labels_in_its_legends_are_those_of_its_metrics() -> None:
    for panel in DASHBOARD["panels"]:
        for target in panel["targets"]:
            names = re.findall(r"trilane_\w+", target["expr"])
            known = {label for name in names for label in SHOWN.get(name, (("le",), ""))[0]}
            assert set(re.findall(r"{{(\w+)}}", target["legendFormat"])) <= known, panel["title"]


def test_its_panels_have_places_of_their_own_and_ask_the_chosen_source() -> None:
    panels = DASHBOARD["panels"]
    assert len({panel["id"] for panel in panels}) == len({panel["title"] for panel in panels}) == len(panels)
    for one, other in combinations([panel["gridPos"] for panel in panels], 2):
        beside = one["x"] + one["w"] <= other["x"] or other["x"] + other["w"] <= one["x"]
        assert beside or one["y"] + one["h"] <= other["y"] or other["y"] + other["h"] <= one["y"]
    assert all(panel["gridPos"]["x"] + panel["gridPos"]["w"] <= 24 for panel in panels)
    sources = {target["datasource"]["uid"] for panel in panels for target in panel["targets"]}
    assert sources == {"${datasource}"}
