"""The trace of a run from the records of its journal: tracks of units, stages and frames, on the host or virtual clock.

Rule: memory is bounded by what the run has in flight. A slice is a recorded job, or the time between two jobs with its
cause; only recorded times are drawn. The slices of a unit do not overlap, so they sum to the unit's accounts. A frame
is late as in the report: it was presented past its deadline. Without a deadline, it is late if its frame time is longer
than the scene's rate allows. A trace file is complete or absent.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict
from heapq import heappop, heappush
from pathlib import Path
from typing import IO, Any, Final, Generic, TypeVar

from trilane.apps.explain.trace_sinks import ChromeSink, FlowArrow, PacketSink, Sink
from trilane.pipeline.journal import Begun, Ended, Record, Said, Sampled, Stepped, Worked, journal_of, target_period_ns
from trilane.pipeline.timeline import Gone, Presented, Timeline
from trilane.pipeline.tracks import UNKNOWN
from trilane.pipeline.unit_history import UNEXPLAINED, IdleSlice
from trilane.scheduler.events import NEVER, Graph
from trilane.scheduler.ledger import JobRecord, idle_causes
from trilane.scheduler.stats import due_ns
from trilane.scheduler.virtual import Simulation
from trilane.writing import write_atomically

NAME: Final = "trace.pftrace"
CHROME_NAME: Final = "trace.json"
#: Ranks of tracks within the group of a run: a viewer shows them in this order.
RUN_RANK, MESSAGE_RANK, FRAME_RANK, UNIT_RANK, SAMPLE_RANK = 0, 1, 2, 10, 1000
#: Numbers that each run in a trace has for its arrows; each frame takes one.
FLOWS_PER_PIPELINE: Final = 1 << 40
#: First part of a sampled value's name -> title, unit.
SAMPLED: Final = {"temperature_c": ("temperature", "°C"), "duty": ("duty", ""), "memory_bytes": ("memory", "B")}
NS_PER_US: Final = 1000
MOST_LANES: Final = 32
EXPECTED, ACTUAL, LEFT_OUT, IN_FLIGHT = "Expected frames", "Actual frames", "Lost and dropped", "Frames in flight"
#: Metrics of stages that are drawn as counters: name -> title, unit.
FIGURE_COUNTERS: Final = {
    "bytes_read": ("bytes read", "B"),
    "bytes_written": ("bytes written", "B"),
    "bytes_uploaded": ("bytes uploaded", "B"),
    "bytes_read_back": ("bytes read back", "B"),
    "bytes_least": ("bytes needed", "B"),
    "instructions": ("instructions", ""),
    "cache_misses": ("cache misses", ""),
}
WAITING: Final = "frames that wait"
#: Largest number of slices of a track that wait for an earlier slice. If more wait, the earlier slice is missing.
MOST_WAITING: Final = 256
Item = TypeVar("Item")


class RunTracks:
    """One run as a group of tracks of `sink`.

    `begun`: first record of the run's journal. `name`: name of the group. `number`: number of the run in the trace,
    from 0.
    """

    def __init__(self, sink: Sink, begun: Begun, name: str = "trilane", number: int = 0) -> None:
        self._sink, self._begun = sink, begun
        clock = str(begun.facts.get("clock", "unknown"))
        process = sink.process(f"{name}, {clock} clock")
        self._run = sink.track("run", process, RUN_RANK)
        self._messages = sink.track("messages", process, MESSAGE_RANK)
        self._frames = _FrameTracks(sink, begun, process, FRAME_RANK)
        self._units = _UnitTracks(sink, begun.graph, process, UNIT_RANK, number * FLOWS_PER_PIPELINE + 1)
        self._timeline = Timeline(begun.graph, begun.settings, idle=True)
        self._process, self._samples = process, dict[str, int]()
        self._now_ns: int | None = None
        self._end_ns = 0

    def add(self, record: Record) -> None:
        """Take the next record of the journal; the first call takes the record after `begun`."""
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
        """Write the last idle slices, the slices that still wait, and the last counters. End the run's own slice."""
        for piece in self._timeline.end():
            self._units.idle(piece)
        self._units.close()
        self._count()
        if self._now_ns is not None:
            self._sink.end(self._run, max(self._now_ns, self._end_ns))

    def _end_step(self, now_ns: int) -> None:
        """Write the counters of the step before the step at `now_ns`.

        At the first step, begin the slice of the whole run.
        """
        if self._now_ns is None:
            self._sink.begin(self._run, now_ns, "run", _facts_of(self._begun))
        self._count()
        self._now_ns = now_ns

    def _count(self) -> None:
        """Write the counters of the last step. Call it when all records of the step are known."""
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


