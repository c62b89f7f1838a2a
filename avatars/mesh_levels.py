"""Levels of an avatar's mesh as a file of its bundle, `mesh-levels.npz`.

Rule: the file names the body that its levels were made for, by a digest of what a body file holds and by measures of
what is computed from it. For any other body its bounds would be wrong, so it is refused. An avatar without this file
has one level, its whole mesh.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from trilane.body.body import ShapedBody
from trilane.body.mesh_levels import TURNS, MeshLevel
from trilane.errors import BadInputError
from trilane.files import read_npz

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
