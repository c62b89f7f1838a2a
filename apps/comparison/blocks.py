"""Resampling of a series whose values are not independent. Rule: whole blocks are drawn, and the data says how long.

Sources: Politis & Romano, "A circular block-resampling procedure for stationary data" (1992); block length by Politis &
White, Econometric Reviews 23 (2004), as corrected by Patton, Politis & White, Econometric Reviews 28 (2009).
"""

from __future__ import annotations

from math import ceil, log10, sqrt

import numpy as np

from trilane.arrays import F64, Ints, Mask

#: Correlations below this many standard errors count as none.
INSIGNIFICANT = 2.0
LEAST_LAGS = 5


def block_length(series: F64) -> int:
    """How many values of `series`, in order, a block of a circular bootstrap of their mean should have; at least 1.

    The length that makes the variance's mean squared error least, by the autocovariances up to twice the lag from which
    on they are insignificant; at most 3 sqrt(n) or n / 3.
    """
    count = len(series)
    most = max(1, ceil(min(3 * sqrt(count), count / 3)))
    centred = series - series.mean()
    variance = float(centred @ centred) / count
    if count < 2 * LEAST_LAGS or variance <= 1e-24 * float(np.max(np.abs(series), initial=0.0)) ** 2:
        return 1
    run = max(LEAST_LAGS, ceil(sqrt(log10(count))))
    lags = min(ceil(sqrt(count)) + run, count - 1)
    covariances = np.array([centred[: count - lag] @ centred[lag:] / count for lag in range(lags + 1)])
    limit = INSIGNIFICANT * sqrt(log10(count) / count)
    is_small = np.abs(covariances[1:] / variance) < limit
    bandwidth = min(2 * max(_last_correlated(is_small, run), 1), lags)
    taper = np.clip(2 * (1 - np.arange(bandwidth + 1) / bandwidth), 0.0, 1.0)
    kept = taper * covariances[: bandwidth + 1]
    spectrum = kept[0] + 2 * kept[1:].sum()
    bend = 2 * (np.arange(bandwidth + 1) * kept).sum()
    if spectrum <= 0:
        return most
    return int(np.clip(round((1.5 * (bend / spectrum) ** 2 * count) ** (1 / 3)), 1, most))


def _last_correlated(is_small: Mask, run: int) -> int:
    """The lag after which `run` insignificant ones follow in a row; else the last that is significant."""
    for lag in range(len(is_small) - run + 1):
        if is_small[lag : lag + run].all():
            return lag
    significant = np.flatnonzero(~is_small)
    return int(significant[-1]) + 1 if len(significant) else 0


def draws(count: int, length: int, replicates: int, generator: np.random.Generator) -> Ints:
    """(replicates, count) places in a series of `count` values, in blocks of `length` that go on at its beginning."""
    blocks = ceil(count / length)
    starts = generator.integers(0, count, (replicates, blocks, 1))
    places = (starts + np.arange(length)) % count
    return places.reshape(replicates, -1)[:, :count]
