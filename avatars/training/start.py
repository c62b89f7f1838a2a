"""The first texture: the mean colour that the training pictures show at each texel, and the body's smoothest fields.

Rule: it is computed from the body and the training set alone.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from trilane.avatars.dressing.layers import BodyArrays
from trilane.avatars.training.data import U16, ShapeGroup
from trilane.avatars.training.spectral import eigenfunctions, fill_gaps, lay_out

F32 = NDArray[np.float32]

COLOURS = 3
OPAQUE = 250
#: Most samples of one shape that are read, and the side of the grid that they are averaged on.
MOST_SAMPLES = 200
GRID = 256


def first_texture(body: BodyArrays, groups: list[ShapeGroup], side: int, channels: int) -> F32:
    """(side, side, channels) in -1..1: three channels of mean colour, then eigenfunctions."""
    fields = eigenfunctions(body.vertices, body.faces, channels - COLOURS)
    image, known = lay_out(fields, body.faces, body.uv, body.uv_faces, side)
    smooth = fill_gaps(image, known)
    colours = mean_colours(groups).repeat(side // GRID, axis=0).repeat(side // GRID, axis=1)
    return np.asarray(np.clip(np.concatenate([2 * colours - 1, smooth], axis=2), -1, 1), np.float32)


def mean_colours(groups: list[ShapeGroup]) -> NDArray[np.float64]:
    """(GRID, GRID, 3) in 0..1: what the pictures show where each texel is drawn; texels never seen are filled in."""
    total, count = np.zeros((GRID * GRID, COLOURS)), np.zeros(GRID * GRID)
    for group in groups:
        for index in range(min(len(group), MOST_SAMPLES)):
            rgba = group.rgba[index]
            seen = (group.covered[index] > 0) & (rgba[..., 3] >= OPAQUE)
            texel = np.minimum(group.uv[index][seen].astype(np.int64) * GRID // U16, GRID - 1)
            number = texel[:, 1] * GRID + texel[:, 0]
            count += np.bincount(number, minlength=GRID * GRID)
            for k in range(COLOURS):
                total[:, k] += np.bincount(number, weights=rgba[seen][:, k], minlength=GRID * GRID) / 255
    mean = total / np.maximum(count, 1)[:, None]
    return fill_gaps(mean.reshape(GRID, GRID, COLOURS), (count > 0).reshape(GRID, GRID))


def used_texels(body: BodyArrays, side: int, margin: int) -> NDArray[np.bool_]:
    """(side, side): texels that a bilinear read of the body can touch, and `margin` more round them."""
    _, known = lay_out(np.zeros((len(body.vertices), 1)), body.faces, body.uv, body.uv_faces, side)
    for _ in range(margin):
        grown = known.copy()
        grown[1:] |= known[:-1]
        grown[:-1] |= known[1:]
        grown[:, 1:] |= known[:, :-1]
        grown[:, :-1] |= known[:, 1:]
        known = grown
    return known
