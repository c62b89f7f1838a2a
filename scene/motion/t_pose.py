"""The joints of a plain body in the T pose, for motions that are looked at without an avatar.

Rule: the rest joints of the default avatar, to the millimetre; an avatar in a scene brings its own.
"""

from __future__ import annotations

import numpy as np

from trilane.arrays import F64
from trilane.body.joints import JOINT_NAMES

#: Millimetres, the pelvis at the origin; right joints are the left ones, mirrored.
_PLACES_MM = {
    "pelvis": (0, 0, 0), "left_hip": (117, -8, -10), "spine1": (0, 87, -35), "left_knee": (131, -416, 24),
    "spine2": (0, 239, -29), "left_ankle": (131, -859, -1), "spine3": (0, 368, -47), "left_foot": (143, -908, 146),
    "neck": (0, 569, 3), "left_collar": (23, 493, 16), "head": (0, 670, 39), "left_shoulder": (185, 488, 12),
    "left_elbow": (457, 488, 12), "left_wrist": (712, 488, 12), "jaw": (0, 677, 53), "left_eye": (30, 711, 121),
    "left_index1": (825, 483, 40), "left_index2": (853, 483, 44), "left_index3": (878, 483, 47),
    "left_middle1": (824, 488, 12), "left_middle2": (861, 488, 6), "left_middle3": (890, 488, 4),
    "left_pinky1": (807, 483, -30), "left_pinky2": (828, 483, -40), "left_pinky3": (844, 483, -46),
    "left_ring1": (818, 488, -10), "left_ring2": (849, 488, -20), "left_ring3": (875, 488, -26),
    "left_thumb1": (753, 484, 38), "left_thumb2": (766, 461, 59), "left_thumb3": (793, 442, 80),
}  # fmt: skip


def _joints() -> F64:
    """(55, 3), metres."""
    rows = [
        np.multiply(_PLACES_MM[name.replace("right_", "left_")], (-1 if name.startswith("right_") else 1, 1, 1))
        for name in JOINT_NAMES
    ]
    return np.array(rows, dtype=np.float64) / 1000


#: Rest joints (55, 3), metres.
T_POSE = _joints()
