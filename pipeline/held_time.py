"""Measures how long a run was held by its viewer.

Rule: the run's figures include that time, and the run says how much.
"""

from __future__ import annotations

from collections.abc import Iterable

from trilane.scheduler.events import Event, Hold

NS_PER_S = 1e9


class HeldTime:
    """Takes what somebody asked of the run. A hold that lets some frames through lasts until the run goes on."""

    def __init__(self) -> None:
        self._total_ns = 0
        self._since_ns: int | None = None

    def hear(self, now_ns: int, events: Iterable[Event]) -> None:
        """Take `events`, which were asked for at `now_ns`."""
        for event in events:
            if not isinstance(event, Hold):
                continue
            if event.frames < 0:
                self._total_ns, self._since_ns = self.until(now_ns), None
            elif self._since_ns is None:
                self._since_ns = now_ns

    def until(self, now_ns: int) -> int:
        """Return for how many ns the run was held up to `now_ns`."""
        return self._total_ns + (0 if self._since_ns is None else now_ns - self._since_ns)

    def sentence(self, now_ns: int) -> str:
        """Return the sentence for the report; empty if the run was never held."""
        held_s = self.until(now_ns) / NS_PER_S
        if not held_s:
            return ""
        return f"held for {held_s:.1f} s by who watched it: frame times, rates and shares of the run have that in them"
