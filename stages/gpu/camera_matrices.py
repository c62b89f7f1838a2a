"""The camera's matrices in the form that the shaders take.

Rule: a target's first row in memory is the top row of the image, so y is flipped here in the projection, and only here.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from trilane.arrays import Floats

FLIP_Y = np.diag([1.0, -1.0, 1.0, 1.0])


def target_clip(view: Floats, projection: Floats) -> bytes:
    """The matrix `clip_from_world` of a target whose first row is the top one: column-major float32 bytes of a `mat4`.

    `view`, `projection` (4,4), OpenGL.
    """
    clip = FLIP_Y @ np.asarray(projection, np.float64) @ np.asarray(view, np.float64)
    return clip.T.astype(np.float32).tobytes()


def eye_of(view: Floats) -> NDArray[np.float64]:
    """Position (3,) of the camera in the world, metres; `view` (4,4) is a rotation and a translation."""
    rotation = np.asarray(view, np.float64)[:3, :3]
    return -rotation.T @ np.asarray(view, np.float64)[:3, 3]
