"""Stages for `bench handoff`: the second fills its slot, the third reads every byte of it.

Rule: the others do nothing; what is measured is how a slot passes through the real processes.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from trilane.arrays import U8
from trilane.errors import TrilaneError
from trilane.hw_profiles.host import host_units
from trilane.pipeline.description import Pipeline, PipelineEdge, PipelineStage
from trilane.pipeline.stage import UnitContext
from trilane.transport.packets import Packet

FACTORY = "trilane.bench.lib.handoff_stages:build"
PAUSE_S = 0.001
WRITER, READER = "raster", "infer"
STAGES = (("pose", "cpu"), (WRITER, "gpu"), (READER, "dsp"), ("present", "cpu"))


class HandoffStage:
    """`trilane.pipeline.stage.Stage`; what it does follows from its name."""

    def __init__(self, name: str) -> None:
        self._name = name

    def bind(self, inputs: Sequence[Packet], outputs: Sequence[Packet]) -> None:
        """Keep the slots."""
        self._inputs, self._outputs = inputs, outputs

    def run(self, frame: int, slot_in: int | None, slot_out: int | None) -> Mapping[str, float]:
        """`pose` pauses, `raster` writes, `infer` reads. Raises TrilaneError for wrong bytes."""
        if self._name == STAGES[0][0]:
            time.sleep(PAUSE_S)
        elif self._name == WRITER and slot_out is not None:
            self._outputs[slot_out].payload[:] = frame % 251
        elif self._name == READER and slot_in is not None:
            check_bytes(self._inputs[slot_in].payload, frame % 251)
        return {}

    def close(self) -> None:
        """Nothing to release."""


def check_bytes(payload: U8, value: int) -> None:
    """Read every byte. Raises TrilaneError when one is not `value`; the size is a multiple of 8."""
    words = payload.view(np.uint64)
    if int(words.sum(dtype=np.uint64)) != len(words) * value * 0x0101010101010101 % 2**64:
        raise TrilaneError(f"a slot of {payload.size} bytes holds others than were written")


def build(settings: Mapping[str, Any], unit: UnitContext) -> HandoffStage:  # noqa: ARG001 - a factory's signature
    """The stage that `settings["name"]` says."""
    return HandoffStage(settings["name"])


def handoff_pipeline(payload_bytes: int) -> Pipeline:
    """A chain whose edge from the GPU unit to the DSP carries `payload_bytes`, and the others nothing."""
    sizes = [payload_bytes if before == WRITER else 0 for before, _ in STAGES[:-1]]
    return Pipeline(
        stages=tuple(
            PipelineStage(name=name, unit=unit, factory=FACTORY, settings={"name": name}) for name, unit in STAGES
        ),
        edges=tuple(PipelineEdge(payload_bytes=size) for size in sizes),
        units=host_units(),
    )
