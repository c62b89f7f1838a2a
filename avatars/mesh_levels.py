"""Levels of a body's mesh: fewer triangles between some of its vertices, and a bound on how far they move the surface.

A level keeps vertices where they are, so a level is a list of triangles. The bound is **how far a level moves the
surface**. Each texel shows on a point of the whole mesh and on a point of the level; the bound holds for the distance
between these two points, for every texel. Therefore it holds for the outline and for all details inside the outline.

Proof of the bound. A posed point of either mesh is a sum of b_v x_v over the corners v of its triangle. Here x_v =
sum_j w_vj G_j v, w_vj are the skinning weights, and G_j is the rigid motion of joint j. Let e_v be the level's b_v
minus the whole mesh's b_v. The e_v sum to 0, and d = sum e_v v is the distance at rest. For any joint k, G_j is G_k
followed by one turn for each joint on the way from k to j: a turn by an angle t_b about the centre c_b of a joint b.
Let y_b = sum e_v W_vb (v - c_b), with W_vb the sum of w_vj over b and the joints below b. The turn of b moves y_b;
where k is b or below b, it moves d - y_b. Therefore the distance is at most

    |d| + sum_b 2 sin(t_b / 2) |y_b or d - y_b|

for any k. Between the places where edges of the two meshes cross in the texture, both points are linear functions of
the texel. Therefore the distance is largest at one of two kinds of places: where edges cross, or at a vertex that lies
in a triangle of the level but is not its corner. The level leaves out such a vertex, or has a fold there.
`training/mesh_levels.py` evaluates the terms at these places, one row for each place. Pose blend shapes move a vertex
by at most r_v = sum_b r_vb |R_b - I|, which adds sum |e_v| r_v. Rows are joined in groups: a group has the largest
value of each term.

A bundle has its levels in `mesh-levels.npz`. Rule: this file identifies the body for which the levels were made. For
that, it has a digest of the body's stored arrays and samples of its computed arrays. For any other body the bounds
would be wrong, and the file is refused. An avatar without this file has one level, its whole mesh.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from trilane.arrays import F32, F64, I32
from trilane.body.body import ShapedBody
from trilane.body.joints import JOINTS, Posed
from trilane.errors import BadInputError
from trilane.files import read_npz

#: Error in metres that float32 may add, by the rounding of weights, of skinned vertices and of the stored terms.
ROUNDING_M = 5e-6
TURNS = JOINTS - 1
#: Approximate number of rows of terms that bound a level.
BOUND_ROWS = 2048


@dataclass(frozen=True)
class MeshLevel:
    """A level of a mesh: F triangles, and G rows with the terms of its bound (see the module's docstring).

    `faces`, `uv_faces`: (F,3) indices of vertices, and of texture coordinates, of the whole body.
    `rest`: (G,) distances |d| at rest, in metres.
    `swing`: (G,54) factors of 2 sin(t_b / 2) for each joint but the root, in metres.
    `blend`: (G,54) factors of |R_b - I| for each joint but the root, in metres.
    `uv_error`: largest distance between the seams of the level and of the whole mesh, in texture widths.
    """

    faces: I32
    uv_faces: I32
    rest: F32
    swing: F32
    blend: F32
    uv_error: float

    def metres(self, posed: Posed) -> float:
        """Return the bound, in metres, on how far the level moves any point of the surface in the pose `posed`."""
        turned = np.linalg.norm(posed.feature.reshape(TURNS, 9), axis=1)
        moved = self.rest + self.swing @ (turned / np.float32(np.sqrt(2.0)))
        if self.has_blend:
            moved = moved + self.blend @ turned
        return float(moved.max()) + ROUNDING_M

    @cached_property
    def has_blend(self) -> bool:
        """Whether the body has pose blend shapes that move a vertex."""
        return bool(self.blend.any())

    @cached_property
    def least_m(self) -> float:
        """The largest distance at rest, in metres; `metres` is never less, in any pose."""
        return float(self.rest.max())

    def reduced(self, shaped: ShapedBody) -> ShapedBody:
        """Return `shaped` with only the triangles of this level, and only the vertices that these triangles use."""
        used, corners = np.unique(self.faces, return_inverse=True)
        return shaped.part(used, corners.reshape(self.faces.shape).astype(np.int32), self.uv_faces)


def grouped(rest: F64, swing: F64, blend: F64) -> tuple[F32, F32, F32]:
    """Return fewer rows (`rest`, `swing`, `blend`) that bound the given rows in every pose.

    A row that cannot have the largest sum in any pose is left out. The rows are sorted by the joints of their two
    largest swings, and then by their largest sum. Groups of neighbours become one row with the largest value of each
    term. `rest` (P,), `swing` and `blend` (P,54): terms of P rows, as in `MeshLevel`.
    """
    most = rest + 2.0 * swing.sum(axis=1) + 2.0 * np.sqrt(2.0) * blend.sum(axis=1)
    matters = most >= rest.max()
    rest, swing, blend, most = rest[matters], swing[matters], blend[matters], most[matters]
    two = np.sort(np.argsort(-swing, axis=1, kind="stable")[:, :2], axis=1)
    key = two[:, 0] * TURNS + two[:, 1]
    order = np.lexsort((most, key))
    begins = np.diff(key[order], prepend=-1) != 0
    begins[:: max(len(rest) // BOUND_ROWS, 1)] = True
    starts = np.flatnonzero(begins)
    tops = [np.maximum.reduceat(rows[order], starts, axis=0) for rows in (rest, swing, blend)]
    # Rounded up, so that a float32 term is never smaller than its float64 value.
    up = [np.nextafter(rows.astype(np.float32), np.float32(np.inf)) for rows in tops]
    return up[0], up[1], up[2]


MESH_LEVELS = "mesh-levels.npz"
EXPECTED = "levels of a mesh (.npz)"
REMEDY = "`trilane avatar levels` makes them"
DIGEST, MEASURES = "digest", "measures"
#: Largest difference at which samples of computed arrays count as equal. Sums of products differ in their last digits
#: from processor to processor, and 10 micrometres do not matter to a bound of millimetres.
MOST_APART = 1e-5
#: Every `STEP`th vertex is among the samples.
STEP = 97
#: For each array of a level, the number of its columns (0: one-dimensional) and whether it holds indices.
COLUMNS = {
    "faces": (3, True),
    "uv_faces": (3, True),
    "rest": (0, False),
    "swing": (TURNS, False),
    "blend": (TURNS, False),
}
UV_ERROR = "uv_error"
#: Most levels that a file may have: a run uploads all of them.
MOST_LEVELS = 8
#: Most rows of an array: the largest number of triangles that a body may have.
MOST_ROWS = 1 << 19


def digest_of(shaped: ShapedBody) -> str:
    """Return the SHA-256, hexadecimal, of the body's stored arrays on which the levels of its mesh depend."""
    body = shaped.body
    digest = hashlib.sha256()
    arrays = (body.v_template, body.parents, body.faces, body.uv_faces, body.uv)
    for array in (*arrays, *(each for each in (body.posedirs, body.offsets) if each is not None)):
        digest.update(f"{array.dtype.str}{array.shape}".encode())
        digest.update(np.ascontiguousarray(array).data)
    return digest.hexdigest()


def measures_of(shaped: ShapedBody) -> NDArray[np.float64]:
    """Return numbers (N,) by which a file of mesh levels recognises its body, beside the digest.

    They are all joints, every STEP-th vertex, the mean skinning weights of each joint, and the weights of every STEP-th
    vertex.
    """
    weights = shaped.body.weights.astype(np.float64)
    parts = (shaped.joints, shaped.vertices[::STEP], weights.mean(axis=0), weights[::STEP])
    return np.concatenate([np.asarray(part, np.float64).ravel() for part in parts])


def levels_to_arrays(levels: Sequence[MeshLevel]) -> dict[str, NDArray[Any]]:
    """Return the arrays of L levels by name: `faces1`, `uv_faces1`, ... of the first level, and `uv_error` (L,)."""
    arrays = {f"{name}{k}": getattr(level, name) for k, level in enumerate(levels, 1) for name in COLUMNS}
    return {**arrays, UV_ERROR: np.array([level.uv_error for level in levels], np.float64)}


def levels_from_arrays(arrays: Mapping[str, NDArray[Any]]) -> tuple[MeshLevel, ...]:
    """Return the levels from `arrays`, a result of `levels_to_arrays`."""
    return tuple(
        MeshLevel(**{name: arrays[f"{name}{k}"] for name in COLUMNS}, uv_error=float(uv_error))
        for k, uv_error in enumerate(arrays[UV_ERROR], 1)
    )


def save_mesh_levels(file: Path | BinaryIO, shaped: ShapedBody, levels: Sequence[MeshLevel]) -> None:
    """Write `levels` of the mesh of `shaped` to an .npz file, with the digest and the measures of `shaped`."""
    digest = np.frombuffer(bytes.fromhex(digest_of(shaped)), np.uint8)
    own: dict[str, Any] = {DIGEST: digest, MEASURES: measures_of(shaped)}
    np.savez_compressed(file, allow_pickle=False, **levels_to_arrays(levels), **own)


def read_mesh_levels(path: Path, shaped: ShapedBody) -> tuple[MeshLevel, ...]:
    """Return the levels of the mesh in the file `path`, finest first. `shaped`: body to which they must belong.

    Raises BadInputError if the file is missing or damaged, is for another body, or has impossible numbers.
    """
    numbers = range(1, MOST_LEVELS + 1)
    arrays = read_npz(
        path, (DIGEST, MEASURES, UV_ERROR, *(f"{name}{k}" for k in numbers for name in COLUMNS)), EXPECTED
    )
    _check_body(path, arrays.get(DIGEST), arrays.get(MEASURES), shaped)
    errors = arrays.get(UV_ERROR)
    if errors is None or errors.ndim != 1 or not 1 <= len(errors) <= MOST_LEVELS or errors.dtype.kind != "f":
        raise BadInputError(f"{path}[{UV_ERROR}]", "no usable array", f"1 to {MOST_LEVELS} numbers", REMEDY)
    _check_numbers(path, UV_ERROR, errors)
    checked: dict[str, NDArray[Any]] = {UV_ERROR: errors}
    limits = {"faces": len(shaped.vertices), "uv_faces": len(shaped.body.uv)}
    for k in range(1, len(errors) + 1):
        rows: dict[str, int] = {}
        for name, (columns, is_index) in COLUMNS.items():
            key = f"{name}{k}"
            array = _checked(path, key, arrays.get(key), columns, is_index)
            kind = "triangles" if is_index else "terms"
            if rows.setdefault(kind, len(array)) != len(array):
                raise BadInputError(f"{path}[{key}]", f"{len(array)} rows", f"{rows[kind]}, as its level has", REMEDY)
            if is_index and (array.min() < 0 or array.max() >= limits[name]):
                raise BadInputError(f"{path}[{key}]", "an index out of range", f"0 to {limits[name] - 1}", REMEDY)
            checked[key] = array
    return levels_from_arrays(checked)


def _check_body(path: Path, digest: NDArray[Any] | None, measures: NDArray[Any] | None, shaped: ShapedBody) -> None:
    own = measures_of(shaped)
    is_alike = measures is not None and measures.dtype.kind == "f" and measures.shape == own.shape
    if is_alike and measures is not None:
        is_alike = bool(np.abs(measures - own).max(initial=0.0) <= MOST_APART)
    if not is_alike or digest is None or digest.dtype != np.uint8 or digest.tobytes().hex() != digest_of(shaped):
        raise BadInputError(path, "levels of another body", "levels of this avatar's body, shape and offsets", REMEDY)


def _checked(path: Path, key: str, array: NDArray[Any] | None, columns: int, is_index: bool) -> NDArray[Any]:
    shape = (columns,) if columns else ()
    if array is None or array.ndim != 1 + len(shape) or array.shape[1:] != shape or not 1 <= len(array) <= MOST_ROWS:
        found = "no array" if array is None else f"shape {array.shape}"
        raise BadInputError(f"{path}[{key}]", found, f"({', '.join(('rows', *map(str, shape)))})", REMEDY)
    if array.dtype.kind not in ("iu" if is_index else "f"):
        raise BadInputError(f"{path}[{key}]", f"dtype {array.dtype}", "indices" if is_index else "numbers", REMEDY)
    if not is_index:
        _check_numbers(path, key, array)
    return array.astype(np.int32 if is_index else np.float32)


def _check_numbers(path: Path, key: str, array: NDArray[Any]) -> None:
    if not (np.isfinite(array).all() and array.min() >= 0.0):
        raise BadInputError(f"{path}[{key}]", "negative numbers, NaN or infinity", "finite distances", REMEDY)
