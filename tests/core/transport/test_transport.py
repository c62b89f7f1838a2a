"""What crosses between processes, to the byte and the flag: messages, memory, sockets; what is refused and left."""

from __future__ import annotations

import contextlib
import errno
import fcntl
import os
import select
import struct
import threading
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import msgpack
import numpy as np
import psutil
import pytest
import zmq
from hypothesis import given
from hypothesis import strategies as st

from trilane import machine
from trilane.errors import TrilaneError
from trilane.transport import link, messages, packets, slots, wakeup
from trilane.transport.link import LOCK, HeartbeatSocket, Link, SocketFolder, context_on_cores, remove_abandoned
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
from trilane.transport.packets import RegionLayout, SlotLayout, create_region, header_dtype, map_region, view_packet
from trilane.transport.slots import EdgeRule, EdgeSlots, SlotError, edge_rule
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


PAGE = 4096
MIB = 1 << 20


def words(*values: int) -> bytes:
    return b"".join(value.to_bytes(8, "little", signed=True) for value in values)


#: Message -> its bytes: which message it is, its integers, and msgpack of what is left when that is not empty.
BYTES = [
    (messages.RunJob(1, 2, 3, -1, 5, 6, 7, 8, 9), b"\0" + words(1, 2, 3, -1, 5, 6, 7, 8, 9)),
    (messages.Ping(), b"\1"),
    (messages.Close(), b"\2"),
    (messages.Ready(77), b"\3" + words(77)),
    (messages.Done(1, 2, 3, 4, 5, 6, 7, 8, 9, 10, {}), b"\4" + words(1, 2, 3, 4, 5, 6, 7, 8, 9, 10)),
    (
        messages.Done(9, 8, 7, 6, 5, 4, 3, 2, 1, 0, {"a": 1.5}),
        b"\4" + words(9, 8, 7, 6, 5, 4, 3, 2, 1, 0) + b"\x81\xa1a\xcb\x3f\xf8" + bytes(6),
    ),
    (messages.Failed(-1, 2, "no"), b"\5" + words(-1, 2) + b"\xa2no"),
    (messages.Failed(-2, 2, ""), b"\5" + words(-2, 2)),
    (messages.Pong(), b"\6"),
    (messages.Closed(), b"\7"),
]


