"""Who may ask the server for anything. Rule: this machine alone, under this address, with the token of this run.

A page of another site that knows the port gets nothing: its Origin is not ours, and a name that it lets point here is
not in the Host header that is expected. The page's own files hold nothing secret and need no token.
"""

from __future__ import annotations

import secrets
from collections.abc import Awaitable, Callable, Mapping, MutableMapping
from typing import Any, Final
from urllib.parse import parse_qs

from trilane.apps.dashboard.refusals import Refusal, Refusals

ADDRESS: Final = "127.0.0.1"
#: Paths that need the token; all others are files of the page.
SECRET_PATHS: Final = frozenset({"/", "/live", "/metrics", "/trace.pftrace"})
STATUS: Final = {
    Refusal.FOREIGN_HOST: 421,
    Refusal.FOREIGN_ORIGIN: 403,
    Refusal.WRONG_TOKEN: 403,
    Refusal.MALFORMED: 400,
}
#: Of a page that is not there: who asks for one asks for nothing that may not be asked.
NOT_FOUND: Final = 404
MOST_FIELDS: Final = 16

Scope = MutableMapping[str, Any]
Receive = Callable[[], Awaitable[MutableMapping[str, Any]]]
Send = Callable[[MutableMapping[str, Any]], Awaitable[None]]
Asgi = Callable[[Scope, Receive, Send], Awaitable[None]]


def hosts(port: int) -> tuple[str, str]:
    """What the Host header may say."""
    return f"{ADDRESS}:{port}", f"localhost:{port}"


def headers(port: int) -> dict[str, str]:
    """Of every answer: nothing from elsewhere, nothing inline, nothing kept, nothing told to others."""
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


class Guard:
    """ASGI middleware: refuses what `refusal_of` names, counts all that is refused, gives every answer `headers`."""

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
        """Why the request is refused, None when it is not."""
        given = [(name.lower(), value.decode("latin-1")) for name, value in scope["headers"]]
        if [value for name, value in given if name == b"host"] not in [[host] for host in self._hosts]:
            return Refusal.FOREIGN_HOST
        origins = [value for name, value in given if name == b"origin"]
        ours = [[f"http://{host}"] for host in self._hosts]
        if origins not in ours and (origins or scope["type"] == "websocket"):
            return Refusal.FOREIGN_ORIGIN
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
