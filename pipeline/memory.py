"""The memory that the units of a run share, for edges and assets, and counts of the bytes that move through it.

Rule: the parent process makes a region for each edge, and always closes it. Assets are written once, sealed, mapped,
and never copied.

One region of anonymous memory contains all assets. It begins with 8 bytes for the length of the index. The index as
JSON follows, and after it the arrays, each from the begin of a page. A unit maps the region read-only. The kernel frees
the region when the last process that has it ends.

A stage counts the bytes that it moves for a frame, and the least number of bytes that the frame needs. A byte counts at
each memory from which it is read or to which it is written. A copy from a slot to the GPU counts as read and as
uploaded; a copy back counts as read back and as written. Therefore the four counts add up to all bytes that passed
through the memories. A stage that copies nothing between its input and its output moves only its least.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import json
import mmap
import os
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from trilane import machine
from trilane.errors import TrilaneError, reason, remedy
from trilane.pipeline.description import HeaderDtype, Model, Pipeline
from trilane.transport.packets import (
    F_ADD_SEALS,
    F_SEAL_GROW,
    F_SEAL_SHRINK,
    PAGE,
    RegionLayout,
    SlotLayout,
    create_region,
)
from trilane.transport.slots import edge_rule


class EdgeRegion(Model):
    """The shared memory of an edge, which units map.

    `fd`: descriptor of the memory, which the units' processes inherit.
    `slots`: number of slots.
    `header`: dtype of every packet's header.
    `payload_bytes`: bytes of every packet's payload.
    """

    fd: int
    slots: int
    header: HeaderDtype
    payload_bytes: int

    @property
    def layout(self) -> RegionLayout:
        return RegionLayout(self.slots, SlotLayout(self.header, self.payload_bytes))


@contextlib.contextmanager
def edge_regions(pipeline: Pipeline) -> Iterator[dict[str, EdgeRegion]]:
    """Make a region of memory for each edge, and yield the regions by the edges' names; close them at the end.

    Raises TrilaneError if there is too little memory.
    """
    regions: dict[str, EdgeRegion] = {}
    try:
        for name, edge in zip(pipeline.edge_names, pipeline.edges, strict=True):
            slots = edge_rule(edge.rule).slots
            fd = create_region(name, RegionLayout(slots, SlotLayout(edge.header, edge.payload_bytes)))
            regions[name] = EdgeRegion(fd=fd, slots=slots, header=edge.header, payload_bytes=edge.payload_bytes)
        yield regions
    finally:
        for region in regions.values():
            os.close(region.fd)


Assets = Mapping[str, NDArray[Any]]

_F_SEAL_WRITE = 0x8  # <linux/fcntl.h>
_LENGTH_BYTES = 8
SEAL_TRIES, SEAL_PAUSE_S = 10, 0.05
_KINDS = "?biufcmMSU"  # kinds of NumPy types whose values contain no Python objects


def share_assets(assets: Assets) -> int:
    """Return a descriptor of sealed memory that holds `assets`.

    Raises TrilaneError if there is too little memory, or if an array contains anything but numbers, times and text.
    """
    index, end = _index(assets)
    try:
        free = machine.here.free_bytes()
        if end > free:
            raise TrilaneError(f"assets: found {end >> 20} MiB, expected at most {free >> 20} MiB, which are free")
        fd = os.memfd_create("trilane:assets", os.MFD_CLOEXEC | os.MFD_ALLOW_SEALING)
    except OSError as error:
        raise TrilaneError(f"no memory for assets: {reason(error)}") from None
    head = json.dumps(index).encode()
    start = _page_up(_LENGTH_BYTES + len(head))
    try:
        os.posix_fallocate(fd, 0, start + end)
        os.pwrite(fd, len(head).to_bytes(_LENGTH_BYTES, "little") + head, 0)
        for name, array in assets.items():
            _write_all(fd, np.ascontiguousarray(array), start + index[name]["offset"])
        _seal(fd)
    except OSError as error:
        os.close(fd)
        why = "; ".join(filter(None, (reason(error), remedy(error, ""))))
        raise TrilaneError(f"assets: no room for {(start + end) >> 20} MiB: {why}") from None
    return fd


def _seal(fd: int) -> None:
    """Seal the memory `fd`, so that no unit can change what another one reads. Raises OSError.

    Linux refuses to seal with EBUSY while it holds a page of the memory itself, for example to move the page
    (`memfd_wait_for_pins` in mm/memfd.c). Therefore the call is repeated for a while.
    """
    for left in reversed(range(SEAL_TRIES)):
        try:
            fcntl.fcntl(fd, F_ADD_SEALS, F_SEAL_SHRINK | F_SEAL_GROW | _F_SEAL_WRITE)
            return
        except OSError as error:
            if error.errno != errno.EBUSY or not left:
                raise
        time.sleep(SEAL_PAUSE_S)


def map_assets(fd: int) -> dict[str, NDArray[Any]]:
    """Return read-only views of the assets by name. `fd`: descriptor from `share_assets`."""
    view = memoryview(mmap.mmap(fd, os.fstat(fd).st_size, prot=mmap.PROT_READ))
    length = int.from_bytes(view[:_LENGTH_BYTES], "little")
    index: dict[str, Any] = json.loads(bytes(view[_LENGTH_BYTES : _LENGTH_BYTES + length]))
    start = _page_up(_LENGTH_BYTES + length)
    return {
        name: np.frombuffer(
            view, dtype=np.dtype(entry["dtype"]), count=int(np.prod(entry["shape"])), offset=start + entry["offset"]
        ).reshape(entry["shape"])
        for name, entry in index.items()
    }


def _index(assets: Assets) -> tuple[dict[str, dict[str, Any]], int]:
    """Return (`dtype`, `shape` and `offset` in bytes of each array, by its name; end of the last array in bytes).

    Offsets count from the first page after the index.
    """
    index, offset = {}, 0
    for name, array in assets.items():
        if array.dtype.kind not in _KINDS:
            raise TrilaneError(f"assets: found {name} of type {array.dtype}, expected numbers, times or text")
        index[name] = {"dtype": array.dtype.str, "shape": list(array.shape), "offset": offset}
        offset += _page_up(array.nbytes)
    return index, max(offset, PAGE)


def _page_up(size: int) -> int:
    return -(-size // PAGE) * PAGE


def _write_all(fd: int, array: NDArray[Any], offset: int) -> None:
    data = memoryview(array.reshape(-1).view(np.uint8).data) if array.nbytes else memoryview(b"")
    while data:
        written = os.pwrite(fd, data, offset)
        data, offset = data[written:], offset + written


#: Name of the metric with which a stage reports each count, by the count's key in report.json.
NAMES = {
    "read": "bytes_read",
    "written": "bytes_written",
    "uploaded": "bytes_uploaded",
    "read_back": "bytes_read_back",
    "least": "bytes_least",
}
BYTES = frozenset(NAMES.values())
_LEAST = "least"


@dataclass(slots=True)
class ByteCounter:
    """The bytes that a stage moves for one frame.

    `read`: bytes read from slots, shared assets and samples.
    `written`: bytes written into the output slot or the file.
    `uploaded`: bytes moved from the CPU's memory into the GPU's.
    `read_back`: bytes moved from the GPU's memory into the CPU's.
    `least`: bytes that the frame needs. They are the part of the input on which the frame depends, read once, and the
    output, written once.
    """

    read: int = 0
    written: int = 0
    uploaded: int = 0
    read_back: int = 0
    least: int = 0

    def start(self, passed_on: int = 0) -> None:
        """Begin a frame. `passed_on`: bytes of the header that is copied from input to output slot; 0: no header is."""
        self.read = self.written = passed_on
        self.uploaded = self.read_back = self.least = 0

    def copied(self, count: int) -> None:
        """Count `count` bytes that were read from one slot and written to another."""
        self.read += count
        self.written += count

    def figures(self) -> dict[str, float]:
        """Return the counts as metrics of the stage's job, by the metrics' names in `NAMES`."""
        return {
            "bytes_read": self.read,
            "bytes_written": self.written,
            "bytes_uploaded": self.uploaded,
            "bytes_read_back": self.read_back,
            "bytes_least": self.least,
        }


def add_bytes(report: dict[str, Any], sums: Mapping[str, Mapping[str, float]]) -> None:
    """Add `bytes` to each stage of a report, and to the report: mean bytes moved for a presented frame.

    A stage without a job moved nothing. A stage whose jobs do not count bytes gets no `bytes`. If no frame was
    presented, or no stage counts bytes, nothing is added.

    `report`: keys of report.json.
    `sums`: sums of each stage's metrics over its jobs, by stage and metric.
    """
    frames = report["frames"]["presented"]
    counted = {stage: row for stage, row in sums.items() if row.keys() >= BYTES}
    if not frames or not counted:
        return
    nothing = dict.fromkeys(BYTES, 0.0)
    for stage, row in report["stages"].items():
        if stage in counted or not row["jobs"]:
            row["bytes"] = _per_frame(counted.get(stage, nothing), frames)
    total = {name: sum(row[name] for row in counted.values()) for name in BYTES}
    seconds = report["duration_s"]
    report["bytes"] = {**_per_frame(total, frames), "gb_per_second": _moved(total) / 1e9 / seconds if seconds else None}


def _per_frame(sums: Mapping[str, float], frames: int) -> dict[str, float | None]:
    """Return the mean bytes per frame by the keys of `NAMES`, and `ratio`: all moved bytes over the least, or None."""
    least = sums[NAMES[_LEAST]]
    means = {key: sums[name] / frames for key, name in NAMES.items()}
    return {**means, "ratio": _moved(sums) / least if least else None}


def _moved(sums: Mapping[str, float]) -> float:
    return sum(sums[name] for key, name in NAMES.items() if key != _LEAST)
