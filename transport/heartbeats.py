"""Heartbeats: one ZeroMQ PAIR socket per unit, over which the unit says that it is ready and that it is alive.

Rule: neither end ever waits for the other. A heartbeat that the other end does not read is dropped.
"""

from __future__ import annotations

import contextlib
from collections.abc import Sequence

import zmq

from trilane.transport.messages import MAX_BYTES, Heartbeat, Message, pack, unpack
from trilane.transport.wakeup import SHORTEST_NS, use_slice

HIGH_WATER = 64  # messages in ZeroMQ's queue; a unit has at most a few outstanding
LINGER_MS = 1000  # how long a unit that ends tries to deliver its last heartbeat


class HeartbeatSocket:
    """One end of a unit's heartbeat connection.

    `socket`: the ZeroMQ socket; one end binds it, the other connects it.
    """

    def __init__(self, context: zmq.Context[zmq.Socket[bytes]], linger_ms: int = 0) -> None:
        """A socket of `context`. On closing it tries for `linger_ms` to deliver what was sent."""
        self.socket: zmq.Socket[bytes] = context.socket(zmq.PAIR)
        self.socket.setsockopt(zmq.LINGER, linger_ms)
        self.socket.setsockopt(zmq.MAXMSGSIZE, MAX_BYTES)
        self.socket.setsockopt(zmq.SNDHWM, HIGH_WATER)
        self.socket.setsockopt(zmq.RCVHWM, HIGH_WATER)

    def fileno(self) -> int:
        """Readable when the socket may have messages: then `receive` is to be called."""
        return self.socket.fileno()

    def send(self, message: Heartbeat) -> None:
        """Send without waiting. Does nothing when the other end has stopped reading."""
        with contextlib.suppress(zmq.Again):
            self.socket.send(pack(message), zmq.DONTWAIT)

    def receive(self) -> list[Message]:
        """All messages that have come since the last call. Raises MessageError for bytes that are no message."""
        messages = []
        while self.socket.poll(0):  # until it is empty: ZeroMQ's descriptor does not become readable again before
            messages.append(unpack(self.socket.recv(zmq.DONTWAIT)))
        return messages

    def close(self) -> None:
        self.socket.close()


def context_on_cores(cores: Sequence[int]) -> zmq.Context[zmq.Socket[bytes]]:
    """A ZeroMQ context for a unit, whose I/O thread runs on `cores` and preempts other work there when it is woken.

    On the unit's own cores that thread would wait behind the unit's next job. Call it from the thread that makes the
    first socket: the I/O thread inherits the short time slice that this function sets, and the caller keeps it too.
    """
    context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
    for core in cores:
        context.set(zmq.THREAD_AFFINITY_CPU_ADD, core)
    use_slice(SHORTEST_NS)
    return context
