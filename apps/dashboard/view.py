"""What a server shows of a live run (`live_server.py`) or a finished one (`finished_view.py`).

Rule: a view answers at once or awaits; it never blocks the loop that all clients share. `TimelineRows` forgets rows
once they are taken. It turns times into milliseconds since the run's first step, and names of units and stages into
their places in the hello. The page and /metrics get the same figures.
"""

from __future__ import annotations

import io
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, Final, Protocol

from trilane.apps.dashboard.pages import ChangesSaid, Client, ControlSaid, Seek
from trilane.apps.watch.followed_run import RunState
from trilane.apps.watch.live_figures import LiveFigures
from trilane.apps.watch.metrics import openmetrics
from trilane.pipeline.journal import Begun, Record, Stepped, Worked
from trilane.pipeline.journal import Said as SaidRecord
from trilane.pipeline.timeline import Timeline
from trilane.pipeline.unit_history import IdleSlice
from trilane.scheduler.events import Graph

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
        """Return the newest picture that `client` has not had, as `pages.shown` writes it.

        The view notes that the client has it.
        """

    def control(self, asked: ControlSaid) -> str:
        """Carry out a request, or begin to. Return the reason for a refusal, "" for none."""

    def restart(self, asked: ChangesSaid) -> Mapping[str, str]:
        """Begin a new run with the changes, or do nothing. Return the reason for each refusal, by control."""

    async def seek(self, client: Client, to: Seek) -> Iterable[Message]:
        """Return the messages to `client` about another time of the run."""

    def metrics(self) -> str:
        """Return the run's figures in OpenMetrics, without the end mark; "" before there are any."""

    @property
    def trace(self) -> Path | None:
        """The run's trace, as far as it is written."""


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
        """Take the next record, but for the first."""
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
        """Take the slices that are left after the last record."""
        self._add_idle(self._timeline.end())

    def take(self) -> tuple[list[JobRow], list[IdleRow], list[tuple[float, str]]]:
        """Return what came since the last call."""
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
    """Return the part of the hello that explains a timeline's numbers."""
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

    `finds_bound`: as of `LiveFigures`.
    """

    def __init__(self, begun: Begun, *, finds_bound: bool = True) -> None:
        self._figures = LiveFigures(begun, finds_bound=finds_bound)

    def add(self, record: Record) -> None:
        """Take the next record."""
        self._figures.add(record)

    def message(self, now_ns: int | None = None) -> dict[str, Any]:
        """Return the message with the figures at `now_ns`; at the last record where it is None."""
        return {"type": "figures", **self._figures.now(now_ns).as_json()}

    @property
    def has_frames(self) -> bool:
        """Whether a frame was presented."""
        return self._figures.has_frames

    def metrics(self, now_ns: int | None = None, state: RunState | None = None) -> str:
        """Return the figures in OpenMetrics, without the end mark. `state`: as of `LiveFigures.now`."""
        return openmetrics(self._figures.now(now_ns, state)).decode().removesuffix(END)


def jpeg_of(image: Any) -> bytes:
    """Return a Pillow image as a JPEG."""
    target = io.BytesIO()
    image.save(target, "JPEG", quality=JPEG_QUALITY)
    return target.getvalue()
