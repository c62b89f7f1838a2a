"""A trace as Chrome's JSON (chrome://tracing, Perfetto, speedscope). Rule: written event by event, whole at the end.

The format: Trace Event Format, docs.google.com/document/d/1CvAClvFfyA5R-PhYUmn5OOQtYMH4h6I0nSsKchNAySU. A process is a
process, a track one of its threads; times are in us.
"""

from __future__ import annotations

import json
from collections.abc import Iterable
from typing import IO, Any, Final

from trilane.apps.tracing.sink import NO_NOTES, Flow, Notes

NS_PER_US: Final = 1000
CATEGORY: Final = "frame"


class ChromeSink:
    """`Sink` of a file. `file`: opened for writing text; whoever opened it closes it, after `close`."""

    def __init__(self, file: IO[str]) -> None:
        self._file, self._is_first, self._tracks = file, True, 0
        self._names: dict[int, str] = {}
        self._process_of: dict[int, int] = {}
        file.write('{"displayTimeUnit": "ms", "traceEvents": [')

    def recurring(self, names: Iterable[str]) -> None:
        """Chrome's JSON has every name in full."""

    def process(self, name: str) -> int:
        number = self._new(name)
        self._process_of[number] = number
        self._write(ph="M", pid=number, name="process_name", args={"name": name})
        return number

    def track(self, name: str, parent: int, rank: int = 0) -> int:  # noqa: ARG002 - the order is that of the calls
        number = self._child(name, parent)
        pid = self._process_of[number]
        self._write(ph="M", pid=pid, tid=number, name="thread_name", args={"name": self._names[number]})
        self._write(ph="M", pid=pid, tid=number, name="thread_sort_index", args={"sort_index": number})
        return number

    def counter_track(self, name: str, parent: int, rank: int = 0, unit: str = "") -> int:  # noqa: ARG002
        return self._child(f"{name}, {unit}" if unit else name, parent)

    def slice(
        self, track: int, begin_ns: int, end_ns: int, name: str, notes: Notes = NO_NOTES, flow: Flow | None = None
    ) -> None:
        times = {"ts": begin_ns / NS_PER_US, "dur": (end_ns - begin_ns) / NS_PER_US}
        self._write(ph="X", **self._at(track), **times, name=name, args=notes)
        if flow is not None:
            phase = "s" if flow.begins else "f" if flow.ends else "t"
            where = {**self._at(track), "ts": begin_ns / NS_PER_US, "bp": "e"}
            self._write(ph=phase, **where, id=flow.number, cat=CATEGORY, name=CATEGORY)

    def begin(self, track: int, at_ns: int, name: str, notes: Notes = NO_NOTES) -> None:
        self._write(ph="B", **self._at(track), ts=at_ns / NS_PER_US, name=name, args=notes)

    def end(self, track: int, at_ns: int) -> None:
        self._write(ph="E", **self._at(track), ts=at_ns / NS_PER_US)

    def instant(self, track: int, at_ns: int, name: str, notes: Notes = NO_NOTES) -> None:
        self._write(ph="i", s="t", **self._at(track), ts=at_ns / NS_PER_US, name=name, args=notes)

    def count(self, track: int, at_ns: int, value: float) -> None:
        where = {"pid": self._process_of[track], "ts": at_ns / NS_PER_US}
        self._write(ph="C", **where, name=self._names[track], args={"value": value})

    def close(self) -> None:
        self._file.write("\n]}\n")
        self._file.flush()

    def _new(self, name: str) -> int:
        self._tracks += 1
        self._names[self._tracks] = name
        return self._tracks

    def _child(self, name: str, parent: int) -> int:
        """Below a track that is no process the name says so: Chrome's threads have no order of their own."""
        pid = self._process_of[parent]
        number = self._new(name if parent == pid else f"{self._names[parent]}: {name}")
        self._process_of[number] = pid
        return number

    def _at(self, track: int) -> dict[str, int]:
        return {"pid": self._process_of[track], "tid": track}

    def _write(self, **event: Any) -> None:
        self._file.write("\n" if self._is_first else ",\n")
        self._is_first = False
        self._file.write(json.dumps(event, separators=(",", ":"), allow_nan=False))
