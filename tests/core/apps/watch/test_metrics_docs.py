"""docs/metrics.md and the Grafana dashboard name every metric that there is, and none that there is not."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from itertools import combinations
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("prometheus_client", reason="the extra dashboard is not installed")

from trilane.apps.watch.metrics import COUNTERS, GAUGES, HISTOGRAMS, SOURCE

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
