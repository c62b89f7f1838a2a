"""Smaller levels of a neural texture, which were learnt with it: read where a texel is smaller than a pixel.

Rule: they are stored side by side in one array (H/2, W/2 + W/4 + ..., C), each at the top, so that an avatar has one
array more and its width says how many levels there are.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from trilane.errors import BadInputError

#: More would end below 16 texels of the usual 512, which hold no part of a body.
MOST_LEVELS = 5


def pack_levels(levels: Sequence[NDArray[Any]]) -> NDArray[Any]:
    """The array of `levels` (H/2,W/2,C), (H/4,W/4,C), ...; at least one."""
    height = levels[0].shape[0]
    rows = [np.pad(level, ((0, height - level.shape[0]), (0, 0), (0, 0))) for level in levels]
    return np.concatenate(rows, axis=1)


def split_levels(packed: NDArray[Any] | None, width: int) -> list[NDArray[Any]]:
    """The levels of `packed`, for a texture of `width`; none without an array."""
    levels: list[NDArray[Any]] = []
    left = 0
    while packed is not None and left < packed.shape[1]:
        shift = len(levels)
        side, height = width >> (shift + 1), packed.shape[0] >> shift
        levels.append(np.ascontiguousarray(packed[:height, left : left + side]))
        left += side
    return levels


def check_levels(packed: NDArray[Any], texture: NDArray[Any], where: object) -> None:
    """Raises BadInputError unless `packed` has levels of `texture` (H,W,C), in numbers of its kind."""
    height, width, channels = texture.shape
    widths = [sum(width >> (k + 1) for k in range(count)) for count in range(1, MOST_LEVELS + 1)]
    fits = packed.ndim == 3 and packed.shape[::2] == (height // 2, channels) and packed.shape[1] in widths
    if not fits or packed.dtype != texture.dtype or height % (1 << MOST_LEVELS) or width % (1 << MOST_LEVELS):
        found = f"levels of shape {packed.shape}, {packed.dtype}"
        expected = (
            f"({height // 2}, {widths[0]} to {widths[-1]}, {channels}), {texture.dtype}: 1 to {MOST_LEVELS} levels"
        )
        raise BadInputError(where, found, expected)  # type: ignore[arg-type]