@pytest.mark.parametrize(("message", "data"), BYTES, ids=[type(row[0]).__name__ for row in BYTES])
def test_a_message_has_the_bytes_that_are_written_down(message: Any, data: bytes) -> None:
    assert pack(message) == data
    again = unpack(data)
    assert (again, type(again)) == (message, type(message))
    with pytest.raises(MessageError):
        unpack(data[: len(data) // 2] if len(data) > 1 else b"\x08")


def test_the_times_of_a_job_that_ended_are_told_in_this_order() -> None:
    lost = ("preempted_ns", "asleep_ns", "preempted_before_ns")
    times = ("t_begin_ns", "t_end_ns", "t_sampled_ns", *lost, "skips", "cpu_ns")
    assert messages.Done._fields == ("id", *times, "cpu_before_ns", "metrics")


@pytest.mark.parametrize(
    "rest", [{1: 2.0}, {"ms": "2"}, {"ms": True}, {"ms": None}, {"ms": 1.0, "n": "2"}, [1.0], "ms"]
)
def test_metrics_are_numbers_by_name(rest: Any) -> None:
    begin = pack(messages.Done(*range(10), {}))  # without metrics nothing follows the integers
    assert unpack(begin + msgpack.packb({"ms": 2.5, "n": 3})) == messages.Done(*range(10), {"ms": 2.5, "n": 3})
    with pytest.raises(MessageError, match=r"expected dict|not msgpack"):
        unpack(begin + msgpack.packb(rest))


def test_what_is_wrong_with_bytes_is_said() -> None:
    with pytest.raises(MessageError, match=r"unknown message b'\\nabc'"):
        unpack(b"\x0aabc")
    with pytest.raises(MessageError, match="10 bytes for Ready, which takes 9"):
        unpack(b"\3" + words(1) + b"\0")
    with pytest.raises(MessageError, match="16 bytes for Failed, which takes 17"):
        unpack(b"\5" + words(1, 2)[:15])
    with pytest.raises(MessageError, match="found '1', expected str"):
        unpack(b"\5" + words(1, 2) + b"\1")
    with pytest.raises(MessageError, match="not msgpack: "):
        unpack(b"\5" + words(1, 2) + b"\xc1")
    with pytest.raises(MessageError, match="Failed of 4096 bytes, expected less than 4096"):
        pack(messages.Failed(1, 2, "e" * 4093))
    assert len(pack(messages.Failed(1, 2, "e" * 4076))) == 4096
    with pytest.raises(MessageError, match="Failed of 4080 bytes"):
        pack(messages.Failed(1, 2, "e" * 4077))
    with pytest.raises(MessageError, match="unknown message b''"):
        unpack(b"")
    assert unpack(pack(messages.Done(1, 2, 3, 4, 5, 6, 7, 8, 9, 10, {"a": 1, "b": 2.5}))).metrics == {"a": 1, "b": 2.5}


@pytest.mark.parametrize(("payload", "slot_bytes"), [(0, 1), (1, 2), (4095, 2), (4096, 2), (4097, 3), (40_960, 11)])
def test_a_slot_is_a_page_of_header_and_whole_pages_of_payload(payload: int, slot_bytes: int) -> None:
    layout = SlotLayout(header_dtype(), payload)
    assert (layout.header_bytes, layout.slot_bytes) == (PAGE, slot_bytes * PAGE)
    assert RegionLayout(5, layout).total_bytes == 5 * slot_bytes * PAGE


def test_the_fields_of_a_header_are_aligned() -> None:
    """8 + 8 + 4 bytes of the frame's fields, 2 of `own`, 2 of nothing, 8 of `wide`."""
    header = header_dtype([("own", "<u2"), ("wide", "<f8")])
    assert header.names is not None
    assert [header.fields[name][1] for name in header.names] == [0, 8, 16, 20, 24]
    assert header.itemsize == 32


def test_a_header_of_more_than_a_page_takes_two() -> None:
    layout = SlotLayout(header_dtype([("matrix", "<f8", (512,))]), 1)
    assert (layout.header_bytes, layout.slot_bytes) == (2 * PAGE, 3 * PAGE)


def test_a_packet_shows_the_bytes_of_its_slot_and_no_others() -> None:
    """Header: frame as 8 bytes, sampling time as 8, epoch as 4, then what is the pipeline's own; payload: a page on."""
    layout = SlotLayout(header_dtype([("own", "<u2")]), 10)
    memory_of_slot = bytearray(2 * PAGE + 5)
    packet = view_packet(memoryview(memory_of_slot), layout)
    packet.header["frame"], packet.header["t_sampled_ns"] = 2**63, -5
    packet.header["epoch"], packet.header["own"] = 7, 515
    packet.payload[:] = range(1, 11)
    start = (2**63).to_bytes(8, "little") + words(-5) + b"\7\0\0\0" + b"\3\2"
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


def test_a_region_is_as_long_as_its_slots_and_stays_so() -> None:
    layout = RegionLayout(3, SlotLayout(header_dtype(), PAGE))
    fd = create_region("edge", layout)
    try:
        assert os.fstat(fd).st_size == 6 * PAGE
        assert not os.get_inheritable(fd)
        assert str(Path(f"/proc/self/fd/{fd}").readlink()).startswith("/memfd:trilane:edge")
        for size in (6 * PAGE - 1, 6 * PAGE + 1):
            with pytest.raises(PermissionError):
                os.ftruncate(fd, size)
        mapped = map_region(fd, layout)
        mapped[1].payload[0], mapped[2].header["frame"] = 5, 9
        assert os.pread(fd, 1, 3 * PAGE) == b"\5"
        assert os.pread(fd, 1, 4 * PAGE) == b"\x09"
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
    for free, is_refused in ((2 * MIB, False), (2 * MIB - 1, True)):
        monkeypatch.setattr(machine.here, "free_bytes", lambda free=free: free)
        if is_refused:
            with pytest.raises(TrilaneError, match=said):
                create_region("pose->raster", layout)
        else:
            os.close(create_region("pose->raster", layout))


def test_memory_that_cannot_be_reserved_leaves_no_file(monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: int) -> None:
        raise OSError(28, "No space left on device")

    before = psutil.Process().num_fds()
    monkeypatch.setattr(os, "posix_fallocate", full)
    with pytest.raises(TrilaneError, match="edge e needs 0 MiB of memory for 1 slots and no space left on device; "):
        create_region("e", RegionLayout(1, SlotLayout(header_dtype(), 1)))
    assert psutil.Process().num_fds() == before


def test_the_table_of_edges_is_the_documented_one() -> None:
    rows = {name: (rule.name, rule.slots, rule.mailbox, rule.yields) for name, rule in slots.RULES.items()}
    assert rows == {
        "single": ("single", 1, False, False),
        "double": ("double", 2, False, False),
        "triple": ("triple", 3, True, True),
        "fifo": ("fifo", 4, False, False),
        "orphan": ("orphan", 6, False, True),
    }
    assert edge_rule("orphan:4") == EdgeRule("orphan", 4, False, True)
    assert edge_rule("orphan:64") == EdgeRule("orphan", 64, False, True)
    assert (edge_rule("fifo:1"), edge_rule("fifo:64")) == (EdgeRule("fifo", 1), EdgeRule("fifo", 64))
    assert slots.TRANSITIONS == {
        "claim": ("free", "writing"),
        "commit": ("writing", "ready"),
        "abandon": ("writing", "free"),
        "take": ("ready", "reading"),
        "drop": ("ready", "free"),
        "release": ("reading", "free"),
        "give_back": ("reading", "ready"),
    }


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("quad", "single, double, triple, fifo:N or orphan:N"),
        ("double:2", "single, double, triple, fifo:N or orphan:N"),
        ("fifo:65", "fifo:N with N from 1 to 64"),
        ("fifo:0", "fifo:N with N from 1 to 64"),
        ("orphan:3", "orphan:N with N from 4 to 64"),
        ("fifo:99999", "fifo:N with N from 1 to 64"),
    ],
)
def test_an_edge_that_there_is_not_is_refused_with_those_that_there_are(text: str, expected: str) -> None:
    with pytest.raises(ValueError, match=f"found edge '{text}', expected {expected}"):
        edge_rule(text)


