"""Holes in a recording: bad samples are left out and the neighbours are interpolated across, and it is said.

Rule: a sample is left out when it holds a number that is not finite or when its time is not after the last kept one;
more than half left out is no recording but an error.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from trilane.arrays import F64
from trilane.errors import BadInputError

#: An interval this many times the median is reported as a gap.
GAP = 1.5


def kept_samples(where: str, times_s: F64, sound: NDArray[np.bool_]) -> tuple[NDArray[np.intp], tuple[str, ...]]:
    """Indices to keep of samples at `times_s` (T,) of which `sound` (T,) are readable, and notes on the rest.

    Raises BadInputError when less than half of the samples remain.
    """
    timed = sound & np.isfinite(times_s)
    broken = int(len(times_s) - timed.sum())
    indices = np.flatnonzero(timed)
    increasing = indices[_strictly_increasing(times_s[indices])]
    late = len(indices) - len(increasing)
    if not len(increasing) or 2 * len(increasing) < len(times_s):
        raise BadInputError(
            where,
            f"{broken} samples that are not finite numbers or no rotation and {late} times that do not increase, "
            f"of {len(times_s)}",
            "at least half of the samples sound",
        )
    notes = []
    if broken:
        first = int(np.flatnonzero(~timed)[0])
        notes.append(f"{broken} samples not finite or no rotation (first: number {first}), interpolated across")
    if late:
        notes.append(f"{late} samples with repeated or decreasing times left out")
    return increasing, (*notes, *_gap_notes(times_s[increasing]))


def _strictly_increasing(times_s: F64) -> NDArray[np.bool_]:
    """Marks the times that are later than every kept one before them."""
    highest = np.maximum.accumulate(times_s)
    keep = np.ones(len(times_s), dtype=bool)
    keep[1:] = times_s[1:] > highest[:-1]
    return keep


def _gap_notes(times_s: F64) -> tuple[str, ...]:
    steps = np.diff(times_s)
    if len(steps) < 2:
        return ()
    wide = steps[steps > GAP * np.median(steps)]
    if not len(wide):
        return ()
    return (f"{len(wide)} gaps, the longest {wide.max() * 1000:.0f} ms, interpolated across",)
