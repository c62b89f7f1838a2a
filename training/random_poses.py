"""Random natural poses, drawn from a table of attitudes (stand, walk, reach, ...) with ranges of joint angles.

Rule: a pose depends only on the random generator. No recorded or built-in motion is used, so those can be held out.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from trilane.arrays import F64
from trilane.body.joints import JOINT_INDEX, JOINT_NAMES
from trilane.scene.rotations import about, rotvec_from_matrix

JOINTS = len(JOINT_NAMES)

#: Standard deviation, in degrees about x, y, z, of the angles added to the joints of every pose. Fingers: `_curl_hand`.
JITTER_DEG = {
    "spine1": (5, 5, 3),
    "spine2": (4, 5, 3),
    "spine3": (4, 5, 3),
    "neck": (8, 12, 5),
    "head": (8, 16, 6),
    "left_collar": (3, 5, 6),
    "right_collar": (3, 5, 6),
    "left_shoulder": (18, 12, 10),
    "right_shoulder": (18, 12, 10),
    "left_elbow": (10, 10, 4),
    "right_elbow": (10, 10, 4),
    "left_wrist": (18, 14, 14),
    "right_wrist": (18, 14, 14),
    "left_hip": (7, 8, 6),
    "right_hip": (7, 8, 6),
    "left_knee": (6, 2, 2),
    "right_knee": (6, 2, 2),
    "left_ankle": (8, 5, 4),
    "right_ankle": (8, 5, 4),
    "left_foot": (6, 2, 2),
    "right_foot": (6, 2, 2),
    "left_eye": (3, 5, 0),
    "jaw": (0.5, 0, 0),
}
SIDES = {"left": 1.0, "right": -1.0}


def random_pose(rng: np.random.Generator) -> F64:
    """Return axis-angle rotations (55,3), radians, in SMPL-X joint order.

    The root only leans, because the cameras go around it.
    """
    pose = np.zeros((JOINTS, 3))
    ATTITUDES[_pick(rng, WEIGHTS)](pose, rng)
    for name, deviation in JITTER_DEG.items():
        pose[JOINT_INDEX[name]] += np.radians(deviation) * np.clip(rng.standard_normal(3), -2.0, 2.0)
    pose[JOINT_INDEX["right_eye"]] = pose[JOINT_INDEX["left_eye"]]
    pose[0] += np.radians((6, 0, 4)) * rng.standard_normal(3)
    for side in SIDES:
        _curl_hand(pose, side, rng)
        _keep_limits(pose, side)
    return pose


def _stand(pose: F64, rng: np.random.Generator) -> None:
    for side in SIDES:
        _arm(pose, side, rng.uniform(-88, -60), rng.uniform(-25, 25), rng.uniform(5, 35))
        _leg(pose, side, rng.uniform(-8, 4), rng.uniform(0, 12), rng.uniform(0, 12))


def _walk(pose: F64, rng: np.random.Generator) -> None:
    phase, stride = rng.uniform(0, 2 * np.pi), rng.uniform(12, 42)
    for side, sign in SIDES.items():
        swing = sign * np.sin(phase)
        lift = max(0.0, np.cos(phase) * sign)
        _leg(pose, side, -stride * swing - 12 * lift, 8 + 55 * lift * rng.uniform(0.5, 1.2), rng.uniform(-3, 6))
        _arm(pose, side, rng.uniform(-86, -66), 0.9 * stride * swing, rng.uniform(10, 60))
    pose[JOINT_INDEX["spine2"], 1] += np.radians(0.2 * stride * np.sin(phase))


def _reach(pose: F64, rng: np.random.Generator) -> None:
    _stand(pose, rng)
    for side in SIDES:
        if rng.random() < 0.6:
            _arm(pose, side, rng.uniform(-60, 55), rng.uniform(-55, 35), rng.uniform(0, 125), rng.uniform(-110, 40))


def _overhead(pose: F64, rng: np.random.Generator) -> None:
    spread, up, bend = rng.uniform(0, 38), rng.uniform(-30, 78), rng.uniform(0, 50)
    for side in SIDES:
        _arm(pose, side, up + rng.uniform(-8, 8), rng.uniform(-25, 25), bend)
        _leg(pose, side, rng.uniform(-15, 5), rng.uniform(0, 35), spread)
        pose[JOINT_INDEX[f"{side}_collar"], 2] += SIDES[side] * np.radians(0.25 * max(up, 0.0))


def _sit(pose: F64, rng: np.random.Generator) -> None:
    fold = rng.uniform(25, 95)
    for side in SIDES:
        _leg(pose, side, -fold + rng.uniform(-10, 10), fold * rng.uniform(0.8, 1.15), rng.uniform(0, 18))
        _arm(pose, side, rng.uniform(-85, -40), rng.uniform(-60, 10), rng.uniform(10, 100))
    pose[JOINT_INDEX["spine1"], 0] += np.radians(rng.uniform(0, 25))


def _free(pose: F64, rng: np.random.Generator) -> None:
    for side in SIDES:
        _arm(pose, side, rng.uniform(-85, 70), rng.uniform(-60, 45), rng.uniform(0, 130), rng.uniform(-90, 60))
        _leg(pose, side, rng.uniform(-80, 25), rng.uniform(0, 90), rng.uniform(-5, 40))
    pose[JOINT_INDEX["spine1"]] += np.radians((10, 10, 6)) * rng.standard_normal(3)


def _rest(pose: F64, rng: np.random.Generator) -> None:
    pose[JOINT_INDEX["head"], 1] += np.radians(rng.uniform(-20, 20))


ATTITUDES: dict[str, Callable[[F64, np.random.Generator], None]] = {
    "stand": _stand,
    "walk": _walk,
    "reach": _reach,
    "overhead": _overhead,
    "sit": _sit,
    "free": _free,
    "rest": _rest,
}
WEIGHTS = {"stand": 0.20, "walk": 0.26, "reach": 0.20, "overhead": 0.15, "sit": 0.07, "free": 0.09, "rest": 0.03}


def _arm(pose: F64, side: str, raised: float, swung: float, bent: float, twisted: float = 0.0) -> None:
    """Set one arm of `pose`, in degrees from the T pose.

    `raised` 90 is overhead, -90 hanging; `swung` > 0 is backwards; `bent` is the elbow's angle; `twisted` < 0 turns the
    forearm upwards.
    """
    sign = SIDES[side]
    hanging, level = max(0.0, -np.sin(np.radians(raised))), np.cos(np.radians(raised))
    turn = about(0, np.radians(swung * hanging)) @ about(1, np.radians(sign * swung * level))
    turn = turn @ about(2, np.radians(sign * raised)) @ about(0, np.radians(twisted))
    pose[JOINT_INDEX[f"{side}_shoulder"]] = rotvec_from_matrix(turn)
    pose[JOINT_INDEX[f"{side}_elbow"]] = np.radians((0.0, -sign * bent, 0.0))


def _leg(pose: F64, side: str, flexed: float, bent: float, spread: float) -> None:
    """Set one leg of `pose`, in degrees from standing.

    `flexed` < 0 lifts the thigh forwards, `bent` is the knee's angle, `spread` moves the leg to the side.
    """
    sign = SIDES[side]
    turn = about(2, np.radians(sign * spread)) @ about(0, np.radians(flexed))
    pose[JOINT_INDEX[f"{side}_hip"]] = rotvec_from_matrix(turn)
    pose[JOINT_INDEX[f"{side}_knee"]] = np.radians((bent, 0.0, 0.0))
    pose[JOINT_INDEX[f"{side}_ankle"]] = np.radians((-0.35 * (flexed + bent), 0.0, -0.6 * sign * spread))


def _curl_hand(pose: F64, side: str, rng: np.random.Generator) -> None:
    sign, grip, spread = SIDES[side], rng.uniform(-5, 75) * rng.random(), rng.uniform(-3, 8)
    for finger, outwards in (("index", 1.0), ("middle", 0.2), ("ring", -0.5), ("pinky", -1.0)):
        for part in (1, 2, 3):
            curl = grip * rng.uniform(0.6, 1.2) + 6.0
            turn = (0.0, -sign * spread * outwards * (part == 1), -sign * curl)
            pose[JOINT_INDEX[f"{side}_{finger}{part}"]] = np.radians(turn)
    for part in (1, 2, 3):
        pose[JOINT_INDEX[f"{side}_thumb{part}"]] = np.radians((6.0, -sign * 8.0, 0.0)) * rng.standard_normal()


def _keep_limits(pose: F64, side: str) -> None:
    knee, elbow = JOINT_INDEX[f"{side}_knee"], JOINT_INDEX[f"{side}_elbow"]
    pose[knee, 0] = np.clip(pose[knee, 0], 0.0, np.radians(135))
    bend = -SIDES[side] * pose[elbow, 1]
    pose[elbow, 1] = -SIDES[side] * np.clip(bend, 0.0, np.radians(140))


def _pick(rng: np.random.Generator, weights: dict[str, float]) -> str:
    names = list(weights)
    share = np.array([weights[name] for name in names])
    return names[int(rng.choice(len(names), p=share / share.sum()))]
