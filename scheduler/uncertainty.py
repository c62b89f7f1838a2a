"""How uncertain a run's own frames leave its mean frame time. Rule: successive frames are not independent.

Method: nonoverlapping batch means. The times are cut into batches of equal length, longer than what one frame carries
over to the next. The means of the batches count as independent, and Student's t over them gives the interval.

Sources: Schmeiser, "Batch Size Effects in the Analysis of Simulation Output", Operations Research 30 (1982), who finds
little use in more than 10 to 30 batches; Law, Simulation Modeling and Analysis, chapter 9.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import sqrt
from statistics import fmean, stdev

NS_PER_MS, NS_PER_S = 1e6, 1e9
MOST_BATCHES = 10
LEAST_BATCHES = 5
#: Least number of frames in a batch: as many as can be in flight in five stages with two slots between each.
LEAST_FRAMES = 10
#: The 0.975 quantile of Student's t, by degrees of freedom.
T_975 = {4: 2.776445, 5: 2.570582, 6: 2.446912, 7: 2.364624, 8: 2.306004, 9: 2.262157}


def mean_interval(values: Sequence[float], mean: float | None = None) -> tuple[float, float] | None:
    """Return the 95 % interval of the mean that a run like this one would have if it went on, in units of `values`.

    None stands for too few values: fewer than `LEAST_BATCHES` batches of `LEAST_FRAMES`, or an interval that reaches 0.

    `values`: values above 0 in the order of measurement. The first ones, which do not fill a batch, count for the mean
    alone.
    `mean`: mean of all values, where `values` are means of blocks.
    """
    batches = min(len(values) // LEAST_FRAMES, MOST_BATCHES)
    if batches < LEAST_BATCHES:
        return None
    mean = fmean(values) if mean is None else mean
    half = _half_width(values, batches)
    return (mean - half, mean + half) if half < mean else None


def batch_interval(values: Sequence[float]) -> float | None:
    """Return half the width of the 95 % interval of a mean, from `values` over equal batches of at least LEAST_FRAMES.

    None stands for fewer than LEAST_BATCHES batches. With more than MOST_BATCHES, neighbours are merged.
    """
    batches = min(len(values), MOST_BATCHES)
    return _half_width(values, batches) if batches >= LEAST_BATCHES else None


def _half_width(values: Sequence[float], batches: int) -> float:
    """Return half the width of the 95 % interval: Student's t over the means of `batches` batches.

    The first values, which fill no batch, do not count.
    """
    length = len(values) // batches
    first = len(values) - batches * length
    means = [fmean(values[first + batch * length : first + (batch + 1) * length]) for batch in range(batches)]
    return T_975[batches - 1] * stdev(means) / sqrt(batches)


def frame_interval_ms(interval_ns: tuple[float, float] | None) -> dict[str, float | None]:
    """Return `mean_low` and `mean_high` of the frame time in ms; both are None without an interval."""
    low, high = interval_ns or (None, None)
    return {"mean_low": low and low / NS_PER_MS, "mean_high": high and high / NS_PER_MS}


def fps_interval(interval_ns: tuple[float, float] | None) -> dict[str, float | None]:
    """Return `fps_low` and `fps_high`, the same interval in frames a second."""
    low, high = interval_ns or (None, None)
    return {"fps_low": high and NS_PER_S / high, "fps_high": low and NS_PER_S / low}
