"""The frames of a run as series, from its journal. Rule: each figure belongs to a frame.

The frame time of a frame begins when the previous frame is presented, and ends when the frame itself is presented. The
work of the units in that time counts for this frame.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from trilane.apps.compare.difference import MOST_FRAMES, Series
from trilane.arrays import F64, I64
from trilane.errors import BadInputError
from trilane.pipeline.journal import Begun, Counted, Ended, Record, Worked, read_journal
from trilane.pipeline.timeline import Presented, Timeline
from trilane.pipeline.unit_history import BUSY, JOIN, OVERHEAD, PREEMPTED, IdleSlice
from trilane.scheduler.ledger import JobRecord, idle_causes
from trilane.units import NS_PER_MS

INSTRUCTIONS, INSTRUCTION_TIME, CPU = "instructions", "time of an instruction", "CPU time"
#: Metric of a stage in the journal -> measure of a series.
REPORTED = {f"bytes_{name}": f"bytes {name.replace('_', ' ')}" for name in ("read", "written", "uploaded", "read_back")}
REPORTED["instructions"] = INSTRUCTIONS
#: Number of frames kept before the first compared frame: they may be in flight when that frame begins.
IN_FLIGHT = 100


class Key(NamedTuple):
    """The subject of a series: what its values measure, and where.

    `measure`: what is measured.
    `of`: stage or unit, "" for the whole run.
    `cause`: cause of idle time, "" for other measures.
    """

    measure: str
    of: str = ""
    cause: str = ""


@dataclass(frozen=True)
class RunFrames:
    """The frames of a run as series.

    `begun`: first record of the journal.
    `series`: series by subject; times are in ms, times of an instruction in ns.
    `ended`: last record; None if the journal has no end.
    `presented`: number of presented frames of the whole run.
    `counted`: counts of lost and dropped frames; None if the journal has no counts.
    """

    begun: Begun
    series: Mapping[Key, Series]
    ended: Ended | None
    presented: int
    counted: Counted | None

    @property
    def is_whole(self) -> bool:
        """Whether the journal has the end of the run."""
        return self.ended is not None


def read_frames(path: Path) -> RunFrames:
    """Return the frames of the journal at `path`.

    Raises BadInputError for a missing or broken journal, or for fewer than two presented frames.
    """
    frames = frames_of(read_journal(path))
    if frames is None:
        raise BadInputError(path, "fewer than two presented frames", "two or more", "run more frames")
    return frames


def frames_of(records: Iterable[Record]) -> RunFrames | None:
    """Return the frames of a journal's `records`; None if fewer than two frames were presented."""
    story = _Story()
    for record in records:
        story.add(record)
    graph, jobs, idle = story.graph, story.jobs, story.idle()
    if len(story.shown) < 2:
        return None
    numbers, end_ns = (np.array([getattr(one, of) for one in story.shown], np.int64) for of in ("frame", "end_ns"))
    latencies = [(one.frame, one.latency_ns) for one in story.shown if one.latency_ns is not None]
    of_frames, latency_ns = np.array(latencies, np.int64).reshape(-1, 2).T
    series = {Key("frame time"): _plain(numbers[1:], np.diff(end_ns)), Key("latency"): _plain(of_frames, latency_ns)}
    for stage in graph.stages:
        series |= _stage(stage.name, [job for job in jobs if job.stage == stage.name])
    for unit in graph.units:
        series |= _unit(unit, [job for job in jobs if job.unit == unit], idle, numbers, end_ns)
    series |= _figures(story.figures)
    series |= _instruction_times(series)
    return RunFrames(story.begun, series, story.ended, story.presented, story.counted)


class _Story:
    """Gathers facts from the records of a journal. For a long run, only facts about the last frames stay in memory.

    `jobs`, `shown`: jobs and presented frames. `figures`: (frame, value) of each job, by subject. `presented`: number
    of presented frames of the whole run. `ended`, `counted`: last records of these types, None before the first.
    """

    def __init__(self) -> None:
        self.jobs: list[JobRecord] = []
        self.shown: list[Presented] = []
        self.figures: dict[Key, list[tuple[int, float]]] = defaultdict(list)
        self.ended: Ended | None = None
        self.counted: Counted | None = None
        self.presented = 0
        self._idle: list[IdleSlice] = []

    def idle(self) -> list[IdleSlice]:
        """Return every idle slice that was kept. Call it once, after the last record."""
        return [*self._idle, *self._timeline.end()]

    def add(self, record: Record) -> None:
        if isinstance(record, Begun):
            self.begun, self.graph = record, record.graph
            self._timeline = Timeline(record.graph, record.settings, idle=True)
            return
        for fact in self._timeline.add(record):
            if isinstance(fact, IdleSlice):
                self._idle.append(fact)
            elif isinstance(fact, Presented):
                self.shown.append(fact)
                self.presented += 1
        if isinstance(record, Worked):
            self._work(record)
        elif isinstance(record, Counted):
            self.counted = record
        elif isinstance(record, Ended):
            self.ended = record

    def _work(self, record: Worked) -> None:
        self.jobs.append(record.job)
        most = (MOST_FRAMES + IN_FLIGHT) * len(self.graph.stages)
        if len(self.jobs) >= 2 * most:
            self._forget(self.jobs[-most])
        for name, value in record.figures.items():
            if name in REPORTED:
                self.figures[Key(REPORTED[name], record.job.stage)].append((record.job.frame, value))

    def _forget(self, first: JobRecord) -> None:
        """Remove all facts from before the job `first`, so that memory does not grow with the run."""
        self.jobs = self.jobs[self.jobs.index(first) :]
        oldest = min(job.frame for job in self.jobs)
        self._idle = [piece for piece in self._idle if piece.end_ns >= first.begin_ns]
        self.shown = [one for one in self.shown if one.frame >= oldest]
        for key, rows in self.figures.items():
            self.figures[key] = [row for row in rows if row[0] >= oldest]


