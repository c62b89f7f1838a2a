"""A unit's link: heartbeats over ZeroMQ beside the job pipe, and the folder of its socket."""

from __future__ import annotations

import fcntl
import os
import select
import shutil
import time
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory

import psutil
import pytest
import zmq

from trilane import machine
from trilane.transport import link
from trilane.transport.link import LOCK, HeartbeatSocket, Link, SocketFolder, context_on_cores, remove_abandoned
from trilane.transport.messages import Done, Failed, JobPipe, Message, PongMessage, Ready, RunJob, job_pipe_pair


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
    child.heartbeat_socket.socket.send(bytes(1 << 17), zmq.DONTWAIT)
    assert not parent.heartbeat_socket.socket.poll(300)


def test_every_heartbeat_that_came_is_received_in_order(context: zmq.Context, tmp_path: Path) -> None:
    one, other = HeartbeatSocket(context), HeartbeatSocket(context)
    one.socket.bind(f"ipc://{tmp_path}/h")
    other.socket.connect(f"ipc://{tmp_path}/h")
    beats = [*(Ready(pid) for pid in range(5)), PongMessage()]
    for beat in beats:
        other.send(beat)
    found: list[Message] = []
    while len(found) < 6 and one.socket.poll(2000):
        found += one.receive()
    assert found == beats
    one.close()
    other.close()


def test_a_heartbeat_socket_holds_little_takes_no_large_message_and_is_closed_at_once(context: zmq.Context) -> None:
    one = HeartbeatSocket(context)
    options = (zmq.TYPE, zmq.LINGER, zmq.MAXMSGSIZE, zmq.SNDHWM, zmq.RCVHWM)
    assert [one.socket.getsockopt(option) for option in options] == [zmq.PAIR, 0, 4096, 64, 64]
    assert one.fileno() == one.socket.getsockopt(zmq.FD)
    one.send(PongMessage())  # nobody is connected: it is dropped, and nobody waits
    one.close()
    assert one.socket.closed


def test_a_link_hands_its_linger_on_and_closes_both_ways(context: zmq.Context) -> None:
    ours, theirs = job_pipe_pair()
    link = Link(context, JobPipe(ours), 7)
    socket = link.heartbeat_socket.socket
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
    monkeypatch.setattr(link, "remove_abandoned", lambda path: made.append(str(path)))
    monkeypatch.setattr("tempfile.mkdtemp", lambda prefix, dir: made.append(dir) or str(tmp_path))  # noqa: ARG005
    SocketFolder().remove()
    assert made == [base if is_kept else "/tmp"] * 2  # noqa: S108
