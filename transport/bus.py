"""The bus: one pair of Unix sockets (SOCK_SEQPACKET) per unit. Rule: no name anywhere; messages stay whole, in order.

The parent makes the pair and the unit inherits its end, so nothing is left on disk whoever is killed, and an end that
closes is noticed by the other at once.
"""

from __future__ import annotations

import socket
import struct
from typing import Self

from trilane.transport.messages import MAX_BYTES, Message, pack, unpack

#: What the kernel keeps of messages that were not read yet, in each direction; a message takes about 1 KiB of it.
BUFFER_BYTES = 1 << 20


class Link:
    """One end of a connection. With a patience it waits: for a message so long, and for room to send without end."""

    def __init__(self, end: socket.socket, patience_ms: int = 0) -> None:
        self.socket = end
        self._flags = 0 if patience_ms else socket.MSG_DONTWAIT
        self._buffer = bytearray(MAX_BYTES)
        end.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, BUFFER_BYTES)
        end.setsockopt(socket.SOL_SOCKET, socket.SO_RCVTIMEO, _timeval(patience_ms))

    @classmethod
    def inherited(cls, fd: int, patience_ms: int) -> Self:
        """The unit's end, which its process was started with."""
        return cls(socket.socket(fileno=fd), patience_ms)

    def fileno(self) -> int:
        return self.socket.fileno()

    def send(self, message: Message) -> None:
        """Raises BlockingIOError when the other end has stopped reading, ConnectionError when it is gone."""
        self.socket.send(pack(message), self._flags)

    def receive(self) -> Message | None:
        """The next message, None when there is none. Raises MessageError for anything else, EOFError at the end."""
        try:
            count = self.socket.recv_into(self._buffer, 0, self._flags)
        except BlockingIOError:
            return None
        except ConnectionResetError:  # said once when the other end left with messages unread; its own come after it
            return self.receive()
        if not count:
            raise EOFError
        return unpack(memoryview(self._buffer)[:count])

    def close(self) -> None:
        self.socket.close()


def _timeval(milliseconds: int) -> bytes:
    return struct.pack("@ll", *divmod(milliseconds * 1000, 1_000_000))


def pair() -> tuple[Link, socket.socket]:
    """The parent's end, and the one that a unit inherits."""
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    return Link(ours), theirs
