"""Turns a mesh whose arms hang at 45 degrees into the T pose, with its shape components and joints.

Rule: the rotations are computed once, from the template. With fixed rotations linear blend skinning is linear in the
vertices and joints, so the same map is applied to template and offsets, and the result is exact for every shape.

T pose: upper arm and forearm along +X (left) or -X (right), palms down with the thumb in front, fingers in the plane of
the palm. Legs: thighs 2 degrees apart from the vertical seen from the front, shins upright, feet as they were.
"""

from __future__ import annotations

import numpy as np

from trilane.arrays import F64
from trilane.body.joints import JOINT_INDEX, JOINT_PARENTS

_UP = np.array([0.0, 1.0, 0.0])
_FRONT = np.array([0.0, 0.0, 1.0])
_FINGER_TIPS = ("thumb", "index", "middle", "ring", "pinky")
#: Share of the hand's turn about the forearm that the forearm makes, and of the upper arm's lift that the collar makes.
_FOREARM_TWIST = 0.5
_COLLAR_LIFT = 0.15
_THIGH_SPREAD = np.radians(2.0)


def bake(points: F64, weights: F64, tips: F64) -> F64:
    """`points` (1 + K, V + 55, 3) in the T pose: row 0 is the template, the others are offsets. Metres.

    `weights` (V, 55). `tips` (10, 3): finger ends of the template, thumb to pinky, left then right.
    """
    vertex_count = len(weights)
    rotations = rest_rotations(points[0, vertex_count:], tips)
    vertices, joints = points[:, :vertex_count], points[:, vertex_count:]
    moved = np.empty_like(joints)
    for j, parent in enumerate(JOINT_PARENTS):
        if parent < 0:
            moved[:, j] = joints[:, j]
        else:
            moved[:, j] = moved[:, parent] + (joints[:, j] - joints[:, parent]) @ rotations[parent].T
    shift = moved - np.einsum("jab,kjb->kja", rotations, joints)
    turned = np.einsum("vab,kvb->kva", np.einsum("vj,jab->vab", weights, rotations), vertices)
    return np.concatenate([turned + np.einsum("vj,kja->kva", weights, shift), moved], axis=1)


def rest_rotations(joints: F64, tips: F64) -> F64:
    """(55, 3, 3) world rotation of each joint that takes the rest pose of `joints` (55, 3) to the T pose."""
    rotations = np.tile(np.eye(3), (len(JOINT_PARENTS), 1, 1))
    for side, out, side_tips in (("left", 1.0, tips[:5]), ("right", -1.0, tips[5:])):
        ends = dict(zip(_FINGER_TIPS, side_tips, strict=True))
        _pose_arm(rotations, joints, side, np.array([out, 0.0, 0.0]), ends)
        _pose_leg(rotations, joints, side, out * _THIGH_SPREAD)
    return rotations


def _pose_leg(rotations: F64, joints: F64, side: str, spread: float) -> None:
    hip, knee, ankle = (joints[JOINT_INDEX[f"{side}_{name}"]] for name in ("hip", "knee", "ankle"))
    for name, bone, wanted in (("hip", knee - hip, spread), ("knee", ankle - knee, 0.0)):
        rotations[JOINT_INDEX[f"{side}_{name}"]] = about(_FRONT, wanted - float(np.arctan2(bone[0], -bone[1])))


def _pose_arm(rotations: F64, joints: F64, side: str, out: F64, ends: dict[str, F64]) -> None:
    def at(name: str) -> F64:
        return np.asarray(joints[JOINT_INDEX[f"{side}_{name}"]])

    upper = align(at("elbow") - at("shoulder"), out)
    hand = _hand_rotation(at, out)
    fore = align(at("wrist") - at("elbow"), out)
    fore = about(out, _FOREARM_TWIST * _twist(hand @ fore.T, out)) @ fore
    chosen = {"collar": power(upper, _COLLAR_LIFT), "shoulder": upper, "elbow": fore, "wrist": hand}
    for finger, tip in ends.items():
        chain = [at(f"{finger}{part}") for part in (1, 2, 3)] + [tip]
        chosen |= {f"{finger}{i + 1}": _flat(hand, chain[i + 1] - chain[i], finger) for i in range(3)}
    for name, rotation in chosen.items():
        rotations[JOINT_INDEX[f"{side}_{name}"]] = rotation


def _hand_rotation(at: object, out: F64) -> F64:
    assert callable(at)
    along = at("middle1") - at("wrist")
    across = at("index1") - at("pinky1")
    return frame(out, _FRONT) @ frame(along, across).T


def _flat(hand: F64, segment: F64, finger: str) -> F64:
    """The hand's rotation, then the smallest rotation that turns a finger's segment into the horizontal plane."""
    turned = hand @ segment
    return hand if finger == "thumb" else align(turned, turned - _UP * (turned @ _UP)) @ hand


def frame(first: F64, second: F64) -> F64:
    """Rotation with unit columns: `first`, the part of `second` at right angles to it, and their cross product."""
    x = first / np.linalg.norm(first)
    y = second - x * (second @ x)
    y /= np.linalg.norm(y)
    return np.stack([x, y, np.cross(x, y)], axis=1)


def align(a: F64, b: F64) -> F64:
    """Smallest rotation (3, 3) that turns direction `a` to direction `b`."""
    axis = np.cross(a, b)
    return about(axis, float(np.arctan2(np.linalg.norm(axis), a @ b)))


def about(axis: F64, angle: float) -> F64:
    """Rotation (3, 3) by `angle` radians about `axis`; the identity when the axis is zero."""
    length = np.linalg.norm(axis)
    if length == 0.0:
        return np.eye(3)
    x, y, z = axis / length
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.asarray(np.eye(3) + np.sin(angle) * cross + (1.0 - np.cos(angle)) * cross @ cross)


def power(rotation: F64, share: float) -> F64:
    """The rotation about the axis of `rotation` by `share` of its angle, which is less than half a turn."""
    axis = np.array([rotation[2, 1] - rotation[1, 2], rotation[0, 2] - rotation[2, 0], rotation[1, 0] - rotation[0, 1]])
    return about(axis, share * float(np.arctan2(np.linalg.norm(axis), np.trace(rotation) - 1.0)))


def _twist(rotation: F64, axis: F64) -> float:
    """Angle, radians, by which `rotation` turns about the unit `axis`: the twist of its swing-twist decomposition."""
    vector = np.array(
        [rotation[2, 1] - rotation[1, 2], rotation[0, 2] - rotation[2, 0], rotation[1, 0] - rotation[0, 1]]
    )
    return 2.0 * float(np.arctan2(vector @ axis, np.trace(rotation) + 1.0))
