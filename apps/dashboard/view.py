"""The interface of a server to a live run (`live_server.py`) or a finished run (`finished_view.py`), and its messages.

Rule: a view answers at once or awaits; it never blocks the event loop, which all clients share. Times are milliseconds
since the run's first step. Units and stages are given by their index in the message `hello`. The page and /metrics get
the same figures.

A message is one byte, which is its kind, and a payload. Kind 1 is JSON in UTF-8, in both directions. Kind 2 is a
picture for the page. Its payload has the number of the frame (uint32), the frame's time in the scene and its age (both
float64, ms), and a JPEG. All numbers are little-endian. Every message of a page is checked. No page delays other pages,
because a task sends each page's own queue. The server drops and counts a page whose queue is full, or that receives
nothing for SEND_S seconds.
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

from trilane.apps.watch.figures import MomentFigures
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
        """Send `data`. The call may return before the system has all bytes."""

    async def close(self, code: int = 1000, reason: str | None = None) -> None:
        """Close the connection with `code` and `reason`."""


class Client:
    """A page that shows a run.

    `socket`: the server's end of the WebSocket to the page.
    `gone`: function that is called once if the server drops the page.

    `asks_picture`: whether the page waits for a picture. `had_frame`: number of the newest frame that the page got, -1
    before the first. `faults`: number of malformed messages that the page has sent.
    """

    def __init__(self, socket: Socket, gone: Callable[[], None]) -> None:
        self._socket, self._gone = socket, gone
        self._queue: asyncio.Queue[bytes] = asyncio.Queue(MOST_QUEUED)
        self._dropped = asyncio.Event()
        self.asks_picture = False
        self.had_frame = -1
        self.faults = 0

    def put(self, data: bytes) -> None:
        """Queue `data` to be sent. If the queue is full, drop the client."""
        try:
            self._queue.put_nowait(data)
        except asyncio.QueueFull:
            self._drop()

    async def send_all(self) -> None:
        """Send the queued messages until the client disconnects, the server drops it, or the task is cancelled."""
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
    """All pages that are connected to a server."""

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
        """Count `client` among the clients while the block runs."""
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
    """A message of a page. A message with an unknown key, or a value of another type, is an error."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)


class PictureAsked(_PageMessage):
    """The page requests the newest picture that the page has not had."""

    type: Literal["picture"]


class ControlSaid(_PageMessage):
    """The page requests `value` for the control `name`. The control may refuse the value."""

    type: Literal["control"]
    name: str = Field(max_length=40)
    value: (
        Annotated[str, Field(max_length=LONGEST_VALUE)]
        | Finite
        | Annotated[list[Finite], Field(min_length=2, max_length=2)]
        | None
    ) = None


class ChangesSaid(_PageMessage):
    """The page requests a new run. `changes`: requested values of controls, by the control's name."""

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
    """The bytes that a client sent are no message."""


def heard(data: bytes) -> Heard:
    """Return the client's message in the bytes `data`. Raises MalformedError for bytes that are no message."""
    if data[:1] != bytes([JSON_KIND]):
        raise MalformedError("a kind that no client sends")
    try:
        return _MESSAGES.validate_json(data[1:])
    except ValidationError as error:
        raise MalformedError(error.errors()[0]["msg"]) from None


def said(message: Mapping[str, Any]) -> bytes:
    """Return `message` as bytes for the page, kind 1. Raises ValueError for a NaN or an infinity."""
    text = json.dumps(message, separators=(",", ":"), allow_nan=False)
    return bytes([JSON_KIND]) + text.encode()


def shown(frame: int, media_ms: float, age_ms: float, jpeg: bytes) -> bytes:
    """Return a picture as bytes for the page, kind 2.

    `frame`: number of the picture's frame.
    `media_ms`: time of the frame in the scene.
    `age_ms`: time since the pose of the frame was sampled.
    `jpeg`: the picture as a JPEG.
    """
    return _PICTURE.pack(PICTURE_KIND, frame & 0xFFFFFFFF, media_ms, age_ms) + jpeg


Message = Mapping[str, Any]
MS = 1e-6  # milliseconds in a nanosecond
#: A job: unit, stage, frame, begin_ms, end_ms, wait_ms.
JobRow = tuple[int, int, int, float, float, float]
#: An idle slice: unit, cause, begin_ms, end_ms.
IdleRow = tuple[int, str, float, float]
#: End of a text in OpenMetrics. The server inserts its own counts before this mark.
END: Final = "# EOF\n"
JPEG_QUALITY = 82


