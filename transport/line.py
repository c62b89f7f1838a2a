"""The line of a unit: work to it, and answers. Rule: one message is one wake-up, and no thread is between the ends.

A pair of Unix sockets that keep messages apart. That a unit lives is said over the bus.
"""

from __future__ import annotations

import socket
import struct

from trilane.transport.messages import MAX_BYTES, Message, pack, unpack


def line_pair() -> tuple[socket.socket, socket.socket]:
    """Both ends, not inherited unless they are passed on."""
    return socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)


class Line:
    """One end. Messages arrive in order or not at all. `patience_ms`: how long `receive` waits; 0: not at all.

    `ended`: the other end is gone, and all that it said was received.
    """

    def __init__(self, end: socket.socket, patience_ms: int = 0) -> None:
        self.ended = False
        self._buffer = memoryview(bytearray(MAX_BYTES))
        self._socket = end
        self._flags = 0 if patience_ms else socket.MSG_DONTWAIT
        end.setblocking(True)
        seconds, rest = divmod(patience_ms, 1000)
        end.setsockopt(socket.SOL_SOCKET, socket.SO_RCVTIMEO, struct.pack("@ll", seconds, rest * 1000))

    def fileno(self) -> int:
        return self._socket.fileno()

    def send(self, message: Message) -> None:
        """To an end that is gone or has stopped reading: nothing, its end or its deadline tells."""
        try:
            self._socket.send(pack(message), socket.MSG_DONTWAIT)
        except (BlockingIOError, BrokenPipeError, ConnectionResetError):
            return

    def receive(self) -> Message | None:
        """The next message, None when there is none or the other end is gone. Raises MessageError for anything else."""
        try:
            size = self._socket.recv_into(self._buffer, 0, self._flags)
        except BlockingIOError:
            return None
        except ConnectionResetError:
            return self.receive()  # said once; what came before it can still be read
        self.ended = not size
        return unpack(self._buffer[:size]) if size else None

    def close(self) -> None:
        self._socket.close()
