"""Messages, memory and the bus: what is refused, and what is left."""

from __future__ import annotations

import contextlib
import errno
import os
import select
import struct
import threading
from pathlib import Path

import msgpack
import numpy as np
import pytest
import zmq
from hypothesis import given
from hypothesis import strategies as st

from trilane.errors import TrilaneError
from trilane.transport.heartbeats import LOCK, BusFolder, Link, sweep
from trilane.transport.job_pipe import PACKETS, JobPipe, job_pipe_pair
from trilane.transport.memory import RegionLayout, create_region, map_region
from trilane.transport.messages import (
    MAX_BYTES,
    MAX_TEXT,
    Alive,
    Close,
    Closed,
    Done,
    Duration,
    Failed,
    Isolate,
    Message,
    MessageError,
    Ping,
    Ready,
    RunJob,
    pack,
    unpack,
)
from trilane.transport.packets import SlotLayout, header_dtype
from trilane.transport.wakeup import AWAKE, DEFAULT, SHORTEST_NS, awake, use_slice

MESSAGES = [
    RunJob(1, 0, 2, -1, 0, 3),
    Isolate(1, 4, 0, 1),
    Ping(),
    Close(),
    Ready(1234),
    Done(1, 2**62, 2**62 + 1, 0, {"encode_ms": 1.5}),
    Duration(2**40),
    Failed(-1, 2, "what was found"),
    Alive(),
    Closed(),
]


@pytest.mark.parametrize("message", MESSAGES, ids=lambda message: type(message).__name__)
def test_a_message_arrives_as_it_was_sent(message: object) -> None:
    again = unpack(pack(message))
    assert again == message
    assert type(again) is type(message)


@pytest.mark.parametrize("data", [b"", b"\xff", b"no message", pack(Close()) + b"\0", pack(Ready(1))[:-1]])
def test_what_is_not_a_message_is_refused(data: bytes) -> None:
    with pytest.raises(MessageError):
        unpack(data)


@pytest.mark.parametrize("figures", [None, [], 1, "text", {"a": "b"}, {1: 2.0}, {"a": True}])
def test_what_are_no_figures_is_refused(figures: object) -> None:
    with pytest.raises(MessageError, match=r"expected dict|not msgpack"):
        unpack(pack(Done(1, 2, 3, 4, {})) + msgpack.packb(figures))


def test_text_that_is_none_is_refused() -> None:
    with pytest.raises(MessageError, match="expected str"):
        unpack(pack(Failed(1, 2, "")) + msgpack.packb(1))


def test_the_largest_message_passes_whole_and_a_larger_one_is_not_packed() -> None:
    largest = Failed(1, 1, "e" * (MAX_BYTES - len(pack(Failed(1, 1, ""))) - 3))
    ours, theirs = (JobPipe(end) for end in job_pipe_pair())
    ours.send(largest)
    ours.send(Ping())
    assert len(pack(largest)) == MAX_BYTES > MAX_TEXT
    assert theirs.receive() == largest and theirs.receive() == Ping()
    ours.close()
    theirs.close()
    with pytest.raises(MessageError, match="less than 4096"):
        pack(Failed(1, 1, "e" * MAX_BYTES))


@given(st.binary(max_size=200))
def test_any_bytes_are_a_message_or_refused(data: bytes) -> None:
    with contextlib.suppress(MessageError):
        assert pack(unpack(data))


@pytest.mark.parametrize("payload", [0, 1, 4096, 100_000])
def test_slots_of_a_region_are_apart_and_start_empty(payload: int) -> None:
    layout = RegionLayout(3, SlotLayout(header_dtype(), payload))
    fd = create_region("test", layout)
    packets, others = map_region(fd, layout), map_region(fd, layout)
    for index, packet in enumerate(packets):
        assert not packet.payload.any()
        packet.header["frame"] = index
        packet.payload[:] = index + 1
    for index, packet in enumerate(others):
        assert packet.header["frame"] == index
        assert np.all(packet.payload == index + 1)
    with pytest.raises(OSError, match="not permitted"):
        os.ftruncate(fd, 0)
    os.close(fd)


def test_a_region_that_the_machine_cannot_hold_is_refused_before_it_is_made() -> None:
    with pytest.raises(TrilaneError, match="lower the tensor or output size"):
        create_region("test", RegionLayout(64, SlotLayout(header_dtype(), 1 << 40)))


def test_a_region_that_is_too_small_is_refused() -> None:
    fd = create_region("test", RegionLayout(1, SlotLayout(header_dtype(), 10)))
    with pytest.raises(ValueError, match="the layout needs"):
        map_region(fd, RegionLayout(2, SlotLayout(header_dtype(), 10)))
    os.close(fd)


def heard(link: Link) -> list[Message]:
    """What comes over the bus within two seconds."""
    messages: list[Message] = []
    while not messages and select.select([link.bus_fd], [], [], 2)[0]:
        messages = link.bus_messages()
    return messages


