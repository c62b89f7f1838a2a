"""A rasteriser in float64 NumPy, whose pictures are the reference for the pictures of the stage raster.

Rule: pixel centres are at half-integers. The rasteriser uses the top-left rule and a less-than depth test. Unlike a
driver, it neither rounds coordinates nor snaps vertices to a grid. Triangles are evaluated in homogeneous coordinates
(Olano and Greer, "Triangle scan conversion using 2D homogeneous coordinates", 1997). The near and the far plane cut
triangles pixel by pixel.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from trilane.arrays import F64
from trilane.stages.gpu.opengl import FLIP_Y
from trilane.stages.gpu.skinned_mesh import MeshArrays

BATCH_SAMPLES = 4_000_000


@dataclass(frozen=True)
class ReferenceImage:
    """The result of rasterising triangles, with a value for each pixel.

    `coverage`: whether a triangle covers the centre of the pixel, (h,w).
    `triangle`: number of the nearest triangle, (h,w) int64; -1 where no triangle is.
    `uv`, `depth`: texture coordinates (h,w,2) and z/w (h,w) of the point of this triangle; 0 where no triangle is.
    """

    coverage: NDArray[np.bool_]
    triangle: NDArray[np.int64]
    uv: F64
    depth: F64


def skin(arrays: MeshArrays, joints: NDArray[np.floating[Any]]) -> F64:
    """Return the skinned vertices (N,3) of the mesh `arrays` in the world, metres.

    `joints`: skinning matrices (55,3,4).
    """
    matrices = np.einsum("nk,nkij->nij", arrays.weight.astype(np.float64), joints.astype(np.float64)[arrays.joint])
    return np.asarray(np.einsum("nij,nj->ni", matrices[..., :3], arrays.position.astype(np.float64)) + matrices[..., 3])


def rasterise(
    world: F64,
    triangles: NDArray[np.integer[Any]],
    uv: NDArray[np.floating[Any]],
    clip: F64,
    shape: tuple[int, int],
    cull: bool = False,
) -> ReferenceImage:
    """Return the image of `triangles`. Row 0 is at the top.

    `world`: vertices in the world, (N,3) metres.
    `triangles`: indices of each triangle's vertices, (F,3).
    `uv`: texture coordinates of each vertex, (N,2).
    `clip`: matrix projection @ view, (4,4).
    `shape`: (height, width) of the image in pixels.
    `cull`: whether to leave out triangles that wind clockwise in the picture.
    """
    corners = _target_corners(world, clip, shape)[triangles]
    pixel, depth, owner, share = _fragments(corners, shape, cull)
    nearest = np.lexsort((owner, depth, pixel))
    pixel, first = np.unique(pixel[nearest], return_index=True)
    chosen = nearest[first]
    height, width = shape
    coverage = np.zeros(height * width, bool)
    triangle = np.full(height * width, -1, np.int64)
    image_uv, image_depth = np.zeros((height * width, 2)), np.zeros(height * width)
    coverage[pixel], triangle[pixel], image_depth[pixel] = True, owner[chosen], depth[chosen]
    image_uv[pixel] = np.einsum("pk,pkc->pc", share[chosen], uv.astype(np.float64)[triangles[owner[chosen]]])
    return ReferenceImage(
        coverage.reshape(shape), triangle.reshape(shape), image_uv.reshape(*shape, 2), image_depth.reshape(shape)
    )


def sample(texture: F64, uv: F64) -> F64:
    """Return bilinear samples (..., C) of `texture` at `uv`. Beyond the edge, the texels of the edge are repeated.

    `texture`: array (H,W,C). `uv`: texture coordinates (..., 2), column first, 0..1.
    """
    height, width = texture.shape[:2]
    column, row = uv[..., 0] * width - 0.5, uv[..., 1] * height - 0.5
    left, top = np.floor(column).astype(np.int64), np.floor(row).astype(np.int64)
    right_share, bottom_share = (column - left)[..., None], (row - top)[..., None]

    def at(dy: int, dx: int) -> F64:
        return np.asarray(texture[np.clip(top + dy, 0, height - 1), np.clip(left + dx, 0, width - 1)])

    upper = at(0, 0) * (1 - right_share) + at(0, 1) * right_share
    lower = at(1, 0) * (1 - right_share) + at(1, 1) * right_share
    return np.asarray(upper * (1 - bottom_share) + lower * bottom_share)


def quantise(real: F64, scale: float, zero_point: int) -> NDArray[np.uint8]:
    """Return clamp(round(real / scale) + zero_point, 0, 255) of each real number. Halves round to even."""
    return np.asarray(np.clip(np.rint(real / scale) + zero_point, 0, 255), np.uint8)


def tensor(image: ReferenceImage, texture: F64, scale: float, zero_point: int) -> NDArray[np.uint8]:
    """Return the tensor (h,w,C) uint8: the quantised texture on the mesh, and the zero point outside of the mesh.

    `image`: result of rasterising the mesh.
    `texture`: neural texture (H,W,C).
    `scale`, `zero_point`: scale and zero point of the tensor.
    """
    q = np.full((*image.coverage.shape, texture.shape[2]), zero_point, np.uint8)
    q[image.coverage] = quantise(sample(texture, image.uv[image.coverage]), scale, zero_point)
    return q


def _target_corners(world: F64, clip: F64, shape: tuple[int, int]) -> F64:
    """Return (column * w, row * w, z, w) of each vertex, (N,4): z and w in clip space, column and row in pixels.

    `world`: vertices (N,3). `clip`: matrix projection @ view (4,4).
    """
    x, y, z, w = np.moveaxis(np.c_[world, np.ones(len(world))] @ (FLIP_Y @ clip).T, -1, 0)
    return np.stack([(x + w) * shape[1] / 2, (y + w) * shape[0] / 2, z, w], axis=-1)


def _fragments(
    corners: F64, shape: tuple[int, int], cull: bool
) -> tuple[NDArray[np.int64], F64, NDArray[np.int64], F64]:
    """Return (pixel, depth, triangle, share) of all fragments: a fragment is one pixel that one triangle covers.

    Each array has a row for each of P fragments. `pixel` (P,): index of the pixel in row-major order. `depth` (P,): z/w
    of the point. `triangle` (P,): number of the triangle. `share` (P,3): barycentric coordinates, perspective-correct.
    `corners`: result of `_target_corners` for the corners of each triangle, (F,3,4). `shape`, `cull`: see `rasterise`.
    """
    low, size = _boxes(corners, shape)
    if cull:
        size[_determinant(corners) >= 0] = 0
    parts = []
    for side in 2 ** np.arange(int(np.ceil(np.log2(float(size.max(initial=1))))) + 1):
        members = np.flatnonzero((size <= side) & (size > side // 2))
        step = max(1, BATCH_SAMPLES // int(side * side))
        parts += [
            _covered(corners, members[at : at + step], low, int(side), shape) for at in range(0, len(members), step)
        ]
    if not parts:
        return np.empty(0, np.int64), np.empty(0), np.empty(0, np.int64), np.empty((0, 3))
    pixel, depth, owner, share = (np.concatenate(column) for column in zip(*parts, strict=True))
    return pixel, depth, owner, share


def _boxes(corners: F64, shape: tuple[int, int]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return (first column and row (F,2), side (F,)) of a square around each triangle, in pixels.

    A side of 0 means that the triangle covers no pixel of the picture.
    """
    limit = np.array([shape[1], shape[0]])
    w = corners[..., 3]
    in_front = (w > 0).all(axis=1)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        place = corners[..., :2] / w[..., None]
    place[~in_front] = np.array([[0, 0], limit, limit])
    low = np.clip(np.floor(np.clip(place.min(axis=1), -1, limit)), 0, limit).astype(np.int64)
    high = np.clip(np.ceil(np.clip(place.max(axis=1), -1, limit)), 0, limit).astype(np.int64)
    side = (high - low).max(axis=1)
    side[((high - low).min(axis=1) <= 0) | (w <= 0).all(axis=1)] = 0
    return low, side


