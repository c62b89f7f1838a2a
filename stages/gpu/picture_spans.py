"""Which parts of the network's picture show anything. Rule: what is left out is transparent wherever it is read.

A body fills about half of its rectangle; a software driver takes as long for a pixel that stays as it is as for any
other. So the picture is cut into bands of rows, and each band to the columns between its first and last texel that is
not transparent, widened by what a screen pixel may read beside its middle.
"""

from __future__ import annotations

import numpy as np

from trilane.arrays import F32, Mask

BAND = 16  # rows
WHOLE: F32 = np.array([[0, 0, 1, 1]], np.float32)


def spans(shown: Mask, margin: int) -> F32:
    """(N,4) float32: left, top, right, bottom of each part, as shares of the picture's sides.

    `shown`: (h,w) where the picture is not transparent. `margin`: texels that are read beside a pixel's middle.
    """
    height, width = shown.shape
    has_any = shown.any(axis=1)
    first = np.where(has_any, shown.argmax(axis=1), width)
    end = np.where(has_any, width - shown[:, ::-1].argmax(axis=1), 0)
    tops = np.arange(0, height, BAND)
    bottoms = np.minimum(tops + BAND, height)
    rows = np.column_stack([np.maximum(tops - margin, 0), np.minimum(bottoms + margin, height)]).ravel()
    left = np.minimum.reduceat(np.append(first, width), rows)[::2] - margin  # of the rows of each pair
    right = np.maximum.reduceat(np.append(end, 0), rows)[::2] + margin
    is_shown = right - left > 2 * margin
    edges = np.column_stack([np.maximum(left, 0), tops, np.minimum(right, width), bottoms])[is_shown]
    return np.asarray(edges / (width, height, width, height), np.float32)
