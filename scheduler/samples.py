"""Times of a run, of which there may be any number. Rule: exact while they are few, then a sketch, and it is said.

A sketch is a structure of bounded size that gives percentiles within a stated error. This folder knows none: who makes
`Samples` of a run that may last for days gives one, of the others all values are kept.
"""

from __future__ import annotations

from array import array
from collections.abc import Callable
from typing import Final, Protocol

from trilane.scheduler.stats import percentile, summary_row

MOST_EXACT: Final = 20_000
#: Of the kept values, so many go to the sketch with each further one, so that no step of the scheduler takes long.
MOVED_AT_ONCE: Final = 4


class Sketch(Protocol):
    """Percentiles of any number of values."""

    def add(self, value: int) -> None:
        """One more."""
        ...

    def percentile(self, share: float) -> float:
        """The value that `share` of the values do not exceed, within the error of the sketch."""
        ...


class Samples:
    """Values in ns. `count`, `total` and `largest` are exact.

    `is_exact`: whether all are in `kept`, in the order in which they came; else `kept` is on its way into the sketch.
    """

    def __init__(self, sketch: Callable[[], Sketch] | None = None) -> None:
        """`sketch`: makes the one that takes them once there are more than MOST_EXACT; None: all are kept."""
        self.count = self.total = self.largest = 0
        self.kept = array("q")
        self._make_sketch = sketch
        self._sketch: Sketch | None = None

    @property
    def is_exact(self) -> bool:
        return self._sketch is None

    @property
    def mean(self) -> float:
        """0 when there are none."""
        return self.total / self.count if self.count else 0.0

    def add(self, value: int) -> None:
        """One more."""
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
        """As `trilane.scheduler.stats.summary_ms` of all values."""
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
