"""A server on a socket of this machine. Rule: what a client does not take or say in time is given up by the system.

The socket listens before the server starts, so the address that is printed can be asked at once.
"""

from __future__ import annotations

import errno
import secrets
import socket
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

from trilane import machine
from trilane.apps.dashboard.guard import ADDRESS
from trilane.apps.dashboard.refusals import Refusal
from trilane.errors import BadInputError, MissingPartError, install_line, reason

if TYPE_CHECKING:
    from trilane.apps.dashboard.app import DashboardApp

SEND_BYTES: Final = 1 << 18  # that the system keeps of what a client does not take
PATIENCE_MS: Final = 10_000
PING_S: Final = 10.0
BACKLOG: Final = 256
TOKEN_BYTES: Final = 24
SWITCHING: Final = 101  # status of a WebSocket that begins
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


def server(app: DashboardApp) -> Any:
    """A uvicorn server of `app`; its `serve(sockets=[...])` returns when its `should_exit` is set.

    What uvicorn refuses before the app hears of it is counted by the app.
    """
    import uvicorn
    from uvicorn.protocols.http.h11_impl import H11Protocol
    from uvicorn.protocols.websockets.websockets_sansio_impl import WebSocketsSansIOProtocol

    from trilane.apps.dashboard.wire import MOST_BYTES

    class Http(H11Protocol):  # type: ignore[misc]
        def send_400_response(self, msg: str) -> None:
            app.refusals.add(Refusal.MALFORMED)
            super().send_400_response(msg)

    class WebSockets(WebSocketsSansIOProtocol):  # type: ignore[misc]
        def handle_connect(self, event: Any) -> None:
            super().handle_connect(event)
            if self.response.status_code != SWITCHING:
                app.refusals.add(Refusal.MALFORMED)

        def handle_text(self, event: Any) -> None:
            self.handle_bytes(event)  # uvicorn prints a traceback where a text is not UTF-8

    config = uvicorn.Config(
        app.asgi,
        log_config=None,
        access_log=False,
        lifespan="on",
        ws=WebSockets,
        ws_max_size=MOST_BYTES,
        ws_ping_interval=PING_S,
        ws_ping_timeout=PING_S,
        ws_per_message_deflate=False,
        timeout_keep_alive=5,
        timeout_graceful_shutdown=1,
        h11_max_incomplete_event_size=16384,
        server_header=False,
        date_header=False,
        http=Http,
    )
    return uvicorn.Server(config)
