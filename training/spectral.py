"""What the neural texture starts from: smooth fields of the body's surface, laid out in texture space.

Rule: fields are smooth on the body, so neighbours on the body begin alike even across UV seams.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import scipy.sparse as sparse
from numpy.typing import NDArray
from scipy.sparse.linalg import eigsh

from trilane.arrays import F64, Ints

SMALLEST_PART = 0.2


def eigenfunctions(vertices: F64, faces: Ints, count: int) -> F64:
    """The `count` smoothest non-constant eigenfunctions (V,count) of the cotangent Laplacian, each scaled to -1..1.

    Pinkall and Polthier, Computing discrete minimal surfaces and their conjugates, 1993. Parts that hang together but
    are not joined to the largest one (eyeballs) take the values of the vertices of it that are nearest.
    """
    laplacian, mass = _cotangent(vertices, faces)
    part = _largest_part(laplacian)
    inner = laplacian[part][:, part]
    values, vectors = eigsh(inner, k=count + 1, M=sparse.diags(mass[part]), sigma=-1e-3, v0=np.ones(len(part)))
    vectors = vectors[:, np.argsort(values)][:, 1:]
    vectors *= np.sign(vectors[np.abs(vectors).argmax(axis=0), np.arange(count)])
    fields = np.empty((len(vertices), count))
    fields[part] = vectors / np.abs(vectors).max(axis=0)
    rest = np.setdiff1d(np.arange(len(vertices)), part)
    for vertex in rest:
        nearest = part[((vertices[part] - vertices[vertex]) ** 2).sum(axis=1).argmin()]
        fields[vertex] = fields[nearest]
    return fields


def lay_out(values: F64, faces: Ints, uv: F64, uv_faces: Ints, side: int) -> tuple[F64, NDArray[np.bool_]]:
    """Vertex `values` (V,C) as an image (side,side,C), and which texels (side,side) a face covers; the rest is 0."""
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
    """`image` (S,S,C) with unknown texels filled from the known ones round them, coarse to fine (push and pull)."""
    weight = known.astype(np.float64)[..., None]
    return _pulled(image * weight, weight)


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


def _cotangent(vertices: F64, faces: Ints) -> tuple[Any, F64]:
    count = len(vertices)
    rows, columns, values = [], [], []
    mass = np.zeros(count)
    for k in range(3):
        i, j, o = faces[:, (k + 1) % 3], faces[:, (k + 2) % 3], faces[:, k]
        a, b = vertices[i] - vertices[o], vertices[j] - vertices[o]
        double_area = np.maximum(np.linalg.norm(np.cross(a, b), axis=1), 1e-12)
        cot = np.clip((a * b).sum(axis=1) / double_area, 0.01, 20.0) / 2
        rows += [i, j]
        columns += [j, i]
        values += [-cot, -cot]
        mass += np.bincount(o, weights=double_area / 6, minlength=count)
    off = sparse.coo_matrix((np.concatenate(values), (np.concatenate(rows), np.concatenate(columns))), (count, count))
    laplacian = (off - sparse.diags(np.asarray(off.sum(axis=1)).ravel())).tocsr()
    return laplacian, np.maximum(mass, 1e-10)


def _largest_part(laplacian: Any) -> NDArray[np.int64]:
    _, label = sparse.csgraph.connected_components(laplacian, directed=False)
    return np.flatnonzero(label == np.bincount(label).argmax())
