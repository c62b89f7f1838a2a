"""Collects times of a run in any number.

Rule: they are exact while they are few, then a sketch, and `is_exact` says so.

A sketch is a structure of bounded size that gives percentiles within a stated error. This folder knows none: the maker
of `Samples` provides one for a run that may last for days. Without one, all values are kept.
"""

from __future__ import annotations

from array import array
from collections.abc import Callable
from typing import Final, Protocol

from trilane.scheduler.stats import percentile, summary_row

# At 8 bytes a value, runs of some minutes stay exact, and runs of days stay small (docs/decisions/journal.md).
MOST_EXACT: Final = 20_000
#: Number of kept values that go to the sketch with each further value, so that no step of the scheduler takes long.
MOVED_AT_ONCE: Final = 4


class Sketch(Protocol):
    """Percentiles of any number of values."""

    def add(self, value: int) -> None:
        """Add one value."""
        ...

    def percentile(self, share: float) -> float:
        """Return the value that `share` of the values do not exceed, within the error of the sketch."""
        ...


class Samples:
    """Values in ns. `count`, `total` and `largest` are exact.

    `is_exact`: whether all values are in `kept`, in the order in which they came. Otherwise `kept` is on its way into
    the sketch.
    """

    def __init__(self, sketch: Callable[[], Sketch] | None = None) -> None:
        """Begin without values.

        `sketch`: function that makes the sketch for more than MOST_EXACT values; None: all values are kept.
        """
        self.count = self.total = self.largest = 0
        self.kept = array("q")
        self._make_sketch = sketch
        self._sketch: Sketch | None = None

    @property
    def is_exact(self) -> bool:
        return self._sketch is None

    @property
    def mean(self) -> float:
        """The mean in ns; 0 without values."""
        return self.total / self.count if self.count else 0.0

    def add(self, value: int) -> None:
        """Add one value."""
        if value > self.largest or not self.count:
            self.largest = value
        self.count += 1
        self.total += value
        if self._sketch is not None:
            self._sketch.add(value)
            self._move(MOVED_AT_ONCE)
            return
        self.kept.append(value)
        if self._make_sketch is not None and self.count > MOST_EXACT:
            self._sketch = self._make_sketch()

    def summary_ms(self) -> dict[str, float]:
        """Return `trilane.scheduler.stats.summary_ms` of all values."""
        sketch = self._sketch
        if sketch is None:
            ordered = sorted(self.kept)
            return summary_row(self.count, self.total, self.largest, lambda share: percentile(ordered, share))
        self._move(len(self.kept))
        return summary_row(self.count, self.total, self.largest, sketch.percentile)

    def _move(self, count: int) -> None:
        if self._sketch is not None:
            for _ in range(min(count, len(self.kept))):
                self._sketch.add(self.kept.pop())
