"""Levels of a body's mesh: fewer triangles between some of its vertices, and how far each level moves the surface.

A level keeps vertices as they are, so it is a list of triangles. **Where it moves the surface to** is said texel by
texel: the point of the whole mesh that shows a texel, and the point of the level that shows the same one. So the bound
holds for the outline and for what is painted inside of it.

Proof of the bound. A posed point of either mesh is a sum of b_v x_v over the corners of its triangle, with x_v = sum_j
w_vj G_j v and G_j the rigid motion of joint j. Let e_v be the level's b_v minus the whole mesh's; the e_v sum to 0, and
d = sum e_v v is the distance at rest. Seen from a joint k, G_j is G_k and the steps along the bones between the two.
Each step is a turn by an angle t_b about the centre c_b of a joint b. Let y_b = sum e_v W_vb (v - c_b), with W_vb the
sum of w_vj over b and the joints below it. The step of b moves y_b, or d - y_b where k is b or below it. So the
distance is at most

    |d| + sum_b 2 sin(t_b / 2) |y_b or d - y_b|

for any k. Between the places where the edges of the two meshes cross, both points are linear in the texel. So the
distance is largest where edges cross, or at a vertex that the level leaves out. `training/mesh_levels.py` evaluates the
terms there. Pose blend shapes move a vertex by at most r_v = sum_b r_vb |R_b - I|, which adds sum |e_v| r_v. Rows of
terms are taken in groups, with the largest of each term in the group.

A bundle has its levels in `mesh-levels.npz`. Rule: that file names the body that its levels were made for, by a digest
of what a body file holds and by measures of what is computed from it. For any other body its bounds would be wrong, so
it is refused. An avatar without this file has one level, its whole mesh.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
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

#: Error that float32 may add, metres: the rounding of weights, of skinned vertices and of the stored terms.
ROUNDING_M = 5e-6
TURNS = JOINTS - 1
#: About so many rows of terms bound a level.
BOUND_ROWS = 2048


@dataclass(frozen=True)
class MeshLevel:
    """A level of a mesh.

    `faces`, `uv_faces` (F,3): triangles, as indices of the whole body's vertices and texture coordinates.
    `rest` (G,), `swing` (G,54), `blend` (G,54): terms of the bound, metres: |d|, the factors of 2 sin(t_b / 2), and
    those of |R_b - I|.
    `uv_error`: distance between the texels at the seams of the level and of the whole mesh, in sides of the texture.
    """

    faces: I32
    uv_faces: I32
    rest: F32
    swing: F32
    blend: F32
    uv_error: float

    def metres(self, posed: Posed) -> float:
        """Return the furthest, in metres, that the level moves a point of the surface in a frame of `Skeleton.pose`."""
        turned = np.linalg.norm(posed.feature.reshape(TURNS, 9), axis=1)
        moved = self.rest + self.swing @ (turned / np.float32(np.sqrt(2.0)))
        if self.has_blend:
            moved = moved + self.blend @ turned
        return float(moved.max()) + ROUNDING_M

    @cached_property
    def has_blend(self) -> bool:
        """Whether pose blend shapes move any vertex."""
        return bool(self.blend.any())

    @cached_property
    def least_m(self) -> float:
        """Least that `metres` returns in any pose: the largest move at rest."""
        return float(self.rest.max())

    def reduced(self, shaped: ShapedBody) -> ShapedBody:
        """Return `shaped` with the triangles of this level and only the vertices that they use, in the same order."""
        used, corners = np.unique(self.faces, return_inverse=True)
        body = shaped.body
        smaller = replace(
            body,
            v_template=body.v_template[used],
            shape_dirs=body.shape_dirs[used],
            expression_dirs=body.expression_dirs[used],
            j_regressor=body.j_regressor[:, used],
            weights=body.weights[used],
            faces=corners.reshape(self.faces.shape).astype(np.int32),
            uv_faces=self.uv_faces,
            posedirs=None if body.posedirs is None else body.posedirs[used],
            offsets=None if body.offsets is None else body.offsets[used],
        )
        return ShapedBody(shaped.vertices[used], shaped.joints, smaller)


def grouped(rest: F64, swing: F64, blend: F64) -> tuple[F32, F32, F32]:
    """Return fewer rows of terms (G,), (G,54), (G,54) that bound all of `rest` (P,), `swing` (P,54), `blend` (P,54).

    Rows that are never the largest, however far the joints turn, are left out. The others are sorted by their two
    largest swings and by their size, and neighbours become one row with the largest of each term.
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
    # Rounded up, so that a term in float32 is never smaller than it was.
    up = [np.nextafter(rows.astype(np.float32), np.float32(np.inf)) for rows in tops]
    return up[0], up[1], up[2]


