"""Things for tests that start no process: a pipeline, its packets and assets, a stage and a clock.

The pipeline has three stages on two units. Rule: every number in it has a value of its own.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from trilane.avatars.bundle import load_bundle
from trilane.pipeline.description import Pipeline, PipelineEdge, PipelineStage, UnitSettings
from trilane.pipeline.memory import BYTES, EdgeRegion
from trilane.pipeline.unit_loop import UnitSpec
from trilane.scene.staging import stage_scene
from trilane.stages.avatar_assets import distinct, load_avatar, pack_assets
from trilane.stages.config import RunConfig, pose_dtype
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


def packets(header: np.dtype[Any], count: int, payload_bytes: int = 8) -> list[Packet]:
    """`count` slots of zeros in this process's own memory."""
    layout = SlotLayout(header, payload_bytes)
    return [view_packet(memoryview(bytearray(layout.slot_bytes)), layout) for _ in range(count)]


def packet(payload_bytes: int, avatars: int = 1) -> Packet:
    """A slot of zeros that tells the pose of `avatars`."""
    return packets(pose_dtype(avatars), 1, payload_bytes)[0]


def assets_of(config: RunConfig) -> dict[str, NDArray[Any]]:
    """The arrays that a run of `config` hands to its units, packed by the same functions. Raises BadInputError."""
    avatars = {folder: load_avatar(load_bundle(folder)) for folder in distinct(config)}
    staged = stage_scene(config.scene, [avatars[folder].shaped for folder in config.avatar_dirs], Path.cwd())
    return pack_assets(list(avatars.values()), staged)


def without_bytes(figures: Mapping[str, float]) -> dict[str, float]:
    """`figures` of a job but the bytes that it moved."""
    return {name: value for name, value in figures.items() if name not in BYTES}


class FakeStage:
    """A stage that notes what it is asked, and raises `error` when it runs and when it closes."""

    def __init__(self, error: Exception | None = None) -> None:
        self.error = error
        self.runs: list[Any] = []
        self.bound: Any = None
        self.closed = False

    def bind(self, inputs: Sequence[Packet], outputs: Sequence[Packet]) -> None:
        self.bound = (inputs, outputs)

    def run(self, frame: int, slot_in: int | None, slot_out: int | None) -> Mapping[str, float]:
        self.runs.append((frame, slot_in, slot_out))
        if self.error is not None:
            raise self.error
        return {"shade": 3}

    def close(self) -> None:
        self.closed = True
        if self.error is not None:
            raise self.error


BEGIN_NS = 5_000_000


class ToldTime:
    """A double of the module `time`: time passes by what is slept, and a microsecond with every look.

    `now_ns`: of the clock.
    `slept`: ns of each sleep.
    """

    def __init__(self) -> None:
        self.now_ns = BEGIN_NS
        self.slept: list[int] = []

    def monotonic_ns(self) -> int:
        self.now_ns += 1000
        return self.now_ns

    def monotonic(self) -> float:
        return self.monotonic_ns() / 1e9

    def sleep(self, seconds: float) -> None:
        self.slept.append(round(seconds * 1e9))
        self.now_ns += round(seconds * 1e9)
