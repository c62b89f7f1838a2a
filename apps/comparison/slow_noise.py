"""How far two runs of one kind differ because a machine's speed drifts. Rule: drift goes on as it did within the runs.

A run's mean varies from run to run by more than its frames' scatter says: what changes slowly is alike within one run
and another in the next. The Allan variance over an averaging time tells it: half the mean squared difference of the
means of neighbouring stretches. It falls as 1/T where frames scatter independently, and stays where noise is as strong
at any time scale (flicker). Here it is measured on stretches of a run and carried on to the length of the whole run, by
the slope it has within the run, between these two.

Sources: Allan, "Statistics of atomic frequency standards", Proc. IEEE 54 (1966); Barnes et al., IEEE Transactions on
Instrumentation and Measurement 20 (1971).
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise
from math import log2

import numpy as np

from trilane.arrays import F64, Ints

STRETCHES = 16


def drift_variance(count: int, value: Callable[[slice], float]) -> float:
    """Variance, from run to run, of a statistic of `count` frames that drift; that of the frames' scatter included.

    `value`: of a stretch of the frames, given as a slice of them. Raises ZeroDivisionError for fewer frames than
    `STRETCHES`.
    """
    edges = np.linspace(0, count, STRETCHES + 1).astype(int)
    short, middle, long = (_allan(_values(edges[::step], value)) for step in (1, 2, 4))
    if middle <= 0:
        return 0.0
    slope = min(max(log2(short / long) / 2, 0.0), 1.0) if min(short, long) > 0 else float(long <= 0)
    return float(middle * (2 / STRETCHES) ** slope)


def _values(edges: Ints, value: Callable[[slice], float]) -> F64:
    return np.array([value(slice(low, high)) for low, high in pairwise(edges.tolist())])


def _allan(values: F64) -> float:
    return float(np.mean(np.diff(values) ** 2)) / 2
