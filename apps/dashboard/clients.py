"""The pages that look at a run. Rule: none can make anything wait; what it leaves unsent is bounded, then it goes.

Each has a queue of its own and a task that empties it. A client whose queue is full, or that takes nothing for
SEND_S, is dropped and counted.
"""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Callable, Iterator
from typing import Final, Protocol

MOST_CLIENTS: Final = 8
MOST_QUEUED: Final = 128
SEND_S: Final = 5.0


class Socket(Protocol):
    """The server's end of a WebSocket."""

    async def send_bytes(self, data: bytes) -> None:
        """Returns when the bytes are with the system, or will be soon."""

    async def close(self, code: int = 1000, reason: str | None = None) -> None:
        """Nothing more is sent."""


class Client:
    """A page. `gone`: called once when it is dropped.

    `asks_picture`: it waits for one. `had_frame`: number of the last that it got. `faults`: how often it said what it
    may not.
    """

    def __init__(self, socket: Socket, gone: Callable[[], None]) -> None:
        self._socket, self._gone = socket, gone
        self._queue: asyncio.Queue[bytes] = asyncio.Queue(MOST_QUEUED)
        self._dropped = asyncio.Event()
        self.asks_picture = False
        self.had_frame = -1
        self.faults = 0

    def put(self, data: bytes) -> None:
        """To be sent; a client that left so much unsent is dropped."""
        try:
            self._queue.put_nowait(data)
        except asyncio.QueueFull:
            self._drop()

    async def send_all(self) -> None:
        """Send what is put until the client is dropped or has left."""
        sender = asyncio.ensure_future(self._send())
        dropped = asyncio.ensure_future(self._dropped.wait())
        try:
            await asyncio.wait([sender, dropped], return_when=asyncio.FIRST_COMPLETED)
        finally:
            for task in (sender, dropped):
                task.cancel()
            await asyncio.gather(sender, dropped, return_exceptions=True)

    async def _send(self) -> None:
        while True:
            data = await self._queue.get()
            try:
                async with asyncio.timeout(SEND_S):  # wait_for of Python 3.11 may lose a cancellation
                    await self._socket.send_bytes(data)
            except TimeoutError:
                self._drop()
                return

    def _drop(self) -> None:
        if not self._dropped.is_set():
            self._dropped.set()
            self._gone()


class Clients:
    """All pages of a server."""

    def __init__(self) -> None:
        self._live: set[Client] = set()

    def __len__(self) -> int:
        return len(self._live)

    @property
    def waiting(self) -> list[Client]:
        """Those that wait for a picture."""
        return [client for client in self._live if client.asks_picture]

    @contextlib.contextmanager
    def joined(self, client: Client) -> Iterator[None]:
        """`client` is told what all are told."""
        self._live.add(client)
        try:
            yield
        finally:
            self._live.discard(client)

    @property
    def are_full(self) -> bool:
        return len(self._live) >= MOST_CLIENTS

    def tell(self, data: bytes) -> None:
        """To all of them."""
        for client in list(self._live):
            client.put(data)
