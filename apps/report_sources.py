"""Where each figure of report.json comes from: a table from keys to sources.

Rule: of all keys here that a figure stands under, the longest decides; no figure stands under none.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from trilane.figure_sources import COMPARED, COMPUTED, MEASURED

#: Key, dotted where it is inside another, to the source of all figures below it.
SOURCES = {
    "frames": MEASURED,
    "duration_s": MEASURED,
    "frame_time_ms": MEASURED,
    "latency_ms": MEASURED,
    "fps": MEASURED,
    "deadline_misses": MEASURED,
    "xrbench": MEASURED,
    "xrbench.energy": COMPUTED,
    "stages": MEASURED,
    "bytes": MEASURED,
    "bytes.least": COMPUTED,
    "bytes.ratio": COMPARED,
    "units": MEASURED,
    "efficiency": MEASURED,
    "core_efficiency": MEASURED,
    "machine_efficiency": MEASURED,
    "bound": COMPUTED,
    "other_programs": MEASURED,
    "caps": COMPUTED,
    "temperature_c": COMPUTED,
    "temperature_c.sensor": MEASURED,
    "startup_ms": MEASURED,
    "figures": MEASURED,
    "baseline": MEASURED,
    "placement": COMPUTED,
    "placement.times": MEASURED,
    "resolution": MEASURED,
    "pace": COMPUTED,
    "pace.host_slower": MEASURED,
    "pace.late_frames": MEASURED,
    "pace.measured_ms": MEASURED,
    "pace.compared_share": MEASURED,
    "pace.ratio": COMPARED,
    "video": MEASURED,
    "check": MEASURED,
}
#: Keys whose numbers are settings, names of things or facts of the machine.
NO_FIGURES_UNDER = ("schema", "machine", "config", "options", "plan", "pids")


def sources_of(document: Mapping[str, Any]) -> dict[str, str]:
    """The sources of the figures in `document`, the content of a report; those of `accuracy` by avatar."""
    sources = {key: source for key, source in SOURCES.items() if _holds(document, key.split("."))}
    return sources | _of_bytes(document["stages"]) | dict(_of_accuracy(document.get("accuracy", {})))


def _of_bytes(stages: Mapping[str, Any]) -> dict[str, str]:
    """Of the stages that count what they move, what is not counted."""
    counting = [f"stages.{name}.bytes" for name, row in stages.items() if row.get("bytes")]
    return {f"{key}.{figure}": SOURCES[f"bytes.{figure}"] for key in counting for figure in ("least", "ratio")}


def _of_accuracy(accuracy: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    for name, facts in accuracy.items():
        yield f"accuracy.{name}", facts["source"]


def _holds(document: Any, path: list[str]) -> bool:
    """Whether `document` has something at `path`."""
    for key in path:
        if not isinstance(document, Mapping) or key not in document:
            return False
        document = document[key]
    return document is not None
