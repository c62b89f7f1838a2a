"""Opens the dashboard's socket, and refuses requests that the server must not answer. Rule: every refusal is counted.

The server accepts only requests from this machine, to this address, with the token of this run. A page of another site
may know the port. Its requests are refused for their Origin header, or for a Host header with another host name. The
files of the page contain no secret and need no token. The socket listens before the server starts, so the printed
address accepts connections at once.
"""

from __future__ import annotations

import errno
import re
import secrets
import socket
from collections import Counter
from collections.abc import Awaitable, Callable, Mapping, MutableMapping
from dataclasses import dataclass
from enum import StrEnum
from typing import Any, Final
from urllib.parse import parse_qs

from trilane import machine
from trilane.errors import BadInputError, MissingPartError, install_line, reason

SEND_BYTES: Final = 1 << 18  # size of the system's buffer for bytes that a client has not yet received
PATIENCE_MS: Final = 10_000  # the system ends a connection whose client acknowledges nothing for so long
BACKLOG: Final = 256
TOKEN_BYTES: Final = 24
PACKAGES: Final = ("starlette", "uvicorn", "websockets", "prometheus_client")
ADDRESS: Final = "127.0.0.1"
#: Paths that need the token; all others are files of the page.
SECRET_PATHS: Final = frozenset({"/", "/live", "/metrics", "/trace.pftrace"})
#: Status of an answer about a missing page. It does not count as a refusal, because the request is allowed.
NOT_FOUND: Final = 404
#: Pattern of a path that may name a page. The page's files have names of at most 30 characters.
SOUND_PATH: Final = re.compile(r"(/(?!\.\.?(/|$))[\w.-]{0,60}){1,4}", re.ASCII)
MOST_FIELDS: Final = 16
#: Most bytes of a request's target and headers together. A browser sends less than 1 kB.
MOST_HEAD_BYTES: Final = 16384
VERSIONS: Final = ("1.0", "1.1")
Scope = MutableMapping[str, Any]
Receive = Callable[[], Awaitable[MutableMapping[str, Any]]]
Send = Callable[[MutableMapping[str, Any]], Awaitable[None]]
Asgi = Callable[[Scope, Receive, Send], Awaitable[None]]


class Refusal(StrEnum):
    """The reason for which the server refused a request, a message or a client. The values are labels of a metric."""

    WRONG_TOKEN = "wrong_token"  # noqa: S105 - the name of a count
    FOREIGN_HOST = "foreign_host"
    FOREIGN_ORIGIN = "foreign_origin"
    TOO_MANY_CLIENTS = "too_many_clients"
    OVERSIZED = "oversized"
    MALFORMED = "malformed"
    CONTROL = "control"
    SLOW_CLIENT = "slow_client"


#: HTTP status of a refusal.
STATUS: Final = {
    Refusal.FOREIGN_HOST: 421,
    Refusal.FOREIGN_ORIGIN: 403,
    Refusal.WRONG_TOKEN: 403,
    Refusal.MALFORMED: 400,
    Refusal.OVERSIZED: 431,
}


@dataclass(frozen=True)
class ServerAddress:
    """The address of a server.

    `listener`: socket that listens.
    `token`: secret that requests for the paths in `SECRET_PATHS` must contain.
    """

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
    """Raise MissingPartError if one of the `PACKAGES` that the server needs is missing."""
    for package in PACKAGES:
        if not machine.here.has_package(package):
            raise MissingPartError(f"the dashboard needs the package {package}", install_line("dashboard"))


def listen(port: int | None) -> ServerAddress:
    """Return the address of a new socket that listens for connections from this machine only, with a new token.

    `port`: port to listen on; None for any free port.
    Raises BadInputError if the port is in use or not allowed.
    """
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
    return ServerAddress(listener, secrets.token_urlsafe(TOKEN_BYTES))


class Refusals:
    """Counts all refusals of a server by reason. A reason that never occurred has the count 0."""

    def __init__(self) -> None:
        self._counts: Counter[Refusal] = Counter(dict.fromkeys(Refusal, 0))

    def add(self, why: Refusal) -> None:
        self._counts[why] += 1

    def as_json(self) -> dict[str, int]:
        """Return the count of each reason, by the value of its `Refusal`."""
        return {why.value: count for why, count in self._counts.items()}


def hosts(port: int) -> tuple[str, str]:
    """Return the two values of the Host header that a server on `port` accepts."""
    return f"{ADDRESS}:{port}", f"localhost:{port}"


