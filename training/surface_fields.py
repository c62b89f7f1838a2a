"""Smooth fields on the body's surface, which most channels of the neural texture start from.

Rule: fields are smooth on the body, so points that are close on the body start with similar values, also across UV
seams.
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

    `vertices` (V,3), `faces` (F,3). Pinkall and Polthier, Computing discrete minimal surfaces and their conjugates,
    1993. Vertices that are not connected to the largest part of the mesh (eyeballs) take the values of its nearest
    vertex.
    """
    laplacian, mass = cotangent_laplacian(vertices, faces)
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


def cotangent_laplacian(vertices: F64, faces: Ints) -> tuple[Any, F64]:
    """The cotangent Laplacian (V,V), sparse, and each vertex's share of the area (V,)."""
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
    return laplacian, mass


def _largest_part(laplacian: Any) -> NDArray[np.int64]:
    _, label = sparse.csgraph.connected_components(laplacian, directed=False)
    return np.flatnonzero(label == np.bincount(label).argmax())
