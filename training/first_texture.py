"""The texture with which training begins: three channels of mean colours, and smooth fields in the other channels.

Rule: the texture depends only on the body and the training samples.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import scipy.sparse as sparse
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation
from scipy.sparse.linalg import eigsh, splu
from scipy.spatial import cKDTree

from trilane.arrays import F32, F64, Ints, Mask
from trilane.training.dataset import U16, ShapeGroup
from trilane.training.surface import BodyArrays

COLOURS = 3
OPAQUE = 250
#: Most samples of one tensor shape that are read, and least number of pixels of a sample that is read: a pixel of a
#: smaller sample spans too many texels.
MOST_SAMPLES = 250
LEAST_PIXELS = 200 * 200
#: A pixel whose UV changes by more than this crosses a UV seam.
LARGEST_SPAN = 0.03
LEAST_WEIGHT = 1e-4
#: `LEAST_AREA`: a face is left out if twice its area, in texels, is smaller. `BEYOND`: a face covers all texels whose
#: barycentric weights are at least -`BEYOND`, so also some beside it.
LEAST_AREA, BEYOND = 1e-9, 0.25
#: Number of texels whose barycentric weights are computed at once, in about 20 MB.
TEXELS_AT_ONCE = 1 << 18


def first_texture(body: BodyArrays, groups: list[ShapeGroup], side: int, channels: int) -> F32:
    """Return the first texture (side, side, channels) in -1..1: three colour channels, then smooth fields.

    The fields are eigenfunctions of the body's Laplacian.

    `body`: body at rest.
    `groups`: training samples, by tensor shape.
    `side`: side of the texture in texels.
    `channels`: number of channels of the texture, more than three.
    """
    fields = eigenfunctions(body.vertices, body.faces, channels - COLOURS)
    image, known = lay_out(fields, body.faces, body.uv, body.uv_faces, side)
    smooth = fill_gaps(image, known)
    colours = mean_colours(groups, side, body)
    return np.asarray(np.clip(np.concatenate([2 * colours - 1, smooth], axis=2), -1, 1), np.float32)


def mean_colours(groups: list[ShapeGroup], side: int, body: BodyArrays) -> NDArray[np.float64]:
    """Return the weighted mean colour (side, side, 3) in 0..1 of the pixels that show each texel.

    A texel that no pixel shows may lie between the pixels of every view. It takes the mean colour of its neighbours
    that are shown. If none is shown, the texel is filled along the surface of `body`.

    Clothes stand off the body, so a texel shows a different point of the clothes in every view. The mean is still
    sharp, because close views and views along the surface's normal have the largest weights (`head_on`).

    `groups`: training samples, by tensor shape. `side`: side of the texture in texels.
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
    """Return the weight (h,w) of each pixel of a UV image, 0 to 1: 1 where the surface is close and seen head-on.

    Let s >= t be the singular values of the derivative of UV by pixel. The weight is (t / s)³. If a pixel spans more
    than a texel, the weight is multiplied by (1 / (side s))². Pixels at seams and outlines have no derivative, and the
    weight 0.

    `uv`: UV image (h,w,2). `covered`: (h,w), whether a pixel shows the body. `side`: side of the texture in texels.
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
    """Return which texels (side, side) a bilinear sample on the body can read, grown by `margin` texels."""
    _, known = lay_out(np.zeros((len(body.vertices), 1)), body.faces, body.uv, body.uv_faces, side)
    return np.asarray(binary_dilation(known, iterations=margin)) if margin else known


# Smooth fields on the body's surface. Most channels of the neural texture begin with them.
#
# Rule: neighbouring points of the body have similar values, also across UV seams.


def eigenfunctions(vertices: F64, faces: Ints, count: int) -> F64:
    """Return the `count` smoothest non-constant eigenfunctions (V,count) of the cotangent Laplacian, each in -1..1.

    A vertex outside the mesh's largest connected part, such as an eyeball or a garment, takes the values of the nearest
    vertex of this part. Source: Pinkall and Polthier, Computing discrete minimal surfaces and their conjugates, 1993.

    `vertices`: (V,3), at rest. `faces`: (F,3) indices of vertices.
    """
    laplacian, mass = cotangent_laplacian(vertices, faces)
    _, label = sparse.csgraph.connected_components(laplacian, directed=False)
    part = np.flatnonzero(label == np.bincount(label).argmax())
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
    """Return (sparse cotangent Laplacian (V,V) of a mesh, area (V,) that belongs to each vertex).

    `vertices`: (V,3). `faces`: (F,3) indices of vertices.
    """
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


# Lays values of a mesh's vertices out as an image in texture space.
#
# Rule: a texel on a face is interpolated from the face's corners. `fill_gaps` and `fill_beside` fill all other texels.


def lay_out(values: F64, faces: Ints, uv: F64, uv_faces: Ints, side: int) -> tuple[F64, NDArray[np.bool_]]:
    """Return (image (side,side,C) of the vertices' values, which texels (side,side) are on a face).

    Texels that are on no face are 0.

    `values`: values of the vertices, (V,C).
    `faces`: indices of `values`, (F,3).
    `uv`: texture coordinates, (T,2).
    `uv_faces`: indices of `uv`, (F,3), for each corner of a face.
    `side`: side of the image in texels.
    """
    image = np.zeros((side, side, values.shape[1]))
    covered = np.zeros((side, side), bool)
    corners = uv[uv_faces] * side - 0.5
    low = np.maximum(np.floor(corners.min(axis=1)).astype(np.int64), 0)
    high = np.minimum(np.ceil(corners.max(axis=1)).astype(np.int64) + 1, side)
    width, height = np.maximum(high - low, 0).T
    (bx, by), (cx, cy) = (corners[:, 1] - corners[:, 0]).T, (corners[:, 2] - corners[:, 0]).T
    around = np.where(np.abs(bx * cy - cx * by) < LEAST_AREA, 0, width * height)
    parts = np.flatnonzero(np.diff(np.cumsum(around) // TEXELS_AT_ONCE)) + 1
    for part in np.split(np.arange(len(faces)), parts):
        face = np.repeat(part, around[part])
        place = np.arange(len(face)) - np.repeat(np.cumsum(around[part]) - around[part], around[part])
        x, y = low[face, 0] + place % width[face], low[face, 1] + place // width[face]
        weights = _barycentric(corners[part], around[part], x, y)
        inside = np.logical_and.reduce([weight >= -BEYOND for weight in weights])
        corner_values = values[faces[face[inside]]]
        # If faces share a texel, the last face wins: NumPy keeps the last value of repeated indices.
        image[y[inside], x[inside]] = sum(w[inside, None] * corner_values[:, k] for k, w in enumerate(weights))
        covered[y[inside], x[inside]] = True
    return image, covered


def fill_gaps(image: NDArray[Any], known: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Return `image` (S,S,C) with unknown texels filled (push-pull).

    Such a texel gets the mean of the known texels in its smallest block (2x2, 4x4, ...) that has any.

    `known`: (S,S), whether a texel is known.
    """
    weight = known.astype(np.float64)[..., None]
    return _pulled(image * weight, weight)


def fill_beside(image: NDArray[Any], known: NDArray[np.bool_]) -> tuple[F64, NDArray[np.bool_]]:
    """Return (`image` (S,S,C) with the neighbours of known texels filled, which texels (S,S) are known or filled).

    A filled texel gets the mean of the known texels among its eight neighbours.

    `known`: (S,S), whether a texel is known.
    """
    total = np.sum(_round_each(image * known[..., None]), axis=0)
    count = np.sum(_round_each(known.astype(np.float64)[..., None]), axis=0)
    near = np.asarray(count[..., 0] > 0)
    return np.where((near & ~known)[..., None], total / np.maximum(count, 1), image), near


def grown(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return `mask` (S,S) grown by one texel in all eight directions."""
    return np.asarray(np.any(_round_each(mask[..., None]), axis=0)[..., 0])


def _round_each(image: NDArray[Any]) -> list[NDArray[Any]]:
    """Return nine images: `image` (S,S,C), and `image` moved by one texel in each of the eight directions.

    Texels that come from beyond the edge are 0.
    """
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


def _barycentric(corners: F64, counts: Ints, x: Ints, y: Ints) -> tuple[F64, F64, F64]:
    """Return the three barycentric weights, (N,) each, of the points `x`, `y` (N,) in their faces.

    `corners` (F,3,2): corners of each face. `counts` (F,): number of successive points of each face.
    """
    (bx, by), (cx, cy) = (corners[:, 1] - corners[:, 0]).T, (corners[:, 2] - corners[:, 0]).T
    area = np.where(counts > 0, bx * cy - cx * by, 1.0)
    px, py = x - np.repeat(corners[:, 0, 0], counts), y - np.repeat(corners[:, 0, 1], counts)
    b = px * np.repeat(cy / area, counts) - py * np.repeat(cx / area, counts)
    c = py * np.repeat(bx / area, counts) - px * np.repeat(by / area, counts)
    return 1 - b - c, b, c


# Fills unknown places of a surface from known places along the surface, and therefore across its UV seams.
#
# Rule: filled values are harmonic: each is a weighted mean of the neighbours' values on the mesh, so it lies within the
# range of the known values. Known values do not change.


def harmonic_fill(values: F64, known: Mask, vertices: F64, faces: Ints) -> F64:
    """Return `values` (V,C) with unknown vertices filled by Laplace's equation on the mesh.

    The known values are the boundary condition; the operator is the cotangent Laplacian (Pinkall and Polthier 1993). In
    a connected part without a known vertex, each vertex takes the values of the known vertex nearest in space. If no
    vertex is known, nothing changes.

    `known`: (V,), whether a vertex's values are known. `vertices` (V,3), `faces` (F,3): the mesh.
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
    """Return `image` (S,S,C) with unseen texels filled from the body's seen texels.

    Texels on a face are filled along the body's surface. Texels on no face, which only bilinear samples at seams use,
    are filled from the texels around them.

    `unseen`: (S,S), whether a texel is to be filled.
    """
    side = len(image)
    values, known = _at_vertices(np.asarray(image, np.float64), ~unseen, body)
    laid, covered = lay_out(
        harmonic_fill(values, known, body.vertices, body.faces), body.faces, body.uv, body.uv_faces, side
    )
    filled = np.where((unseen & covered)[..., None], laid, image)
    return np.where((unseen & ~covered)[..., None], fill_gaps(filled, ~unseen | covered), filled)


def _at_vertices(image: F64, seen: Mask, body: BodyArrays) -> tuple[F64, Mask]:
    """Return (values (V,C) of `image` at the body's vertices, which vertices (V,) have a value).

    Values are bilinear samples of the texels `seen` (S,S) only. A vertex on a seam has several places in the texture,
    and gets the mean of their values.
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
