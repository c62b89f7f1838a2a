"""Percentiles of more times than are kept, by the library ddsketch. Rule: within RELATIVE_ERROR of the exact ones.

Masson, Rim, Lee, "DDSketch: A Fast and Fully-Mergeable Quantile Sketch with Relative-Error Guarantees", PVLDB 12
(2019). The bins grow by a constant factor, so each value is known within that factor. BINS of them reach from a
nanosecond to centuries; a bin is made when it gets a value.
"""

from __future__ import annotations

from ddsketch import LogCollapsingLowestDenseDDSketch

from trilane.scheduler.samples import MOST_EXACT

RELATIVE_ERROR = 0.005
BINS = 4096
EXACT = "exact"
SKETCHED = f"of more than {MOST_EXACT} samples by ddsketch, within {RELATIVE_ERROR:.1%}; of fewer exact"


class DdSketch:
    """A `trilane.scheduler.samples.Sketch` of values of at least 0."""

    def __init__(self) -> None:
        self._sketch = LogCollapsingLowestDenseDDSketch(RELATIVE_ERROR, BINS)

    def add(self, value: int) -> None:
        self._sketch.add(value)

    def percentile(self, share: float) -> float:
        return self._sketch.get_quantile_value(share) or 0.0
