"""Units for `bench handoff`: the raster stage fills its slot, the infer stage reads every byte of it.

Rule: the rest of the pipeline does nothing; what is measured is how a slot passes through the real processes.
"""

from __future__ import annotations

import os
import time
from collections.abc import Mapping, Sequence

import numpy as np

from trilane.errors import TrilaneError
from trilane.stages.config import RunConfig
from trilane.transport.packets import Packet

STAGES = {"cpu": ("pose", "present"), "gpu": ("raster", "composite"), "dsp": ("infer",)}
PAUSE_S = 0.001


class HandoffStage:
    """`trilane.pipeline.stage.Stage`."""

    def __init__(self, name: str) -> None:
        self._name = name

    def bind(self, inputs: Sequence[Packet], outputs: Sequence[Packet]) -> None:
        """Keep the slots."""
        self._inputs, self._outputs = inputs, outputs

    def run(self, frame: int, slot_in: int | None, slot_out: int | None) -> Mapping[str, float]:
        """`pose` pauses, `raster` writes, `infer` reads. Raises TrilaneError for wrong bytes."""
        if self._name == "pose":
            time.sleep(PAUSE_S)
        elif self._name == "raster" and slot_out is not None:
            self._outputs[slot_out].payload[:] = frame % 251
        elif self._name == "infer" and slot_in is not None:
            check_bytes(self._inputs[slot_in].payload, frame % 251)
        return {}

    def close(self) -> None:
        """Nothing is held."""


def check_bytes(payload: np.ndarray, value: int) -> None:
    """Read every byte. Raises TrilaneError when one is not `value`; the size is a multiple of 8."""
    words = payload.view(np.uint64)
    if int(words.sum(dtype=np.uint64)) != len(words) * value * 0x0101010101010101 % 2**64:
        raise TrilaneError(f"a slot of {payload.size} bytes holds others than were written")


def build(_config: RunConfig) -> dict[str, HandoffStage]:
    """The stages of the unit that runs here."""
    return {name: HandoffStage(name) for name in STAGES[os.environ["TRILANE_UNIT"]]}