def test_the_slots_of_a_fifo_from_claim_to_release() -> None:
    """Step by step over two slots: which slot, which state, which frame."""
    edge = EdgeSlots(edge_rule("fifo:2"))
    assert (edge.state, edge.frame, edge.free, list(edge.ready), edge.epoch) == (["free"] * 2, [-1, -1], [1, 0], [], 0)
    assert edge.claim(7) == (0, None)
    assert (edge.state, edge.frame) == (["writing", "free"], [7, -1])
    assert edge.commit(0) == []
    assert edge.claim(8) == (1, None)
    assert not edge.can_claim()
    with pytest.raises(SlotError, match="no slot to claim"):
        edge.claim(9)
    edge.take(0)
    assert (edge.state, list(edge.ready)) == (["reading", "writing"], [])
    edge.abandon(1)
    assert (edge.state, edge.frame, edge.free) == (["reading", "free"], [7, -1], [1])
    assert edge.can_claim()
    with pytest.raises(SlotError, match="cannot take slot 0, which is reading"):
        edge.take(0)
    edge.release(0)
    assert (edge.state, edge.frame, edge.free) == (["free"] * 2, [-1, -1], [1, 0])


def test_a_claim_evicts_the_oldest_only_when_no_slot_is_free() -> None:
    edge = EdgeSlots(edge_rule("orphan:4"))
    for frame in range(3):
        edge.commit(edge.claim(frame)[0])
    assert edge.claim(3) == (3, None)
    assert edge.can_claim()
    assert edge.claim(4) == (0, 0)
    assert [edge.frame[slot] for slot in edge.ready] == [1, 2]
    assert edge.drop(2) == 2
    assert (edge.frame, edge.free) == ([4, 1, -1, 3], [2])


def test_pipes_are_crossed_keep_messages_apart_and_are_not_inherited() -> None:
    ours, theirs = job_pipe_pair()
    try:
        for end, other in ((ours, theirs), (theirs, ours)):
            os.write(end.writes, b"one")
            os.write(end.writes, b"two")
            assert [os.read(other.reads, 99), os.read(other.reads, 99)] == [b"one", b"two"]
        for fd in (*ours, *theirs):
            assert not os.get_inheritable(fd)
        JobPipe(ours, waits=True), JobPipe(theirs)
        assert [os.get_blocking(fd) for fd in (*ours, *theirs)] == [True, False, False, False]
        assert (JobPipe(ours).fileno(), JobPipe(ours).ended) == (ours.reads, False)
    finally:
        ours.close()
        theirs.close()


