"""The frames of a run as series, from its journal. Rule: every figure here is a frame's, in the order of presentation.

A frame's own time is from the frame presented before it to it; what units did in that time is the frame's share of
them.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from trilane.apps.comparison.difference import MOST_FRAMES, Series
from trilane.arrays import F64, I64
from trilane.errors import BadInputError
from trilane.pipeline.journal import Begun, Counted, Ended, Record, Worked, read_journal
from trilane.pipeline.timeline import Presented, Timeline
from trilane.pipeline.unit_history import BUSY, IDLE_CAUSES, OVERHEAD, PREEMPTED, IdleSlice
from trilane.scheduler.ledger import JobRecord

NS_PER_MS = 1e6
STATES = (BUSY, *IDLE_CAUSES)
INSTRUCTIONS, INSTRUCTION_TIME = "instructions", "time of an instruction"
#: Figures of jobs that stages report or the processor counts, and the measures that they are here.
REPORTED = {f"bytes_{name}": f"bytes {name.replace('_', ' ')}" for name in ("read", "written", "uploaded", "read_back")}
REPORTED["instructions"] = INSTRUCTIONS
#: Frames that may have been begun before the first of which all is kept.
IN_FLIGHT = 100


class Key(NamedTuple):
    """What a series is of: `measure`, and the stage, the unit, or nothing. `cause`: of idle time; else empty."""

    measure: str
    of: str = ""
    cause: str = ""


@dataclass(frozen=True)
class RunFrames:
    """`series` of a run's frames by what they are of, times in ms.

    `begun`: the journal's first record, `ended` its last; None where the run did not end by itself.
    `presented`: frames of the whole run. `counted`: those left out; None where there are none.
    """

    begun: Begun
    series: Mapping[Key, Series]
    ended: Ended | None
    presented: int
    counted: Counted | None

    @property
    def is_whole(self) -> bool:
        """Whether the journal has the whole run."""
        return self.ended is not None


def read_frames(path: Path) -> RunFrames:
    """The frames that the journal at `path` tells of. Raises BadInputError for one that is none or ends too early."""
    frames = frames_of(read_journal(path))
    if frames is None:
        raise BadInputError(path, "fewer than two presented frames", "two or more", "run more frames")
    return frames


def frames_of(records: Iterable[Record]) -> RunFrames | None:
    """None where fewer than two frames were presented."""
    story = _Story()
    for record in records:
        story.add(record)
    graph, jobs, idle = story.graph, story.jobs, story.idle()
    if len(story.shown) < 2:
        return None
    shown = [(one.frame, one.end_ns, one.latency_ns) for one in story.shown]
    numbers, end_ns, latency_ns = (np.array(column, np.int64) for column in zip(*shown, strict=True))
    series = {Key("frame time"): _plain(numbers[1:], np.diff(end_ns)), Key("latency"): _plain(numbers, latency_ns)}
    for stage in graph.stages:
        series |= _stage(stage.name, [job for job in jobs if job.stage == stage.name])
    for unit in graph.units:
        series |= _unit(unit, [job for job in jobs if job.unit == unit], idle, numbers, end_ns)
    series |= _figures(story.figures)
    series |= _instruction_times(series)
    return RunFrames(story.begun, series, story.ended, story.presented, story.counted)


class _Story:
    """What the records of a journal tell, gathered."""

    def __init__(self) -> None:
        self.jobs: list[JobRecord] = []
        self.shown: list[Presented] = []
        self.figures: dict[Key, list[tuple[int, float]]] = defaultdict(list)
        self.ended: Ended | None = None
        self.counted: Counted | None = None
        self.presented = 0
        self._idle: list[IdleSlice] = []

    def idle(self) -> list[IdleSlice]:
        """Every idle slice of the run; to be asked once, after the last record."""
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
        """What was before the job `first`, so that of a run of days no more is kept than of its last frames."""
        self.jobs = self.jobs[self.jobs.index(first) :]
        oldest = min(job.frame for job in self.jobs)
        self._idle = [piece for piece in self._idle if piece.end_ns >= first.begin_ns]
        self.shown = [one for one in self.shown if one.frame >= oldest]
        for key, rows in self.figures.items():
            self.figures[key] = [row for row in rows if row[0] >= oldest]


def _plain(frames: I64, ns: I64) -> Series:
    return Series(frames, ns / NS_PER_MS, np.ones(len(frames)))


def _stage(name: str, jobs: Sequence[JobRecord]) -> dict[Key, Series]:
    """`work`: on the core; `service`: with the time without one; `wait`: for the unit."""
    frames = np.array([job.frame for job in jobs], np.int64)
    service = np.array([job.end_ns - job.begin_ns for job in jobs], np.int64)
    preempted = np.array([job.preempted_ns for job in jobs], np.int64)
    wait = np.array([job.begin_ns - job.ready_ns for job in jobs], np.int64)
    return {
        Key("work", name): _plain(frames, service - preempted),
        Key("service", name): _plain(frames, service),
        Key("wait", name): _plain(frames, wait),
    }


def _unit(
    unit: str, jobs: Sequence[JobRecord], idle: Sequence[IdleSlice], frames: I64, end_ns: I64
) -> dict[Key, Series]:
    """Busy and idle time of a unit in the time of each frame, by cause, as shares of that time."""
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
    return {
        Key("busy" if state == BUSY else "idle", unit, "" if state == BUSY else state): Series(
            frames[1:], _within(pieces, state, end_ns), weights
        )
        for state in STATES
    }


def _within(pieces: Sequence[tuple[int, int, Mapping[str, int]]], state: str, edges_ns: I64) -> F64:
    """(edges - 1,) ms of `state` between neighbouring edges, spread evenly over each piece of time that has it."""
    places, totals, total = [0.0], [0.0], 0
    for begin_ns, end_ns, states in pieces:
        places += [begin_ns, end_ns]
        totals.append(total)
        total += states.get(state, 0)
        totals.append(total)
    return np.asarray(np.diff(np.interp(edges_ns, places, totals)) / NS_PER_MS)


def _figures(figures: Mapping[Key, Sequence[tuple[int, float]]]) -> dict[Key, Series]:
    """Figures that stages gave of their jobs."""
    return {
        key: Series(
            np.array([frame for frame, _ in rows], np.int64), np.array([v for _, v in rows]), np.ones(len(rows))
        )
        for key, rows in figures.items()
    }


def _instruction_times(series: Mapping[Key, Series]) -> dict[Key, Series]:
    """Of each stage whose instructions were counted, in ns: its time on the core over them."""
    found = {}
    for key, counted in series.items():
        if key.measure == INSTRUCTIONS:
            work = series[Key("work", key.of)]
            frames, ours, theirs = np.intersect1d(work.frames, counted.frames, return_indices=True)
            ns = work.values[ours] * NS_PER_MS / np.maximum(counted.values[theirs], 1.0)
            found[Key(INSTRUCTION_TIME, key.of)] = Series(frames, ns, np.ones(len(frames)))
    return found
