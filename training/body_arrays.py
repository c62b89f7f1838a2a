"""The arrays of a body at rest that its clothes and its first texture are made from.

Rule: float64 and int64, so that the geometry is computed without rounding to float32.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from trilane.arrays import F64
from trilane.body.body import ShapedBody


@dataclass(frozen=True)
class BodyArrays:
    """`vertices` (V,3) metres at rest, `faces` (F,3), `uv` (T,2), `uv_faces` (F,3), `weights` (V,55).

    `joints` (55,3) at rest.
    """

    vertices: F64
    faces: NDArray[np.int64]
    uv: F64
    uv_faces: NDArray[np.int64]
    weights: F64
    joints: F64


def body_arrays(shaped: ShapedBody) -> BodyArrays:
    """The arrays of a body that clothes are made from."""
    body = shaped.body
    return BodyArrays(
        vertices=shaped.vertices.astype(np.float64),
        faces=body.faces.astype(np.int64),
        uv=body.uv.astype(np.float64),
        uv_faces=body.uv_faces.astype(np.int64),
        weights=body.weights.astype(np.float64),
        joints=shaped.joints,
    )
