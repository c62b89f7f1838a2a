"""Fills what is not known on a surface from what is known round it, along the surface and so across its UV seams.

Rule: filled values are harmonic: each is the weighted mean of its neighbours on the mesh, so none lies beyond the known
ones. What is known stays as it is.
"""

from __future__ import annotations

import numpy as np
import scipy.sparse as sparse
from numpy.typing import NDArray
from scipy.sparse.linalg import splu
from scipy.spatial import cKDTree

from trilane.arrays import F64, Ints, Mask
from trilane.training.body_arrays import BodyArrays
from trilane.training.surface_fields import cotangent_laplacian
from trilane.training.texture_layout import fill_gaps, lay_out


def harmonic_fill(values: F64, known: Mask, vertices: F64, faces: Ints) -> F64:
    """`values` (V,C) of a mesh with those of vertices that are not `known` (V,) solved for.

    The solution of Laplace's equation with the known values as boundary, for the cotangent Laplacian (Pinkall and
    Polthier 1993) of `vertices` (V,3), `faces` (F,3). Parts of the mesh without any known vertex take the values of the
    known vertex that is nearest in space. Unchanged when no vertex is known.
    """
    filled = np.array(values, np.float64)
    if not known.any():
        return filled
    laplacian, _ = cotangent_laplacian(vertices, faces)
    _, part = sparse.csgraph.connected_components(laplacian, directed=False)
    reached = np.bincount(part, weights=known)[part] > 0
    far = np.flatnonzero(~reached)
    if len(far):
        sources = np.flatnonzero(known)
        filled[far] = filled[sources[cKDTree(vertices[sources]).query(vertices[far])[1]]]
    open_ = np.flatnonzero(reached & ~known)
    if len(open_):
        rows = laplacian[open_]
        filled[open_] = splu(rows[:, open_].tocsc()).solve(-(rows[:, known] @ filled[known]))
    return filled


def fill_along_surface(image: NDArray[np.floating], unseen: Mask, body: BodyArrays) -> F64:
    """`image` (S,S,C) with the texels `unseen` (S,S) filled from the others that the body uses.

    Those that a face covers are filled along the body's surface; those beside the faces, which only bilinear reads at
    seams use, from the texels round them.
    """
    side = len(image)
    values, known = _at_vertices(np.asarray(image, np.float64), ~unseen, body)
    laid, covered = lay_out(
        harmonic_fill(values, known, body.vertices, body.faces), body.faces, body.uv, body.uv_faces, side
    )
    filled = np.where((unseen & covered)[..., None], laid, image)
    return np.where((unseen & ~covered)[..., None], fill_gaps(filled, ~unseen | covered), filled)


def _at_vertices(image: F64, seen: Mask, body: BodyArrays) -> tuple[F64, Mask]:
    """The values (V,C) of the `seen` texels of `image` at the body's vertices, and which vertices (V,) have one.

    Each of a vertex's places in the texture is read bilinearly, from seen texels alone; a vertex on a seam has the mean
    of its places.
    """
    side, count = len(image), len(body.vertices)
    pairs = np.unique(np.column_stack([body.faces.reshape(-1), body.uv_faces.reshape(-1)]), axis=0)
    at = np.clip(body.uv[pairs[:, 1]] * side - 0.5, 0, side - 1)
    low = np.minimum(at.astype(np.int64), side - 2)
    share = at - low
    total, weight = np.zeros((count, image.shape[2])), np.zeros(count)
    for x, y in ((0, 0), (1, 0), (0, 1), (1, 1)):
        column, row = (low + np.array([x, y])).T
        part = np.where((x, y), share, 1 - share).prod(axis=1) * seen[row, column]
        np.add.at(total, pairs[:, 0], part[:, None] * image[row, column])
        np.add.at(weight, pairs[:, 0], part)
    return total / np.maximum(weight, 1e-12)[:, None], weight > 0
