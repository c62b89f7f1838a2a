"""One end of the connection between the scheduler and a unit: the job pipe and the heartbeat socket together.

Rule: what must keep its order (jobs and their answers) goes over the job pipe; heartbeats have a way of their own, so
that neither delays the other.
"""

from __future__ import annotations

import zmq

from trilane.transport.heartbeats import HeartbeatSocket
from trilane.transport.job_pipe import JobPipe
from trilane.transport.messages import Heartbeat, Message


class Link:
    """`job_pipe` and `heartbeat_socket` of one end. Messages of each arrive in order or not at all."""

    def __init__(self, context: zmq.Context[zmq.Socket[bytes]], job_pipe: JobPipe, linger_ms: int = 0) -> None:
        """Takes over `job_pipe`; `context` and `linger_ms` are those of `HeartbeatSocket`."""
        self.job_pipe = job_pipe
        self.heartbeat_socket = HeartbeatSocket(context, linger_ms)

    def bind(self, endpoint: str) -> None:
        """Wait for the unit's heartbeats at `endpoint` (the scheduler's end)."""
        self.heartbeat_socket.socket.bind(endpoint)

    def connect(self, endpoint: str) -> None:
        """Send heartbeats to `endpoint` (the unit's end)."""
        self.heartbeat_socket.socket.connect(endpoint)

    @property
    def heartbeat_fd(self) -> int:
        """A descriptor that is readable when `heartbeats` is to be called."""
        return self.heartbeat_socket.fileno()

    def send_heartbeat(self, message: Heartbeat) -> None:
        """Send without waiting. Does nothing when the other end has stopped reading."""
        self.heartbeat_socket.send(message)

    def heartbeats(self) -> list[Message]:
        """All heartbeats since the last call. Raises MessageError for bytes that are no message."""
        return self.heartbeat_socket.receive()

    def close(self) -> None:
        """Close both; heartbeats that were sent are delivered within `linger_ms`."""
        self.heartbeat_socket.close()
        self.job_pipe.close()
