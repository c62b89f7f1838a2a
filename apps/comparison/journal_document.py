"""What a journal alone tells of its run, with the keys of a report that a comparison reads.

Rule: what the journal does not say is not there, and is named as not known. Settings come from its first record,
figures from its frames; of a run that ended, from its last record, of another what bounded it until then.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

from pydantic import ValidationError
from pydantic_core import from_json, to_json

from trilane.apps.comparison.configuration import NOT_KNOWN, PARTS
from trilane.apps.comparison.difference import STATISTICS
from trilane.apps.comparison.run_frames import Key, RunFrames
from trilane.errors import BadInputError
from trilane.pipeline.journal import read_journal
from trilane.pipeline.reckoning import places_of, reckoned
from trilane.pipeline.run_metrics import RunMetrics

#: Facts of the first record that a report has too.
FACTS: Final = ("config", "machine", "made", "accuracy")


def document_of(frames: RunFrames, path: Path) -> dict[str, Any]:
    """Of the `frames` of the journal at `path`. Raises BadInputError for facts that are none of a run."""
    facts = from_json(to_json(dict(frames.begun.facts)))
    for name in FACTS:
        if not isinstance(facts.get(name, {}), dict):
            raise BadInputError(f"{path}: {name}", repr(facts[name])[:80], "names and their values, as in report.json")
    found = {
        "clock": facts.get("clock", "host"),
        "policy": frames.begun.settings.policy,
        "config": facts.get("config", {}),
        "machine": facts.get("machine", {}),
        "accuracy": facts.get("accuracy", {}),
        "frames": _counts(frames),
        "frame_time_ms": _times(frames, Key("frame time")),
        "latency_ms": _times(frames, Key("latency")),
        "stages": {
            stage.name: {
                "unit": stage.unit,
                "service_ms": _times(frames, Key("service", stage.name)),
                "wait_ms": _times(frames, Key("wait", stage.name)),
            }
            for stage in frames.begun.graph.stages
        },
        "units": {unit: _unit(frames, unit, facts.get("config", {})) for unit in frames.begun.graph.units},
        **{name: facts[name] for name in ("made",) if name in facts},
        **_at_the_end(frames, path),
    }
    if "edge" in found["config"]:
        found.setdefault("edge", found["config"]["edge"])
    return {**found, NOT_KNOWN: tuple(part for part in PARTS if part not in (facts if part in FACTS else found))}


def _at_the_end(frames: RunFrames, path: Path) -> dict[str, Any]:
    """What the last record says of the whole run; where there is none, what bounded it and how full its cores were."""
    if frames.ended is None:
        begun, records = frames.begun, read_journal(path)
        return dict(reckoned(begun.graph, begun.settings, places_of(begun), records).figures)
    try:
        return RunMetrics.model_validate(from_json(to_json(dict(frames.ended.report)))).as_json()
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(str(part) for part in first["loc"])
        raise BadInputError(f"{path}, last record: {key}", first["msg"].lower(), "the figures of a run") from None


def _counts(frames: RunFrames) -> dict[str, Any]:
    """`requested`: until now, without those that were in flight."""
    lost = dict(frames.counted.lost) if frames.counted else {}
    dropped = dict(frames.counted.dropped) if frames.counted else {}
    asked = frames.presented + sum(lost.values()) + sum(dropped.values())
    return {"requested": asked, "presented": frames.presented, "lost_by_cause": lost, "dropped": dropped}


def _times(frames: RunFrames, key: Key) -> dict[str, float]:
    series = frames.series[key]
    if not len(series.values):
        return {}
    return {name: float(STATISTICS[name](series.values, series.weights)) for name in ("mean", "p50", "p90", "p99")}


def _unit(frames: RunFrames, unit: str, config: Mapping[str, Any]) -> dict[str, Any]:
    series = {key: each for key, each in frames.series.items() if key.of == unit and key.measure in ("busy", "idle")}
    shares = {key: float(each.values.sum() / each.weights.sum()) for key, each in series.items()}
    cores = config.get("units", {}).get(unit, {}).get("cores", ())
    return {
        "busy": shares[Key("busy", unit)],
        "idle": {key.cause: share for key, share in shares.items() if key.cause},
        "cores": tuple(cores),
    }
