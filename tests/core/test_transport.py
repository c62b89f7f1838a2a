"""Messages, memory and the bus: what is refused, and what is left."""

from __future__ import annotations

import contextlib
import os
from pathlib import Path

import msgpack
import numpy as np
import pytest
import zmq
from hypothesis import given
from hypothesis import strategies as st

from trilane.errors import TrilaneError
from trilane.stages.contracts import SlotLayout
from trilane.transport.bus import LOCK, BusFolder, Link, sweep
from trilane.transport.memory import RegionLayout, create_region, map_region
from trilane.transport.messages import (
    Alive,
    Close,
    Closed,
    Done,
    Duration,
    Failed,
    Isolate,
    MessageError,
    Ready,
    RunJob,
    pack,
    unpack,
)
from trilane.transport.wakeup import DEFAULT, SHORTEST_NS, use_slice

MESSAGES = [
    RunJob(1, "raster", 2, -1, 0, 3),
    Isolate("infer", 4, 0, 1),
    Close(),
    Ready(1234),
    Done(1, 2**62, 2**62 + 1, 0, {"encode_ms": 1.5}),
    Duration(2**40),
    Failed(-1, "what was found", 2),
    Alive(),
    Closed(),
]


@pytest.mark.parametrize("message", MESSAGES, ids=lambda message: type(message).__name__)
def test_a_message_arrives_as_it_was_sent(message: object) -> None:
    again = unpack(pack(message))
    assert again == message
    assert type(again) is type(message)


@pytest.mark.parametrize(
    "content",
    [
        None,
        [],
        {},
        ["Nothing"],
        [["Close"]],
        ["Close", 1],
        ["Ready"],
        ["Ready", "1"],
        ["Ready", True],
        ["Ready", 1.0],
        ["Duration", [1]],
        ["Done", 1, 2, 3, 4, {"a": "b"}],
        ["Done", 1, 2, 3, 4, {1: 2.0}],
    ],
)
def test_what_is_not_a_message_is_refused(content: object) -> None:
    with pytest.raises(MessageError):
        unpack(msgpack.packb(content))


@given(st.binary(max_size=200))
def test_any_bytes_are_a_message_or_refused(data: bytes) -> None:
    with contextlib.suppress(MessageError):
        assert pack(unpack(data))


@pytest.mark.parametrize("payload", [0, 1, 4096, 100_000])
def test_slots_of_a_region_are_apart_and_start_empty(payload: int) -> None:
    layout = RegionLayout(3, SlotLayout(2, payload))
    fd = create_region("test", layout)
    packets, others = map_region(fd, layout), map_region(fd, layout)
    for index, packet in enumerate(packets):
        assert not packet.payload.any()
        packet.pose["frame"] = index
        packet.payload[:] = index + 1
    for index, packet in enumerate(others):
        assert packet.pose["frame"] == index
        assert np.all(packet.payload == index + 1)
    with pytest.raises(OSError, match="not permitted"):
        os.ftruncate(fd, 0)
    os.close(fd)


def test_a_region_that_the_machine_cannot_hold_is_refused_before_it_is_made() -> None:
    with pytest.raises(TrilaneError, match="lower the tensor or output size"):
        create_region("test", RegionLayout(64, SlotLayout(1, 1 << 40)))


def test_a_region_that_is_too_small_is_refused() -> None:
    fd = create_region("test", RegionLayout(1, SlotLayout(1, 10)))
    with pytest.raises(ValueError, match="the layout needs"):
        map_region(fd, RegionLayout(2, SlotLayout(1, 10)))
    os.close(fd)


def test_the_folder_is_private_and_goes_while_the_link_lives(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    context = zmq.Context()
    parent, child = Link(context), Link(context)
    folder = BusFolder()
    assert folder.path.stat().st_mode & 0o777 == 0o700
    parent.socket.bind(folder.endpoint("cpu"))
    child.socket.connect(folder.endpoint("cpu"))
    child.send(Ready(1))
    assert parent.wait(2000)
    assert parent.receive() == Ready(1)
    folder.remove()
    assert not list(tmp_path.iterdir())
    parent.send(Close())
    assert child.wait(2000)
    assert (child.receive(), child.receive()) == (Close(), None)
    parent.close()
    child.close()
    context.term()


def test_a_message_too_large_is_not_received() -> None:
    context = zmq.Context()
    parent, child = Link(context), Link(context)
    with BusFolder() as folder:
        parent.socket.bind(folder.endpoint("cpu"))
        child.socket.connect(folder.endpoint("cpu"))
        child.socket.send(bytes(1 << 17), zmq.DONTWAIT)
        assert not parent.wait(300)
    parent.close()
    child.close()
    context.term()


def test_only_a_folder_that_nobody_holds_is_swept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    held = BusFolder()
    (tmp_path / "trilane-stale").mkdir()
    (tmp_path / "trilane-stale" / LOCK).touch()
    (tmp_path / "trilane-other").mkdir()
    (tmp_path / "trilane-link").symlink_to(held.path)
    sweep(tmp_path)
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted([held.path.name, "trilane-other", "trilane-link"])
    held.remove()


def test_a_slice_is_asked_for_and_given_back() -> None:
    """Whether the kernel takes the wish or not, what this thread may do and its niceness stay as they were."""
    before = os.sched_getscheduler(0), os.getpriority(os.PRIO_PROCESS, 0)
    assert use_slice(SHORTEST_NS) == use_slice(DEFAULT)
    assert (os.sched_getscheduler(0), os.getpriority(os.PRIO_PROCESS, 0)) == before
