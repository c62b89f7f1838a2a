"""Reads the pose blend shapes of a body file as a stream.

Rule: an array of zeros (80 MB in many files) takes no memory: it is allocated at the first number that is not zero.
"""

from __future__ import annotations

import math
import zipfile
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from trilane.errors import BadInputError
from trilane.files import DAMAGED, read_header

KEY = "posedirs"
MAX_BYTES = 1 << 30
_CHUNK_ITEMS = 1 << 18


def read_pose_blend(path: Path, shape: tuple[int, int, int]) -> NDArray[np.float32] | None:
    """The array `posedirs` of the npz at `path`, float32 of `shape`, read-only; None when it is all zero.

    Raises BadInputError when it is missing, misshapen, pickled, too large, truncated or not finite.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            if f"{KEY}.npy" not in archive.namelist():
                raise BadInputError(path, f"no array {KEY!r}", "a body file in the SMPL-X layout (.npz)")
            with archive.open(f"{KEY}.npy") as file:
                return _read(f"{path}[{KEY}]", file, shape)
    except DAMAGED as error:
        raise BadInputError(path, f"no readable .npz archive ({error})", "a body file (.npz)") from error


def _read(where: str, file: IO[bytes], shape: tuple[int, int, int]) -> NDArray[np.float32] | None:
    dtype, order = _check_header(where, file, shape)
    count = math.prod(shape)
    flat: NDArray[np.float32] | None = None
    for start in range(0, count, _CHUNK_ITEMS):
        items = min(_CHUNK_ITEMS, count - start)
        data = file.read(items * dtype.itemsize)
        if len(data) < items * dtype.itemsize:
            raise BadInputError(where, "truncated data", f"{count * dtype.itemsize} bytes by its own header")
        chunk = np.frombuffer(data, dtype)
        if not chunk.any():
            continue
        if flat is None:
            flat = np.zeros(count, np.float32)
        with np.errstate(over="ignore"):
            flat[start : start + items] = chunk
        if not np.isfinite(flat[start : start + items]).all():
            raise BadInputError(where, "NaN or infinity", "finite numbers")
    if flat is None:
        return None
    array = np.ascontiguousarray(flat.reshape(shape, order=order))
    array.flags.writeable = False
    return array


def _check_header(where: str, file: IO[bytes], shape: tuple[int, int, int]) -> tuple[np.dtype[Any], Any]:
    stored_shape, fortran, dtype = read_header(where, file)
    if dtype.kind not in "fiu":
        raise BadInputError(where, f"dtype {dtype}", "numbers")
    if stored_shape != shape:
        raise BadInputError(where, f"shape {stored_shape}", str(shape))
    if math.prod(shape) * dtype.itemsize > MAX_BYTES:
        raise BadInputError(where, f"shape {stored_shape} of {dtype}", f"at most {MAX_BYTES} bytes")
    return dtype, "F" if fortran else "C"
