"""Shows any moment of a finished run, from its journal and its video.

Rule: the journal is read once, into unnamed temporary files, because the journal may be larger than the memory.
Pictures are decoded on request and not kept.
"""

from __future__ import annotations

import asyncio
import json
import os
import tempfile
import threading
from collections.abc import Iterable, Mapping
from contextlib import suppress
from fractions import Fraction
from pathlib import Path
from typing import IO, Any, Final, NamedTuple
from weakref import WeakKeyDictionary

import av
import numpy as np
from numpy.typing import NDArray

from trilane.apps.dashboard.run_facts import RunFacts, facts_of_folder
from trilane.apps.dashboard.view import (
    ChangesSaid,
    Client,
    ControlSaid,
    Message,
    Seek,
    TimelineRows,
    described,
    figures_said,
    jpeg_of,
    metrics_text,
    note,
    shown,
    slices,
)
from trilane.apps.watch.followed_run import CUT_OFF, FollowedRun, RunState
from trilane.apps.watch.live_figures import LiveFigures
from trilane.errors import BadInputError
from trilane.pipeline.journal import NAME, Begun, Ended, Record, Stepped, journal_in, read_journal
from trilane.pipeline.unit_history import UNEXPLAINED
from trilane.scheduler.ledger import idle_causes
from trilane.stages.gpu.video_reader import open_video

FIRST_SPAN_MS: Final = 5000.0
FIGURES_EVERY_MS: Final = 1000.0
MOST_JOBS: Final = 6000
MOST_IDLE: Final = 6000
MOST_NOTES: Final = 100
OVER: Final = "the run is over"
NO_VIDEO: Final = "there are no pictures: video.mp4 is missing or cannot be read"
CAUSE_NAMES: Final = (*idle_causes(joins=True), UNEXPLAINED)
TIMES: Final = [("begin", "<f8"), ("end", "<f8")]
JOB: Final = np.dtype([("unit", "u1"), ("stage", "u1"), ("frame", "<u4"), *TIMES, ("wait", "<f8")])
IDLE: Final = np.dtype([("unit", "u1"), ("cause", "u1"), *TIMES])
PRESENTED: Final = np.dtype([("frame", "<u4"), *TIMES])
FIGURES: Final = np.dtype([("offset", "<u8"), ("size", "<u4"), *TIMES])
PIECE_ROWS = 4096


class FinishedView:
    """The `RunView` of the finished run in `folder`. The constructor raises the errors of `_read_run`."""

    def __init__(self, folder: Path) -> None:
        self._run = _read_run(folder)
        self._video = _RunPictures(folder / "video.mp4", self._run.facts.fps)
        self.trace: Path | None = folder / "trace.pftrace"
        self._at_ms: WeakKeyDictionary[Client, float] = WeakKeyDictionary()

    def greeting(self) -> Iterable[Message]:
        run = self._run
        told = {**run.facts.hello(), **described(run.begun.graph)}
        span = [0.0, run.end_ms]
        yield {"type": "hello", "run": told, "controls": [], "is_live": False, "span_ms": span}
        yield run.facts.state("ended")
        yield from (note(t_ms, text) for t_ms, text in run.notes)
        if self._video.is_missing:
            yield note(0.0, NO_VIDEO)
        yield from self._moment(run.end_ms, FIRST_SPAN_MS)

    async def news(self, *, is_watched: bool) -> Iterable[Message]:  # noqa: ARG002 - a view's signature
        return ()

    async def picture(self, client: Client) -> bytes | None:
        frame = self._run.frame_at(self._at_ms.get(client, self._run.end_ms))
        if frame is None or frame == client.had_frame:
            return None
        jpeg = await asyncio.to_thread(self._video.jpeg, frame)
        client.had_frame = frame
        return None if jpeg is None else shown(frame, 1000 * frame / self._run.facts.fps, 0.0, jpeg)

    def control(self, asked: ControlSaid) -> str:  # noqa: ARG002 - a view's signature
        return OVER

    def restart(self, asked: ChangesSaid) -> Mapping[str, str]:
        return dict.fromkeys(asked.changes, OVER)

    async def seek(self, client: Client, to: Seek) -> Iterable[Message]:
        t_ms = min(to.t_ms, self._run.end_ms)
        self._at_ms[client] = t_ms
        return await asyncio.to_thread(lambda: list(self._moment(t_ms, to.span_ms)))

    def metrics(self) -> str:
        return self._run.metrics

    def close(self) -> None:
        """Close the video and remove the temporary files."""
        self._run.close()
        self._video.close()

    def _moment(self, t_ms: float, span_ms: float) -> Iterable[Message]:
        yield self._run.slices_near(t_ms, span_ms)
        yield self._run.figures_at(t_ms)


def _read_run(folder: Path) -> _FinishedRun:
    """Return the finished run in `folder`. Raises BadInputError for a broken report, or a missing or broken journal."""
    journal = journal_in(folder)
    if journal is None:
        raise BadInputError(folder, f"no {NAME}", "the folder of a run", "`trilane run` writes one into runs/")
    run: _FinishedRun | None = None
    for record in read_journal(journal):
        if isinstance(record, Begun):
            run = _FinishedRun(record, facts_of_folder(folder, record))
        elif run is not None:
            run.add(record)
    assert run is not None, "a journal begins with its header"
    run.end(FollowedRun(folder).state)
    return run


