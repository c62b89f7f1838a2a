"""A camera that somebody turns about what it looks at. Rule: pure; without a turn the view keeps its every bit.

The turn is one of the world: about the vertical through the pivot, then about the level axis that runs to the camera's
right. The camera stays upright, above the floor and off the pole; where the scene's own camera is beyond that, it is
not turned further out. Coming nearer is a move along the line to the pivot, the lens stays the same.
"""

from __future__ import annotations

import numpy as np

from trilane.arrays import F64
from trilane.scene.rotations import about

LOWEST_DEG, HIGHEST_DEG = -8.0, 85.0
LEAST_LEVEL_M = 1e-6  # of the camera's distance from the pivot, level; below it stands over the pivot


def steered(view: F64, pivot: F64, azimuth_deg: float, elevation_deg: float, zoom: float) -> F64:
    """World to camera (4, 4) of the camera of `view` (4, 4), turned about `pivot` (3,) and moved towards it.

    `azimuth_deg`: to the right about the vertical. `elevation_deg`: upwards. `zoom`: how many times nearer, above 0.
    """
    if azimuth_deg == 0.0 and elevation_deg == 0.0 and zoom == 1.0:
        return view
    eye = -view[:3, :3].T @ view[:3, 3]
    turn = _turn(eye - pivot, azimuth_deg, elevation_deg)
    world = np.eye(4)
    world[:3, :3] = turn.T
    world[:3, 3] = pivot - turn.T @ pivot
    moved: F64 = view @ world
    seen = moved[:3, :3] @ pivot + moved[:3, 3]
    moved[:3, 3] += (1.0 / zoom - 1.0) * seen
    return moved


def _turn(arm: F64, azimuth_deg: float, elevation_deg: float) -> F64:
    """The turn (3, 3) of a camera at `arm` (3,) from the pivot."""
    level = float(np.hypot(arm[0], arm[2]))
    if level < LEAST_LEVEL_M:
        return about(1, np.radians(azimuth_deg))
    heading = np.arctan2(arm[0], arm[2])
    now_deg = float(np.degrees(np.arctan2(arm[1], level)))
    low, high = min(LOWEST_DEG, now_deg), max(HIGHEST_DEG, now_deg)
    raised = np.radians(np.clip(now_deg + elevation_deg, low, high) - now_deg)
    return about(1, heading + np.radians(azimuth_deg)) @ about(0, -raised) @ about(1, -heading)