def test_a_pipe_of_sixteen_pages_will_do_and_a_smaller_one_will_not(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(fcntl, "fcntl", lambda *_: 16 * os.sysconf("SC_PAGESIZE"))
    for end in job_pipe_pair():
        end.close()
    asked: list[int] = []
    monkeypatch.setattr(fcntl, "fcntl", lambda fd, _: asked.append(fd) or 1 << 20)
    ours, theirs = job_pipe_pair()
    assert asked == [theirs.writes, ours.writes] or asked == [ours.writes, theirs.writes]
    ours.close()
    theirs.close()
    monkeypatch.setattr(fcntl, "fcntl", lambda *_: 16 * os.sysconf("SC_PAGESIZE") - 1)
    with pytest.raises(TrilaneError, match=r"^no pipe for 16 messages: 65535 bytes for a pipe, by /proc"):
        job_pipe_pair()


def test_a_heartbeat_socket_holds_little_takes_no_large_message_and_is_closed_at_once() -> None:
    context = zmq.Context()
    one, other = HeartbeatSocket(context), HeartbeatSocket(context, 5)
    options = (zmq.TYPE, zmq.LINGER, zmq.MAXMSGSIZE, zmq.SNDHWM, zmq.RCVHWM)
    assert [one.socket.getsockopt(option) for option in options] == [zmq.PAIR, 0, 4096, 64, 64]
    assert other.socket.getsockopt(zmq.LINGER) == 5
    assert one.fileno() == one.socket.getsockopt(zmq.FD)
    one.send(messages.Pong())  # nobody is connected: it is dropped, and nobody waits
    one.close()
    other.close()
    assert one.socket.closed
    context.term()


def test_a_link_hands_its_linger_on_and_closes_both_ways() -> None:
    context = zmq.Context()
    ours, theirs = job_pipe_pair()
    link, other = Link(context, JobPipe(ours), 7), Link(context, JobPipe(theirs))
    assert [each.heartbeat_socket.socket.getsockopt(zmq.LINGER) for each in (link, other)] == [7, 0]
    assert link.heartbeat_fd == link.heartbeat_socket.fileno()
    link.close()
    assert link.heartbeat_socket.socket.closed
    with pytest.raises(OSError, match="Bad file descriptor"):
        os.fstat(ours.reads)
    other.close()
    context.term()


def test_every_heartbeat_that_came_is_received_in_order(tmp_path: Path) -> None:
    context = zmq.Context()
    one, other = HeartbeatSocket(context), HeartbeatSocket(context)
    one.socket.bind(f"ipc://{tmp_path}/h")
    other.socket.connect(f"ipc://{tmp_path}/h")
    for pid in range(5):
        other.send(messages.Ready(pid))
    other.send(messages.Pong())
    received: list[Any] = []
    while len(received) < 6 and one.socket.poll(2000):
        received += one.receive()
    assert received == [*(messages.Ready(pid) for pid in range(5)), messages.Pong()]
    one.close()
    other.close()
    context.term()


def test_the_thread_of_heartbeats_stays_on_the_schedulers_cores(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its time slice is asked for before it is made, for it inherits it."""
    slices: list[int] = []
    monkeypatch.setattr(link, "use_slice", slices.append)
    core = max(machine.here.cores())
    tasks = Path("/proc/self/task")
    before = set(tasks.iterdir())
    context = context_on_cores((core,))
    assert slices == [100_000]
    socket = HeartbeatSocket(context)
    io_threads: list[Path] = []
    end = time.monotonic() + 60
    while not io_threads and time.monotonic() < end:  # a thread names itself once it runs, after it chose its cores
        io_threads = [t for t in set(tasks.iterdir()) - before if (t / "comm").read_text().startswith("ZMQbg/IO")]
    assert [os.sched_getaffinity(int(task.name)) for task in io_threads] == [{core}]  # noqa: TID251 - of a thread
    socket.close()
    context.term()


def test_the_folder_of_a_socket(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    with SocketFolder() as folder:
        assert folder.path.parent == tmp_path and folder.path.name.startswith("trilane-")
        assert folder.endpoint("cpu") == f"ipc://{folder.path}/cpu"
        assert (folder.path / "lock").stat().st_mode & 0o777 == 0o600
        remove_abandoned(tmp_path)
        assert folder.path.is_dir()
        fds = psutil.Process().num_fds()
    assert not folder.path.exists()
    assert psutil.Process().num_fds() == fds - 1


@pytest.mark.parametrize(("length", "is_kept"), [(79, True), (80, False)])
def test_a_base_whose_name_is_too_long_for_a_socket_gives_way_to_tmp(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, length: int, is_kept: bool
) -> None:
    base = "/" + "b" * (length - 1)
    made: list[str] = []
    monkeypatch.setattr("tempfile.tempdir", base)
    monkeypatch.setattr(link, "remove_abandoned", lambda path: made.append(str(path)))
    monkeypatch.setattr("tempfile.mkdtemp", lambda prefix, dir: made.append(dir) or str(tmp_path))  # noqa: ARG005
    SocketFolder().remove()
    assert made == [base if is_kept else "/tmp"] * 2  # noqa: S108


def test_a_folder_of_somebody_else_is_left_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("trilane-a", "trilane-b"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "lock").touch()
    with monkeypatch.context() as patched:
        patched.setattr(os, "getuid", lambda: 12345)
        remove_abandoned(tmp_path)
    assert len(list(tmp_path.iterdir())) == 2
    remove_abandoned(tmp_path)
    assert not list(tmp_path.iterdir())


def test_what_stands_before_a_folder_that_is_left_alone_is_still_removed(tmp_path: Path) -> None:
    """A link, a folder without a lock, then an abandoned one."""
    for name in ("without", "abandoned", "elsewhere"):
        (tmp_path / name).mkdir()
    (tmp_path / "link").symlink_to(tmp_path / "elsewhere")
    for name in ("abandoned", "elsewhere"):
        (tmp_path / name / "lock").touch()
    names = ("link", "without", "abandoned")
    remove_abandoned(SimpleNamespace(glob=lambda _pattern: [tmp_path / name for name in names]))  # type: ignore[arg-type]
    assert {path.name for path in tmp_path.iterdir()} == {"link", "without", "elsewhere"}


class FakeLibc:
    """Notes the system calls that it is asked for, and answers each with `answer`."""

    def __init__(self, answer: int) -> None:
        self.answer, self.calls = answer, []

    def syscall(self, *call: Any) -> int:
        self.calls.append(call)
        return self.answer


@pytest.mark.parametrize(("answer", "accepted"), [(0, True), (-1, False)])
def test_a_slice_is_asked_for_by_sched_setattr(monkeypatch: pytest.MonkeyPatch, answer: int, accepted: bool) -> None:
    """48 bytes: size, policy 0, no flags, niceness, priority 0, the slice as runtime, no deadline, no period."""
    libc = FakeLibc(answer)
    monkeypatch.setattr("ctypes.CDLL", lambda _: libc)
    monkeypatch.setattr("os.getpriority", lambda which, who: {(os.PRIO_PROCESS, 0): 3}[which, who])
    monkeypatch.setattr(machine.here, "architecture", lambda: "aarch64")
    assert wakeup.use_slice(wakeup.UNIT_NS) is accepted
    assert libc.calls == [(274, 0, struct.pack("=IIQiIQQQ", 48, 0, 0, 3, 0, 1_000_000, 0, 0), 0)]
    assert (wakeup.SCHED_SETATTR["x86_64"], wakeup.SHORTEST_NS, wakeup.DEFAULT) == (314, 100_000, 0)


def test_where_slices_are_unknown_or_not_ours_nothing_is_asked(monkeypatch: pytest.MonkeyPatch) -> None:
    libc = FakeLibc(0)
    monkeypatch.setattr("ctypes.CDLL", lambda _: libc)
    with monkeypatch.context() as patched:
        patched.setattr(machine.here, "architecture", lambda: "riscv64")
        assert wakeup.use_slice(1) is False
    monkeypatch.setattr("os.sched_getscheduler", lambda _: os.SCHED_FIFO)
    assert wakeup.use_slice(1) is False
    assert libc.calls == []


def test_the_file_that_keeps_cores_awake_is_held_open_inside_the_block(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert Path("/dev/cpu_dma_latency") == wakeup.LATENCY_FILE
    file = tmp_path / "latency"
    file.touch()
    monkeypatch.setattr(wakeup, "LATENCY_FILE", file)
    before = psutil.Process().num_fds()
    with wakeup.awake() as idle_cores:
        assert (idle_cores, psutil.Process().num_fds()) == ("wait awake", before + 1)
        assert file.read_bytes() == bytes(4)
    assert psutil.Process().num_fds() == before
    with wakeup.awake(False) as idle_cores:
        assert idle_cores == "sleep: the performance profile asks for no haste"
        assert psutil.Process().num_fds() == before


def test_the_constants_of_linux_are_those_of_its_headers() -> None:
    assert (packets.F_ADD_SEALS, packets.F_SEAL_SHRINK, packets.F_SEAL_GROW) == (1033, 2, 4)
    assert packets.FRAME_FIELDS == (("frame", "<u8"), ("t_sampled_ns", "<i8"), ("epoch", "<u4"))


def test_receiving_heartbeats_waits_for_none() -> None:
    asked: list[Any] = []

    class Socket:
        def poll(self, timeout_ms: int) -> bool:
            asked.append(timeout_ms)
            return len(asked) < 3

        def recv(self, flags: int) -> bytes:
            assert flags == zmq.DONTWAIT
            return pack(messages.Pong())

    context = zmq.Context()
    one = HeartbeatSocket(context)
    real, one.socket = one.socket, Socket()  # type: ignore[assignment]
    assert one.receive() == [messages.Pong()] * 2
    assert asked == [0, 0, 0]
    real.close()
    context.term()