class _FinishedRun:
    """A finished run as tables in temporary files. `_read_run` fills the tables.

    `begun`: first record of the journal.
    `facts`: facts for the page.

    `end_ms`: time of the last step. `jobs`, `idle`, `presented`: tables of jobs, idle slices and presented frames.
    `figures`: table of regular moments, with the place where the figures of each are stored. `metrics`: figures of the
    whole run in OpenMetrics. `notes`: last messages for a person, each as (time, text). All times are ms since the
    first step.
    """

    def __init__(self, begun: Begun, facts: RunFacts) -> None:
        self.begun, self.facts = begun, facts
        self.end_ms = 0.0
        self.jobs, self.idle, self.presented, self.figures = map(TimeTable, (JOB, IDLE, PRESENTED, FIGURES))
        self._written = _TextStore()
        self._timeline, self._live = TimelineRows(begun), LiveFigures(begun, finds_bound=facts.bound is None)
        read = begun.graph.streams
        self._ends = {place for place, stage in enumerate(begun.graph.stages) if stage.name not in read}
        self._due_ms = 0.0
        self.metrics = ""
        self._is_whole = False
        self.notes: list[tuple[float, str]] = []

    def add(self, record: Record) -> None:
        """Add the next record of the journal after `begun`."""
        self._timeline.add(record)
        self._live.add(record)
        self._is_whole = isinstance(record, Ended)
        if isinstance(record, Stepped):
            self._keep()
            if self._timeline.now_ms >= self._due_ms:
                self._keep_figures()

    def end(self, state: RunState) -> None:
        """Complete the tables after the last record. `state`: state of the run at its end."""
        self._timeline.end()
        self._keep()
        self._keep_figures()
        self.end_ms, self.metrics = self._timeline.now_ms, metrics_text(self._live.now(state=state))
        if not self._is_whole:
            self.notes.append((self.end_ms, CUT_OFF))
        for table in (self.jobs, self.idle, self.presented, self.figures):
            table.complete()

    def figures_at(self, t_ms: float) -> Mapping[str, Any]:
        """Return the message with the newest stored figures up to `t_ms`; if there are none, the first after."""
        row = self.figures.last_before(t_ms)
        row = self.figures.near(t_ms, FIGURES_EVERY_MS, 1)[0] if row is None else row
        figures: Mapping[str, Any] = json.loads(self._written.read(int(row["offset"]), int(row["size"])))
        return figures

    def slices_near(self, t_ms: float, span_ms: float) -> Message:
        """Return the message with the jobs and idle slices from `t_ms` - `span_ms` to `t_ms` + `span_ms`.

        If there are more than `MOST_JOBS` jobs or `MOST_IDLE` idle slices, only the nearest to `t_ms` are returned.
        """
        jobs = [
            (int(r["unit"]), int(r["stage"]), int(r["frame"]), float(r["begin"]), float(r["end"]), float(r["wait"]))
            for r in self.jobs.near(t_ms, span_ms, MOST_JOBS)
        ]
        idle = [
            (int(r["unit"]), CAUSE_NAMES[int(r["cause"])], float(r["begin"]), float(r["end"]))
            for r in self.idle.near(t_ms, span_ms, MOST_IDLE)
        ]
        return slices(jobs, idle)

    def frame_at(self, t_ms: float) -> int | None:
        """Return the number of the newest frame that was presented by `t_ms`; None before the first frame."""
        row = self.presented.last_before(t_ms)
        return None if row is None else int(row["frame"])

    def close(self) -> None:
        """Remove the temporary files."""
        for table in (self.jobs, self.idle, self.presented, self.figures, self._written):
            table.close()

    def _keep(self) -> None:
        jobs, idle, notes = self._timeline.take()
        for unit, stage, frame, begin, end, wait in jobs:
            self.jobs.add((unit, stage, frame, begin, end, wait))
            if stage in self._ends:
                self.presented.add((frame, end, end))
        for unit, cause, begin, end in idle:
            self.idle.add((unit, CAUSE_NAMES.index(cause), begin, end))
        self.notes = [*self.notes, *notes][-MOST_NOTES:]

    def _keep_figures(self) -> None:
        offset, size = self._written.add(json.dumps(figures_said(self._live.now())).encode())
        self.figures.add((offset, size, self._timeline.now_ms, self._timeline.now_ms))
        self._due_ms = self._timeline.now_ms + FIGURES_EVERY_MS


