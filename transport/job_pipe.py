"""The line of a unit: work to it, and answers. Rule: one message is one wake-up, and no thread is between the ends.

Two pipes in packet mode (O_DIRECT of pipe(2)), which keep messages apart. That a unit lives is said over the bus.
"""

from __future__ import annotations

import errno
import fcntl
import os
from typing import NamedTuple

from trilane.errors import TrilaneError, reason
from trilane.transport.messages import MAX_BYTES, Message, pack, unpack

PACKETS = 16  # that a pipe holds: a page each, of the 64 KiB that Linux gives it; a unit has a few outstanding


class JobPipeEnd(NamedTuple):
    """File descriptors, not inherited unless they are passed on."""

    reads: int
    writes: int

    def close(self) -> None:
        for fd in self:
            os.close(fd)


def job_pipe_pair() -> tuple[JobPipeEnd, JobPipeEnd]:
    """Both ends. Raises TrilaneError when this user or process has no more pipes."""
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
    """One end. Messages arrive in order or not at all. `waits`: `receive` waits for a message.

    `ended`: the other end is gone, and all that it said was received.
    """

    def __init__(self, end: JobPipeEnd, *, waits: bool = False) -> None:
        self.ended = False
        self._end = end
        self._reads, self._writes = end
        os.set_blocking(end.reads, waits)
        os.set_blocking(end.writes, False)

    def fileno(self) -> int:
        return self._reads

    def send(self, message: Message) -> None:
        """To an end that is gone or has stopped reading: nothing, its end or its deadline tells."""
        try:
            os.write(self._writes, pack(message))
        except (BlockingIOError, BrokenPipeError):
            return

    def receive(self) -> Message | None:
        """The next message, None when there is none or the other end is gone. Raises MessageError for anything else."""
        try:
            data = os.read(self._reads, MAX_BYTES)
        except BlockingIOError:
            return None
        self.ended = not data
        return unpack(data) if data else None

    def close(self) -> None:
        self._end.close()
