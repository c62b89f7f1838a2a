"""The trace of a run from the records of its journal, while the run goes on or afterwards, on either clock.

Rule: bounded memory: what is held is what the run has in flight, however long it lasts. Every record is told once, in
order, the `Begun` when the writer is made.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict
from typing import IO, Any, Final

from trilane.apps.tracing.chrome import ChromeSink
from trilane.apps.tracing.frame_tracks import FrameTracks
from trilane.apps.tracing.packets import PacketSink
from trilane.apps.tracing.sink import Sink
from trilane.apps.tracing.unit_tracks import UnitTracks
from trilane.pipeline.journal import Begun, Ended, Record, Said, Sampled, Stepped, Worked
from trilane.pipeline.timeline import Gone, Presented, Timeline
from trilane.pipeline.unit_history import IdleSlice

NAME: Final = "trace.pftrace"
CHROME_NAME: Final = "trace.json"
#: Ranks of the tracks of a process.
RUN_RANK, MESSAGE_RANK, FRAME_RANK, UNIT_RANK, SAMPLE_RANK = 0, 1, 2, 10, 1000
#: Arrows of several pipelines in one trace: so many frames each.
FLOWS_PER_PIPELINE: Final = 1 << 40
#: First part of a sampled value's name -> what people call it, unit.
SAMPLED: Final = {"temperature_c": ("temperature", "°C"), "duty": ("duty", ""), "memory_bytes": ("memory", "B")}


class RunTracks:
    """One run as a group of tracks of `sink`. `number`: of the pipelines in it. `name`: of the group."""

    def __init__(self, sink: Sink, begun: Begun, name: str = "trilane", number: int = 0) -> None:
        self._sink, self._begun = sink, begun
        clock = str(begun.facts.get("clock", "unknown"))
        process = sink.process(f"{name}, {clock} clock")
        self._run = sink.track("run", process, RUN_RANK)
        self._messages = sink.track("messages", process, MESSAGE_RANK)
        self._frames = FrameTracks(sink, begun, process, FRAME_RANK)
        self._units = UnitTracks(sink, begun.graph, process, UNIT_RANK, number * FLOWS_PER_PIPELINE + 1)
        self._timeline = Timeline(begun.graph, begun.settings, idle=True)
        self._process, self._samples = process, dict[str, int]()
        self._now_ns: int | None = None
        self._end_ns = 0

    def add(self, record: Record) -> None:
        """The next record of the journal."""
        if isinstance(record, Stepped):
            self._end_step(record.now_ns)
        had_started = self._timeline.start_ns is not None
        facts = self._timeline.add(record)
        for fact in facts:
            if isinstance(fact, IdleSlice):
                self._units.idle(fact)
            elif isinstance(fact, Presented | Gone):
                self._frames.add(fact)
        match record:
            case Stepped() if not had_started and self._timeline.start_ns is not None:
                self._units.start(record.now_ns)
            case Worked():
                self._units.work(record)
            case Sampled():
                self._sample(record)
            case Said():
                self._sink.instant(self._messages, record.now_ns, record.text)
            case Ended():
                self._end_ns = record.now_ns

    def close(self) -> None:
        """Write what is still held; the run has ended, or nothing more of it is known."""
        for piece in self._timeline.end():
            self._units.idle(piece)
        self._units.close()
        self._count()
        if self._now_ns is not None:
            self._sink.end(self._run, max(self._now_ns, self._end_ns))

    def _end_step(self, now_ns: int) -> None:
        """The step before the one at `now_ns` is whole; before the first the run begins."""
        if self._now_ns is None:
            self._sink.begin(self._run, now_ns, "run", _facts_of(self._begun))
        self._count()
        self._now_ns = now_ns

    def _count(self) -> None:
        """The counters after the last step, now that all that belongs to it was told."""
        if self._now_ns is not None:
            line, stages = self._timeline, self._begun.graph.stages
            self._frames.count(self._now_ns, len(line.frames))
            self._units.count(self._now_ns, {stage.name: len(line.waiting(stage.name)) for stage in stages})

    def _sample(self, sampled: Sampled) -> None:
        for name, value in sampled.values.items():
            if name not in self._samples:
                kind, _, of = name.partition(".")
                title, unit = SAMPLED.get(kind, (kind, ""))
                rank = SAMPLE_RANK + len(self._samples)
                self._samples[name] = self._sink.counter_track(f"{of} {title}".strip(), self._process, rank, unit)
            self._sink.count(self._samples[name], sampled.now_ns, value)


class TraceWriter:
    """The trace of a run as Perfetto's packets. `file`: opened for bytes; whoever opened it closes it after `close`."""

    def __init__(self, file: IO[bytes], begun: Begun) -> None:
        self._sink = PacketSink(file)
        self._tracks = RunTracks(self._sink, begun)

    def add(self, record: Record) -> None:
        """The next record of the journal."""
        self._tracks.add(record)

    def close(self) -> None:
        """The trace is whole."""
        self._tracks.close()
        self._sink.close()


def write_trace(records: Iterable[Record], file: IO[bytes]) -> None:
    """The trace of a journal's `records` as Perfetto's packets."""
    write_tracks(PacketSink(file), {"trilane": records})


def write_chrome_trace(records: Iterable[Record], file: IO[str]) -> None:
    """The trace of a journal's `records` as Chrome's JSON."""
    write_tracks(ChromeSink(file), {"trilane": records})


def write_tracks(sink: Sink, runs: Mapping[str, Iterable[Record]]) -> None:
    """Several runs in one trace, each a group of tracks by its name, one after the other; the sink is closed."""
    for number, (name, records) in enumerate(runs.items()):
        tracks: RunTracks | None = None
        for record in records:
            if isinstance(record, Begun):
                tracks = RunTracks(sink, record, name, number)
            elif tracks is not None:
                tracks.add(record)
        if tracks is not None:
            tracks.close()
    sink.close()


def _facts_of(begun: Begun) -> dict[str, Any]:
    """What is known of a run before its first frame, and the times of the clock are."""
    clocks = {"host": "CLOCK_MONOTONIC", "virtual": "simulated time from 0 on"}
    times = f"ns of {clocks.get(str(begun.facts.get('clock')), 'an unknown clock')}"
    settings = {key: value for key, value in asdict(begun.settings).items() if not isinstance(value, Sequence) or value}
    return {"times": times, **begun.facts, "scheduler": settings, "edges": list(begun.graph.edges)}
