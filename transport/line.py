"""The line of a unit: work to it, and answers. Rule: one message is one wake-up, and no thread is between the ends.

Two pipes in packet mode (O_DIRECT of pipe(2)), which keep messages apart. That a unit lives is said over the bus.
"""

from __future__ import annotations

import fcntl
import os
from typing import NamedTuple

from trilane.errors import TrilaneError
from trilane.transport.messages import MAX_BYTES, Message, pack, unpack

PACKETS = 64  # that a pipe holds, a page each; a unit has at most a few outstanding


class LineEnd(NamedTuple):
    """File descriptors, not inherited unless they are passed on."""

    reads: int
    writes: int

    def close(self) -> None:
        for fd in self:
            os.close(fd)


def line_pair() -> tuple[LineEnd, LineEnd]:
    """Both ends. Raises TrilaneError when the user has no more memory for pipes."""
    there, back = os.pipe2(os.O_CLOEXEC | os.O_DIRECT), os.pipe2(os.O_CLOEXEC | os.O_DIRECT)
    ends = LineEnd(back[0], there[1]), LineEnd(there[0], back[1])
    try:
        for end in ends:
            fcntl.fcntl(end.writes, fcntl.F_SETPIPE_SZ, PACKETS * os.sysconf("SC_PAGESIZE"))
    except OSError as error:
        for end in ends:
            end.close()
        limit = "/proc/sys/fs/pipe-user-pages-soft"
        raise TrilaneError(f"no pipe of {PACKETS} messages: {error.strerror}; {limit} is the user's limit") from None
    return ends


class Line:
    """One end. Messages arrive in order or not at all. `waits`: `receive` waits for a message.

    `ended`: the other end is gone, and all that it said was received.
    """

    def __init__(self, end: LineEnd, *, waits: bool = False) -> None:
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
