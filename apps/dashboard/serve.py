"""A server on a socket of this machine. Rule: what a client does not take or say in time is given up by the system.

The socket listens before the server starts, so the address that is printed can be asked at once.
"""

from __future__ import annotations

import errno
import secrets
import socket
from dataclasses import dataclass
from typing import Any, Final

from trilane import machine
from trilane.apps.dashboard.guard import ADDRESS
from trilane.errors import BadInputError, MissingPartError, reason
from trilane.install import install_line

SEND_BYTES: Final = 1 << 18  # that the system keeps of what a client does not take
PATIENCE_MS: Final = 10_000
PING_S: Final = 10.0
BACKLOG: Final = 256
TOKEN_BYTES: Final = 24
PACKAGES: Final = ("starlette", "uvicorn", "websockets", "prometheus_client")


@dataclass(frozen=True)
class Place:
    """Where a server listens and what one has to know to be answered."""

    listener: socket.socket
    token: str

    @property
    def port(self) -> int:
        return int(self.listener.getsockname()[1])

    @property
    def url(self) -> str:
        return f"http://{ADDRESS}:{self.port}/?token={self.token}"

    def close(self) -> None:
        self.listener.close()


def require_server() -> None:
    """Raises MissingPartError when the packages of the extra are missing."""
    for package in PACKAGES:
        if not machine.here.has_package(package):
            raise MissingPartError(f"the dashboard needs the package {package}", install_line("dashboard"))


def listen(port: int | None) -> Place:
    """A socket on `port` of this machine alone, on any free one when None. Raises BadInputError."""
    listener = socket.socket(socket.AF_INET, socket.SOCK_STREAM | socket.SOCK_CLOEXEC)
    try:
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SEND_BYTES)
        listener.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, PATIENCE_MS)
        listener.bind((ADDRESS, port or 0))
        listener.listen(BACKLOG)
    except OSError as error:
        listener.close()
        found = f"{port}, which is in use" if error.errno == errno.EADDRINUSE else f"{port}: {reason(error)}"
        raise BadInputError("--port", found, "a port that is free", "without it a free one is taken") from None
    return Place(listener, secrets.token_urlsafe(TOKEN_BYTES))


def server(asgi: Any) -> Any:
    """A uvicorn server of `asgi`; its `serve(sockets=[...])` returns when its `should_exit` is set."""
    import uvicorn

    from trilane.apps.dashboard.wire import MOST_BYTES

    config = uvicorn.Config(
        asgi,
        log_config=None,
        access_log=False,
        lifespan="on",
        ws="websockets-sansio",
        ws_max_size=MOST_BYTES,
        ws_ping_interval=PING_S,
        ws_ping_timeout=PING_S,
        ws_per_message_deflate=False,
        timeout_keep_alive=5,
        timeout_graceful_shutdown=1,
        h11_max_incomplete_event_size=16384,
        server_header=False,
        date_header=False,
        http="h11",
    )
    return uvicorn.Server(config)
