"""The memory that packets live in. Rule: no name anywhere (memfd), one region per edge, its size sealed.

The parent makes the regions and keeps their descriptors; children inherit and map them. A region is gone with the
last process that has it, whatever ends that process.
"""

from __future__ import annotations

import fcntl
import mmap
import os
from dataclasses import dataclass

import psutil

from trilane.errors import TrilaneError, reason
from trilane.transport.packets import Packet, SlotLayout, view_packet

MIB = 1 << 20
F_ADD_SEALS, F_SEAL_SHRINK, F_SEAL_GROW = 1033, 0x2, 0x4  # <linux/fcntl.h>; the fcntl module of Python 3.11 lacks some


@dataclass(frozen=True)
class RegionLayout:
    """The slots of one edge, one after the other."""

    slots: int
    slot: SlotLayout

    @property
    def total_bytes(self) -> int:
        return self.slots * self.slot.slot_bytes


def create_region(name: str, layout: RegionLayout) -> int:
    """A descriptor of fresh, zeroed shared memory (`name` is for humans: it shows in /proc/PID/maps only).

    Every page is reserved here, so that a machine without memory says so now and not by a signal in a later write.
    Raises TrilaneError when there is too little.
    """
    free = psutil.virtual_memory().available
    if layout.total_bytes > free:
        raise TrilaneError(_too_little(name, layout, f"{free // MIB} MiB are free"))
    fd = os.memfd_create(f"trilane:{name}", os.MFD_CLOEXEC | os.MFD_ALLOW_SEALING)
    try:
        os.posix_fallocate(fd, 0, layout.total_bytes)
        fcntl.fcntl(fd, F_ADD_SEALS, F_SEAL_SHRINK | F_SEAL_GROW)
    except OSError as error:
        os.close(fd)
        raise TrilaneError(_too_little(name, layout, reason(error))) from None
    return fd


def map_region(fd: int, layout: RegionLayout) -> list[Packet]:
    """Views of every slot of the region; the mapping lives as long as they do.

    Raises ValueError when the region is smaller than the layout.
    """
    found = os.fstat(fd).st_size
    if found < layout.total_bytes:
        raise ValueError(f"region of {found} bytes, the layout needs {layout.total_bytes}")
    view = memoryview(mmap.mmap(fd, layout.total_bytes))
    step = layout.slot.slot_bytes
    return [view_packet(view[index * step : (index + 1) * step], layout.slot) for index in range(layout.slots)]


def _too_little(name: str, layout: RegionLayout, why: str) -> str:
    return (
        f"edge {name} needs {layout.total_bytes // MIB} MiB of memory for {layout.slots} slots and {why}; "
        "lower the tensor or output size, or the number of slots"
    )
