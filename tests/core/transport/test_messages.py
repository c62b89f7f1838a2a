"""Messages as bytes, the job pipe that carries them, heartbeats over ZeroMQ beside it, and the folder of its socket."""

from __future__ import annotations

import contextlib
import errno
import fcntl
import os
import select
import shutil
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import msgpack
import psutil
import pytest
import zmq
from hypothesis import given
from hypothesis import strategies as st

from trilane import machine
from trilane.errors import TrilaneError
from trilane.transport import messages
from trilane.transport.messages import (
    LOCK,
    MAX_BYTES,
    PACKETS,
    Close,
    Closed,
    Done,
    Failed,
    HeartbeatSocket,
    JobPipe,
    Link,
    Message,
    MessageError,
    Ping,
    PongMessage,
    Ready,
    RunJob,
    SocketFolder,
    context_on_cores,
    job_pipe_pair,
    pack,
    remove_abandoned,
    unpack,
)


def words(*values: int) -> bytes:
    return b"".join(value.to_bytes(8, "little", signed=True) for value in values)


#: Message -> its bytes: which message it is, its integers, and msgpack of what is left when that is not empty.
BYTES = [
    (RunJob(1, 2, 3, -1, 5, 6, 7, 8, 9), b"\0" + words(1, 2, 3, -1, 5, 6, 7, 8, 9)),
    (Ping(), b"\1"),
    (Close(), b"\2"),
    (Ready(77), b"\3" + words(77)),
    (Done(1, 2**62, 3, 4, 5, 6, 7, 8, 9, 10, {}), b"\4" + words(1, 2**62, 3, 4, 5, 6, 7, 8, 9, 10)),
    (Done(*range(10), {"a": 1.5}), b"\4" + words(*range(10)) + b"\x81\xa1a\xcb\x3f\xf8" + bytes(6)),
    (Failed(-1, 2, "no"), b"\5" + words(-1, 2) + b"\xa2no"),
    (Failed(-2, 2, ""), b"\5" + words(-2, 2)),
    (PongMessage(), b"\6"),
    (Closed(), b"\7"),
]


@pytest.mark.parametrize(("message", "data"), BYTES, ids=[type(row[0]).__name__ for row in BYTES])
def test_a_message_has_the_bytes_that_are_written_down(message: Any, data: bytes) -> None:
    assert pack(message) == data
    again = unpack(data)
    assert (again, type(again)) == (message, type(message))


DONE = pack(Done(*range(10), {}))  # without metrics nothing follows the integers


@pytest.mark.parametrize(
    ("data", "said"),
    [
        (b"", "unknown message b''"),
        (b"\x0aabc", r"unknown message b'\\nabc'"),
        (b"\2\0", "2 bytes for Close, which takes 1"),
        (b"\3" + words(1) + b"\0", "10 bytes for Ready, which takes 9"),
        (b"\5" + words(1, 2)[:15], "16 bytes for Failed, which takes 17"),
        (b"\5" + words(1, 2) + b"\1", "found '1', expected str"),
        (b"\5" + words(1, 2) + b"\xc1", "not msgpack: "),
        *(
            (DONE + msgpack.packb(metrics), r"expected dict|not msgpack")
            for metrics in (
                None,
                [1.0],
                1,
                "ms",
                {1: 2.0},
                {"ms": "2"},
                {"ms": True},
                {"ms": None},
                {"ms": 1.0, "n": "2"},
            )
        ),
    ],
)
def test_bytes_that_are_no_message_are_refused(data: bytes, said: str) -> None:
    with pytest.raises(MessageError, match=said):
        unpack(data)


@given(st.binary(max_size=200))
def test_any_bytes_are_a_message_or_refused(data: bytes) -> None:
    with contextlib.suppress(MessageError):
        assert pack(unpack(data))


def test_whole_numbers_are_metrics_too() -> None:
    assert unpack(DONE + msgpack.packb({"ms": 2.5, "n": 3})) == Done(*range(10), {"ms": 2.5, "n": 3})


def test_the_largest_message_passes_whole_and_a_larger_one_is_not_packed() -> None:
    """17 bytes of integers and 3 of the text's length."""
    largest = Failed(1, 1, "e" * (MAX_BYTES - 17 - 3))
    ours, theirs = (JobPipe(end) for end in job_pipe_pair())
    ours.send(largest)
    ours.send(Ping())
    assert len(pack(largest)) == MAX_BYTES
    assert [theirs.receive(), theirs.receive()] == [largest, Ping()]
    ours.close()
    theirs.close()
    with pytest.raises(MessageError, match="Failed of 4080 bytes, expected less than 4096"):
        pack(Failed(1, 1, largest.message + "e"))


