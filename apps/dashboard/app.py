"""The dashboard's HTTP server: the page's files, a WebSocket, metrics and the trace.

Rule: this module decides nothing about the run. News about the run goes to all clients; an answer goes only to the
client that asked. For each request for a picture, a client gets one picture: the newest one that the client has not
had. A client that does not receive or answer in time loses its connection.
"""

from __future__ import annotations

import asyncio
import contextlib
import traceback
from collections.abc import AsyncIterator, Callable
from functools import partial
from pathlib import Path
from typing import Any, Final

from starlette.applications import Starlette
from starlette.requests import Request
from starlette.responses import FileResponse, PlainTextResponse, Response
from starlette.routing import Mount, Route, WebSocketRoute
from starlette.staticfiles import StaticFiles
from starlette.websockets import WebSocket, WebSocketDisconnect

from trilane.apps.dashboard.access import MOST_HEAD_BYTES, Asgi, Guard, Refusal, Refusals, refusal_of_head
from trilane.apps.dashboard.view import (
    MOST_BYTES,
    ChangesSaid,
    Client,
    Clients,
    Heard,
    MalformedError,
    PictureAsked,
    RunView,
    Seek,
    heard,
    said,
)

PAGE: Final = Path(__file__).with_name("page")
NEWS_S: Final = 0.1
PICTURE_S: Final = 0.02
LAST_S: Final = 0.3
MOST_FAULTS: Final = 16
OPENMETRICS: Final = "application/openmetrics-text; version=1.0.0; charset=utf-8"
#: Close code of a WebSocket whose client broke the protocol -> the refusal to count.
PROTOCOL_FAULTS: Final = {1009: Refusal.OVERSIZED, 1002: Refusal.MALFORMED, 1007: Refusal.MALFORMED}
REFUSED_HELP: Final = (
    "# HELP trilane_dashboard_refused Requests, messages and clients that the dashboard refused or dropped.\n"
    "# TYPE trilane_dashboard_refused counter\n"
)
PING_S: Final = 10.0
SWITCHING: Final = 101  # HTTP status of an accepted WebSocket


