"""The texture that training starts from: the mean colour of each texel in the training pictures, and smooth fields.

Rule: it is computed from the body and the training set alone.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from trilane.arrays import F32
from trilane.training.body_arrays import BodyArrays
from trilane.training.sample_files import U16, ShapeGroup
from trilane.training.surface_fields import eigenfunctions
from trilane.training.surface_fill import fill_along_surface
from trilane.training.texture_layout import fill_beside, fill_gaps, lay_out

COLOURS = 3
OPAQUE = 250
#: At most this many samples of one shape are read, and none with fewer pixels: those span too many texels.
MOST_SAMPLES = 250
LEAST_PIXELS = 200 * 200
#: A pixel that spans more than this share of the texture crosses a UV seam.
LARGEST_SPAN = 0.03
LEAST_WEIGHT = 1e-4


def first_texture(body: BodyArrays, groups: list[ShapeGroup], side: int, channels: int) -> F32:
    """(side, side, channels) in -1..1: three channels of colour, then eigenfunctions of the body's Laplacian.

    `body`: the body at rest.
    `groups`: the training samples.
    `side`: of the texture, texels.
    `channels`: of the texture, more than three.
    """
    fields = eigenfunctions(body.vertices, body.faces, channels - COLOURS)
    image, known = lay_out(fields, body.faces, body.uv, body.uv_faces, side)
    smooth = fill_gaps(image, known)
    colours = mean_colours(groups, side, body)
    return np.asarray(np.clip(np.concatenate([2 * colours - 1, smooth], axis=2), -1, 1), np.float32)


def mean_colours(groups: list[ShapeGroup], side: int, body: BodyArrays) -> NDArray[np.float64]:
    """(side, side, 3) in 0..1: the mean colour of the pixels at which each texel is drawn.

    Texels beside seen ones, which lie between the pixels of a view, have their mean; all others are filled along the
    surface of `body`.

    Clothes stand off the body, so in every view a texel shows another point of them. The mean is still sharp, because
    near views and views along the surface's normal have the largest weights.
    """
    total, count = np.zeros((side * side, COLOURS)), np.zeros(side * side)
    for group in groups:
        if group.shape[0] * group.shape[1] < LEAST_PIXELS:
            continue
        for index in range(min(len(group), MOST_SAMPLES)):
            rgba = group.rgba[index]
            uv = group.uv[index].astype(np.float64) / U16
            weight = head_on(uv, group.covered[index] > 0, side) * (rgba[..., 3] >= OPAQUE)
            seen = weight > 0
            texel = np.minimum((uv[seen] * side).astype(np.int64), side - 1)
            number = texel[:, 1] * side + texel[:, 0]
            count += np.bincount(number, weights=weight[seen], minlength=side * side)
            for k in range(COLOURS):
                coloured = weight[seen] * rgba[seen][:, k] / 255
                total[:, k] += np.bincount(number, weights=coloured, minlength=side * side)
    mean = total / np.maximum(count, 1e-12)[:, None]
    colours, near = fill_beside(mean.reshape(side, side, COLOURS), (count > LEAST_WEIGHT).reshape(side, side))
    return fill_along_surface(colours, ~near, body)


def head_on(uv: NDArray[np.float64], covered: NDArray[np.bool_], side: int) -> NDArray[np.float64]:
    """Weight (h,w) of each pixel of a UV image (h,w,2): 1 where the surface is seen along its normal and large.

    With s >= t the singular values of the derivative of UV by pixel: (t / s)^3, times (1 / (side s))^2 where a pixel
    spans more than a texel. 0 at the outline, where there is no derivative, and across seams.
    """
    across, down = np.zeros_like(uv), np.zeros_like(uv)
    across[:, 1:-1] = (uv[:, 2:] - uv[:, :-2]) / 2
    down[1:-1] = (uv[2:] - uv[:-2]) / 2
    inner = covered.copy()
    inner[:, 1:-1] &= covered[:, 2:] & covered[:, :-2]
    inner[1:-1] &= covered[2:] & covered[:-2]
    inner[[0, -1]] = inner[:, [0, -1]] = False
    a, b, c = (across**2).sum(axis=2), (down**2).sum(axis=2), (across * down).sum(axis=2)
    large = (a + b + np.sqrt((a - b) ** 2 + 4 * c * c)) / 2
    small = np.maximum(a * b - c * c, 0) / np.maximum(large, 1e-14)
    weight = (small / np.maximum(large, 1e-14)) ** 1.5 * np.minimum(1.0, 1 / np.maximum(large * side**2, 1e-14))
    return np.where(inner & (large < LARGEST_SPAN**2), weight, 0.0)


def used_texels(body: BodyArrays, side: int, margin: int) -> NDArray[np.bool_]:
    """(side, side): texels that a bilinear read of the body's texture can use, and `margin` more round them."""
    _, known = lay_out(np.zeros((len(body.vertices), 1)), body.faces, body.uv, body.uv_faces, side)
    for _ in range(margin):
        grown = known.copy()
        grown[1:] |= known[:-1]
        grown[:-1] |= known[1:]
        grown[:, 1:] |= known[:, :-1]
        grown[:, :-1] |= known[:, 1:]
        known = grown
    return known
