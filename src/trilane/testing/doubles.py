"""Mock stages of every unit. Rule: they spend the time that the environment says, and check what they are handed.

`TRILANE_MOCK` holds `stage=milliseconds` pairs separated by commas (default 1 ms each); `stage=raise` fails at frame
3, `stage=hang` never ends frame 3, `stage=badbuild` cannot be built. The payload of a frame is its number, repeated,
and each stage checks it, so that a slot used twice is seen.
"""

from __future__ import annotations

import os
import time
from collections.abc import Mapping, Sequence

import numpy as np

from trilane.errors import BadInputError
from trilane.stages.config import RunConfig
from trilane.transport.packets import Packet

STAGES = {"cpu": ("pose", "present"), "gpu": ("raster", "composite"), "dsp": ("infer",)}
BAD_FRAME = 3


class MockStage:
    """Spends `spend_ms` per frame by sleeping; passes the frame's number on in the payload."""

    def __init__(self, name: str, behaviour: str, log: str | None) -> None:
        self._name, self._behaviour = name, behaviour
        self._spend_s = 0.001 if behaviour in ("raise", "hang") else float(behaviour) / 1000
        self._log = open(log, "a", encoding="ascii") if log else None  # noqa: SIM115, PTH123 - closed in close()

    def bind(self, inputs: Sequence[Packet], outputs: Sequence[Packet]) -> None:
        self._inputs, self._outputs = inputs, outputs

    def run(self, frame: int, slot_in: int | None, slot_out: int | None) -> Mapping[str, float]:
        if self._behaviour == "raise" and frame == BAD_FRAME:
            raise BadInputError("mock.npz", "nothing", "something")
        time.sleep(3600 if self._behaviour == "hang" and frame == BAD_FRAME else self._spend_s)
        if slot_in is not None:
            self._check(self._inputs[slot_in], frame)
        if slot_out is not None:
            packet = self._outputs[slot_out]
            packet.payload[:64] = frame % 251
        if self._log is not None:
            self._log.write(f"{frame}\n")
        return {"frame": float(frame)}

    def close(self) -> None:
        if self._log is not None:
            self._log.close()

    def _check(self, packet: Packet, frame: int) -> None:
        if int(packet.header["frame"]) != frame:
            raise RuntimeError(f"header of frame {packet.header['frame']} for frame {frame}")
        if packet.payload.size and not np.all(packet.payload[:64] == frame % 251):
            raise RuntimeError(f"payload {packet.payload[:4]} for frame {frame}")


def build(config: RunConfig) -> dict[str, MockStage]:
    """The stages of the unit whose fake this is; the unit is known from the one that runs here."""
    unit = os.environ["TRILANE_UNIT"]
    spend = dict(part.split("=") for part in os.environ.get("TRILANE_MOCK", "").split(",") if part)
    if "badbuild" in (spend.get(name) for name in STAGES[unit]):
        raise BadInputError("mock.onnx", "nothing", "a network", "train one")
    log = str(config.out_dir / "presented.txt") if config.record else None
    return {name: MockStage(name, spend.get(name, "1"), log if name == "present" else None) for name in STAGES[unit]}
