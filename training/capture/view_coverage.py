"""From which sides a capture shows the person: the direction of the camera in the body's own axes.

Rule: directions are those of the root joint; +Z is the way that the body faces, +X its left.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from trilane.arrays import F64
from trilane.body.kinematics import rodrigues

#: Degrees about the body at which the camera sees each side: 0 from the front, 90 from the body's left.
SIDES = {"front": 0.0, "left": 90.0, "back": 180.0, "right": -90.0}
#: Width of an entry of the table of directions.
STEP_DEG = 30


def camera_direction(pose: F64, root: F64, view: F64) -> tuple[float, float]:
    """Degrees: yaw (0 front, 90 left, in -180..180) and height above the horizon of the camera, as the body has them.

    `pose` (55,3). `root` (3,): place of the posed root joint. `view` (4,4): from the world of both to the camera.
    """
    eye = np.linalg.inv(view)[:3, 3]
    x, y, z = rodrigues(pose[0]).T @ (eye - root)
    return float(np.degrees(np.arctan2(x, z))), float(np.degrees(np.arctan2(y, np.hypot(x, z))))


def side_of(yaw_deg: float) -> str:
    """The side that a camera at `yaw_deg` sees most of."""
    return min(SIDES, key=lambda side: abs((yaw_deg - SIDES[side] + 180) % 360 - 180))


def frames_by_side(yaws_deg: Sequence[float]) -> dict[str, int]:
    """Number of frames that show each side."""
    sides = [side_of(yaw) for yaw in yaws_deg]
    return {side: sides.count(side) for side in SIDES}


def widest_gap_deg(yaws_deg: Sequence[float]) -> float:
    """The widest turn about the body, degrees, from which no frame was taken; 360 of one frame."""
    turns = np.sort(np.asarray(yaws_deg) % 360)
    return float(np.diff(turns, append=turns[0] + 360).max())
