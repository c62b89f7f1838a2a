"""Writes a pipeline's description as the text of a pipeline file, and says what such a file cannot hold.

    tables = tables_of(pipeline, {"policy": "latest", "fps": 30.0}, {"camera": 0.4})
    text = file_text(tables, unsaid(pipeline))

Rule: this module writes any description, by its stages, edges and units; it does not know what the stages do.
`pipeline_file.checked_tables` reads the same tables, so every written file can be checked and predicted.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Final

from trilane.pipeline.description import Pipeline, PipelineStage
from trilane.transport.packets import header_dtype

NOT_RUN: Final = (
    "its stages are no blocks and no code of your own: `trilane check` and `predict` take it, `run` does not"
)
NOT_SAID: Final[Mapping[str, Any]] = {}


def tables_of(
    pipeline: Pipeline, run: Mapping[str, Any], times_ms: Mapping[str, float], taken: Mapping[str, Any] = NOT_SAID
) -> dict[str, Any]:
    """Return the tables of a pipeline file.

    `run`: the table [run] without edges and latency, which the description states. `times_ms`: mean time of a job by
    stage, in ms; a stage that is missing states no time. `taken`: which frames take the bypass, as keys of its table.
    """
    joints = list(pipeline.joints.values())
    rules = {before.name: edge.rule for (before, _), edge in zip(joints, pipeline.edges, strict=True)}
    sizes = {before.name: edge.payload_bytes for (before, _), edge in zip(joints, pipeline.edges, strict=True)}
    alike = len(set(rules.values())) == 1
    tables = {
        "run": {**run, "latency_to": pipeline.latency_to or pipeline.stages[-1].name},
        "stages": {
            stage.name: _stage(pipeline, place, sizes.get(stage.name, 0), times_ms)
            for place, stage in enumerate(pipeline.stages)
        },
    }
    if pipeline.bypass is not None:
        begin, end = pipeline.bypass
        tables["stages"][begin]["bypass"] = {"to": end, **taken} if taken else end
    if alike:
        tables["run"]["edge"] = next(iter(rules.values()))
    elif rules:
        tables["edges"] = rules
    return tables


def _stage(pipeline: Pipeline, place: int, payload_bytes: int, times_ms: Mapping[str, float]) -> dict[str, Any]:
    """Return the keys of the stage at `place`, whose slots have `payload_bytes`."""
    stage = pipeline.stages[place]
    keys: dict[str, Any] = {"python": stage.factory, "unit": stage.unit}
    if reads := _reads(pipeline, place):
        keys["in"] = reads
    if payload_bytes:
        keys["out"] = f"u8 {payload_bytes}"
    if stage.every > 1:
        keys["every"] = stage.every
    if stage.name in times_ms:
        keys["time_ms"] = times_ms[stage.name]
    return keys


def _reads(pipeline: Pipeline, place: int) -> str | dict[str, Any] | None:
    """Return what the stage at `place` reads: the stage before it in a chain, else a table by the stages' names."""
    stage: PipelineStage = pipeline.stages[place]
    if stage.inputs is None:
        return pipeline.stages[place - 1].name if place else None
    reads: dict[str, Any] = {}
    for each in stage.inputs:
        reads[each.stage] = each.stage
        if each.latest:
            age = {"max_age_ms": each.max_age_ms} if each.max_age_ms else {}
            reads[each.stage] = {"from": each.stage, "sync": "latest", **age}
    return reads or None


def unsaid(pipeline: Pipeline) -> Iterator[str]:
    """Yield what a pipeline file cannot say of the pipeline, each as a sentence."""
    yield NOT_RUN
    own = max((edge.header.itemsize for edge in pipeline.edges), default=0)
    if own > header_dtype().itemsize:
        yield f"every slot also has a header of {own} bytes: not in this file"
    held = {stage.name: stage.pace_ns for stage in pipeline.stages if stage.pace_ns}
    if held:
        yield f"jobs are held to a least time: {', '.join(f'{name} {ns / 1e6:g} ms' for name, ns in held.items())}"


def file_text(tables: Mapping[str, Any], comments: Sequence[str] = ()) -> str:
    """Return the tables as TOML: a line for each key, and for each stage. `comments`: lines before them.

    Keys are names of stages and of units, whose letters need no quotes.
    """
    lines = [f"# {each}" for each in comments]
    for name, table in tables.items():
        lines.append(f"[{name}]")
        lines += [f"{key} = {_value(value)}" for key, value in table.items()]
    return "\n".join(lines) + "\n"


def _value(value: object) -> str:
    if isinstance(value, Mapping):
        return "{ " + ", ".join(f"{key} = {_value(each)}" for key, each in value.items()) + " }"
    return json.dumps(value, ensure_ascii=False)
