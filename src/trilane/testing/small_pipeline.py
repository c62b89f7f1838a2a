"""A pipeline of three stages on two units, which no process runs. Rule: every number in it has a value of its own."""

from __future__ import annotations

from typing import Any

import numpy as np

from trilane.pipeline.description import Pipeline, PipelineEdge, PipelineStage, UnitSettings
from trilane.pipeline.regions import EdgeRegion
from trilane.pipeline.unit_spec import UnitSpec
from trilane.transport.messages import JobPipeEnd
from trilane.transport.packets import Packet, SlotLayout, header_dtype, view_packet

#: The header of the first edge's packets.
OWN = header_dtype([("own", "<u2")])
UNITS = {"left": UnitSettings(cores=(1, 0), threads=2), "right": UnitSettings(cores=(3, 1), threads=1, spin=True)}
STAGES = tuple(
    PipelineStage(name=name, unit=unit, factory="json:loads", pace_ns=pace)
    for name, unit, pace in (("in", "left", 0), ("mid", "right", 5), ("out", "left", 0))
)
EDGES = (PipelineEdge(payload_bytes=100, header=OWN, rule="single"), PipelineEdge(payload_bytes=5000, rule="fifo:3"))


def pipeline(**changes: Any) -> Pipeline:
    """The pipeline with `changes`. Raises BadInputError for those that do not fit."""
    return Pipeline(**{"stages": STAGES, "edges": EDGES, "units": UNITS, **changes})


def spec_of(**changes: Any) -> UnitSpec:
    """What the process of the unit `right` is told, with `changes`; its descriptors are 10 to 14."""
    values: dict[str, Any] = {
        "unit": "right",
        "endpoint": "ipc://none",
        "job_pipe": JobPipeEnd(10, 11),
        "assets_fd": 12,
        "settings": UNITS["right"],
        "scheduler_cores": (1, 0),
        "run_cores": (0, 1, 3),
        "stages": (STAGES[1],),
        "module_folders": (),
        "edges": {
            "in->mid": EdgeRegion(fd=13, slots=1, header=OWN, payload_bytes=100),
            "mid->out": EdgeRegion(fd=14, slots=3, header=header_dtype(), payload_bytes=5000),
        },
        "inputs": {"mid": ("in->mid",)},
        "outputs": {"mid": "mid->out"},
    }
    return UnitSpec(**{**values, **changes})


def packets(header: np.dtype[Any], count: int) -> list[Packet]:
    """`count` slots of 8 bytes in this process's own memory."""
    layout = SlotLayout(header, 8)
    return [view_packet(memoryview(bytearray(layout.slot_bytes)), layout) for _ in range(count)]
