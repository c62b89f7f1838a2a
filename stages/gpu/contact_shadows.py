"""Contact shadows: the soft dark discs that a body casts on the floor under its joints.

Rule: one table of discs; each disc grows and fades with the height of its joint above the floor.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from trilane.arrays import F64
from trilane.body.joints import JOINT_INDEX

# joint, radius on the floor in metres, strength there, height in metres over which it fades to 1/e
DISCS = (
    ("left_ankle", 0.15, 0.65, 0.18),
    ("right_ankle", 0.15, 0.65, 0.18),
    ("left_foot", 0.16, 0.70, 0.15),
    ("right_foot", 0.16, 0.70, 0.15),
    ("left_knee", 0.22, 0.45, 0.30),
    ("right_knee", 0.22, 0.45, 0.30),
    ("pelvis", 0.50, 0.60, 1.20),
    ("spine3", 0.45, 0.45, 0.60),
    ("head", 0.30, 0.45, 0.30),
    ("left_wrist", 0.16, 0.45, 0.15),
    ("right_wrist", 0.16, 0.45, 0.15),
)
WIDENING = 0.35  # metres of radius gained for each metre of height
FAINTEST = 0.02

_JOINT = np.array([JOINT_INDEX[name] for name, *_ in DISCS])
_RADIUS, _STRENGTH, _FADE = np.array([numbers for _, *numbers in DISCS]).T


def floor_discs(joints: NDArray[np.floating[Any]], rest: F64) -> NDArray[np.float32]:
    """Discs (N,4) float32: x, z, radius, strength, for skinning matrices (55,3,4) and rest joints (55,3)."""
    matrices = np.asarray(joints, np.float64)[_JOINT]
    place = np.einsum("nij,nj->ni", matrices[..., :3], rest[_JOINT]) + matrices[..., 3]
    height = np.maximum(place[:, 1], 0.0)
    strength = _STRENGTH * np.exp(-height / _FADE)
    discs = np.column_stack([place[:, 0], place[:, 2], _RADIUS + WIDENING * height, strength])
    return np.asarray(discs[strength > FAINTEST], np.float32)