def _plain(frames: I64, ns: I64) -> Series:
    return Series(frames, ns / NS_PER_MS, np.ones(len(frames)))


def _stage(name: str, jobs: Sequence[JobRecord]) -> dict[Key, Series]:
    """Return the times of a stage's jobs as series, in ms, by subject.

    The measures are `work`, the time on the core; `service`, from begin to end; `wait`, before the begin. If every job
    has a CPU time, the CPU time of all threads is added.
    `name`: name of the stage.
    `jobs`: jobs of the stage, in order.
    """
    frames = np.array([job.frame for job in jobs], np.int64)
    service = np.array([job.end_ns - job.begin_ns for job in jobs], np.int64)
    preempted = np.array([job.preempted_ns for job in jobs], np.int64)
    wait = np.array([job.begin_ns - job.ready_ns for job in jobs], np.int64)
    cpu = np.array([job.cpu_ns for job in jobs], np.int64)
    found = {Key(CPU, name): _plain(frames, cpu)} if cpu.all() else {}
    return found | {
        Key("work", name): _plain(frames, service - preempted),
        Key("service", name): _plain(frames, service),
        Key("wait", name): _plain(frames, wait),
    }


def _unit(
    unit: str, jobs: Sequence[JobRecord], idle: Sequence[IdleSlice], frames: I64, end_ns: I64
) -> dict[Key, Series]:
    """Return the busy time of a unit, and its idle time by cause, as series over all presented frames but the first.

    Each series is a share: `values` are the busy or idle times within the frame times, `weights` the frame times, ms.
    `unit`: name of the unit.
    `jobs`: jobs of the unit.
    `idle`: idle slices of all units.
    `frames`: (n,) numbers of the presented frames.
    `end_ns`: (n,) times of presentation.
    """
    pieces: list[tuple[int, int, dict[str, int]]] = []
    for job in jobs:
        busy = job.end_ns - job.begin_ns - job.preempted_ns - job.asleep_ns
        pieces.append((job.begin_ns, job.end_ns, {BUSY: busy, PREEMPTED: job.preempted_ns, OVERHEAD: job.asleep_ns}))
    for piece in idle:
        if piece.unit == unit:
            rest = piece.end_ns - piece.begin_ns - piece.preempted_ns
            states = {piece.cause: rest}
            states[PREEMPTED] = states.get(PREEMPTED, 0) + piece.preempted_ns
            pieces.append((piece.begin_ns, piece.end_ns, states))
    pieces.sort(key=lambda piece: piece[:2])
    weights = np.diff(end_ns) / NS_PER_MS
    causes = idle_causes(joins=any(JOIN in parts for _, _, parts in pieces))
    return {
        key: Series(frames[1:], _within(pieces, state, end_ns), weights)
        for key, state in [(Key("busy", unit), BUSY), *((Key("idle", unit, cause), cause) for cause in causes)]
    }


def _within(pieces: Sequence[tuple[int, int, Mapping[str, int]]], state: str, edges_ns: I64) -> F64:
    """Return the time in `state` between each time in `edges_ns` and the next, in ms, (n - 1,) float64.

    The time of a state in a piece counts as spread evenly over the piece.
    `pieces`: begin, end, and time by state of each piece, all in ns.
    `edges_ns`: (n,) times, ascending.
    """
    places, totals, total = [0.0], [0.0], 0
    for begin_ns, end_ns, states in pieces:
        places += [begin_ns, end_ns]
        totals.append(total)
        total += states.get(state, 0)
        totals.append(total)
    return np.asarray(np.diff(np.interp(edges_ns, places, totals)) / NS_PER_MS)


def _figures(figures: Mapping[Key, Sequence[tuple[int, float]]]) -> dict[Key, Series]:
    """Return the metrics of stages as series, by subject. `figures`: (frame, value) of each job, by subject."""
    return {
        key: Series(
            np.array([frame for frame, _ in rows], np.int64), np.array([v for _, v in rows]), np.ones(len(rows))
        )
        for key, rows in figures.items()
    }


def _instruction_times(series: Mapping[Key, Series]) -> dict[Key, Series]:
    """Return the time on the core per instruction, ns, as a series for each stage with counted instructions.

    `series`: other series of the run, by subject.
    """
    found = {}
    for key, counted in series.items():
        if key.measure == INSTRUCTIONS:
            work = series[Key("work", key.of)]
            frames, ours, theirs = np.intersect1d(work.frames, counted.frames, return_indices=True)
            ns = work.values[ours] * NS_PER_MS / np.maximum(counted.values[theirs], 1.0)
            found[Key(INSTRUCTION_TIME, key.of)] = Series(frames, ns, np.ones(len(frames)))
    return found
