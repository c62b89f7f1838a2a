"""Lays values of a mesh's vertices out as an image in texture space.

Rule: a texel that a face covers is interpolated from the face's corners; gaps between faces are filled on request.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from trilane.arrays import F64, Ints


def lay_out(values: F64, faces: Ints, uv: F64, uv_faces: Ints, side: int) -> tuple[F64, NDArray[np.bool_]]:
    """An image (side,side,C) of the vertices' values, and which texels (side,side) a face covers; others are 0.

    `values`: (V,C).
    `faces`: (F,3) indices of `values`.
    `uv`: (T,2).
    `uv_faces`: (F,3) indices of `uv`, per corner.
    `side`: of the image, texels.
    """
    image = np.zeros((side, side, values.shape[1]))
    covered = np.zeros((side, side), bool)
    corners = uv[uv_faces] * side - 0.5
    for corner, face in zip(corners, faces, strict=True):
        low = np.maximum(np.floor(corner.min(axis=0)).astype(int), 0)
        high = np.minimum(np.ceil(corner.max(axis=0)).astype(int) + 1, side)
        if (high <= low).any():
            continue
        x, y = np.meshgrid(np.arange(low[0], high[0]), np.arange(low[1], high[1]))
        weights = _barycentric(corner, x, y)
        if weights is None:
            continue
        inside = (weights >= -0.25).all(axis=-1)
        image[y[inside], x[inside]] = weights[inside] @ values[face]
        covered[y[inside], x[inside]] = True
    return image, covered


def fill_gaps(image: NDArray[Any], known: NDArray[np.bool_]) -> NDArray[np.float64]:
    """`image` (S,S,C) with the texels that are not `known` (S,S) filled from those round them (push and pull)."""
    weight = known.astype(np.float64)[..., None]
    return _pulled(image * weight, weight)


def fill_beside(image: NDArray[Any], known: NDArray[np.bool_]) -> tuple[F64, NDArray[np.bool_]]:
    """`image` (S,S,C) where texels beside those that are `known` (S,S) have their mean; and which are known now."""
    total = np.sum(_round_each(image * known[..., None]), axis=0)
    count = np.sum(_round_each(known.astype(np.float64)[..., None]), axis=0)
    near = np.asarray(count[..., 0] > 0)
    return np.where((near & ~known)[..., None], total / np.maximum(count, 1), image), near


def grown(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """`mask` (S,S) and the eight texels round each of its own."""
    return np.asarray(np.any(_round_each(mask[..., None]), axis=0)[..., 0])


def _round_each(image: NDArray[Any]) -> list[NDArray[Any]]:
    """Of `image` (S,S,C): nine images, in which each texel has its own value or that of one beside it; 0 beyond."""
    side = image.shape[0]
    padded = np.pad(image, ((1, 1), (1, 1), (0, 0)))
    return [padded[y : y + side, x : x + side] for y in range(3) for x in range(3)]


def _pulled(total: F64, weight: F64) -> F64:
    mean = total / np.maximum(weight, 1e-9)
    if total.shape[0] == 1 or total.shape[0] % 2 or bool((weight > 0).all()):
        return mean
    halves = [a.reshape(a.shape[0] // 2, 2, a.shape[1] // 2, 2, -1).sum(axis=(1, 3)) for a in (total, weight)]
    coarse = _pulled(*halves).repeat(2, axis=0).repeat(2, axis=1)
    return np.where(weight > 0, mean, coarse)


def _barycentric(corner: F64, x: NDArray[Any], y: NDArray[Any]) -> F64 | None:
    (ax, ay), (bx, by), (cx, cy) = corner
    area = (bx - ax) * (cy - ay) - (cx - ax) * (by - ay)
    if abs(area) < 1e-9:
        return None
    b = ((x - ax) * (cy - ay) - (cx - ax) * (y - ay)) / area
    c = ((bx - ax) * (y - ay) - (x - ax) * (by - ay)) / area
    return np.stack([1 - b - c, b, c], axis=-1)