def headers(port: int) -> dict[str, str]:
    """Return the headers that every answer of a server on `port` has.

    They forbid foreign content, inline code, caching and referrers.
    """
    sockets = " ".join(f"ws://{host}" for host in hosts(port))
    policy = (
        "default-src 'none'; script-src 'self'; style-src 'self'; font-src 'self'; img-src 'self' blob:; "
        f"connect-src 'self' {sockets}; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    )
    return {
        "content-security-policy": policy,
        "x-content-type-options": "nosniff",
        "x-frame-options": "DENY",
        "referrer-policy": "no-referrer",
        "cross-origin-resource-policy": "same-origin",
        "cross-origin-opener-policy": "same-origin-allow-popups",  # the trace is handed to a window of its own
        "permissions-policy": "camera=(), microphone=(), geolocation=()",
        "cache-control": "no-store",
    }


def refusal_of_head(scope: Mapping[str, Any]) -> Refusal | None:
    """Return why a request is refused: for a large head, a body, or a wrong HTTP version. None if it is allowed.

    `scope`: ASGI scope of the request.
    """
    lines = [scope["raw_path"] + scope["query_string"], *(name + value for name, value in scope["headers"])]
    if sum(map(len, lines)) > MOST_HEAD_BYTES:
        return Refusal.OVERSIZED
    bodies = [name for name, value in scope["headers"] if name == b"content-length" and value.strip(b"0")]
    bodies += [name for name, _ in scope["headers"] if name == b"transfer-encoding"]
    return Refusal.MALFORMED if bodies or scope["http_version"] not in VERSIONS else None


class Guard:
    """ASGI middleware that refuses requests, counts the refusals, and adds `headers` to every answer.

    An answer of `app` with a status from 400 to 499, except NOT_FOUND, counts as a refusal too.
    `app`: application that answers the allowed requests.
    `port`: port of the server.
    `token`: token that secret paths need.
    `refusals`: counts of refusals, to which the guard adds.
    """

    def __init__(self, app: Asgi, port: int, token: str, refusals: Refusals) -> None:
        self._app, self._hosts, self._token, self._refusals = app, hosts(port), token, refusals
        self._headers = [(name.encode(), value.encode()) for name, value in headers(port).items()]

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] not in ("http", "websocket"):
            await self._app(scope, receive, send)
            return
        why = self.refusal_of(scope)
        if why is None:
            await self._app(scope, receive, self._with_headers(send, is_refused=False))
            return
        self._refusals.add(why)
        await self._refuse(scope, receive, self._with_headers(send, is_refused=True), why)

    def refusal_of(self, scope: Mapping[str, Any]) -> Refusal | None:
        """Return the reason for which a request is refused; None if the request is allowed.

        `scope`: ASGI scope of the request.
        """
        given = [(name.lower(), value.decode("latin-1")) for name, value in scope["headers"]]
        if [value for name, value in given if name == b"host"] not in [[host] for host in self._hosts]:
            return Refusal.FOREIGN_HOST
        origins = [value for name, value in given if name == b"origin"]
        ours = [[f"http://{host}"] for host in self._hosts]
        if origins not in ours and (origins or scope["type"] == "websocket"):
            return Refusal.FOREIGN_ORIGIN
        if SOUND_PATH.fullmatch(scope["path"]) is None:
            return Refusal.MALFORMED
        if why := refusal_of_head(scope):
            return why
        if scope["path"] in SECRET_PATHS:
            return self._refusal_of_token(scope["query_string"])
        return None

    def _refusal_of_token(self, query: bytes) -> Refusal | None:
        try:
            tokens = parse_qs(query.decode("latin-1"), max_num_fields=MOST_FIELDS).get("token", [])
        except ValueError:
            return Refusal.MALFORMED
        is_known = len(tokens) == 1 and secrets.compare_digest(tokens[0].encode(), self._token.encode())
        return None if is_known else Refusal.WRONG_TOKEN

    async def _refuse(self, scope: Scope, receive: Receive, send: Send, why: Refusal) -> None:
        if scope["type"] == "websocket":
            await receive()
            await send({"type": "websocket.close", "code": 1008, "reason": why.value})
            return
        body = f"refused: {why.value.replace('_', ' ')}\n".encode()
        plain = [(b"content-type", b"text/plain; charset=utf-8"), (b"content-length", str(len(body)).encode())]
        await send({"type": "http.response.start", "status": STATUS[why], "headers": plain})
        await send({"type": "http.response.body", "body": body})

    def _with_headers(self, send: Send, *, is_refused: bool) -> Send:
        async def sent(message: MutableMapping[str, Any]) -> None:
            if message["type"] == "http.response.start":
                if not is_refused and 400 <= message["status"] < 500 and message["status"] != NOT_FOUND:
                    self._refusals.add(Refusal.MALFORMED)
                ours = {name for name, _ in self._headers}
                theirs = [pair for pair in message.get("headers", []) if pair[0].lower() not in ours]
                message = {**message, "headers": [*theirs, *self._headers]}
            await send(message)

        return sent