def write_trace(records: Iterable[Record], file: IO[bytes]) -> None:
    """Write the trace of a run to `file` as Perfetto's packets. `records`: all records of the run's journal."""
    write_tracks(PacketSink(file), {"trilane": records})


def write_tracks(sink: Sink, runs: Mapping[str, Iterable[Record]]) -> None:
    """Write several runs to one trace, one after the other, and close `sink`.

    `runs`: name of a group of tracks -> all records of the run's journal.
    """
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
    """Return the notes of the whole run's slice: facts known before its first frame, and the clock of its times."""
    clocks = {"host": "CLOCK_MONOTONIC", "virtual": "simulated time from 0 on"}
    times = f"ns of {clocks.get(str(begun.facts.get('clock')), 'an unknown clock')}"
    settings = {key: value for key, value in asdict(begun.settings).items() if not isinstance(value, Sequence) or value}
    return {"times": times, **begun.facts, "scheduler": settings, "edges": list(begun.graph.edges)}


def write_run(records: Iterable[Record], target: Path, *, chrome: bool = False) -> None:
    """Write the trace of a run to the file `target`. Raises BadInputError if the file cannot be written.

    `records`: all records of the run's journal. `chrome`: whether to write Chrome's JSON in place of Perfetto's
    packets.
    """
    with write_atomically(target) as draft:
        if chrome:
            with draft.open("w", encoding="utf-8") as text:
                write_tracks(ChromeSink(text), {"trilane": records})
        else:
            with draft.open("wb") as file:
                write_trace(records, file)


def write_predicted(runs: Mapping[str, Simulation], facts: Mapping[str, Any], target: Path) -> None:
    """Write the trace of recorded runs in virtual time to the file `target`, as Perfetto's packets.

    `runs`: name of a group of tracks -> run, with its recording. `facts`: facts that all runs have, as in `Begun`.

    Raises BadInputError if the file cannot be written.
    """
    records: dict[str, Iterable[Record]] = {}
    begun = {"clock": "virtual", "target_period_ns": 0, **facts}
    for name, run in runs.items():
        assert run.recording is not None
        records[name] = journal_of(run.recording, run.jobs, begun, run.report)
    with write_atomically(target) as draft, draft.open("wb") as file:
        write_tracks(PacketSink(file), records)


