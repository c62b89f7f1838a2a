"""Offsets of a body's vertices, from the skin to what is drawn, as a file of a bundle.

Rule: as many as the body has vertices, finite, and none longer than clothes and hair are; kept in float16, which is
exact to 16 micrometres at 5 cm.
"""

from __future__ import annotations

from pathlib import Path
from typing import BinaryIO

import numpy as np

from trilane.arrays import F32
from trilane.errors import BadInputError
from trilane.files import read_npz

KEY = "offsets"
EXPECTED = "offsets of a body's vertices at rest (.npz)"
#: Metres; what stands farther off is no part of a body's surface.
LONGEST_M = 0.5


def as_kept(offsets: F32) -> F32:
    """`offsets` (V,3) as a file keeps them."""
    return offsets.astype(np.float16).astype(np.float32)


def save_offsets(file: Path | BinaryIO, offsets: F32) -> None:
    """Write `offsets` (V,3), metres."""
    np.savez_compressed(file, offsets=offsets.astype(np.float16))


def read_offsets(path: Path, vertices: int) -> F32:
    """(V,3) metres, of a body of so many `vertices`. Raises BadInputError."""
    array = read_npz(path, (KEY,), EXPECTED).get(KEY)
    if array is None:
        raise BadInputError(path, f"no array {KEY!r}", EXPECTED)
    where = f"{path}[{KEY}]"
    if array.shape != (vertices, 3) or array.dtype.kind != "f":
        raise BadInputError(
            where, f"{array.dtype} of shape {array.shape}", f"floating-point numbers of shape ({vertices}, 3)"
        )
    with np.errstate(over="ignore"):
        offsets: F32 = array.astype(np.float32)
        lengths = np.linalg.norm(offsets, axis=1)
    if not (lengths <= LONGEST_M).all():  # NaN and infinity are not
        raise BadInputError(where, "offsets that are not finite or too long", f"at most {LONGEST_M} m")
    offsets.flags.writeable = False
    return offsets