class RunView(Protocol):
    """The interface of a server to one run, or to successive runs. docs/dashboard.md describes the messages."""

    def greeting(self) -> Iterable[Message]:
        """Return the first messages to a client: the hello, the state, recent slices, notes and figures."""

    async def news(self, *, is_watched: bool) -> Iterable[Message]:
        """Return messages to all clients about everything since the last call.

        `is_watched`: whether the server has clients. Without clients, the result is empty.
        """

    async def picture(self, client: Client) -> bytes | None:
        """Return the newest picture in the form of `shown`, and update `client.had_frame`.

        None is returned if `client` has had the newest picture, or if no picture can be sent now.
        """

    def control(self, asked: ControlSaid) -> str:
        """Carry out the request `asked` for one control, or begin to.

        Return why the request is refused, in words; "" for an accepted request.
        """

    def restart(self, asked: ChangesSaid) -> Mapping[str, str]:
        """Request a new run with all changes in `asked`. Return the reason for each refusal, by control.

        If a change is refused, no run is requested. The result is empty if the run is requested.
        """

    async def seek(self, client: Client, to: Seek) -> Iterable[Message]:
        """Return messages to `client` about the part `to` of a finished run."""

    def metrics(self) -> str:
        """Return the run's figures in OpenMetrics, without the end mark; "" if no figures exist yet."""

    @property
    def trace(self) -> Path | None:
        """Return the file of the run's trace, which may not exist yet; None if the run has no folder yet."""


class TimelineRows:
    """Collects the jobs, idle slices and notes of a run. `take` returns each one once.

    `begun`: first record of the journal.

    `now_ms`: time of the last step, ms since the first step.
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
        """Add the next record of the journal after `begun`."""
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
        """Add the idle slices that are still open after the last record."""
        self._add_idle(self._timeline.end())

    def take(self) -> tuple[list[JobRow], list[IdleRow], list[tuple[float, str]]]:
        """Return three lists since the last call: jobs, idle slices, and notes. A note is (time in ms, text)."""
        taken = self._jobs, self._idle, self._notes
        self._jobs, self._idle, self._notes = [], [], []
        return taken

    def _add_idle(self, pieces: Iterable[IdleSlice]) -> None:
        for piece in pieces:
            unit, cause = self._units[piece.unit], piece.cause
            self._idle.append((unit, cause, self._ms(piece.begin_ns), self._ms(piece.end_ns)))

    def _ms(self, now_ns: int) -> float:
        """Return the time from the first step to `now_ns`, in ms, rounded to a microsecond.

        The first call sets the time of the first step.
        """
        if self._start_ns is None:
            self._start_ns = now_ns
        return round((now_ns - self._start_ns) * MS, 3)


def described(graph: Graph) -> dict[str, Any]:
    """Return the part of the message `hello` with the stages, units and edges of a pipeline.

    The index in each list is the number of the stage, unit or edge in other messages.
    `graph`: the pipeline as the scheduler knows it.
    """
    return {
        "stages": [{"name": stage.name, "unit": stage.unit} for stage in graph.stages],
        "units": list(graph.units),
        "edges": [{"name": graph.edge_name(place), "rule": rule} for place, rule in enumerate(graph.edges)],
    }


def slices(jobs: Sequence[JobRow], idle: Sequence[IdleRow]) -> dict[str, Any]:
    """Return the message `slices` with the rows `jobs` and `idle`."""
    return {"type": "slices", "jobs": jobs, "idle": idle}


def note(t_ms: float, text: str) -> dict[str, Any]:
    """Return the message `note`, a message for a person.

    `t_ms`: time of the note, ms since the first step.
    `text`: text of the note.
    """
    return {"type": "note", "t_ms": t_ms, "text": text}


def figures_said(figures: MomentFigures) -> dict[str, Any]:
    """Return the message `figures` with the figures of a run at one moment."""
    return {"type": "figures", **figures.as_json()}


def metrics_text(figures: MomentFigures) -> str:
    """Return the figures of a run in OpenMetrics, without the end mark."""
    from trilane.apps.watch.metrics import openmetrics  # this module needs a package of the extra `dashboard`

    return openmetrics(figures).decode().removesuffix(END)


def jpeg_of(image: Any) -> bytes:
    """Return the Pillow image `image` as the bytes of a JPEG."""
    target = io.BytesIO()
    image.save(target, "JPEG", quality=JPEG_QUALITY)
    return target.getvalue()
