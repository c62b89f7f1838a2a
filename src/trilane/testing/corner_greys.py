"""A last stage in place of `present` that keeps no video: of each frame it notes the mean of a corner, exactly.

Rule: what it notes is what the slot holds; a video would lose some of it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from trilane.pipeline.stage import UnitContext
from trilane.transport.packets import Packet

SIDE = 8  # pixels


class CornerGreys:
    """Appends a line `frame mean` to `log`, of the upper left corner of pictures that are `width` pixels wide."""

    def __init__(self, log: str, width: int) -> None:
        self._log = open(log, "a", buffering=1, encoding="ascii")  # noqa: SIM115, PTH123 - closed in close()
        self._width = width

    def bind(self, inputs: Sequence[Packet], outputs: Sequence[Packet]) -> None:  # noqa: ARG002 - a last stage has none
        self._rows = [packet.payload[: SIDE * self._width * 3].reshape(SIDE, self._width, 3) for packet in inputs]

    def run(self, frame: int, slot_in: int | None, slot_out: int | None) -> Mapping[str, float]:  # noqa: ARG002
        assert slot_in is not None
        self._log.write(f"{frame} {float(self._rows[slot_in][:, :SIDE].mean())}\n")
        return {}

    def close(self) -> None:
        self._log.close()


def build(settings: Mapping[str, Any], unit: UnitContext) -> CornerGreys:  # noqa: ARG001 - a factory's signature
    """The stage that `settings` describe: `log` and `width`."""
    return CornerGreys(settings["log"], settings["width"])
