"""The figures of a moment, for the page and for /metrics. Rule: both are told the same figures."""

from __future__ import annotations

from typing import Any, Final

from trilane.apps.live.followed_run import RunState
from trilane.apps.live.live_figures import LiveFigures
from trilane.apps.live.openmetrics import openmetrics
from trilane.pipeline.journal import Begun, Record

#: What a text in OpenMetrics ends with; the server's own counts come before it.
END: Final = "# EOF\n"


class Meter:
    """Fed the records after `begun`, in order. `finds_bound`: as of `LiveFigures`."""

    def __init__(self, begun: Begun, *, finds_bound: bool = True) -> None:
        self._figures = LiveFigures(begun, finds_bound=finds_bound)

    def add(self, record: Record) -> None:
        """The next record."""
        self._figures.add(record)

    def message(self, now_ns: int | None = None) -> dict[str, Any]:
        """The figures at `now_ns`; where it is None, at the last record."""
        return {"type": "figures", **self._figures.now(now_ns).as_json()}

    def metrics(self, now_ns: int | None = None, state: RunState | None = None) -> str:
        """In OpenMetrics, without the end mark. `state`: as of `LiveFigures.now`."""
        return openmetrics(self._figures.now(now_ns, state)).decode().removesuffix(END)
