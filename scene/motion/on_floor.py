"""Whether a recorded body is on the floor of its file along an axis: so one who lies is told from one who stands.

Rule: files that have a floor have it at 0. A body is on it along an axis when its lowest joint hardly leaves it; which
axis that may be is decided by `recorded.py`.
"""

from __future__ import annotations

import numpy as np

from trilane.arrays import F64
from trilane.body.joints import JOINT_INDEX, JOINT_PARENTS
from trilane.scene.motion.t_pose import T_POSE
from trilane.scene.rotations import matrix_from_rotvec

#: The joints of the body; hands and face follow them.
BODY = 22
#: So many frames, evenly spread, tell it.
MOST_FRAMES = 200
#: Height of the lowest joint of one who lies or stands on the hands: from, to, and how far it goes up and down between
#: a tenth and nine tenths of the frames. Joints of one who lies are up to half a trunk's depth above the floor.
LIES_M, LIES_SPREAD_M = (-0.02, 0.17), 0.08
#: The same of one who walks; toes are 2 to 5 cm above the floor, and floors of recordings are off by centimetres.
STANDS_M, STANDS_SPREAD_M = (-0.12, 0.25), 0.25


def joint_places(poses: F64, places: F64, leg_m: float | None) -> F64:
    """Places (T, 22, 3) of the joints of a plain body whose legs are `leg_m` long; its own when that is None.

    `poses` (T, 55, 3): axis-angle. `places` (T, 3): of the pelvis, metres.
    """
    ours = float(np.linalg.norm(T_POSE[JOINT_INDEX["left_hip"]] - T_POSE[JOINT_INDEX["left_knee"]]))
    ours += float(np.linalg.norm(T_POSE[JOINT_INDEX["left_knee"]] - T_POSE[JOINT_INDEX["left_ankle"]]))
    rest = T_POSE * (leg_m / ours if leg_m else 1.0)
    turns = matrix_from_rotvec(poses[:, :BODY])
    found = np.repeat(places[:, None], BODY, axis=1)
    for joint, parent in enumerate(JOINT_PARENTS[1:BODY], 1):
        found[:, joint] = found[:, parent] + turns[:, parent] @ (rest[joint] - rest[parent])
        turns[:, joint] = turns[:, parent] @ turns[:, joint]
    return found


def lowest(poses: F64, places: F64, leg_m: float | None, up: F64) -> F64:
    """Heights (n,) along `up` (3,) of the lowest joint in at most MOST_FRAMES of the frames; the rest as above."""
    some = np.linspace(0, len(poses) - 1, min(len(poses), MOST_FRAMES)).round().astype(int)
    return np.asarray((joint_places(poses[some], places[some], leg_m) @ up).min(axis=1))


def lies(heights: F64) -> bool:
    """Whether `heights` (n,) of the lowest joint are those of one who lies, or stands on the hands, on the floor."""
    return _are_within(heights, LIES_M, LIES_SPREAD_M)


def stands(heights: F64) -> bool:
    """Whether they are those of one who stands or walks on the floor."""
    return _are_within(heights, STANDS_M, STANDS_SPREAD_M)


def _are_within(heights: F64, within: tuple[float, float], spread: float) -> bool:
    low, middle, high = np.quantile(heights, (0.1, 0.5, 0.9))
    return bool(within[0] <= middle <= within[1] and high - low <= spread)