class DashboardApp:
    """The server's application.

    `view`: run to show.
    `port`: port on which the server listens.
    `token`: secret that clients must send.

    `asgi`: the ASGI application. `refusals`: counts of refused requests. `stop`: function that ends the server; the
    function `server` sets it. The application calls `stop` if one of its own tasks fails.
    """

    def __init__(self, view: RunView, port: int, token: str) -> None:
        self._view = view
        self.stop: Callable[[], None] = lambda: None
        self.refusals = Refusals()
        self._clients = Clients()
        self._asked = asyncio.Event()
        routes = [
            Route("/", self._index),
            Route("/metrics", self._metrics),
            Route("/trace.pftrace", self._trace),
            WebSocketRoute("/live", self._live),
            Mount("/", StaticFiles(directory=PAGE, check_dir=False)),
        ]
        app = Starlette(routes=routes, lifespan=self._lifespan)
        self.asgi: Asgi = Guard(app, port, token, self.refusals)

    async def finish(self) -> None:
        """Send the remaining messages to all clients, and wait LAST_S seconds so that clients can receive them."""
        await self._tell_newest()
        await asyncio.sleep(LAST_S)

    @contextlib.asynccontextmanager
    async def _lifespan(self, _app: Starlette) -> AsyncIterator[None]:
        tasks = [asyncio.create_task(self._tell_news()), asyncio.create_task(self._hand_out_pictures())]
        for task in tasks:
            task.add_done_callback(self._stop_if_failed)
        try:
            yield
        finally:
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)

    def _stop_if_failed(self, task: asyncio.Task[None]) -> None:
        """Print the traceback and end the server if `task` failed, so that the page does not stop without a reason."""
        if not task.cancelled() and (error := task.exception()) is not None:
            traceback.print_exception(error)
            self.stop()

    async def _index(self, _request: Request) -> Response:
        return FileResponse(PAGE / "index.html")

    async def _metrics(self, _request: Request) -> Response:
        rows = [f'trilane_dashboard_refused_total{{why="{why}"}} {n}\n' for why, n in self.refusals.as_json().items()]
        return Response("".join([self._view.metrics(), REFUSED_HELP, *rows, "# EOF\n"]), media_type=OPENMETRICS)

    async def _trace(self, _request: Request) -> Response:
        trace = self._view.trace
        if trace is None or not trace.is_file():
            return PlainTextResponse("this run has no trace yet\n", 404)
        return FileResponse(trace, media_type="application/octet-stream", filename=trace.name)

    async def _live(self, socket: WebSocket) -> None:
        if self._clients.are_full:
            self.refusals.add(Refusal.TOO_MANY_CLIENTS)
            await socket.close(1013)
            return
        client = Client(socket, lambda: self.refusals.add(Refusal.SLOW_CLIENT))
        with self._clients.joined(client):
            await socket.accept()
            for message in self._view.greeting():
                client.put(said(message))
            client.put(said(self._refused()))
            tasks = [asyncio.create_task(client.send_all()), asyncio.create_task(self._listen(socket, client))]
            try:
                await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
            finally:
                for task in tasks:
                    task.cancel()
                await asyncio.gather(*tasks, return_exceptions=True)
        with contextlib.suppress(RuntimeError, WebSocketDisconnect):  # the client has closed it already
            await socket.close(1008)

    async def _listen(self, socket: WebSocket, client: Client) -> None:
        """Carry out the messages of `client` until it disconnects or has sent MOST_FAULTS malformed messages."""
        while client.faults < MOST_FAULTS:
            event = await socket.receive()
            if event["type"] == "websocket.disconnect":
                if event.get("code") in PROTOCOL_FAULTS:
                    self.refusals.add(PROTOCOL_FAULTS[event["code"]])
                return
            try:
                await self._do(client, heard(event.get("bytes") or b""))
            except MalformedError as error:
                client.faults += 1
                self._refuse(client, Refusal.MALFORMED, "", str(error))

    async def _do(self, client: Client, message: Heard) -> None:
        if isinstance(message, PictureAsked):
            client.asks_picture = True
            self._asked.set()
        elif isinstance(message, Seek):
            for answer in await self._view.seek(client, message):
                client.put(said(answer))
        elif isinstance(message, ChangesSaid):
            for name, why in self._view.restart(message).items():
                self._refuse(client, Refusal.CONTROL, name, why)
        elif why := self._view.control(message):
            self._refuse(client, Refusal.CONTROL, message.name, why)

    def _refuse(self, client: Client, kind: Refusal, control: str, why: str) -> None:
        self.refusals.add(kind)
        client.put(said({"type": "refused", "control": control, "why": why}))

    def _refused(self) -> dict[str, Any]:
        return {"type": "refusals", "counts": self.refusals.as_json()}

    async def _tell_news(self) -> None:
        counts = self.refusals.as_json()
        while True:
            await asyncio.sleep(NEWS_S)
            await self._tell_newest()
            if counts != self.refusals.as_json():
                counts = self.refusals.as_json()
                self._clients.tell(said(self._refused()))

    async def _tell_newest(self) -> None:
        for message in await self._view.news(is_watched=len(self._clients) > 0):
            self._clients.tell(said(message))

    async def _hand_out_pictures(self) -> None:
        while True:
            await self._asked.wait()
            waiting = self._clients.waiting
            if not waiting:
                self._asked.clear()
                continue
            for client in waiting:
                picture = await self._view.picture(client)
                if picture is not None:
                    client.asks_picture = False
                    client.put(picture)
            await asyncio.sleep(PICTURE_S)


def server(app: DashboardApp) -> Any:
    """Return a uvicorn server for `app`. Its coroutine `serve(sockets=[...])` returns after `should_exit` is set.

    Requests that uvicorn itself refuses are counted in `app.refusals`.
    """
    import uvicorn
    from uvicorn.protocols.http.h11_impl import H11Protocol
    from uvicorn.protocols.websockets.websockets_sansio_impl import WebSocketsSansIOProtocol

    class Http(H11Protocol):  # type: ignore[misc]
        def send_400_response(self, msg: str) -> None:
            app.refusals.add(Refusal.MALFORMED)
            super().send_400_response(msg)

        def handle_websocket_upgrade(self, event: Any) -> None:
            if refusal_of_head(self.scope) is None:  # checked here: uvicorn passes on every version as 1.1
                super().handle_websocket_upgrade(event)
            else:
                self.send_400_response("refused: malformed")

    class WebSockets(WebSocketsSansIOProtocol):  # type: ignore[misc]
        def handle_connect(self, event: Any) -> None:
            super().handle_connect(event)
            if self.response.status_code != SWITCHING:
                app.refusals.add(Refusal.MALFORMED)

        def handle_text(self, event: Any) -> None:
            self.handle_bytes(event)  # the original method prints a traceback for a text that is not UTF-8

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
        h11_max_incomplete_event_size=MOST_HEAD_BYTES,
        server_header=False,
        date_header=False,
        http=Http,
    )
    answers = uvicorn.Server(config)
    app.stop = partial(setattr, answers, "should_exit", True)
    return answers
