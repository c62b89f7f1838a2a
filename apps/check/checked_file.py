"""What `trilane check` says of a pipeline file, as one document: stages, streams, the bound on the period, memory.

Rule: nothing runs here, and no Python of the file is imported.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

from trilane.apps.check.port_types import PortTypes, port_types, read_networks
from trilane.errors import BadInputError
from trilane.hw_profiles.pipeline_prediction import StagePrice, bound_of, given_price
from trilane.pipeline.file_graph import edge_rules, graph_of
from trilane.pipeline.file_keys import PythonStage, StageKeys
from trilane.pipeline.pipeline_file import PipelineFile, read_pipeline
from trilane.transport.slots import edge_rule
from trilane.units import NS_PER_MS

#: Of the slots of one stream; a run has them in shared memory.
MOST_STREAM_BYTES: Final = 2 << 30


def check_file(path: Path) -> dict[str, Any]:
    """Check a pipeline file, its networks and its ports, and return what `trilane check --json` prints.

    Raises BadInputError.
    """
    return document_of(read_pipeline(path))


def document_of(file: PipelineFile) -> dict[str, Any]:
    """Return what `check_file` says of a pipeline file that was read."""
    types = port_types(file, read_networks(file))
    prices = {name: price for name in file.stages if (price := given_price(file, name)) is not None}
    known = prices if len(prices) == len(file.stages) else None
    rules = edge_rules(file)
    period: dict[str, Any] = {"period_ms": None, "cycle": [], "limit": ""}
    if known is not None:
        _, bound = bound_of(file, known)
        period = {
            "period_ms": float(bound.period_ns) / NS_PER_MS,
            "cycle": list(bound.stages),
            "limit": bound.limit,
        }
    streams = [_stream(file, name, rule, types) for name, rule in rules.items()]
    memory = [each["memory_bytes"] for each in streams]
    return {
        "schema": 1,
        "file": str(file.path),
        "run": file.run.model_dump(mode="json", exclude_defaults=True) | {"policy": file.run.policy},
        "latency_to": file.latency_to,
        "units": {name: {"hardware": file.hardware(name)} for name in file.units},
        "stages": [_stage(file, name, prices.get(name)) for name in file.stages],
        "streams": streams,
        "routes": _routes(file, rules),
        **period,
        "memory_bytes": sum(each for each in memory if each is not None),
        "memory_unknown": [each["from"] for each in streams if each["memory_bytes"] is None],
        "imports": sorted({each.python for each in file.stages.values() if isinstance(each, PythonStage)}),
    }


def _stage(file: PipelineFile, name: str, price: StagePrice | None) -> dict[str, Any]:
    stage = file.stages[name]
    return {
        "name": name,
        "unit": stage.unit,
        "kind": stage.kind,
        "what": _what(stage),
        "in": [_input(each) for each in stage.inputs],
        "every": stage.every,
        "time_ms": None if price is None else price.time.mean_ms,
        "time_from": "" if price is None else price.source,
    }


def _routes(file: PipelineFile, rules: Mapping[str, str]) -> list[dict[str, Any]]:
    """Return the way past some stages: its ends, the stages that a frame skips there, and the share of such frames."""
    if file.bypass is None:
        return []
    begin, way = file.bypass
    share = None if way.taken is None else float(way.taken)
    return [{"from": begin, "to": way.to, "past": list(graph_of(file, rules).bypassed), "share": share}]


def _what(stage: StageKeys) -> str:
    """Return the stage's model, code or block; empty for a time alone."""
    return str(getattr(stage, stage.kind)) if stage.kind != "time_ms" else ""


def _input(each: Any) -> dict[str, Any]:
    source = f"{each.stage}.{each.from_port}" if each.from_port else each.stage
    sync = {"sync": "latest", "max_age_ms": each.max_age_ms or None} if each.latest else {"sync": "frame"}
    return {"port": each.port, "from": source, **sync}


def _stream(file: PipelineFile, name: str, rule: str, types: PortTypes) -> dict[str, Any]:
    ports: Mapping[str, Any] = types.get(name, {})
    slots = edge_rule(rule).slots
    slot_bytes = sum(port.payload_bytes for port in ports.values()) if ports else None
    if slot_bytes is not None and slots * slot_bytes > MOST_STREAM_BYTES:
        found = f"{slots} slots of {slot_bytes >> 20} MiB behind {name}"
        expected = f"at most {MOST_STREAM_BYTES >> 30} GiB for a stream"
        raise BadInputError(f"{file.path}: edges.{name}", found, expected, "fewer slots or a smaller port")
    return {
        "from": name,
        "to": file.readers[name],
        "slots": slots,
        "rule": rule,
        "ports": {port: str(kind) for port, kind in ports.items()},
        "memory_bytes": None if slot_bytes is None else slots * slot_bytes,
    }
