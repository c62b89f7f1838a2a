"""The pages that show a run: the messages between a page and its server, and the limit of unsent ones.

Rule: a message is a kind, then a payload; every message of a page is checked. Kind 1 is JSON in UTF-8, both ways. Kind
2, to the page alone, is a picture: the frame's number (uint32), its time in the scene and its age (float64, ms), all
little-endian, then a JPEG. No page can make anything wait: each has a queue of its own and a task that empties it. A
page whose queue is full, or that takes nothing for SEND_S, is dropped and counted.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import struct
from collections.abc import Callable, Iterator, Mapping
from typing import Annotated, Any, Final, Literal, Protocol

from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, ValidationError

MOST_CLIENTS: Final = 8
MOST_QUEUED: Final = 128
SEND_S: Final = 5.0
JSON_KIND: Final = 1
PICTURE_KIND: Final = 2
MOST_BYTES: Final = 4096
LONGEST_VALUE: Final = 512
MOST_CHANGES: Final = 16
LONGEST_SPAN_MS: Final = 3_600_000.0
_PICTURE = struct.Struct("<BIdd")
Finite = Annotated[float, Field(allow_inf_nan=False)]


class Socket(Protocol):
    """The server's end of a WebSocket."""

    async def send_bytes(self, data: bytes) -> None:
        """Return when the bytes are with the system, or will be soon."""

    async def close(self, code: int = 1000, reason: str | None = None) -> None:
        """Send nothing more."""


class Client:
    """A page that looks at a run. `gone`: function that is called once when it is dropped.

    `asks_picture`: whether it waits for a picture. `had_frame`: number of the last frame that it got. `faults`: number
    of malformed messages.
    """

    def __init__(self, socket: Socket, gone: Callable[[], None]) -> None:
        self._socket, self._gone = socket, gone
        self._queue: asyncio.Queue[bytes] = asyncio.Queue(MOST_QUEUED)
        self._dropped = asyncio.Event()
        self.asks_picture = False
        self.had_frame = -1
        self.faults = 0

    def put(self, data: bytes) -> None:
        """Queue `data` to be sent; a client that left too much unsent is dropped."""
        try:
            self._queue.put_nowait(data)
        except asyncio.QueueFull:
            self._drop()

    async def send_all(self) -> None:
        """Send the queued messages until the client is dropped or has left."""
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
        """Return the clients that wait for a picture."""
        return [client for client in self._live if client.asks_picture]

    @contextlib.contextmanager
    def joined(self, client: Client) -> Iterator[None]:
        """Send `client` the messages to all clients while the block runs."""
        self._live.add(client)
        try:
            yield
        finally:
            self._live.discard(client)

    @property
    def are_full(self) -> bool:
        return len(self._live) >= MOST_CLIENTS

    def tell(self, data: bytes) -> None:
        """Queue `data` for all clients."""
        for client in list(self._live):
            client.put(data)


class _PageMessage(BaseModel):
    """A message of a page, of which every key is known and has its type."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)


class PictureAsked(_PageMessage):
    """The page wants the newest picture that it has not had."""

    type: Literal["picture"]


class ControlSaid(_PageMessage):
    """The page requests that the control `name` gets `value`; the control decides whether it can."""

    type: Literal["control"]
    name: str = Field(max_length=40)
    value: (
        Annotated[str, Field(max_length=LONGEST_VALUE)]
        | Finite
        | Annotated[list[Finite], Field(min_length=2, max_length=2)]
        | None
    ) = None


class ChangesSaid(_PageMessage):
    """The page requests a new run with all `changes`, the values of controls by their names."""

    type: Literal["restart"]
    changes: dict[Annotated[str, Field(max_length=40)], Annotated[str, Field(max_length=LONGEST_VALUE)]] = Field(
        min_length=1, max_length=MOST_CHANGES
    )


class Seek(_PageMessage):
    """The page requests the part of a finished run from `span_ms` before `t_ms` to `span_ms` after it."""

    type: Literal["seek"]
    t_ms: Finite = Field(ge=0)
    span_ms: Finite = Field(gt=0, le=LONGEST_SPAN_MS)


Heard = PictureAsked | ControlSaid | ChangesSaid | Seek
_MESSAGES: TypeAdapter[Heard] = TypeAdapter(Annotated[Heard, Field(discriminator="type")])


class MalformedError(ValueError):
    """The bytes are nothing that a client may say."""


def heard(data: bytes) -> Heard:
    """Read a client's message `data`. Raises MalformedError."""
    if data[:1] != bytes([JSON_KIND]):
        raise MalformedError("a kind that no client sends")
    try:
        return _MESSAGES.validate_json(data[1:])
    except ValidationError as error:
        raise MalformedError(error.errors()[0]["msg"]) from None


def said(message: Mapping[str, Any]) -> bytes:
    """Write `message` for the page. Raises ValueError for a NaN or an infinity."""
    text = json.dumps(message, separators=(",", ":"), allow_nan=False)
    return bytes([JSON_KIND]) + text.encode()


def shown(frame: int, media_ms: float, age_ms: float, jpeg: bytes) -> bytes:
    """Write a picture for the page: number of the frame, its time in the scene and its age in ms, and a JPEG."""
    return _PICTURE.pack(PICTURE_KIND, frame & 0xFFFFFFFF, media_ms, age_ms) + jpeg
