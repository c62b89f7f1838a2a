"""The skeleton: the longest chain of joints, at hard angles and far from the origin.

Rule: the reference walks from joint to joint in extended precision, the code that is tested jumps by powers of two.

The bound. A local rotation is off by at most 3 b in norm, b as in rotations.py and U for adding I. A product of two
rows and columns rounds by gamma_4 of at most sqrt(3) * sqrt(3) (rotations) or sqrt(3) |place| + |place| (places). Over
d joints these add up: the place of the last joint is off by at most

    L sum (3 b + 12 U) + d gamma_4 (sqrt(3) + 1) (|root| + L)        L: length of the chain's bones, root: of the body.

Skinning matrices are float32: an entry is off by U32 of itself beside that.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from trilane.apps.experiments.hard_numbers.hard_number import HIGHAM, U32, HardNumber, U, gamma, worst
from trilane.apps.experiments.hard_numbers.rotations import turn_bound
from trilane.arrays import F64
from trilane.body.body import ShapedBody
from trilane.body.kinematics import Skeleton

MM = 1e3
Wide = NDArray[np.longdouble]
#: What is done with every joint of the chain -> the angle of each about the axis (1, 2, 3) / sqrt(14).
TURNS = {
    "all turned by 1e-7": 1e-7,
    "all turned by pi - 1e-7": np.pi - 1e-7,
    "all turned by pi": np.pi,
    "all turned by 100 pi + 1": 100 * np.pi + 1,
}
#: Metres of the root joint from the origin.
PLACES = {"at the origin": 0.0, "200 m away": 200.0, "10 km away": 1e4}
SEED = 23


def chain_cases(shaped: ShapedBody) -> Iterator[HardNumber]:
    """Rows of the longest chain, and of the matrices that the GPU gets."""
    skeleton = Skeleton(shaped.joints, shaped.body.parents)
    axis = np.array([1.0, 2.0, 3.0]) / np.sqrt(14.0)
    poses = {name: np.tile(axis * angle, (len(shaped.joints), 1)) for name, angle in TURNS.items()}
    poses["turned at random, up to 2 pi"] = random_pose(len(shaped.joints))
    for name, pose in poses.items():
        wanted = walked(shaped, pose, np.zeros(3))[:, :, 3]
        errors, bounds = np.abs(skeleton.pose(pose).joints - wanted).max(axis=1), joint_bounds(shaped, pose, 0.0)
        yield HardNumber(f"joints of the whole body {name}", *_in_mm(worst(errors, bounds)), "mm", HIGHAM)
    pose = poses["turned at random, up to 2 pi"]
    for name, metres in PLACES.items():
        root = metres * axis
        wanted = walked(shaped, pose, root)
        wanted[:, :, 3] -= np.einsum("jab,jb->ja", wanted[:, :, :3], shaped.joints)
        own = joint_bounds(shaped, pose, metres)[:, None]
        rest = np.linalg.norm(shaped.joints, axis=1)[:, None]
        bounds = own + _rotation_bounds(shaped, pose)[:, None] * rest + gamma(5) * (np.abs(wanted[:, :, 3]) + 2 * rest)
        bounds = bounds + U32 * (np.abs(wanted[:, :, 3]) + bounds)
        errors = np.abs(skeleton.pose(pose, root).matrices[:, :, 3] - wanted[:, :, 3])
        yield HardNumber(f"places of the skinning matrices, {name}", *_in_mm(worst(errors, bounds)), "mm", HIGHAM)


def walked(shaped: ShapedBody, pose: F64, root: F64) -> Wide:
    """World transforms (55, 3, 4) of the joints, one after the other from the root, in extended precision."""
    wide = np.longdouble
    found: Wide = np.zeros((len(shaped.joints), 3, 4), wide)
    for joint, parent in enumerate(shaped.body.parents):
        own = np.zeros((3, 4), wide)
        own[:, :3] = _wide_rotation(pose[joint].astype(wide))
        own[:, 3] = shaped.joints[joint].astype(wide) - (shaped.joints[parent].astype(wide) if parent >= 0 else 0)
        if parent < 0:
            own[:, 3] += root.astype(wide)
            found[joint] = own
        else:
            above = found[parent]
            found[joint, :, :3] = above[:, :3] @ own[:, :3]
            found[joint, :, 3] = above[:, :3] @ own[:, 3] + above[:, 3]
    return found


def joint_bounds(shaped: ShapedBody, pose: F64, root_m: float) -> F64:
    """How far each joint (55,) may be off, metres."""
    parents, joints = shaped.body.parents, shaped.joints
    length, depth = np.zeros(len(joints)), np.zeros(len(joints))
    for joint, parent in enumerate(parents):
        if parent >= 0:
            length[joint] = length[parent] + np.linalg.norm(joints[joint] - joints[parent])
            depth[joint] = depth[parent] + 1
    length += np.linalg.norm(joints[0])
    return np.asarray(
        length * _rotation_bounds(shaped, pose) + (depth + 2) * gamma(4) * (np.sqrt(3) + 1) * (root_m + length)
    )


def _rotation_bounds(shaped: ShapedBody, pose: F64) -> F64:
    """By how much each joint's world rotation (55,) may be off, in norm."""
    local = 3 * (turn_bound(np.linalg.norm(pose, axis=1)) + U) + 12 * U
    total = np.zeros(len(local))
    for joint, parent in enumerate(shaped.body.parents):
        total[joint] = local[joint] + (total[parent] if parent >= 0 else 0.0)
    return total


def _wide_rotation(v: Wide) -> Wide:
    """The matrix (3, 3) of an axis-angle vector, by 1 - cos = 2 sin^2, in the vector's precision."""
    angle = np.sqrt(v @ v)
    if angle == 0:
        return np.eye(3, dtype=v.dtype)
    cross = np.zeros((3, 3), v.dtype)
    cross[[2, 0, 1], [1, 2, 0]] = v
    cross[[1, 2, 0], [2, 0, 1]] = -v
    half = np.sin(angle / 2) / angle
    turned: Wide = np.eye(3, dtype=v.dtype) + np.sin(angle) / angle * cross + 2 * half * half * (cross @ cross)
    return turned


def random_pose(joints: int) -> F64:
    rng = np.random.default_rng(SEED)
    axis = rng.normal(size=(joints, 3))
    return np.asarray(axis / np.linalg.norm(axis, axis=1, keepdims=True) * rng.uniform(0, 2 * np.pi, (joints, 1)))


def _in_mm(found: tuple[float, float]) -> tuple[float, float]:
    return found[0] * MM, found[1] * MM
