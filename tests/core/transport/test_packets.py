"""The memory of an edge: where headers and payloads lie, who sees them, and what is refused."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import psutil
import pytest

from trilane import machine
from trilane.errors import TrilaneError
from trilane.transport.packets import RegionLayout, SlotLayout, create_region, header_dtype, map_region, view_packet

PAGE = 4096
MIB = 1 << 20


@pytest.mark.parametrize(("payload", "slot_bytes"), [(0, 1), (1, 2), (4095, 2), (4096, 2), (4097, 3), (40_960, 11)])
def test_a_slot_is_a_page_of_header_and_whole_pages_of_payload(payload: int, slot_bytes: int) -> None:
    layout = SlotLayout(header_dtype(), payload)
    assert (layout.header_bytes, layout.slot_bytes) == (PAGE, slot_bytes * PAGE)
    assert RegionLayout(5, layout).total_bytes == 5 * slot_bytes * PAGE


def test_a_header_of_more_than_a_page_takes_two() -> None:
    layout = SlotLayout(header_dtype([("matrix", "<f8", (512,))]), 1)
    assert (layout.header_bytes, layout.slot_bytes) == (2 * PAGE, 3 * PAGE)


def test_the_fields_of_a_header_are_aligned() -> None:
    """8 + 8 + 4 bytes of the frame's fields, 2 of `own`, 2 of nothing, 8 of `wide`."""
    header = header_dtype([("own", "<u2"), ("wide", "<f8")])
    assert header.names is not None
    assert [header.fields[name][1] for name in header.names] == [0, 8, 16, 20, 24]
    assert header.itemsize == 32


def test_a_packet_shows_the_bytes_of_its_slot_and_no_others() -> None:
    """Header: frame as 8 bytes, sampling time as 8, epoch as 4, then what is the pipeline's own; payload: a page on."""
    layout = SlotLayout(header_dtype([("own", "<u2")]), 10)
    memory_of_slot = bytearray(2 * PAGE + 5)
    packet = view_packet(memoryview(memory_of_slot), layout)
    packet.header["frame"], packet.header["t_sampled_ns"] = 2**63, -5
    packet.header["epoch"], packet.header["own"] = 7, 515
    packet.payload[:] = range(1, 11)
    start = (2**63).to_bytes(8, "little") + (-5).to_bytes(8, "little", signed=True) + b"\7\0\0\0" + b"\3\2"
    assert memory_of_slot[: len(start)] == start
    assert memory_of_slot[PAGE : PAGE + 12] == bytes([*range(1, 11), 0, 0])
    assert (packet.header.shape, packet.payload.shape, packet.payload.dtype) == ((), (10,), np.uint8)
    with pytest.raises(ValueError, match=r"^slot of 8191 bytes, the layout needs 8192"):
        view_packet(memoryview(memory_of_slot)[: 2 * PAGE - 1], layout)


def test_layouts_and_packets_do_not_change() -> None:
    layout = SlotLayout(header_dtype(), 1)
    packet = view_packet(memoryview(bytearray(layout.slot_bytes)), layout)
    for thing, name in ((layout, "payload_bytes"), (packet, "header"), (RegionLayout(1, layout), "slots")):
        with pytest.raises(AttributeError, match="cannot assign"):
            setattr(thing, name, None)


def test_a_region_is_as_long_as_its_slots_stays_so_and_two_maps_show_the_same() -> None:
    layout = RegionLayout(3, SlotLayout(header_dtype(), PAGE))
    fd = create_region("edge", layout)
    try:
        assert os.fstat(fd).st_size == 6 * PAGE
        assert not os.get_inheritable(fd)
        assert str(Path(f"/proc/self/fd/{fd}").readlink()).startswith("/memfd:trilane:edge")
        for size in (6 * PAGE - 1, 6 * PAGE + 1):
            with pytest.raises(PermissionError):
                os.ftruncate(fd, size)
        first, second = map_region(fd, layout), map_region(fd, layout)
        assert not any(packet.payload.any() for packet in first)
        for index, packet in enumerate(first):
            packet.header["frame"], packet.payload[:] = index, index + 5
        for index, packet in enumerate(second):
            assert packet.header["frame"] == index and (packet.payload == index + 5).all()
        assert (os.pread(fd, 1, 3 * PAGE), os.pread(fd, 1, 4 * PAGE)) == (b"\6", b"\2")
        with pytest.raises(ValueError, match=rf"^region of {6 * PAGE} bytes, the layout needs {8 * PAGE}"):
            map_region(fd, RegionLayout(4, layout.slot))
    finally:
        os.close(fd)


def test_memory_that_is_just_there_is_taken_and_a_byte_more_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    layout = RegionLayout(2, SlotLayout(header_dtype(), MIB - PAGE))
    said = (
        r"^edge pose->raster needs 2 MiB of memory for 2 slots and 1 MiB are free; "
        "lower the tensor or output size, or the number of slots$"
    )
    monkeypatch.setattr(machine.here, "free_bytes", lambda: 2 * MIB)
    os.close(create_region("pose->raster", layout))
    monkeypatch.setattr(machine.here, "free_bytes", lambda: 2 * MIB - 1)
    with pytest.raises(TrilaneError, match=said):
        create_region("pose->raster", layout)


@pytest.mark.parametrize("call", ["os.memfd_create", "psutil.virtual_memory"])
def test_too_many_open_files_are_told(call: str, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object) -> None:
        raise OSError(24, "Too many open files")

    monkeypatch.setattr(call, full)
    with pytest.raises(TrilaneError, match=r"^no memory for edge e: too many open files$"):
        create_region("e", RegionLayout(1, SlotLayout(header_dtype(), 1)))


def test_memory_that_cannot_be_reserved_leaves_no_file(monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: int) -> None:
        raise OSError(28, "No space left on device")

    before = psutil.Process().num_fds()
    monkeypatch.setattr(os, "posix_fallocate", full)
    with pytest.raises(TrilaneError, match="edge e needs 0 MiB of memory for 1 slots and no space left on device; "):
        create_region("e", RegionLayout(1, SlotLayout(header_dtype(), 1)))
    assert psutil.Process().num_fds() == before
