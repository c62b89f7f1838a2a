"""Lays out the packets that pass between stages, and the shared memory that they live in.

One slot holds one header, then the payload; stages get views of a slot, never copies. Every header begins with
`FRAME_FIELDS`, which the unit's loop fills in; the pipeline defines the other fields. Everything that a later stage
needs to know about a frame travels in the frame's packet; no stage asks another stage.

Each edge has one region of memory without a name (memfd), of a fixed size. The parent makes the regions and keeps their
descriptors; child processes inherit the descriptors and map the regions. The kernel frees a region when the last
process that has the region ends, even by a crash.
"""

from __future__ import annotations

import fcntl
import mmap
import os
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from trilane import machine
from trilane.arrays import U8
from trilane.errors import TrilaneError, reason

PAGE = 4096
#: `frame`: number of the frame, from 0. `t_sampled_ns`: time on CLOCK_MONOTONIC at which the frame's input was sampled;
#: the latency begins then. `epoch`: epoch of the slot's edge (`trilane.transport.slots`).
FRAME_FIELDS = (("frame", "<u8"), ("t_sampled_ns", "<i8"), ("epoch", "<u4"))


def header_dtype(fields: Sequence[tuple[Any, ...]] = ()) -> np.dtype[Any]:
    """Return the dtype of a header: `FRAME_FIELDS`, then `fields`, each as `numpy.dtype` takes it."""
    return np.dtype([*FRAME_FIELDS, *fields], align=True)


@dataclass(frozen=True)
class SlotLayout:
    """The layout of one slot: a header, then a payload of `payload_bytes` bytes, each rounded up to whole pages."""

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
    """Return views of a slot's memory, without a copy; raises ValueError when `buffer` is shorter than the layout."""
    if len(buffer) < layout.slot_bytes:
        raise ValueError(f"slot of {len(buffer)} bytes, the layout needs {layout.slot_bytes}")
    header = np.frombuffer(buffer, dtype=layout.header, count=1).reshape(())
    payload = np.frombuffer(buffer, dtype=np.uint8, count=layout.payload_bytes, offset=layout.header_bytes)
    return Packet(header, payload)


MIB = 1 << 20
MOST_NAME = 249  # bytes, of memfd_create(2)
#: From <linux/fcntl.h>; the fcntl module of Python 3.11 does not have all of them.
F_ADD_SEALS, F_SEAL_SHRINK, F_SEAL_GROW = 1033, 0x2, 0x4


@dataclass(frozen=True)
class RegionLayout:
    """The layout of an edge's memory: `slots` slots with the layout `slot`, one after the other."""

    slots: int
    slot: SlotLayout

    @property
    def total_bytes(self) -> int:
        return self.slots * self.slot.slot_bytes


def create_region(name: str, layout: RegionLayout) -> int:
    """Return a descriptor of new, zeroed shared memory for `layout`. `name` appears in /proc/PID/maps and nowhere else.

    All pages are reserved here. Otherwise a later write to a page could end the process by a signal, if memory is
    short. Raises TrilaneError when there is too little memory, or when too many files are open.
    """
    try:
        free = machine.here.free_bytes()
        if layout.total_bytes > free:
            raise TrilaneError(_too_little(name, layout, f"{free // MIB} MiB are free"))
        fd = os.memfd_create(f"trilane:{name}"[:MOST_NAME], os.MFD_CLOEXEC | os.MFD_ALLOW_SEALING)
    except OSError as error:
        raise TrilaneError(f"no memory for edge {name}: {reason(error)}") from None
    try:
        os.posix_fallocate(fd, 0, layout.total_bytes)
        fcntl.fcntl(fd, F_ADD_SEALS, F_SEAL_SHRINK | F_SEAL_GROW)
    except OSError as error:
        os.close(fd)
        raise TrilaneError(_too_little(name, layout, reason(error))) from None
    return fd


def map_region(fd: int, layout: RegionLayout) -> list[Packet]:
    """Map the region behind the descriptor `fd`, and return a view of every slot.

    The mapping lives as long as the views. Raises ValueError when the region is smaller than the layout.
    """
    region_bytes = os.fstat(fd).st_size
    if region_bytes < layout.total_bytes:
        raise ValueError(f"region of {region_bytes} bytes, the layout needs {layout.total_bytes}")
    view = memoryview(mmap.mmap(fd, layout.total_bytes))
    step = layout.slot.slot_bytes
    return [view_packet(view[index * step : (index + 1) * step], layout.slot) for index in range(layout.slots)]


def _too_little(name: str, layout: RegionLayout, why: str) -> str:
    return (
        f"edge {name} needs {layout.total_bytes // MIB} MiB of memory for {layout.slots} slots and {why}; "
        "lower the tensor or output size, or the number of slots"
    )
