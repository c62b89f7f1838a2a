"""The bus: one ZeroMQ PAIR socket per unit over ipc. Rule: its folder is private, and there only while a unit connects.

Once every unit is connected the folder is removed: the connections live on without a name. What a killed parent may
leave in the moment before that is removed by the next run, which knows by the lock that nobody holds it.
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

from trilane.transport.job_pipe import JobPipe
from trilane.transport.messages import MAX_BYTES, Heartbeat, Message, pack, unpack
from trilane.transport.wakeup import SHORTEST_NS, use_slice

PREFIX = "trilane-"
LOCK = "lock"
HIGH_WATER = 64  # messages; a unit has at most a few outstanding
LAST_WORDS_MS = 1000  # how long a unit that ends tries to deliver what it said last
MAX_PATH = 80  # of the folder; a unix socket's path holds 108 bytes


class BusFolder:
    """A 0700 folder for the sockets' names, held by a lock on a file inside."""

    def __init__(self) -> None:
        base = tempfile.gettempdir()
        base = base if len(base) < MAX_PATH else "/tmp"  # noqa: S108 - mkdtemp below makes a private folder in it
        sweep(Path(base))
        self.path = Path(tempfile.mkdtemp(prefix=PREFIX, dir=base))
        self._lock = os.open(self.path / LOCK, os.O_CREAT | os.O_RDWR | os.O_CLOEXEC, 0o600)
        fcntl.flock(self._lock, fcntl.LOCK_EX)

    def endpoint(self, name: str) -> str:
        return f"ipc://{self.path / name}"

    def remove(self) -> None:
        shutil.rmtree(self.path, ignore_errors=True)
        os.close(self._lock)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_exc: object) -> None:
        self.remove()


def sweep(base: Path) -> None:
    """Remove this user's bus folders whose owner is gone: those whose lock can be taken."""
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


def prompt_context(cores: Sequence[int]) -> zmq.Context[zmq.Socket[bytes]]:
    """A context for a unit, to be used from this thread: its I/O thread runs on `cores` and at once when it is woken.

    Left where the unit works it would wait for the job that the unit begins the moment after it said `Done`.
    Leaves this thread with a short slice.
    """
    context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
    for core in cores:
        context.set(zmq.THREAD_AFFINITY_CPU_ADD, core)
    use_slice(SHORTEST_NS)  # the thread inherits it when the first socket is made
    return context


class Link:
    """One end of a connection: the bus, and the line. Messages of each arrive in order or not at all."""

    def __init__(self, context: zmq.Context[zmq.Socket[bytes]], line: JobPipe, linger_ms: int = 0) -> None:
        self.line = line
        self.socket: zmq.Socket[bytes] = context.socket(zmq.PAIR)
        self.socket.setsockopt(zmq.LINGER, linger_ms)
        self.socket.setsockopt(zmq.MAXMSGSIZE, MAX_BYTES)
        self.socket.setsockopt(zmq.SNDHWM, HIGH_WATER)
        self.socket.setsockopt(zmq.RCVHWM, HIGH_WATER)

    @property
    def bus_fd(self) -> int:
        """Readable when `bus_messages` is to be called: the bus may have something."""
        return self.socket.fileno()

    def sign(self, message: Heartbeat) -> None:
        """Over the bus; what has an order goes over the line. Nothing to an end that has stopped reading."""
        with contextlib.suppress(zmq.Again):
            self.socket.send(pack(message), zmq.DONTWAIT)

    def bus_messages(self) -> list[Message]:
        """All that came over the bus since the last call. Raises MessageError for what is no message."""
        messages = []
        while self.socket.poll(0):  # until there is none: only then `bus_fd` rests
            messages.append(unpack(self.socket.recv(zmq.DONTWAIT)))
        return messages

    def close(self) -> None:
        self.socket.close()
        self.line.close()