def test_pipes_are_crossed_keep_messages_apart_and_are_not_inherited() -> None:
    ours, theirs = job_pipe_pair()
    try:
        for end, other in ((ours, theirs), (theirs, ours)):
            os.write(end.writes, b"one")
            os.write(end.writes, b"two")
            assert [os.read(other.reads, 99), os.read(other.reads, 99)] == [b"one", b"two"]
        assert not any(os.get_inheritable(fd) for fd in (*ours, *theirs))
        JobPipe(ours, waits=True), JobPipe(theirs)
        assert [os.get_blocking(fd) for fd in (*ours, *theirs)] == [True, False, False, False]
        assert (JobPipe(ours).fileno(), JobPipe(ours).ended) == (ours.reads, False)
    finally:
        ours.close()
        theirs.close()


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
    jobs = [theirs.receive() for _ in range(PACKETS + 1)]
    assert jobs == [*(RunJob(number, 0, 0, 0, 0, 0, 0, 0) for number in range(PACKETS)), None]
    theirs.close()
    ours.send(Ping())
    assert ours.receive() is None and ours.ended
    ours.close()


def test_messages_sent_before_an_end_closed_with_work_unread_are_received() -> None:
    ours, theirs = (JobPipe(end) for end in job_pipe_pair())
    theirs.send(PongMessage())
    ours.send(Ping())
    theirs.close()
    assert ours.receive() == PongMessage() and not ours.ended
    assert ours.receive() is None and ours.ended
    ours.close()


def test_a_job_pipe_refuses_bytes_that_are_no_message() -> None:
    end, other = job_pipe_pair()
    os.write(end.writes, b"no message")
    job_pipe = JobPipe(other)
    with pytest.raises(MessageError):
        job_pipe.receive()
    end.close()
    job_pipe.close()


def open_files() -> set[Path]:
    return set(Path("/proc/self/fd").iterdir())