MESH_LEVELS = "mesh-levels.npz"
EXPECTED = "levels of a mesh (.npz)"
REMEDY = "`trilane avatar levels` makes them"
DIGEST, MEASURES = "digest", "measures"
#: Largest difference of a measure. Sums of products differ in their last digits from processor to processor; places
#: 10 micrometres apart are the same to a bound of millimetres.
MOST_APART = 1e-5
#: One vertex in so many is a measure.
STEP = 97
#: For each array of a level, its columns (0 for one number a row) and whether it holds indices.
COLUMNS = {
    "faces": (3, True),
    "uv_faces": (3, True),
    "rest": (0, False),
    "swing": (TURNS, False),
    "blend": (TURNS, False),
}
UV_ERROR = "uv_error"
#: Most levels that a file may have; a run makes each of them ready to be drawn.
MOST_LEVELS = 8
#: Most rows of an array, the most triangles that a body may have.
MOST_ROWS = 1 << 19


def digest_of(shaped: ShapedBody) -> str:
    """Return the SHA-256, hexadecimal, of what levels of the mesh of `shaped` depend on and a file holds as it is."""
    body = shaped.body
    digest = hashlib.sha256()
    arrays = (body.v_template, body.parents, body.faces, body.uv_faces, body.uv)
    for array in (*arrays, *(each for each in (body.posedirs, body.offsets) if each is not None)):
        digest.update(f"{array.dtype.str}{array.shape}".encode())
        digest.update(np.ascontiguousarray(array).data)
    return digest.hexdigest()


def measures_of(shaped: ShapedBody) -> NDArray[np.float64]:
    """Return numbers (N,) float64 of what is computed from a body file: the person's shape, and the joints' weights."""
    weights = shaped.body.weights.astype(np.float64)
    parts = (shaped.joints, shaped.vertices[::STEP], weights.mean(axis=0), weights[::STEP])
    return np.concatenate([np.asarray(part, np.float64).ravel() for part in parts])


def levels_to_arrays(levels: Sequence[MeshLevel]) -> dict[str, NDArray[Any]]:
    """Return the arrays of `levels`: `faces1`, `uv_faces1`, ... of the first, and `uv_error` (L,) of all."""
    arrays = {f"{name}{k}": getattr(level, name) for k, level in enumerate(levels, 1) for name in COLUMNS}
    return {**arrays, UV_ERROR: np.array([level.uv_error for level in levels], np.float64)}


def levels_from_arrays(arrays: Mapping[str, NDArray[Any]]) -> tuple[MeshLevel, ...]:
    """Return the levels in `arrays`, as `levels_to_arrays` made them."""
    return tuple(
        MeshLevel(**{name: arrays[f"{name}{k}"] for name in COLUMNS}, uv_error=float(uv_error))
        for k, uv_error in enumerate(arrays[UV_ERROR], 1)
    )


def save_mesh_levels(file: Path | BinaryIO, shaped: ShapedBody, levels: Sequence[MeshLevel]) -> None:
    """Write `levels` of the mesh of `shaped`."""
    digest = np.frombuffer(bytes.fromhex(digest_of(shaped)), np.uint8)
    own: dict[str, Any] = {DIGEST: digest, MEASURES: measures_of(shaped)}
    np.savez_compressed(file, allow_pickle=False, **levels_to_arrays(levels), **own)


def read_mesh_levels(path: Path, shaped: ShapedBody) -> tuple[MeshLevel, ...]:
    """Read the levels of the mesh of `shaped`, finest first.

    Raises BadInputError when the file is missing, damaged, of another body, or has numbers that no level has.
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
