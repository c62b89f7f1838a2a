"""From the packet's matrices to what the shaders take.

Rule: targets hold row 0 of the image first, so y is turned round in the projection and nowhere else.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from trilane.arrays import Floats

FLIP_Y = np.diag([1.0, -1.0, 1.0, 1.0])


def target_clip(view: Floats, projection: Floats) -> bytes:
    """World to clip space of a target whose first row is the top one, as column-major float32 bytes of a `mat4`."""
    clip = FLIP_Y @ np.asarray(projection, np.float64) @ np.asarray(view, np.float64)
    return clip.T.astype(np.float32).tobytes()


def eye_of(view: Floats) -> NDArray[np.float64]:
    """Position (3,) of the camera in the world, for a `view` of rotation and translation."""
    rotation = np.asarray(view, np.float64)[:3, :3]
    return -rotation.T @ np.asarray(view, np.float64)[:3, 3]