@pytest.mark.parametrize(("missing", "is_enough"), [(0, True), (1, False)])
def test_a_pipe_of_sixteen_pages_will_do_and_a_smaller_one_will_not(
    missing: int, is_enough: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = open_files()
    monkeypatch.setattr(fcntl, "fcntl", lambda *_: 16 * os.sysconf("SC_PAGESIZE") - missing)
    if is_enough:
        for end in job_pipe_pair():
            end.close()
    else:
        said = r"^no pipe for 16 messages: 65535 bytes for a pipe, by /proc.*pipe-user-pages-soft"
        with pytest.raises(TrilaneError, match=said):
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


@pytest.fixture
def context() -> Iterator[zmq.Context]:
    context = zmq.Context()
    yield context
    context.term()


@pytest.fixture
def links(context: zmq.Context) -> Iterator[tuple[Link, Link]]:
    """The scheduler's end and the unit's, which waits for jobs."""
    ours, theirs = job_pipe_pair()
    parent, child = Link(context, JobPipe(ours)), Link(context, JobPipe(theirs, waits=True))
    yield parent, child
    parent.close()
    child.close()


def received(link: Link) -> list[Message]:
    """The first heartbeats that come within two seconds."""
    messages: list[Message] = []
    while not messages and select.select([link.heartbeat_fd], [], [], 2)[0]:
        messages = link.heartbeats()
    return messages


def test_the_folder_is_private_and_goes_while_the_link_lives(
    links: tuple[Link, Link], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    parent, child = links
    folder = SocketFolder()
    assert folder.path.stat().st_mode & 0o777 == 0o700
    parent.bind(folder.endpoint("cpu"))
    child.connect(folder.endpoint("cpu"))
    child.send_heartbeat(Ready(1))
    assert received(parent) == [Ready(1)]
    folder.remove()
    assert not list(tmp_path.iterdir())
    child.send_heartbeat(PongMessage())
    assert received(parent) == [PongMessage()] and parent.heartbeats() == []


def test_jobs_go_over_the_job_pipe_and_heartbeats_over_zeromq(links: tuple[Link, Link], tmp_path: Path) -> None:
    """Jobs need no address, and keep their order; a heartbeat that is too large is not received."""
    parent, child = links
    parent.bind(f"ipc://{tmp_path}/bus")
    child.connect(f"ipc://{tmp_path}/bus")
    job, done = RunJob(1, 0, 7, 0, 1, 0, 0, 0), Done(1, 2, 3, 4, 5, 6, 7, 0, 8, 9, {"inferred": 1.0})
    parent.job_pipe.send(job)
    assert child.job_pipe.receive() == job
    child.send_heartbeat(PongMessage())
    child.job_pipe.send(done)
    child.job_pipe.send(Failed(2, 2, "no such thing"))
    assert [parent.job_pipe.receive() for _ in range(3)] == [done, Failed(2, 2, "no such thing"), None]
    assert received(parent) == [PongMessage()]
    child.socket.send(bytes(1 << 17), zmq.DONTWAIT)
    assert not parent.socket.poll(300)


def test_every_heartbeat_that_came_is_received_in_order(context: zmq.Context, tmp_path: Path) -> None:
    one, other = HeartbeatSocket(context), HeartbeatSocket(context)
    one.socket.bind(f"ipc://{tmp_path}/h")
    other.socket.connect(f"ipc://{tmp_path}/h")
    beats = [*(Ready(pid) for pid in range(5)), PongMessage()]
    for beat in beats:
        other.send_heartbeat(beat)
    found: list[Message] = []
    while len(found) < 6 and one.socket.poll(2000):
        found += one.heartbeats()
    assert found == beats
    one.close()
    other.close()


def test_a_heartbeat_socket_holds_little_takes_no_large_message_and_is_closed_at_once(context: zmq.Context) -> None:
    one = HeartbeatSocket(context)
    options = (zmq.TYPE, zmq.LINGER, zmq.MAXMSGSIZE, zmq.SNDHWM, zmq.RCVHWM)
    assert [one.socket.getsockopt(option) for option in options] == [zmq.PAIR, 0, 4096, 64, 64]
    assert one.heartbeat_fd == one.socket.getsockopt(zmq.FD)
    one.send_heartbeat(PongMessage())  # nobody is connected: it is dropped, and nobody waits
    one.close()
    assert one.socket.closed


def test_a_link_hands_its_linger_on_and_closes_both_ways(context: zmq.Context) -> None:
    ours, theirs = job_pipe_pair()
    link = Link(context, JobPipe(ours), 7)
    socket = link.socket
    assert socket.getsockopt(zmq.LINGER) == 7
    link.close()
    theirs.close()
    assert socket.closed
    with pytest.raises(OSError, match="Bad file descriptor"):
        os.fstat(ours.reads)


def test_the_thread_of_heartbeats_stays_on_the_schedulers_cores() -> None:
    core = max(machine.here.cores())
    tasks = Path("/proc/self/task")
    before = set(tasks.iterdir())
    context = context_on_cores((core,))
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
        assert (folder.path / LOCK).stat().st_mode & 0o777 == 0o600
        fds = psutil.Process().num_fds()
    assert not folder.path.exists()
    assert psutil.Process().num_fds() == fds - 1


@pytest.fixture
def short_path() -> Iterator[Path]:
    """A folder whose name is short enough for a socket's, however long that of the tests' folder is."""
    with TemporaryDirectory(dir="/tmp") as name:
        yield Path(name)


def test_only_a_folder_of_ones_own_whose_lock_is_free_is_removed(
    short_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Beside it stand one that is locked, one without a lock, and a link; neither lock stays open."""
    tmp_path = short_path
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    locked = SocketFolder()
    for name in ("trilane-a-stale", "trilane-without", "trilane-z-stale", "elsewhere"):
        (tmp_path / name).mkdir()
        if name != "trilane-without":
            (tmp_path / name / LOCK).touch()
    (tmp_path / "trilane-link").symlink_to(tmp_path / "elsewhere")
    fds = psutil.Process().num_fds()
    with monkeypatch.context() as patched:
        patched.setattr(os, "getuid", lambda: 12345)
        remove_abandoned(tmp_path)
    assert len(list(tmp_path.iterdir())) == 6
    remove_abandoned(tmp_path)
    assert psutil.Process().num_fds() == fds
    left = {"elsewhere", "trilane-link", "trilane-without", locked.path.name}
    assert {path.name for path in tmp_path.iterdir()} == left
    locked.remove()


@pytest.mark.parametrize("is_gone", [True, False])
def test_a_folder_that_another_process_takes_for_abandoned_before_its_lock_is_replaced(
    short_path: Path, monkeypatch: pytest.MonkeyPatch, is_gone: bool
) -> None:
    """The other process comes between the lock's file and the lock. It is done at once, or holds the lock meanwhile."""
    monkeypatch.setattr("tempfile.tempdir", str(short_path))
    lock, held = fcntl.flock, list[int]()

    def late(fd: int, how: int) -> None:
        if not held:
            (path,) = short_path.glob(f"*/{LOCK}")
            held.append(os.open(path, os.O_RDWR))
            lock(held[0], fcntl.LOCK_EX | fcntl.LOCK_NB)
            if is_gone:
                shutil.rmtree(path.parent)
                lock(held[0], fcntl.LOCK_UN)
        lock(fd, how)

    monkeypatch.setattr(fcntl, "flock", late)
    fds = psutil.Process().num_fds()
    with SocketFolder() as folder:
        assert psutil.Process().num_fds() == fds + 2
        os.close(held[0])
        remove_abandoned(short_path)
        assert (folder.path / LOCK).exists() and [*short_path.iterdir()] == [folder.path]


@pytest.mark.parametrize(("length", "is_kept"), [(79, True), (80, False)])
def test_a_base_whose_name_is_too_long_for_a_socket_gives_way_to_tmp(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, length: int, is_kept: bool
) -> None:
    base = "/" + "b" * (length - 1)
    made: list[str] = []
    monkeypatch.setattr("tempfile.tempdir", base)
    monkeypatch.setattr(messages, "remove_abandoned", lambda path: made.append(str(path)))
    monkeypatch.setattr("tempfile.mkdtemp", lambda prefix, dir: made.append(dir) or str(tmp_path))  # noqa: ARG005
    SocketFolder().remove()
    assert made == [base if is_kept else "/tmp"] * 2  # noqa: S108
