"""What a trace is written into. Rule: tracks, slices, instants, counters and flows, whatever the file's format.

Times are ns of the run's clock. The slices of one track come in the order of their begins and do not overlap.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple, Protocol

#: What stands beside a slice: numbers, texts, and mappings and sequences of them.
Notes = Mapping[str, Any]
NO_NOTES: Notes = {}


class Flow(NamedTuple):
    """The arrow of which a slice is part: `number` above 0, the same for all its slices; whether it begins or ends."""

    number: int
    begins: bool = False
    ends: bool = False


class Sink(Protocol):
    """A trace file under way."""

    def recurring(self, names: Iterable[str]) -> None:
        """Names of slices and instants that come again and again."""

    def process(self, name: str) -> int:
        """A group of tracks of its own; the number of its track."""

    def track(self, name: str, parent: int, rank: int = 0) -> int:
        """A track below another one, in the order of `rank`; its number. Those of one name are shown as one."""

    def counter_track(self, name: str, parent: int, rank: int = 0, unit: str = "") -> int:
        """A track of numbers. `unit`: of the numbers, as people write it."""

    def slice(
        self, track: int, begin_ns: int, end_ns: int, name: str, notes: Notes = NO_NOTES, flow: Flow | None = None
    ) -> None:
        """A piece of time on a track."""

    def begin(self, track: int, at_ns: int, name: str, notes: Notes = NO_NOTES) -> None:
        """A slice whose end is not known yet."""

    def end(self, track: int, at_ns: int) -> None:
        """The end of the slice that has begun on the track."""

    def instant(self, track: int, at_ns: int, name: str, notes: Notes = NO_NOTES) -> None:
        """Something that took no time."""

    def count(self, track: int, at_ns: int, value: float) -> None:
        """From now on the counter has this value."""

    def close(self) -> None:
        """All that was written is in the file."""
