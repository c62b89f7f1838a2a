"""The units of a run as tracks: its jobs and the causes of its idle time, and below each unit its stages.

Rule: a slice is a job as it was recorded, or the time between two jobs under its cause; nothing is drawn that was not
measured. The slices of a unit do not overlap, so that its accounts can be added up from them. A job whose unit held it
while the unit did another one is shown from its begin on; what of the time its unit had no core, its notes say.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

from trilane.apps.tracing.sink import Flow, Sink
from trilane.apps.tracing.tiles import Tiles
from trilane.pipeline.journal import Worked
from trilane.pipeline.unit_history import IDLE_CAUSES, UNEXPLAINED, IdleSlice
from trilane.scheduler.events import Graph
from trilane.scheduler.ledger import JobRecord

#: Figures of jobs that are counters of their stage: name -> title, unit.
COUNTED: Final = {
    "bytes_read": ("bytes read", "B"),
    "bytes_written": ("bytes written", "B"),
    "bytes_uploaded": ("bytes uploaded", "B"),
    "bytes_read_back": ("bytes read back", "B"),
    "bytes_least": ("bytes needed", "B"),
    "instructions": ("instructions", ""),
    "cache_misses": ("cache misses", ""),
}
NS_PER_US: Final = 1000
WAITING: Final = "frames that wait"


class UnitTracks:
    """Tracks below `parent`, from `rank` on. `flows_from`: frame n is part of the arrow `flows_from` + n."""

    def __init__(self, sink: Sink, graph: Graph, parent: int, rank: int, flows_from: int = 1) -> None:
        self._sink, self._flows_from = sink, flows_from
        sink.recurring([*IDLE_CAUSES, UNEXPLAINED, *(stage.name for stage in graph.stages)])
        self._units = {unit: sink.track(unit, parent, rank + place) for place, unit in enumerate(graph.units)}
        self._tiles: dict[str, Tiles[JobRecord | IdleSlice]] = {unit: Tiles() for unit in graph.units}
        self._first, self._last = graph.stages[0].name, graph.stages[-1].name
        self._stages = {
            stage.name: sink.track(stage.name, self._units[stage.unit], place)
            for place, stage in enumerate(graph.stages)
        }
        self._depths: dict[str, tuple[int, int]] = {}
        self._counters: dict[tuple[str, str], int] = {}
        self._figures: dict[tuple[str, str], float] = {}

    def start(self, at_ns: int) -> None:
        """The time of the accounts begins."""
        for tiles in self._tiles.values():
            tiles.start(at_ns)

    def work(self, worked: Worked) -> None:
        """A job has ended."""
        job = worked.job
        self._tiles[job.unit].add(job.begin_ns, job.end_ns, job)
        self._sink.slice(self._stages[job.stage], job.begin_ns, job.end_ns, f"{job.frame}")
        self._count_figures(job, worked.figures)
        self._write(job.unit)

    def idle(self, piece: IdleSlice) -> None:
        """A unit was idle."""
        self._tiles[piece.unit].add(piece.begin_ns, piece.end_ns, piece)
        self._write(piece.unit)

    def count(self, at_ns: int, waiting: Mapping[str, int]) -> None:
        """How many frames wait before each stage."""
        for stage, frames in waiting.items():
            counter, depth = self._depths.get(stage, (0, 0))
            if frames == depth:
                continue
            if not counter:
                counter = self._sink.counter_track(WAITING, self._stages[stage], 0)
            self._depths[stage] = counter, frames
            self._sink.count(counter, at_ns, frames)

    def close(self) -> None:
        """Write what still waits."""
        for unit in self._units:
            self._write(unit, rest=True)

    def _write(self, unit: str, *, rest: bool = False) -> None:
        track = self._units[unit]
        for begin_ns, end_ns, piece in self._tiles[unit].take(rest=rest):
            if isinstance(piece, IdleSlice):
                notes = _if_any(preempted_ns=piece.preempted_ns)
                self._sink.slice(track, begin_ns, end_ns, piece.cause, notes)
            else:
                flow = Flow(self._flows_from + piece.frame, piece.stage == self._first, piece.stage == self._last)
                self._sink.slice(track, begin_ns, end_ns, piece.stage, _notes_of(piece), flow)

    def _count_figures(self, job: JobRecord, figures: Mapping[str, float]) -> None:
        """Those of the table that have changed since the stage's last job, from the job's begin on; none that is 0."""
        for rank, (name, (title, unit)) in enumerate(COUNTED.items(), start=1):
            key, value = (job.stage, name), figures.get(name)
            if value is None or self._figures.get(key, 0) == value:
                continue
            if key not in self._counters:
                self._counters[key] = self._sink.counter_track(title, self._stages[job.stage], rank, unit)
            self._figures[key] = value
            self._sink.count(self._counters[key], job.begin_ns, value)


def _notes_of(job: JobRecord) -> dict[str, int]:
    lost = _if_any(preempted_ns=job.preempted_ns, asleep_ns=job.asleep_ns)
    return {"frame": job.frame, "wait_us": (job.begin_ns - job.ready_ns) // NS_PER_US, **lost}


def _if_any(**times_ns: int) -> dict[str, int]:
    """Those that are not 0."""
    return {name: ns for name, ns in times_ns.items() if ns}
