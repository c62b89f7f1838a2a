"""Stages of a graph for tests with real processes: each writes a whole number, so that a test knows every value.

`settings`: `op`, and what the op needs. `log`: file to which the stage writes a line for each job, if given.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from trilane.pipeline.description import Pipeline, PipelineEdge, PipelineStage, StageInput, UnitSettings
from trilane.pipeline.stage import UnitContext
from trilane.transport.packets import Packet

MODULE = "support.graph_stages"
#: What each op writes, from the frame and the values that it read.
OPS: dict[str, Any] = {
    "frame": lambda frame, _read: frame,
    "twice": lambda _frame, read: 2 * read[0],
    "plus": lambda _frame, read: read[0] + 1000,
    "sum": lambda _frame, read: sum(value for value in read if value is not None),
}


class Number:
    def __init__(self, settings: Mapping[str, Any]) -> None:
        self._op, self._ms = OPS[settings["op"]], settings.get("ms", 0)
        self._log = Path(settings["log"]) if "log" in settings else None
        self._joins = settings["joins"]

    def bind(self, inputs: Sequence[Any], outputs: Sequence[Packet]) -> None:
        self._inputs, self._outputs = inputs, outputs

    def run(self, frame: int, slot_in: Any, slot_out: int | None) -> Mapping[str, float]:
        time.sleep(self._ms / 1e3)
        if self._joins:
            packets = [None if slot is None else of[slot] for of, slot in zip(self._inputs, slot_in, strict=True)]
        else:
            packets = [] if slot_in is None else [self._inputs[slot_in]]
        value = self._op(frame, [None if packet is None else int(packet.payload.view("<i8")[0]) for packet in packets])
        if slot_out is not None:
            self._outputs[slot_out].payload.view("<i8")[0] = value
        if self._log is not None:
            told = [-1 if packet is None else int(packet.header["frame"]) for packet in packets]
            with self._log.open("a") as file:
                file.write(f"{frame} {value} {' '.join(map(str, told))}\n")
        return {}

    def close(self) -> None:
        """Hold nothing."""


def number(settings: Mapping[str, Any], _unit: UnitContext) -> Number:
    return Number(settings)


def stage(name: str, unit: str, op: str, *inputs: str | StageInput, every: int = 1, **settings: Any) -> PipelineStage:
    """A stage that reads other stages."""
    read = tuple(StageInput(stage=each) if isinstance(each, str) else each for each in inputs)
    joins = len(read) > 1 or any(each.latest for each in read)
    values = {"op": op, "joins": joins, **settings}
    return PipelineStage(name=name, unit=unit, factory=f"{MODULE}:number", settings=values, inputs=read, every=every)


def graph(*stages: PipelineStage, rule: str = "double", **more: Any) -> Pipeline:
    """A pipeline of `stages`; its units have core 0."""
    edges = {each.stage for made in stages for each in made.inputs or ()}
    units = {made.unit: UnitSettings(cores=(0,), threads=1) for made in stages}
    edge = PipelineEdge(payload_bytes=8, rule=rule)
    return Pipeline(stages=stages, edges=(edge,) * len(edges), units=units, **more)
