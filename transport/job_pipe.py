"""The job pipe of a unit: jobs to it, and its answers. Rule: one message wakes one process, with no thread between.

It is two pipes, one each way, in packet mode (O_DIRECT of pipe(2)), in which every read returns one whole message.
Heartbeats do not go over it (see `trilane.transport.heartbeats`).
"""

from __future__ import annotations

import errno
import fcntl
import os
from typing import NamedTuple

from trilane.errors import TrilaneError, reason
from trilane.transport.messages import MAX_BYTES, Message, pack, unpack

PACKETS = 16  # messages that a pipe holds: a page each, of the 64 KiB that Linux gives a pipe


class JobPipeEnd(NamedTuple):
    """The file descriptors of one end. Child processes inherit them only when they are passed on explicitly."""

    reads: int
    writes: int

    def close(self) -> None:
        for fd in self:
            os.close(fd)


def job_pipe_pair() -> tuple[JobPipeEnd, JobPipeEnd]:
    """The two ends of a new job pipe. Raises TrilaneError when this user or this process may open no more pipes."""
    fds: list[int] = []
    try:
        for _ in range(2):
            fds += os.pipe2(os.O_CLOEXEC | os.O_DIRECT)
            size = fcntl.fcntl(fds[-1], fcntl.F_GETPIPE_SZ)
            if size < PACKETS * os.sysconf("SC_PAGESIZE"):
                raise OSError(errno.EDQUOT, f"{size} bytes for a pipe, by /proc/sys/fs/pipe-user-pages-soft")
    except OSError as error:
        for fd in fds:
            os.close(fd)
        raise TrilaneError(f"no pipe for {PACKETS} messages: {reason(error)}") from None
    return JobPipeEnd(fds[2], fds[1]), JobPipeEnd(fds[0], fds[3])


class JobPipe:
    """One end of a job pipe. Messages arrive in order or not at all.

    `waits`: `receive` waits until there is a message. `ended`: the other end is closed, and every message that it sent
    has been received.
    """

    def __init__(self, end: JobPipeEnd, *, waits: bool = False) -> None:
        self.ended = False
        self._end = end
        self._reads, self._writes = end
        os.set_blocking(end.reads, waits)
        os.set_blocking(end.writes, False)

    def fileno(self) -> int:
        """Readable when `receive` has something to return, or when the other end is closed."""
        return self._reads

    def send(self, message: Message) -> None:
        """Send without waiting. Does nothing when the other end is closed or its pipe is full.

        The scheduler learns of such a unit by the end of its process or by a missed deadline.
        """
        try:
            os.write(self._writes, pack(message))
        except (BlockingIOError, BrokenPipeError):
            return

    def receive(self) -> Message | None:
        """The next message; None when none has come (if this end does not wait) or the other end is closed.

        Raises MessageError for bytes that are no message.
        """
        try:
            data = os.read(self._reads, MAX_BYTES)
        except BlockingIOError:
            return None
        self.ended = not data
        return unpack(data) if data else None

    def close(self) -> None:
        self._end.close()
