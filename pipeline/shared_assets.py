"""Shares arrays of the parent with every unit of a run. Rule: written once, sealed, mapped, never copied.

One region of anonymous memory holds them all. It begins with 8 bytes for the length of the index, then the index as
JSON, then the arrays, each on its own page. A unit maps it read-only. The kernel frees it when the last process that
has it ends.
"""

from __future__ import annotations

import fcntl
import json
import mmap
import os
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from trilane import machine
from trilane.errors import TrilaneError, reason
from trilane.transport.packets import F_ADD_SEALS, F_SEAL_GROW, F_SEAL_SHRINK, PAGE

Assets = Mapping[str, NDArray[Any]]

F_SEAL_WRITE = 0x8  # <linux/fcntl.h>
LENGTH_BYTES = 8
KINDS = "?biufcmMSU"  # kinds of NumPy types that consist of their bytes alone


def share_assets(assets: Assets) -> int:
    """Return a descriptor of sealed memory that holds `assets`.

    Raises TrilaneError when there is too little memory, and for arrays of another kind than numbers, times and text.
    """
    index, end = _index(assets)
    free = machine.here.free_bytes()
    if end > free:
        raise TrilaneError(f"assets: found {end >> 20} MiB, expected at most {free >> 20} MiB, which are free")
    head = json.dumps(index).encode()
    start = _page_up(LENGTH_BYTES + len(head))
    fd = os.memfd_create("trilane:assets", os.MFD_CLOEXEC | os.MFD_ALLOW_SEALING)
    try:
        os.posix_fallocate(fd, 0, start + end)
        os.pwrite(fd, len(head).to_bytes(LENGTH_BYTES, "little") + head, 0)
        for name, array in assets.items():
            _write_all(fd, np.ascontiguousarray(array), start + index[name]["offset"])
        # Sealed, so that no unit can change what another one reads.
        fcntl.fcntl(fd, F_ADD_SEALS, F_SEAL_SHRINK | F_SEAL_GROW | F_SEAL_WRITE)
    except OSError as error:
        os.close(fd)
        raise TrilaneError(f"assets: no room for {(start + end) >> 20} MiB: {reason(error)}") from None
    return fd


def map_assets(fd: int) -> dict[str, NDArray[Any]]:
    """Return read-only views of the arrays in `fd`, in the order in which they were given."""
    view = memoryview(mmap.mmap(fd, os.fstat(fd).st_size, prot=mmap.PROT_READ))
    length = int.from_bytes(view[:LENGTH_BYTES], "little")
    index: dict[str, Any] = json.loads(bytes(view[LENGTH_BYTES : LENGTH_BYTES + length]))
    start = _page_up(LENGTH_BYTES + length)
    return {
        name: np.frombuffer(
            view, dtype=np.dtype(entry["dtype"]), count=int(np.prod(entry["shape"])), offset=start + entry["offset"]
        ).reshape(entry["shape"])
        for name, entry in index.items()
    }


def _index(assets: Assets) -> tuple[dict[str, dict[str, Any]], int]:
    """Return type, shape and place of every array, and the end of the last one.

    Places count from the first page after the index.
    """
    index, offset = {}, 0
    for name, array in assets.items():
        if array.dtype.kind not in KINDS:
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