class _FrameTracks:
    """Tracks of a run's frames, below the track `parent`: expected, presented, and lost or dropped frames.

    `begun`: first record of the run's journal. `rank`: place of the first of these tracks among those below `parent`.
    """

    def __init__(self, sink: Sink, begun: Begun, parent: int, rank: int) -> None:
        self._sink, self._parent = sink, parent
        self._settings, self._target_ns = begun.settings, target_period_ns(begun)
        self._ranks = {EXPECTED: rank, ACTUAL: rank + 1}
        self._lanes = {name: Lanes(MOST_LANES) for name in self._ranks}
        self._tracks: dict[tuple[str, int], int] = {}
        self._left_out = sink.track(LEFT_OUT, parent, rank + 2)
        self._in_flight = sink.counter_track(IN_FLIGHT, parent, rank + 3)
        self._flying = -1
        self._before_ns: int | None = None

    def add(self, frame: Presented | Gone) -> None:
        """Write a frame that has left the pipeline: presented, lost or dropped."""
        if isinstance(frame, Gone):
            if frame.frame != UNKNOWN:
                self._expect(frame.frame, frame.release_ns, self._before_ns)
            notes = {"frame": frame.frame} if frame.frame != UNKNOWN else {}
            self._sink.instant(self._left_out, frame.at_ns, f"{frame.kind} {frame.cause}", notes)
            return
        late_ns = frame.end_ns - self._expect(frame.frame, frame.release_ns, frame.before_ns)
        name = f"late {frame.frame}" if late_ns > 0 else f"{frame.frame}"
        notes = {"late_us": late_ns // NS_PER_US} if late_ns > 0 else {}
        self._slice(ACTUAL, frame.release_ns, frame.end_ns, name, notes)
        self._before_ns = frame.end_ns

    def count(self, at_ns: int, in_flight: int) -> None:
        """Write that `in_flight` frames are in flight at `at_ns`. If the number has not changed, write nothing."""
        if in_flight != self._flying:
            self._flying = in_flight
            self._sink.count(self._in_flight, at_ns, self._flying)

    def _expect(self, frame: int, release_ns: int, before_ns: int | None) -> int:
        """Write the slice in which a frame is expected, and return the time in ns at which the frame is due.

        The slice ends at this time. If nothing says when the frame is due, write nothing and return NEVER.

        `frame`: number of the frame. `release_ns`: time of its release. `before_ns`: time at which the frame before it
        was presented; None if the time since then is no frame time.
        """
        until_ns = due_ns(self._settings.due_from_ns(release_ns), before_ns, self._target_ns)
        if until_ns != NEVER:
            begin_ns = until_ns - self._target_ns if self._target_ns else release_ns
            self._slice(EXPECTED, begin_ns, until_ns, f"{frame}", {})
        return until_ns

    def _slice(self, name: str, begin_ns: int, end_ns: int, text: str, notes: dict[str, int]) -> None:
        lane, begin_ns = self._lanes[name].place(begin_ns, end_ns)
        if (name, lane) not in self._tracks:
            self._tracks[name, lane] = self._sink.track(name, self._parent, self._ranks[name])
        self._sink.slice(self._tracks[name, lane], begin_ns, end_ns, text, notes)


class _UnitTracks:
    """Tracks of a run's units, below the track `parent`: jobs, idle time by cause, and the unit's stages.

    A job that was dispatched ahead is shown from its begin on.

    `graph`: graph of the run. `rank`: place of the first of these tracks among those below `parent`.
    `flows_from`: number of the arrow that connects the jobs of frame 0. Frame n has the arrow `flows_from` + n.
    """

    def __init__(self, sink: Sink, graph: Graph, parent: int, rank: int, flows_from: int = 1) -> None:
        self._sink, self._flows_from = sink, flows_from
        sink.recurring([*idle_causes(joins=not graph.is_chain), UNEXPLAINED, *(stage.name for stage in graph.stages)])
        self._units = {unit: sink.track(unit, parent, rank + place) for place, unit in enumerate(graph.units)}
        self._tiles: dict[str, Tiles[JobRecord | IdleSlice]] = {unit: Tiles() for unit in graph.units}
        read = [graph.inputs_of(place) for place in range(len(graph.stages))]
        self._begins = {stage.name for stage, inputs in zip(graph.stages, read, strict=True) if not inputs}
        self._ends = {stage.name for stage in graph.stages} - graph.streams.keys()
        self._stages = {
            stage.name: sink.track(stage.name, self._units[stage.unit], place)
            for place, stage in enumerate(graph.stages)
        }
        self._depths: dict[str, tuple[int, int]] = {}
        self._counters: dict[tuple[str, str], int] = {}
        self._figures: dict[tuple[str, str], float] = {}

    def start(self, at_ns: int) -> None:
        """Begin the units' tracks at `at_ns`, the begin of the time that the ledger accounts for."""
        for tiles in self._tiles.values():
            tiles.start(at_ns)

    def work(self, worked: Worked) -> None:
        """Write a job that has ended, and the counters that it changed."""
        job = worked.job
        self._tiles[job.unit].add(job.begin_ns, job.end_ns, job)
        self._sink.slice(self._stages[job.stage], job.begin_ns, job.end_ns, f"{job.frame}")
        self._count_figures(job, worked.figures)
        self._write(job.unit)

    def idle(self, piece: IdleSlice) -> None:
        """Write a slice of a unit's idle time."""
        self._tiles[piece.unit].add(piece.begin_ns, piece.end_ns, piece)
        self._write(piece.unit)

    def count(self, at_ns: int, waiting: Mapping[str, int]) -> None:
        """Write how many frames wait before each stage at `at_ns`. A stage whose number has not changed is left out.

        `waiting`: number of waiting frames by stage.
        """
        for stage, frames in waiting.items():
            counter, depth = self._depths.get(stage, (0, 0))
            if frames == depth:
                continue
            if not counter:
                counter = self._sink.counter_track(WAITING, self._stages[stage], 0)
            self._depths[stage] = counter, frames
            self._sink.count(counter, at_ns, frames)

    def close(self) -> None:
        """Write the slices that still wait for an earlier slice."""
        for unit in self._units:
            self._write(unit, rest=True)

    def _write(self, unit: str, *, rest: bool = False) -> None:
        track = self._units[unit]
        for begin_ns, end_ns, piece in self._tiles[unit].take(rest=rest):
            if isinstance(piece, IdleSlice):
                notes = _if_any(preempted_ns=piece.preempted_ns, late=piece.late)
                self._sink.slice(track, begin_ns, end_ns, piece.cause, notes)
            else:
                flow = FlowArrow(self._flows_from + piece.frame, piece.stage in self._begins, piece.stage in self._ends)
                self._sink.slice(track, begin_ns, end_ns, piece.stage, _notes_of(piece), flow)

    def _count_figures(self, job: JobRecord, figures: Mapping[str, float]) -> None:
        """Write, at the begin of `job`, each counter of its stage that has changed. A counter starts with the value 0.

        `figures`: metrics of the job, by name.
        """
        for rank, (name, (title, unit)) in enumerate(FIGURE_COUNTERS.items(), start=1):
            key, value = (job.stage, name), figures.get(name)
            if value is None or self._figures.get(key, 0) == value:
                continue
            if key not in self._counters:
                self._counters[key] = self._sink.counter_track(title, self._stages[job.stage], rank, unit)
            self._figures[key] = value
            self._sink.count(self._counters[key], job.begin_ns, value)


def _notes_of(job: JobRecord) -> dict[str, int | str]:
    lost = _if_any(preempted_ns=job.preempted_ns, asleep_ns=job.asleep_ns)
    return {"frame": job.frame, "wait_us": (job.begin_ns - job.ready_ns) // NS_PER_US, **lost}


def _if_any(**notes: int | str) -> dict[str, int | str]:
    """Return the `notes` without zeros and empty values."""
    return {name: value for name, value in notes.items() if value}


class Tiles(Generic[Item]):
    """Puts the slices of one track in order, without overlap.

    A unit always has a job or is idle. Therefore a slice can be written when earlier slices fill the time up to its
    begin. A slice that begins before the end of the written time is cut at that end, or left out if it ends earlier.
    """

    def __init__(self) -> None:
        self._until_ns: int | None = None
        self._waiting: list[tuple[int, int, int, Item]] = []
        self._count = 0

    def add(self, begin_ns: int, end_ns: int, item: Item) -> None:
        """Add a slice of the track, from `begin_ns` to `end_ns`. `item`: content of the slice, which `take` yields."""
        self._count += 1
        heappush(self._waiting, (begin_ns, end_ns, self._count, item))

    def start(self, at_ns: int) -> None:
        """Set the time at which the first slice of the track begins."""
        self._until_ns = at_ns

    def take(self, *, rest: bool = False) -> Iterator[tuple[int, int, Item]]:
        """Yield (begin, end, item) of each slice that can be written now, times in ns, in order.

        `rest`: whether to yield every slice that is left.
        """
        waiting = self._waiting
        while waiting and (rest or len(waiting) > MOST_WAITING or self._reaches(waiting[0][0])):
            begin_ns, end_ns, _, item = heappop(waiting)
            begin_ns = max(begin_ns, self._until_ns or begin_ns)
            if end_ns >= begin_ns:
                self._until_ns = end_ns
                yield begin_ns, end_ns, item

    def _reaches(self, at_ns: int) -> bool:
        return self._until_ns is not None and self._until_ns >= at_ns


class Lanes:
    """Distributes overlapping slices over lanes, numbered from 0, so that the slices of a lane do not overlap.

    `most`: largest number of lanes. If more slices than lanes overlap, the begin of the last slice is cut.
    """

    def __init__(self, most: int) -> None:
        self._most = most
        self._until_ns: list[int] = []

    def place(self, begin_ns: int, end_ns: int) -> tuple[int, int]:
        """Return (number of the lane of a slice, time in ns at which the slice begins in this lane)."""
        for lane, until_ns in enumerate(self._until_ns):
            if until_ns <= begin_ns:
                self._until_ns[lane] = end_ns
                return lane, begin_ns
        if len(self._until_ns) < self._most:
            self._until_ns.append(end_ns)
            return len(self._until_ns) - 1, begin_ns
        lane = min(range(self._most), key=self._until_ns.__getitem__)
        begin_ns = min(self._until_ns[lane], end_ns)
        self._until_ns[lane] = max(end_ns, self._until_ns[lane])
        return lane, begin_ns
