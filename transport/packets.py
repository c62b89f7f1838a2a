"""The packets that pass between stages: one slot = one header, then the payload. Rule: views of a slot, never copies.

Every header begins with `FRAME_FIELDS`, which the unit's loop fills in; the other fields are the pipeline's own.
Everything that a later stage needs to know about a frame travels in its packet; no stage asks another.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from trilane.arrays import U8

PAGE = 4096
#: `frame`: number from 0. `t_sampled_ns`: CLOCK_MONOTONIC, when the frame's input was sampled: latency begins there.
#: `epoch`: of the slot, see `trilane.transport.slots`.
FRAME_FIELDS = (("frame", "<u8"), ("t_sampled_ns", "<i8"), ("epoch", "<u4"))


def header_dtype(fields: Sequence[tuple[Any, ...]] = ()) -> np.dtype[Any]:
    """The layout of a header: `FRAME_FIELDS`, then `fields` as `numpy.dtype` takes them."""
    return np.dtype([*FRAME_FIELDS, *fields], align=True)


@dataclass(frozen=True)
class SlotLayout:
    """Bytes of one slot: the header rounded up to a page, then `payload_bytes`, rounded up likewise."""

    header: np.dtype[Any]
    payload_bytes: int

    @property
    def header_bytes(self) -> int:
        return -(-self.header.itemsize // PAGE) * PAGE

    @property
    def slot_bytes(self) -> int:
        return self.header_bytes + -(-self.payload_bytes // PAGE) * PAGE


@dataclass(frozen=True)
class Packet:
    """A view of one slot. `header`: 0-d structured array. `payload`: (payload_bytes,) uint8."""

    header: NDArray[np.void]
    payload: U8


def view_packet(buffer: memoryview, layout: SlotLayout) -> Packet:
    """Views of a slot's memory, without a copy. Raises ValueError when `buffer` is shorter than the layout."""
    if len(buffer) < layout.slot_bytes:
        raise ValueError(f"slot of {len(buffer)} bytes, the layout needs {layout.slot_bytes}")
    header = np.frombuffer(buffer, dtype=layout.header, count=1).reshape(())
    payload = np.frombuffer(buffer, dtype=np.uint8, count=layout.payload_bytes, offset=layout.header_bytes)
    return Packet(header, payload)
