"""Arrays that every unit may read: the same values everywhere, and nobody can change them."""

from __future__ import annotations

import contextlib
import errno
import fcntl
import mmap
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from trilane import machine
from trilane.errors import TrilaneError
from trilane.pipeline import memory
from trilane.pipeline.memory import map_assets, share_assets

ASSETS: dict[str, NDArray[Any]] = {
    "weights": np.arange(5000, dtype=np.float32).reshape(50, 100),
    "one": np.array(3, dtype=np.int64),
    "none": np.zeros((0, 4), dtype=np.uint8),
    "turned": np.arange(12).reshape(3, 4).T,
    "names": np.array(["left", "right arm"]),
    "big end first": np.arange(3, dtype=">f8"),
}


def shared(assets: Mapping[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
    fd = share_assets(assets)
    try:
        return map_assets(fd)
    finally:
        os.close(fd)


def test_every_array_arrives_as_it_was_on_pages_of_its_own() -> None:
    arrived = shared(ASSETS)
    assert list(arrived) == list(ASSETS)
    for name, array in ASSETS.items():
        assert (arrived[name].dtype, arrived[name].shape) == (array.dtype, array.shape)
        assert np.array_equal(arrived[name], array)
        assert array.size == 0 or arrived[name].ctypes.data % mmap.PAGESIZE == 0


def test_nobody_can_write_to_them() -> None:
    with pytest.raises(ValueError, match="read-only"):
        shared(ASSETS)["weights"][0, 0] = 1
    fd = share_assets(ASSETS)
    try:
        for change in (
            lambda: mmap.mmap(fd, 4096, prot=mmap.PROT_READ | mmap.PROT_WRITE),
            lambda: os.pwrite(fd, b"x", 0),
            lambda: os.ftruncate(fd, 0),
        ):
            with pytest.raises(PermissionError):
                change()
    finally:
        os.close(fd)


def open_assets() -> list[str]:
    """Descriptors of shared assets in this process; other threads may close theirs meanwhile."""
    found = []
    for file in Path("/proc/self/fd").iterdir():
        with contextlib.suppress(FileNotFoundError):
            if "trilane:assets" in str(file.readlink()):
                found.append(file.name)
    return sorted(found)


@pytest.mark.parametrize("array", [np.array([{}]), np.zeros(2, [("a", "u1")]), np.zeros(2, "V3")])
def test_arrays_whose_bytes_do_not_say_what_they_are_are_refused(array: NDArray[Any]) -> None:
    before = open_assets()
    with pytest.raises(TrilaneError, match="expected numbers, times or text"):
        share_assets({"odd": array})
    assert open_assets() == before


@pytest.mark.parametrize(("free", "is_refused"), [(4096, False), (4095, True)])
def test_assets_that_fit_to_the_byte_are_taken(free: int, is_refused: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(machine.here, "free_bytes", lambda: free)
    if is_refused:
        with pytest.raises(TrilaneError, match=r"^assets: found 0 MiB, expected at most 0 MiB, which are free$"):
            share_assets({})
    else:
        os.close(share_assets({}))


def test_assets_that_find_no_room_leave_no_file(monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: int) -> None:
        raise OSError(28, "No space left on device")

    before = open_assets()
    monkeypatch.setattr(os, "posix_fallocate", full)
    with pytest.raises(TrilaneError, match=r"^assets: no room for 3 MiB: no space left on device$"):
        share_assets({"a": np.zeros(3 << 20, np.uint8)})
    assert open_assets() == before


@pytest.mark.parametrize(
    ("refusals", "is_sealed"), [(0, True), (memory.SEAL_TRIES - 1, True), (memory.SEAL_TRIES, False)]
)
def test_a_page_that_the_kernel_holds_for_a_moment_does_not_end_the_run(
    refusals: int, is_sealed: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    real, calls = fcntl.fcntl, iter(range(refusals))

    def sometimes_busy(fd: int, command: int, argument: int) -> int:
        if next(calls, None) is not None:
            raise OSError(errno.EBUSY, "busy")
        return real(fd, command, argument)

    monkeypatch.setattr(fcntl, "fcntl", sometimes_busy)
    monkeypatch.setattr(memory, "SEAL_PAUSE_S", 0.0)
    if not is_sealed:
        with pytest.raises(TrilaneError, match="no room"):
            share_assets({"a": np.zeros(3)})
        return
    fd = share_assets({"a": np.zeros(3)})
    with pytest.raises(PermissionError):
        os.pwrite(fd, b"x", 0)
    os.close(fd)


def test_too_many_open_files_are_told(monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object) -> None:
        raise OSError(errno.EMFILE, "Too many open files")

    monkeypatch.setattr(os, "memfd_create", full)
    with pytest.raises(TrilaneError, match=r"^no memory for assets: too many open files$"):
        share_assets({"a": np.zeros(3)})
