"""How far a run's own frames leave its mean frame time open. Rule: frames that follow each other are not independent.

Method: nonoverlapping batch means. The times are cut into batches of equal length, longer than what one frame carries
over to the next; the means of the batches count as independent, and Student's t over them gives the interval.

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
#: Frames in a batch, at least: as many as can be in flight in five stages with two slots between each.
LEAST_FRAMES = 10
#: The 0.975 quantile of Student's t, by degrees of freedom.
T_975 = {4: 2.776445, 5: 2.570582, 6: 2.446912, 7: 2.364624, 8: 2.306004, 9: 2.262157}


def mean_interval(values: Sequence[float], mean: float | None = None) -> tuple[float, float] | None:
    """Where the mean lies that a run like this one would have if it went on: the 95 % interval, in units of `values`.

    `values`: in the order in which they were measured, each above 0; of the first ones, those that do not fill a batch
    count for the mean alone. None when they are too few to tell: fewer than `LEAST_BATCHES` batches of `LEAST_FRAMES`,
    or so scattered that the interval reaches 0. `mean`: of all, where `values` are means of blocks of them.
    """
    batches = min(len(values) // LEAST_FRAMES, MOST_BATCHES)
    if batches < LEAST_BATCHES:
        return None
    mean = fmean(values) if mean is None else mean
    half = _half_width(values, batches)
    return (mean - half, mean + half) if half < mean else None


def batch_interval(values: Sequence[float]) -> float | None:
    """Half the width of the 95 % interval of a mean, from its `values` over equal batches of LEAST_FRAMES and more.

    None for fewer than LEAST_BATCHES; of more than MOST_BATCHES neighbours are put together.
    """
    batches = min(len(values), MOST_BATCHES)
    return _half_width(values, batches) if batches >= LEAST_BATCHES else None


def _half_width(values: Sequence[float], batches: int) -> float:
    """Student's t over the means of so many batches; the first values, which fill none, do not count."""
    length = len(values) // batches
    first = len(values) - batches * length
    means = [fmean(values[first + batch * length : first + (batch + 1) * length]) for batch in range(batches)]
    return T_975[batches - 1] * stdev(means) / sqrt(batches)


def frame_interval_ms(interval_ns: tuple[float, float] | None) -> dict[str, float | None]:
    """`mean_low` and `mean_high` of the frame time in ms, both None when it cannot be told."""
    low, high = interval_ns or (None, None)
    return {"mean_low": low and low / NS_PER_MS, "mean_high": high and high / NS_PER_MS}


def fps_interval(interval_ns: tuple[float, float] | None) -> dict[str, float | None]:
    """`fps_low` and `fps_high`: the same interval as frames a second."""
    low, high = interval_ns or (None, None)
    return {"fps_low": high and NS_PER_S / high, "fps_high": low and NS_PER_S / low}