def _covered(corners: F64, members: Any, low: Any, side: int, shape: tuple[int, int]) -> tuple[Any, Any, Any, Any]:
    points = corners[members]
    edges = np.stack([_cross(points, 1, 2), _cross(points, 2, 0), _cross(points, 0, 1)], axis=1)
    determinant = _determinant(points)
    turned = np.where(determinant < 0, -1.0, 1.0)[:, None, None]
    edges *= turned
    column = low[members, 0][:, None, None] + np.arange(side)[None, None, :]
    row = low[members, 1][:, None, None] + np.arange(side)[None, :, None]
    value = edges[:, :, 0, None, None] * (column + 0.5)[:, None]
    value = value + edges[:, :, 1, None, None] * (row + 0.5)[:, None] + edges[:, :, 2, None, None]
    # Left edges own the samples that lie exactly on them, and so do horizontal edges at the top.
    top_left = (edges[..., 0] > 0) | ((edges[..., 0] == 0) & (edges[..., 1] > 0))
    owned = (value > 0) | ((value == 0) & top_left[:, :, None, None])
    inside = owned.all(axis=1) & (column < shape[1]) & (row < shape[0]) & (determinant != 0)[:, None, None]
    which, y, x = np.nonzero(inside)
    share = value[which, :, y, x]
    share /= share.sum(axis=1, keepdims=True)
    z, w = (np.einsum("pk,pk->p", share, points[which, :, axis]) for axis in (2, 3))
    in_depth = (z >= -w) & (z <= w) & (w > 0)
    pixel = row[which, y, 0] * shape[1] + column[which, 0, x]
    return pixel[in_depth], (z[in_depth] / w[in_depth]), members[which][in_depth], share[in_depth]


def _cross(points: F64, first: int, second: int) -> F64:
    return np.asarray(np.cross(points[:, first][:, [0, 1, 3]], points[:, second][:, [0, 1, 3]]))


def _determinant(points: F64) -> F64:
    """Return a determinant for each triangle, (F,): positive if the triangle winds clockwise in the picture."""
    return np.asarray((_cross(points, 1, 2) * points[:, 0][:, [0, 1, 3]]).sum(axis=-1))
