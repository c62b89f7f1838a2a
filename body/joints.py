"""The 55 joints of the SMPL-X layout: names and parents, in file order.

Rule: only this file knows joint numbers; all other code looks joints up by name.
"""

from __future__ import annotations

JOINTS = 55
POSE_FEATURES = 486  # 54 joints x 9: (R - I) of every joint but the root
_FINGERS = ("index", "middle", "pinky", "ring", "thumb")

#: Joint names in SMPL-X order: body 0-21, jaw 22, eyes 23-24, left hand 25-39, right hand 40-54.
JOINT_NAMES: tuple[str, ...] = (
    "pelvis",
    "left_hip",
    "right_hip",
    "spine1",
    "left_knee",
    "right_knee",
    "spine2",
    "left_ankle",
    "right_ankle",
    "spine3",
    "left_foot",
    "right_foot",
    "neck",
    "left_collar",
    "right_collar",
    "head",
    "left_shoulder",
    "right_shoulder",
    "left_elbow",
    "right_elbow",
    "left_wrist",
    "right_wrist",
    "jaw",
    "left_eye",
    "right_eye",
    *(f"{side}_{finger}{part}" for side in ("left", "right") for finger in _FINGERS for part in (1, 2, 3)),
)


def _hand_parents(wrist: int, first: int) -> list[int]:
    return [wrist if part == 0 else first + 3 * finger + part - 1 for finger in range(5) for part in range(3)]


#: Parent of each joint; -1 for the root.
JOINT_PARENTS: tuple[int, ...] = (
    *(-1, 0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 9, 9, 12, 13, 14, 16, 17, 18, 19, 15, 15, 15),
    *_hand_parents(wrist=20, first=25),
    *_hand_parents(wrist=21, first=40),
)

#: Joints without face and hands.
BODY_JOINTS: tuple[str, ...] = JOINT_NAMES[:22]

#: Index of each joint by name.
JOINT_INDEX: dict[str, int] = {name: i for i, name in enumerate(JOINT_NAMES)}

#: Length of a pose: axis-angle, three numbers a joint.
POSE_SIZE = 3 * len(JOINT_NAMES)
LEFT_HAND = slice(3 * 25, 3 * 40)
RIGHT_HAND = slice(3 * 40, 3 * 55)
