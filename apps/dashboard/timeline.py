"""The records of a journal as what a timeline draws. Rule: pure; what was taken is not kept.

Times become milliseconds since the run's first step; units and stages become their places in the hello.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

from trilane.pipeline.journal import Begun, Record, Stepped, Worked
from trilane.pipeline.journal import Said as SaidRecord
from trilane.pipeline.timeline import Timeline
from trilane.pipeline.unit_history import IdleSlice
from trilane.scheduler.events import Graph

MS = 1e-6  # of a nanosecond

#: unit, stage, frame, begin_ms, end_ms, wait_ms
JobRow = tuple[int, int, int, float, float, float]
#: unit, cause, begin_ms, end_ms
IdleRow = tuple[int, str, float, float]


class TimelineRows:
    """Jobs, idle slices and notes that came since the last `take`. `begun`: the run's first record.

    `now_ms`: of the last step.
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
        """The next record, but for the first."""
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
        """After the last record: the slices that are left."""
        self._add_idle(self._timeline.end())

    def take(self) -> tuple[list[JobRow], list[IdleRow], list[tuple[float, str]]]:
        """What came since the last call."""
        taken = self._jobs, self._idle, self._notes
        self._jobs, self._idle, self._notes = [], [], []
        return taken

    def _add_idle(self, pieces: Iterable[IdleSlice]) -> None:
        for piece in pieces:
            unit, cause = self._units[piece.unit], piece.cause
            self._idle.append((unit, cause, self._ms(piece.begin_ns), self._ms(piece.end_ns)))

    def _ms(self, now_ns: int) -> float:
        """Since the first step, to a microsecond; the first that is asked for is that step."""
        if self._start_ns is None:
            self._start_ns = now_ns
        return round((now_ns - self._start_ns) * MS, 3)


def described(graph: Graph) -> dict[str, Any]:
    """The part of the hello that says what a timeline's numbers mean."""
    return {
        "stages": [{"name": stage.name, "unit": stage.unit} for stage in graph.stages],
        "units": list(graph.units),
        "edges": [{"name": graph.edge_name(place), "rule": rule} for place, rule in enumerate(graph.edges)],
    }


def slices(jobs: Sequence[JobRow], idle: Sequence[IdleRow]) -> dict[str, Any]:
    """The message that holds them."""
    return {"type": "slices", "jobs": jobs, "idle": idle}


def note(t_ms: float, text: str) -> dict[str, Any]:
    """The message that says `text` to a person."""
    return {"type": "note", "t_ms": t_ms, "text": text}
