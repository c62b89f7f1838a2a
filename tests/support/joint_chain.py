"""Places of joints by a chain of their own, to compare motions by: a joint at a time, from the pelvis outwards.

Rule: nothing of `body/joints.py` or `scene/motion/retarget.py` is used, so that they can be held against this.
"""

from __future__ import annotations

import numpy as np

from trilane.arrays import F64
from trilane.body.joints import JOINT_NAMES, JOINT_PARENTS
from trilane.scene.rotations import matrix_from_rotvec

BODY_JOINTS = 22
LIMBS = tuple(
    (f"{side}_{start}", f"{side}_{end}")
    for side in ("left", "right")
    for start, end in (("hip", "knee"), ("knee", "ankle"), ("ankle", "foot"), ("shoulder", "elbow"), ("elbow", "wrist"))
)


def chained_places(poses: F64, pelvis: F64, rest: F64) -> F64:
    """Places (T, 22, 3) of the body's joints for `poses` (T, 55, 3), axis-angle, and places (T, 3) of the pelvis.

    `rest` (55, 3): the joints at rest.
    """
    places = np.zeros((len(poses), BODY_JOINTS, 3))
    turns = np.zeros((len(poses), BODY_JOINTS, 3, 3))
    places[:, 0], turns[:, 0] = pelvis, matrix_from_rotvec(poses[:, 0])
    for joint in range(1, BODY_JOINTS):
        above = JOINT_PARENTS[joint]
        places[:, joint] = places[:, above] + turns[:, above] @ (rest[joint] - rest[above])
        turns[:, joint] = turns[:, above] @ matrix_from_rotvec(poses[:, joint])
    return places


def limb_directions(places: F64) -> dict[str, F64]:
    """End of each limb's part -> its direction (T, 3), unit length, from places (T, 22, 3)."""
    at = {name: places[:, index] for index, name in enumerate(JOINT_NAMES[:BODY_JOINTS])}
    bones = {end: at[end] - at[start] for start, end in LIMBS}
    bones["trunk"] = at["neck"] - at["pelvis"]
    return {name: bone / np.linalg.norm(bone, axis=-1, keepdims=True) for name, bone in bones.items()}


def degrees_between(a: F64, b: F64) -> F64:
    """Angles (T,) between unit vectors (T, 3)."""
    return np.asarray(np.degrees(np.arccos(np.clip((a * b).sum(axis=-1), -1, 1))))
