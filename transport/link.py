"""One end of the connection between the scheduler and a unit: the job pipe and the heartbeat socket together.

Jobs and their answers must keep their order, so they go over the job pipe. Heartbeats have a way of their own, so that
neither delays the other. Neither end ever waits for the other: a heartbeat that the other end does not read is dropped.

The folder of a unit's ZeroMQ socket is private. It exists only until the unit has connected, because a connection does
not need the name of its socket. A parent that is killed before that leaves its folder behind. The next run finds that
nobody holds the folder's lock, and removes the folder.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import shutil
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Self

import zmq

from trilane.transport.messages import MAX_BYTES, Heartbeat, JobPipe, Message, pack, unpack
from trilane.transport.wakeup import SHORTEST_NS, use_slice

PREFIX = "trilane-"
LOCK = "lock"
MAX_PATH = 80  # of the folder's path; the path of a Unix socket inside it may have 108


class SocketFolder:
    """A folder with mode 0700 for the names of sockets, held by a lock on a file inside it."""

    def __init__(self) -> None:
        base = tempfile.gettempdir()
        base = base if len(base) < MAX_PATH else "/tmp"  # noqa: S108 - mkdtemp below makes a private folder in it
        remove_abandoned(Path(base))
        while not self._is_made(base):  # another process took it for abandoned before it was locked, and removes it
            os.close(self._lock)

    def _is_made(self, base: str) -> bool:
        """Make a folder with a lock, and return whether both are still there once it is locked."""
        self.path = Path(tempfile.mkdtemp(prefix=PREFIX, dir=base))
        self._lock = os.open(self.path / LOCK, os.O_CREAT | os.O_RDWR | os.O_CLOEXEC, 0o600)
        with contextlib.suppress(BlockingIOError):
            fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            return os.fstat(self._lock).st_nlink > 0
        return False

    def endpoint(self, name: str) -> str:
        """Return the ZeroMQ address of the socket `name` in this folder."""
        return f"ipc://{self.path / name}"

    def remove(self) -> None:
        """Remove the folder and let go of its lock."""
        shutil.rmtree(self.path, ignore_errors=True)
        os.close(self._lock)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_exc: object) -> None:
        self.remove()


def remove_abandoned(base: Path) -> None:
    """Remove this user's socket folders in `base` whose owner has ended; their lock is free."""
    for folder in base.glob(f"{PREFIX}*"):
        with contextlib.suppress(OSError):
            if folder.is_symlink() or folder.stat().st_uid != os.getuid():
                continue
            lock = os.open(folder / LOCK, os.O_RDWR | os.O_CLOEXEC | os.O_NOFOLLOW)
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                shutil.rmtree(folder, ignore_errors=True)
            finally:
                os.close(lock)


HIGH_WATER = 64  # messages in ZeroMQ's queue; a unit has at most a few outstanding
LINGER_MS = 1000  # how long a unit that ends tries to deliver its last heartbeat


class HeartbeatSocket:
    """One end of a unit's heartbeat connection.

    `socket`: the ZeroMQ socket; one end binds it, the other connects it.
    """

    def __init__(self, context: zmq.Context[zmq.Socket[bytes]], linger_ms: int = 0) -> None:
        """Make a socket of `context`, which tries for `linger_ms` ms after its closing to deliver what was sent."""
        self.socket: zmq.Socket[bytes] = context.socket(zmq.PAIR)
        self.socket.setsockopt(zmq.LINGER, linger_ms)
        self.socket.setsockopt(zmq.MAXMSGSIZE, MAX_BYTES)
        self.socket.setsockopt(zmq.SNDHWM, HIGH_WATER)
        self.socket.setsockopt(zmq.RCVHWM, HIGH_WATER)

    def fileno(self) -> int:
        """Return a descriptor that is readable when the socket may have messages; then call `receive`."""
        return self.socket.fileno()

    def send(self, message: Heartbeat) -> None:
        """Send without waiting; does nothing when the other end has stopped reading."""
        with contextlib.suppress(zmq.Again):
            self.socket.send(pack(message), zmq.DONTWAIT)

    def receive(self) -> list[Message]:
        """Return all messages since the last call; raises MessageError for bytes that are no message."""
        messages = []
        while self.socket.poll(0):  # until it is empty: before that, ZeroMQ's descriptor does not become readable again
            messages.append(unpack(self.socket.recv(zmq.DONTWAIT)))
        return messages

    def close(self) -> None:
        self.socket.close()


def context_on_cores(cores: Sequence[int]) -> zmq.Context[zmq.Socket[bytes]]:
    """Return a ZeroMQ context for a unit, whose I/O thread runs on `cores` and preempts other work there when it wakes.

    On the unit's own cores that thread would wait behind the unit's next job. Call this from the thread that makes the
    first socket. The I/O thread inherits the short time slice set here, and the caller keeps it too.
    """
    context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
    for core in cores:
        context.set(zmq.THREAD_AFFINITY_CPU_ADD, core)
    use_slice(SHORTEST_NS)
    return context


class Link:
    """The `job_pipe` and the `heartbeat_socket` of one end; messages of each arrive in order or not at all."""

    def __init__(self, context: zmq.Context[zmq.Socket[bytes]], job_pipe: JobPipe, linger_ms: int = 0) -> None:
        """Take over `job_pipe`; `context` and `linger_ms` are those of `HeartbeatSocket`."""
        self.job_pipe = job_pipe
        self.heartbeat_socket = HeartbeatSocket(context, linger_ms)

    def bind(self, endpoint: str) -> None:
        """Receive the unit's heartbeats at `endpoint` (the scheduler's end)."""
        self.heartbeat_socket.socket.bind(endpoint)

    def connect(self, endpoint: str) -> None:
        """Send heartbeats to `endpoint` (the unit's end)."""
        self.heartbeat_socket.socket.connect(endpoint)

    @property
    def heartbeat_fd(self) -> int:
        """A descriptor that is readable when `heartbeats` should be called."""
        return self.heartbeat_socket.fileno()

    def send_heartbeat(self, message: Heartbeat) -> None:
        """Send without waiting; does nothing when the other end has stopped reading."""
        self.heartbeat_socket.send(message)

    def heartbeats(self) -> list[Message]:
        """Return all heartbeats since the last call; raises MessageError for bytes that are no message."""
        return self.heartbeat_socket.receive()

    def close(self) -> None:
        """Close both; heartbeats that were sent are delivered within `linger_ms`."""
        self.heartbeat_socket.close()
        self.job_pipe.close()
