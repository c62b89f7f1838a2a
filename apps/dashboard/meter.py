"""The figures of a moment, for the page and for /metrics."""

from __future__ import annotations

from typing import Any

from trilane.pipeline.journal import Begun, Record, Stepped, Worked


class Meter:
    """Fed the records after `begun`, in order."""

    def __init__(self, begun: Begun) -> None:
        self._last = begun.graph.stages[-1].name
        self._start_ns: int | None = None
        self._presented = 0
        self._now_ns = 0

    def add(self, record: Record) -> None:
        """The next record."""
        if isinstance(record, Stepped):
            self._start_ns = record.now_ns if self._start_ns is None else self._start_ns
            self._now_ns = record.now_ns
        elif isinstance(record, Worked):
            self._presented += record.job.stage == self._last

    def message(self, now_ns: int | None = None) -> dict[str, Any]:
        """The figures at `now_ns`; where it is None, at the last record."""
        t_ms = (max(now_ns or 0, self._now_ns) - (self._start_ns or 0)) / 1e6
        return {"type": "figures", "t_ms": t_ms, "frames": {"presented": self._presented}}

    def metrics(self) -> str:
        """In OpenMetrics, without the end mark."""
        return ""
