"""What a server shows of a live run (`live_server.py`) or a finished one (`finished_view.py`), and the messages.

Rule: a view answers at once or awaits; it never blocks the loop that all clients share. `TimelineRows` forgets rows
after `take` returned them. It writes times as milliseconds since the run's first step. It writes units and stages as
their numbers in the hello. The page and /metrics get the same figures.

A message is a kind, then a payload; every message of a page is checked. Kind 1 is JSON in UTF-8, both ways. Kind 2, to
the page alone, is a picture: the frame's number (uint32), its time in the scene and its age (float64, ms), all
little-endian, then a JPEG. No page delays the others: each has a queue of its own, and a task sends what is in the
queue. The server drops and counts a page whose queue is full, or that takes nothing for SEND_S.
"""

from __future__ import annotations

import asyncio
import contextlib
import io
import json
import struct
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Final, Literal, Protocol

from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, ValidationError

from trilane.apps.watch.followed_run import RunState
from trilane.apps.watch.live_figures import LiveFigures
from trilane.pipeline.journal import Begun, Record, Stepped, Worked
from trilane.pipeline.journal import Said as SaidRecord
from trilane.pipeline.timeline import Timeline
from trilane.pipeline.unit_history import IdleSlice
from trilane.scheduler.events import Graph

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
        """Send `data`; return when the system has the bytes or will soon have them."""

    async def close(self, code: int = 1000, reason: str | None = None) -> None:
        """Close the connection with `code` and `reason`."""


class Client:
    """A page that looks at a run. `gone`: function that is called once when the page is dropped.

    `asks_picture`: whether the page waits for a picture. `had_frame`: number of the last frame that the page got.
    `faults`: number of malformed messages.
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
    """The page requests `value` for the control `name`; the control may refuse it."""

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
    """The bytes are no message of a client."""


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


Message = Mapping[str, Any]
MS = 1e-6  # of a nanosecond
#: unit, stage, frame, begin_ms, end_ms, wait_ms
JobRow = tuple[int, int, int, float, float, float]
#: unit, cause, begin_ms, end_ms
IdleRow = tuple[int, str, float, float]
#: What a text in OpenMetrics ends with; the server's own counts come before it.
END: Final = "# EOF\n"
JPEG_QUALITY = 82


class RunView(Protocol):
    """A run as a server shows it. Messages are those of docs/dashboard.md."""

    def greeting(self) -> Iterable[Message]:
        """Return the first messages to a client: the hello, the state, and recent events."""

    async def news(self, *, is_watched: bool) -> Iterable[Message]:
        """Return what happened since the last call, for all clients; nothing while there is no client."""

    async def picture(self, client: Client) -> bytes | None:
        """Return the newest picture that `client` has not had, as `shown` writes it.

        The view notes that the client has it.
        """

    def control(self, asked: ControlSaid) -> str:
        """Carry out a request, or begin to. Return the reason for a refusal, "" without a refusal."""

    def restart(self, asked: ChangesSaid) -> Mapping[str, str]:
        """Begin a new run with the changes, or do nothing. Return the reason for each refusal, by control."""

    async def seek(self, client: Client, to: Seek) -> Iterable[Message]:
        """Return the messages to `client` about another time of the run."""

    def metrics(self) -> str:
        """Return the run's figures in OpenMetrics, without the end mark; "" before there are any."""

    @property
    def trace(self) -> Path | None:
        """Return the file of the run's trace, or of the part that is written so far."""


