"""When the feet of a recorded person stand on the floor of the recording.

Rule: told by the heights of ankles and toes alone: each of them has a height at which it is while its foot stands, and
a person stands while at least one of them is at its own.
"""

from __future__ import annotations

import numpy as np

from trilane.arrays import F64

#: The height at which a joint stands is that below which it is in this share of the frames, percent.
STANDING_PERCENTILE = 5.0
#: At most so far above it a joint still stands; from `FLIES_M` on it does not; metres.
STANDS_M, FLIES_M = 0.03, 0.06


def stance(heights: F64) -> F64:
    """How much the person stands, per frame (T,): 1 on the floor, 0 in the air.

    `heights` (T, 2, n): of the n joints of both feet that are recorded, left and right, metres along up.
    """
    standing = np.percentile(heights, STANDING_PERCENTILE, axis=(0, 1))
    above = (heights - standing).min(axis=(1, 2))
    return np.asarray(np.clip((FLIES_M - above) / (FLIES_M - STANDS_M), 0.0, 1.0))
