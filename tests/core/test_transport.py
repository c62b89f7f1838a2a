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
from trilane.transport.link import LOCK, Link, SocketFolder, remove_abandoned
from trilane.transport.messages import (
    MAX_BYTES,
    MAX_TEXT,
    PACKETS,
    Close,
    Closed,
    Done,
    Failed,
    JobPipe,
    Message,
    MessageError,
    Ping,
    Pong,
    Ready,
    RunJob,
    job_pipe_pair,
    pack,
    unpack,
)
from trilane.transport.packets import RegionLayout, SlotLayout, create_region, header_dtype, map_region
from trilane.transport.wakeup import AWAKE, DEFAULT, SHORTEST_NS, awake, use_slice

MESSAGES = [
    RunJob(1, 0, 2, -1, 0, 3, 0, 0),
    Ping(),
    Close(),
    Ready(1234),
    Done(1, 2**62, 2**62 + 1, 0, 5, 6, 7, 1, 8, 9, {"encode_ms": 1.5}),
    Failed(-1, 2, "a failure"),
    Pong(),
    Closed(),
]


@pytest.mark.parametrize("message", MESSAGES, ids=lambda message: type(message).__name__)
def test_a_message_arrives_as_it_was_sent(message: object) -> None:
    again = unpack(pack(message))
    assert again == message
    assert type(again) is type(message)


@pytest.mark.parametrize("data", [b"", b"\xff", b"no message", pack(Close()) + b"\0", pack(Ready(1))[:-1]])
def test_bytes_that_are_no_message_are_refused(data: bytes) -> None:
    with pytest.raises(MessageError):
        unpack(data)


@pytest.mark.parametrize("metrics", [None, [], 1, "text", {"a": "b"}, {1: 2.0}, {"a": True}])
def test_values_that_are_no_metrics_are_refused(metrics: object) -> None:
    with pytest.raises(MessageError, match=r"expected dict|not msgpack"):
        unpack(pack(Done(1, 2, 3, 4, 5, 6, 7, 0, 8, 9, {})) + msgpack.packb(metrics))


def test_a_text_field_of_another_type_is_refused() -> None:
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


def received(link: Link) -> list[Message]:
    """The first heartbeats that come within two seconds."""
    messages: list[Message] = []
    while not messages and select.select([link.heartbeat_fd], [], [], 2)[0]:
        messages = link.heartbeats()
    return messages


def test_the_folder_is_private_and_goes_while_the_link_lives(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    context = zmq.Context()
    parent, child = (Link(context, JobPipe(end)) for end in job_pipe_pair())
    folder = SocketFolder()
    assert folder.path.stat().st_mode & 0o777 == 0o700
    parent.bind(folder.endpoint("cpu"))
    child.connect(folder.endpoint("cpu"))
    child.send_heartbeat(Ready(1))
    assert received(parent) == [Ready(1)]
    folder.remove()
    assert not list(tmp_path.iterdir())
    child.send_heartbeat(Pong())
    assert received(parent) == [Pong()] and parent.heartbeats() == []
    parent.close()
    child.close()
    context.term()


def test_jobs_go_over_the_job_pipe_and_heartbeats_over_zeromq(tmp_path: Path) -> None:
    """Jobs need no address, and keep their order."""
    context = zmq.Context()
    ends = job_pipe_pair()
    parent, child = Link(context, JobPipe(ends[0])), Link(context, JobPipe(ends[1], waits=True))
    parent.bind(f"ipc://{tmp_path}/bus")
    child.connect(f"ipc://{tmp_path}/bus")
    job, done = RunJob(1, 0, 7, 0, 1, 0, 0, 0), Done(1, 2, 3, 4, 5, 6, 7, 0, 8, 9, {"inferred": 1.0})
    parent.job_pipe.send(job)
    assert child.job_pipe.receive() == job
    child.send_heartbeat(Pong())
    child.job_pipe.send(done)
    child.job_pipe.send(Failed(2, 2, "no such thing"))
    assert [parent.job_pipe.receive() for _ in range(3)] == [done, Failed(2, 2, "no such thing"), None]
    assert received(parent) == [Pong()]
    assert not select.select([parent.heartbeat_fd], [], [], 0)[0]
    parent.close()
    child.close()
    context.term()


def test_a_job_pipe_waits_for_a_message_or_not_at_all() -> None:
    ours, theirs = job_pipe_pair()
    patient, hasty = JobPipe(ours, waits=True), JobPipe(theirs)
    assert hasty.receive() is None and not hasty.ended
    threading.Timer(0.05, hasty.send, [Ping()]).start()
    assert patient.receive() == Ping()
    hasty.close()
    assert patient.receive() is None and patient.ended
    patient.close()


def test_sending_to_an_end_that_is_closed_or_full_does_nothing() -> None:
    ours, theirs = (JobPipe(end) for end in job_pipe_pair())
    for number in range(10_000):
        ours.send(RunJob(number, 0, 0, 0, 0, 0, 0, 0))
    assert [theirs.receive() for _ in range(PACKETS + 1)] == [
        *(RunJob(n, 0, 0, 0, 0, 0, 0, 0) for n in range(PACKETS)),
        None,
    ]
    theirs.close()
    ours.send(Done(1, 2, 3, 4, 5, 6, 7, 0, 8, 9, {}))
    assert ours.receive() is None and ours.ended
    ours.close()


def test_messages_sent_before_an_end_closed_with_work_unread_are_received() -> None:
    ours, theirs = (JobPipe(end) for end in job_pipe_pair())
    theirs.send(Done(1, 2, 3, 4, 5, 6, 7, 0, 8, 9, {}))
    ours.send(RunJob(2, 0, 0, 0, 0, 0, 0, 0))
    theirs.close()
    assert ours.receive() == Done(1, 2, 3, 4, 5, 6, 7, 0, 8, 9, {}) and not ours.ended
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


def test_a_job_pipe_refuses_bytes_that_are_no_message() -> None:
    end, other = job_pipe_pair()
    os.write(end.writes, b"no message")
    job_pipe = JobPipe(other)
    with pytest.raises(MessageError):
        job_pipe.receive()
    end.close()
    job_pipe.close()


def test_a_message_too_large_is_not_received() -> None:
    context = zmq.Context()
    parent, child = (Link(context, JobPipe(end)) for end in job_pipe_pair())
    with SocketFolder() as folder:
        parent.bind(folder.endpoint("cpu"))
        child.connect(folder.endpoint("cpu"))
        child.heartbeat_socket.socket.send(bytes(1 << 17), zmq.DONTWAIT)
        assert not parent.heartbeat_socket.socket.poll(300)
    parent.close()
    child.close()
    context.term()


def test_only_a_folder_whose_lock_is_free_is_removed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    locked = SocketFolder()
    (tmp_path / "trilane-stale").mkdir()
    (tmp_path / "trilane-stale" / LOCK).touch()
    (tmp_path / "trilane-other").mkdir()
    (tmp_path / "trilane-link").symlink_to(locked.path)
    expected = [locked.path.name, "trilane-other", "trilane-link"]
    descriptors = Path("/proc/self/fd")
    open_before = sorted(descriptors.iterdir())
    remove_abandoned(tmp_path)
    assert sorted(descriptors.iterdir()) == open_before, "neither lock stays open"
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(expected)
    locked.remove()


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