class TimelineRows:
    """Collects jobs, idle slices and notes until the next `take`. `begun`: first record of the run.

    `now_ms`: time of the last step.
    """

    def __init__(self, begun: Begun) -> None:
        graph = begun.graph
        self._units = {unit: place for place, unit in enumerate(graph.units)}
        self._stages = {stage.name: place for place, stage in enumerate(graph.stages)}
        self._timeline = Timeline(graph, begun.settings, idle=True)
        self._start_ns: int | None = None
        self.now_ms = 0.0
        self._jobs: list[JobRow] = []
        self._idle: list[IdleRow] = []
        self._notes: list[tuple[float, str]] = []

    def add(self, record: Record) -> None:
        """Take the next record of the journal; its first record is `begun`."""
        if isinstance(record, Stepped):
            self.now_ms = self._ms(record.now_ns)
        elif isinstance(record, Worked):
            job = record.job
            times = self._ms(job.begin_ns), self._ms(job.end_ns), round((job.begin_ns - job.ready_ns) * MS, 3)
            self._jobs.append((self._units[job.unit], self._stages[job.stage], job.frame, *times))
        elif isinstance(record, SaidRecord):
            self._notes.append((self._ms(record.now_ns), record.text))
        self._add_idle(fact for fact in self._timeline.add(record) if isinstance(fact, IdleSlice))

    def end(self) -> None:
        """Collect the slices that are still open after the last record."""
        self._add_idle(self._timeline.end())

    def take(self) -> tuple[list[JobRow], list[IdleRow], list[tuple[float, str]]]:
        """Return the rows that were collected since the last call."""
        taken = self._jobs, self._idle, self._notes
        self._jobs, self._idle, self._notes = [], [], []
        return taken

    def _add_idle(self, pieces: Iterable[IdleSlice]) -> None:
        for piece in pieces:
            unit, cause = self._units[piece.unit], piece.cause
            self._idle.append((unit, cause, self._ms(piece.begin_ns), self._ms(piece.end_ns)))

    def _ms(self, now_ns: int) -> float:
        """Return the time since the first step, rounded to a microsecond; the first call sets that step."""
        if self._start_ns is None:
            self._start_ns = now_ns
        return round((now_ns - self._start_ns) * MS, 3)


def described(graph: Graph) -> dict[str, Any]:
    """Return the part of the hello that names the units and stages by their numbers."""
    return {
        "stages": [{"name": stage.name, "unit": stage.unit} for stage in graph.stages],
        "units": list(graph.units),
        "edges": [{"name": graph.edge_name(place), "rule": rule} for place, rule in enumerate(graph.edges)],
    }


def slices(jobs: Sequence[JobRow], idle: Sequence[IdleRow]) -> dict[str, Any]:
    """Return the message that holds jobs and idle slices."""
    return {"type": "slices", "jobs": jobs, "idle": idle}


def note(t_ms: float, text: str) -> dict[str, Any]:
    """Return the message that says `text` to a person."""
    return {"type": "note", "t_ms": t_ms, "text": text}


class RunMeter:
    """Takes the records after `begun`, in order, and gives the figures of a moment.

    `finds_bound`: as in `LiveFigures`.
    """

    def __init__(self, begun: Begun, *, finds_bound: bool = True) -> None:
        self._figures = LiveFigures(begun, finds_bound=finds_bound)

    def add(self, record: Record) -> None:
        """Take the next record."""
        self._figures.add(record)

    def message(self, now_ns: int | None = None) -> dict[str, Any]:
        """Return the message with the figures at `now_ns`, or at the last record if `now_ns` is None."""
        return {"type": "figures", **self._figures.now(now_ns).as_json()}

    @property
    def has_frames(self) -> bool:
        """Whether a frame was presented."""
        return self._figures.has_frames

    def metrics(self, now_ns: int | None = None, state: RunState | None = None) -> str:
        """Return the figures in OpenMetrics, without the end mark. `state`: as in `LiveFigures.now`."""
        from trilane.apps.watch.metrics import openmetrics  # which needs a package of the extra `dashboard`

        return openmetrics(self._figures.now(now_ns, state)).decode().removesuffix(END)


def jpeg_of(image: Any) -> bytes:
    """Return a Pillow image as a JPEG."""
    target = io.BytesIO()
    image.save(target, "JPEG", quality=JPEG_QUALITY)
    return target.getvalue()
