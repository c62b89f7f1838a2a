"""Counts of times by their length. Rule: the bounds never change, so that counts of different runs can be added up."""

from __future__ import annotations

from bisect import bisect_left

from trilane.apps.live.figures import Histogram

NS_PER_S = 1e9
#: Upper bounds in seconds: a few to each halving of the rate between 200 and 10 frames a second, fewer on both sides.
BOUNDS_S = (
    *(0.001, 0.002, 0.003, 0.004, 0.005, 0.006, 0.008),
    *(0.01, 0.0125, 0.015, 0.0175, 0.02, 0.025, 0.03, 0.035, 0.04, 0.05, 0.06, 0.075),
    *(0.1, 0.15, 0.2, 0.3, 0.5, 1.0, 2.0, 5.0, 10.0),
)


class TimeHistogram:
    """Of times in ns."""

    def __init__(self) -> None:
        self._counts = [0] * (len(BOUNDS_S) + 1)
        self._sum_ns = 0

    def add(self, time_ns: int) -> None:
        """A time that equals a bound counts below it."""
        self._counts[bisect_left(BOUNDS_S, time_ns / NS_PER_S)] += 1
        self._sum_ns += time_ns

    def now(self) -> Histogram:
        """As counted so far."""
        return Histogram(BOUNDS_S, tuple(self._counts), self._sum_ns / NS_PER_S)
