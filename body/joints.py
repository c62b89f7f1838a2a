"""The 55 joints of the SMPL-X layout, and their kinematics: from an axis-angle pose to skinning matrices, in float64.

Rule: this file defines the joint numbers; other code looks up joints by name.

Rotations are exact at every angle. A rotation by the angle t = |v| about v has the quaternion w = cos(t/2), u = v
sin(t/2) / t. R - I is then 2 (u u^T - (u.u) I + w [u]x) (O. Rodrigues, 1840). No digits cancel in this form near 0 or
pi.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from trilane.arrays import F32, F64
from trilane.errors import BadInputError

JOINTS = 55
POSE_FEATURES = 486  # 54 joints x 9: (R - I) of every joint but the root
_FINGERS = ("index", "middle", "pinky", "ring", "thumb")

#: Joint names in SMPL-X order: body 0-21, jaw 22, eyes 23-24, left hand 25-39, right hand 40-54.
JOINT_NAMES: tuple[str, ...] = (
    "pelvis", "left_hip", "right_hip", "spine1", "left_knee", "right_knee", "spine2", "left_ankle", "right_ankle",
    "spine3", "left_foot", "right_foot", "neck", "left_collar", "right_collar", "head", "left_shoulder",
    "right_shoulder", "left_elbow", "right_elbow", "left_wrist", "right_wrist", "jaw", "left_eye", "right_eye",
    *(f"{side}_{finger}{part}" for side in ("left", "right") for finger in _FINGERS for part in (1, 2, 3)),
)  # fmt: skip


def _hand_parents(wrist: int, first: int) -> list[int]:
    return [wrist if part == 0 else first + 3 * finger + part - 1 for finger in range(5) for part in range(3)]


#: Index of each joint's parent; -1 for the root.
JOINT_PARENTS: tuple[int, ...] = (
    *(-1, 0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 9, 9, 12, 13, 14, 16, 17, 18, 19, 15, 15, 15),
    *_hand_parents(wrist=20, first=25),
    *_hand_parents(wrist=21, first=40),
)

#: Names of the joints without those of the face and the hands.
BODY_JOINTS: tuple[str, ...] = JOINT_NAMES[:22]

#: Index of each joint by name.
JOINT_INDEX: dict[str, int] = {name: i for i, name in enumerate(JOINT_NAMES)}

#: Length of a flat pose: three axis-angle numbers per joint.
POSE_SIZE = 3 * len(JOINT_NAMES)
LEFT_HAND = slice(3 * 25, 3 * 40)
RIGHT_HAND = slice(3 * 40, 3 * 55)


#: At this x and below, sin(x) / x is exactly 1 in float64. Smaller half angles are raised to this x, so an angle of 0
#: needs no special case.
_TINY = 1e-150
#: Largest Euclidean norm of a pose (radians) and of the root's transform (metres). Beyond it, too many digits are lost.
MAX_VALUE = 1e6


def _products_to_turn() -> F64:
    """Return the matrix (16, 9) that maps the flattened outer product q q^T to the flattened R - I, both row-major.

    q is the quaternion (w, ux, uy, uz) of the rotation R.
    """
    table = np.zeros((4, 4, 3, 3))
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        table[1 + i, 1 + i, [j, k], [j, k]] = -2.0
        table[1 + i, 1 + j, [i, j], [j, i]] = 2.0
        table[0, 1 + i, [k, j], [j, k]] = 2.0, -2.0
    return table.reshape(16, 9)


_TURN = _products_to_turn()
_IDENTITY = np.eye(3)


def turn(rotvec: ArrayLike) -> F64:
    """Return R - I (..., 3, 3) for axis-angle vectors (..., 3), radians, of any magnitude."""
    v = np.asarray(rotvec, np.float64)
    half = 0.5 * np.sqrt(np.einsum("...i,...i->...", v, v))
    floor = np.maximum(half, _TINY)
    quaternion = np.empty((*v.shape[:-1], 4))
    np.cos(half, out=quaternion[..., 0])
    np.multiply(v, (0.5 * np.sin(floor) / floor)[..., None], out=quaternion[..., 1:])
    products = quaternion[..., :, None] * quaternion[..., None, :]
    return np.asarray((products.reshape(*v.shape[:-1], 16) @ _TURN).reshape(*v.shape[:-1], 3, 3))


def rodrigues(rotvec: ArrayLike) -> F64:
    """Return rotation matrices (..., 3, 3) for axis-angle vectors (..., 3), radians, of any magnitude."""
    return turn(rotvec) + _IDENTITY


@dataclass(frozen=True)
class Posed:
    """A skeleton in one pose. The arrays are buffers of the skeleton: the next call of `Skeleton.pose` overwrites them.

    `matrices` (55,3,4) float32: skinning matrices; x_world = sum_k w_k (matrices_k @ [x_rest, 1]).
    `joints` (55,3) float64: positions in the world, metres.
    `feature` (486,) float32: R - I of joints 1 to 54, row-major, with R the rotation relative to the parent.
    """

    matrices: F32
    joints: F64
    feature: F32


class Skeleton:
    """The joint chain of one shaped body.

    World transforms come from pointer jumping: after k rounds, each joint holds the product of the 2^k transforms that
    end at that joint. A tree of depth 11 then takes four batched products instead of 55 steps.
    """

    def __init__(self, joints: F64, parents: NDArray[np.int32]) -> None:
        """Prepare the chain.

        `joints` (J,3): rest positions, metres.
        `parents` (J,): index of each joint's parent, -1 at the root, which is joint 0.
        """
        count = len(parents)
        self._rest = np.asarray(joints, np.float64)
        self._jumps = _ancestors(parents)
        self._offsets = self._rest - np.where(parents[:, None] < 0, 0.0, self._rest[parents])
        self._local = np.tile(np.eye(4), (count + 1, 1, 1))
        self._gathered = self._local.copy()
        self._products = (self._local.copy(), self._local.copy())
        self._world = self._products[(len(self._jumps) - 1) % 2] if self._jumps else self._local
        self._matrices = np.empty((count, 3, 4), np.float32)
        self._feature = np.empty((count - 1, 3, 3), np.float32)
        self._angles = np.empty((count, 3))
        self._posed = Posed(self._matrices, self._world[:-1, :3, 3], self._feature.reshape(-1))

    def pose(self, pose: ArrayLike, translation: ArrayLike | None = None, world: F64 | None = None) -> Posed:
        """Pose the chain, and return its buffers.

        `pose` (J * 3,): axis-angle, radians.
        `translation` (3,): translation of the root in body space, metres; None for no translation.
        `world` (4,4): transform from body space to the world; None for the identity.
        Raises BadInputError when the norm of `pose` or of the root's transform is not finite, or above MAX_VALUE.
        """
        self._angles.reshape(-1)[:] = np.asarray(pose, np.float64).reshape(-1)
        _require_finite(self._angles, "pose", "joint angles below 1e6 rad")
        turns = turn(self._angles)
        np.add(turns, _IDENTITY, out=self._local[:-1, :3, :3])
        self._local[:-1, :3, 3] = self._offsets
        self._feature[:] = turns[1:]
        if translation is not None:
            self._local[0, :3, 3] += np.asarray(translation, np.float64)
        if world is not None:
            self._local[0] = world @ self._local[0]
        _require_finite(self._local[0], "place of the body", "metres below 1e6")
        self._chain()
        return self._write()

    def _chain(self) -> None:
        previous = self._local
        for k, ancestors in enumerate(self._jumps):
            np.take(previous, ancestors, axis=0, out=self._gathered, mode="clip")
            previous = np.matmul(self._gathered, previous, out=self._products[k % 2])

    def _write(self) -> Posed:
        linear, place = self._world[:-1, :3, :3], self._world[:-1, :3, 3]
        self._matrices[:, :, :3] = linear
        self._matrices[:, :, 3] = place - np.einsum("jab,jb->ja", linear, self._rest)
        return self._posed


def _require_finite(values: F64, where: str, expected: str) -> None:
    flat = values.ravel()
    with np.errstate(over="ignore", invalid="ignore"):
        square = flat @ flat
    if not square <= MAX_VALUE**2:  # `not` includes NaN, which no comparison holds for
        raise BadInputError(where, "NaN, infinity or a huge number", expected)


def _ancestors(parents: NDArray[np.int32]) -> list[NDArray[np.intp]]:
    """Return an array (J + 1,) for each round k: the 2^k-th ancestor of each joint, by `parents` (J,).

    Index J stands for an identity transform above the root; it is its own ancestor.
    """
    count = len(parents)
    jump = np.append(np.where(parents < 0, count, parents), count).astype(np.intp)
    rounds = []
    while (jump < count).any():
        rounds.append(jump)
        jump = jump[jump]
    return rounds