class _RunPictures:
    """Pictures from the video of a run. Several threads may call `jpeg`: a lock lets one call at a time decode.

    `path`: file of the video, which may be missing.
    `fps`: frames a second of the scene; frame n is shown from second n / `fps` on.
    """

    def __init__(self, path: Path, fps: float) -> None:
        self._lock = threading.Lock()
        self._fps = fps
        self._container: Any = None
        with suppress(OSError, av.error.FFmpegError, IndexError):  # the run was not recorded, or has no pictures
            self._container = open_video(path)
            self._stream: Any = self._container.streams.video[0]
            return
        self.close()

    @property
    def is_missing(self) -> bool:
        return self._container is None

    def jpeg(self, frame: int) -> bytes | None:
        """Return the picture that was shown at the time of the frame number `frame`, as a JPEG.

        None is returned if the video is missing, has no such picture, or is damaged there.
        """
        if self._container is None:
            return None
        one = 1 / Fraction(self._fps).limit_denominator(1001) / self._stream.time_base
        pts, newest = int(frame * one), None
        with self._lock, suppress(av.error.FFmpegError):
            self._container.seek(pts, stream=self._stream, backward=True)
            for picture in self._container.decode(self._stream):
                if newest is not None and picture.pts > pts + one / 2:
                    break
                newest = picture
            return None if newest is None else jpeg_of(newest.to_image())
        return None  # the video is damaged at this frame

    def close(self) -> None:
        if self._container is not None:
            self._container.close()
            self._container = None


class _Piece(NamedTuple):
    offset: int
    rows: int
    begin: float
    end: float


class TimeTable:
    """A table in a temporary file. Each row has a begin and an end, and rows are found by time.

    The file consists of pieces of at most PIECE_ROWS rows. Memory holds only the offset, the number of rows, the
    earliest begin and the latest end of each piece. Rows need not be sorted exactly, but `near` is faster if rows of
    similar times are added together.
    `dtype`: type of a row, with the fields `begin` and `end` in one unit of time.
    """

    def __init__(self, dtype: np.dtype[Any]) -> None:
        self._dtype = dtype
        self._file: IO[bytes] = tempfile.TemporaryFile(prefix="trilane-")  # noqa: SIM115 - `close` closes it
        self._fresh: list[tuple[Any, ...]] = []
        self._pieces: list[_Piece] = []

    def add(self, row: tuple[Any, ...]) -> None:
        self._fresh.append(row)
        if len(self._fresh) == PIECE_ROWS:
            self.complete()

    def complete(self) -> None:
        """Write the rows that are still in memory to the file, so that searches find them."""
        if self._fresh:
            rows = np.array(self._fresh, self._dtype)
            offset = self._file.seek(0, os.SEEK_END)
            self._file.write(rows.tobytes())
            self._file.flush()
            self._pieces.append(_Piece(offset, len(rows), float(rows["begin"].min()), float(rows["end"].max())))
            self._fresh = []

    def near(self, time: float, reach: float, most: int) -> NDArray[Any]:
        """Return the rows that overlap the interval from `time - reach` to `time + reach`, sorted by begin.

        `time`: middle of the interval. `reach`: half its length.
        `most`: largest number of rows to return; if there are more, the rows nearest to `time` are returned.
        """
        low, high = time - reach, time + reach
        touching = [piece for piece in self._pieces if piece.begin <= high and piece.end >= low]
        touching.sort(key=lambda piece: _away(time, piece.begin, piece.end))
        found = [np.empty(0, self._dtype)]
        for piece in touching:
            if sum(map(len, found)) >= most:
                break
            rows = self._read(piece)
            found.append(rows[(rows["begin"] <= high) & (rows["end"] >= low)])
        rows = np.concatenate(found)
        away = np.maximum(np.maximum(rows["begin"] - time, time - rows["end"]), 0)
        rows = rows[np.argsort(away, kind="stable")[:most]]
        return rows[np.argsort(rows["begin"], kind="stable")]

    def last_before(self, time: float) -> np.void | None:
        """Return the row with the latest end that is not after `time`; None if the table has no such row.

        Only the last piece with such a row is searched. Therefore rows must be added in about the order of their ends.
        """
        for piece in reversed(self._pieces):
            rows = self._read(piece)
            ended = rows[rows["end"] <= time]
            if len(ended):
                last: np.void = ended[int(ended["end"].argmax())]
                return last
        return None

    def close(self) -> None:
        """Close the temporary file, which removes it. Call no other method afterwards."""
        self._file.close()

    def _read(self, piece: _Piece) -> NDArray[Any]:
        return np.frombuffer(
            os.pread(self._file.fileno(), piece.rows * self._dtype.itemsize, piece.offset), self._dtype
        )


def _away(time: float, begin: float, end: float) -> float:
    return max(begin - time, time - end, 0.0)


class _TextStore:
    """Stores texts in a temporary file. `add` returns the offset and length of a text in bytes; `read` takes both."""

    def __init__(self) -> None:
        self._file: IO[bytes] = tempfile.TemporaryFile(prefix="trilane-", buffering=0)  # noqa: SIM115 - `close` closes it

    def add(self, text: bytes) -> tuple[int, int]:
        offset = self._file.seek(0, os.SEEK_END)
        self._file.write(text)
        return offset, len(text)

    def read(self, offset: int, size: int) -> bytes:
        return os.pread(self._file.fileno(), size, offset)

    def close(self) -> None:
        """Close the temporary file, which removes it."""
        self._file.close()