def test_the_folder_is_private_and_goes_while_the_link_lives(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    context = zmq.Context()
    parent, child = (Link(context, JobPipe(end)) for end in job_pipe_pair())
    folder = BusFolder()
    assert folder.path.stat().st_mode & 0o777 == 0o700
    parent.socket.bind(folder.endpoint("cpu"))
    child.socket.connect(folder.endpoint("cpu"))
    child.sign(Ready(1))
    assert heard(parent) == [Ready(1)]
    folder.remove()
    assert not list(tmp_path.iterdir())
    child.sign(Alive())
    assert heard(parent) == [Alive()] and parent.bus_messages() == []
    parent.close()
    child.close()
    context.term()


def test_work_goes_over_the_line_and_life_signs_over_the_bus(tmp_path: Path) -> None:
    """Work needs no address, and keeps its order."""
    context = zmq.Context()
    ends = job_pipe_pair()
    parent, child = Link(context, JobPipe(ends[0])), Link(context, JobPipe(ends[1], waits=True))
    parent.socket.bind(f"ipc://{tmp_path}/bus")
    child.socket.connect(f"ipc://{tmp_path}/bus")
    job, done = RunJob(1, 0, 7, 0, 1, 0), Done(1, 2, 3, 4, {"inferred": 1.0})
    parent.line.send(job)
    assert child.line.receive() == job
    child.sign(Alive())
    child.line.send(done)
    child.line.send(Failed(2, 2, "no such thing"))
    assert [parent.line.receive() for _ in range(3)] == [done, Failed(2, 2, "no such thing"), None]
    assert heard(parent) == [Alive()]
    assert not select.select([parent.bus_fd], [], [], 0)[0]
    parent.close()
    child.close()
    context.term()


def test_a_line_waits_for_a_message_or_not_at_all() -> None:
    ours, theirs = job_pipe_pair()
    patient, hasty = JobPipe(ours, waits=True), JobPipe(theirs)
    assert hasty.receive() is None and not hasty.ended
    threading.Timer(0.05, hasty.send, [Ping()]).start()
    assert patient.receive() == Ping()
    hasty.close()
    assert patient.receive() is None and patient.ended
    patient.close()


def test_a_line_whose_end_is_gone_or_stopped_says_nothing() -> None:
    ours, theirs = (JobPipe(end) for end in job_pipe_pair())
    for number in range(10_000):
        ours.send(RunJob(number, 0, 0, 0, 0, 0))
    assert [theirs.receive() for _ in range(PACKETS + 1)] == [*(RunJob(n, 0, 0, 0, 0, 0) for n in range(PACKETS)), None]
    theirs.close()
    ours.send(Done(1, 2, 3, 4, {}))
    assert ours.receive() is None and ours.ended
    ours.close()


def test_what_was_said_before_an_end_that_left_work_unread_is_heard() -> None:
    ours, theirs = (JobPipe(end) for end in job_pipe_pair())
    theirs.send(Done(1, 2, 3, 4, {}))
    ours.send(RunJob(2, 0, 0, 0, 0, 0))
    theirs.close()
    assert ours.receive() == Done(1, 2, 3, 4, {}) and not ours.ended
    assert ours.receive() is None and ours.ended
    ours.close()


def open_files() -> set[Path]:
    return set(Path("/proc/self/fd").iterdir())


def test_a_user_without_memory_for_pipes_is_told_so(monkeypatch: pytest.MonkeyPatch) -> None:
    before = open_files()
    monkeypatch.setattr("fcntl.fcntl", lambda *_: 4096)
    with pytest.raises(TrilaneError, match=r"4096 bytes for a pipe, by .*pipe-user-pages-soft"):
        job_pipe_pair()
    assert open_files() == before


def test_a_process_without_files_for_pipes_is_told_so(monkeypatch: pytest.MonkeyPatch) -> None:
    before, pipes = open_files(), iter([os.pipe2])

    def pipe2(flags: int) -> tuple[int, int]:
        for make in pipes:
            return make(flags)
        raise OSError(errno.EMFILE, "Too many open files")

    monkeypatch.setattr("os.pipe2", pipe2)
    with pytest.raises(TrilaneError, match="too many open files"):
        job_pipe_pair()
    assert open_files() == before


def test_a_line_refuses_what_is_no_message() -> None:
    end, other = job_pipe_pair()
    os.write(end.writes, b"no message")
    line = JobPipe(other)
    with pytest.raises(MessageError):
        line.receive()
    end.close()
    line.close()


def test_a_message_too_large_is_not_received() -> None:
    context = zmq.Context()
    parent, child = (Link(context, JobPipe(end)) for end in job_pipe_pair())
    with BusFolder() as folder:
        parent.socket.bind(folder.endpoint("cpu"))
        child.socket.connect(folder.endpoint("cpu"))
        child.socket.send(bytes(1 << 17), zmq.DONTWAIT)
        assert not parent.socket.poll(300)
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


def test_cores_stay_awake_for_a_while(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = tmp_path / "latency"
    monkeypatch.setattr("trilane.transport.wakeup.LATENCY_FILE", file)
    with awake() as idle_cores:
        assert idle_cores == f"sleep: {file}: no such file or directory"
    file.touch()
    with awake(wanted=False) as idle_cores:
        assert idle_cores.startswith("sleep: ") and not file.read_bytes()
    with awake() as idle_cores:
        assert idle_cores == AWAKE
        assert file.read_bytes() == struct.pack("=i", 0)
