"""Standing on the floor: how far a motion has to be lifted so that the body's own lowest point touches y = 0.

Rule: heights come from vertices of the body, not from joints. `sequence` lifts the whole motion by one amount, so
that jumps leave the floor; `frame` lifts every frame by its own, so that some point touches it always.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from trilane.arrays import F64
from trilane.body.body import ShapedBody
from trilane.body.joints import JOINT_INDEX
from trilane.body.kinematics import Skeleton
from trilane.scene.motion.motion import Motion

Ground = Literal["auto", "sequence", "frame", "none"]

LOOKS_PER_S, MAX_LOOKS = 30, 600
#: One frame in twenty may dip below the floor, so that one bad frame does not lift all others.
LOWEST_PERCENTILE = 5.0
#: Largest skin weights of a vertex that count here.
WEIGHTS = 4
#: Looked along for the outermost vertices of each joint: the axes and the diagonals of a cube.
_SIGNS = [(x, y, z) for x in (-1, 0, 1) for y in (-1, 0, 1) for z in (-1, 0, 1) if abs(x) + abs(y) + abs(z) in (1, 3)]
DIRECTIONS: F64 = np.array(_SIGNS, dtype=np.float64) / np.linalg.norm(_SIGNS, axis=1, keepdims=True)


@dataclass(frozen=True)
class Outline:
    """The outermost vertices of a body: `points` (K, 4) at rest with a 1 appended; `joints` and `weights` (K, W)."""

    points: F64
    joints: NDArray[np.intp]
    weights: F64

    def posed(self, matrices: NDArray[np.float32]) -> F64:
        """World positions (K, 3) under skinning matrices (55, 3, 4); pose blend shapes left out."""
        blend = np.einsum("kw,kwc->kc", self.weights, matrices.reshape(-1, 12)[self.joints])
        return np.asarray(np.einsum("kab,kb->ka", blend.reshape(-1, 3, 4), self.points))


def outline(body: ShapedBody) -> Outline:
    """For each joint, the vertices it moves most that lie furthest along each of DIRECTIONS."""
    weights, rest = body.body.weights, body.vertices.astype(np.float64)
    owner = weights.argmax(axis=1)
    picked: set[int] = set()
    for joint in np.unique(owner):
        own = np.flatnonzero(owner == joint)
        picked.update(own[(rest[own] @ DIRECTIONS.T).argmax(axis=0)].tolist())
    index = np.array(sorted(picked))
    points = np.concatenate([rest[index], np.ones((len(index), 1))], axis=1)
    top = np.argsort(-weights[index], axis=1)[:, :WEIGHTS]
    largest = np.take_along_axis(weights[index], top, axis=1).astype(np.float64)
    return Outline(points, top, largest / largest.sum(axis=1, keepdims=True))


def leg_length(joints: F64) -> float:
    """Hip to knee to ankle of rest joints (55, 3), metres, left side."""
    hip, knee, ankle = (joints[JOINT_INDEX[f"left_{name}"]] for name in ("hip", "knee", "ankle"))
    return float(np.linalg.norm(knee - hip) + np.linalg.norm(ankle - knee))


def ground_rule(motion: Motion, ground: Ground) -> Ground:
    """`auto` is `sequence` for a motion that says where the pelvis is, `frame` for one that does not."""
    if ground != "auto":
        return ground
    return "sequence" if motion.travels else "frame"


def _look_count(motion: Motion) -> int:
    dense = int(motion.duration_s * LOOKS_PER_S) + 1
    return min(max(len(motion.times_s), dense), MAX_LOOKS)


def lift(motion: Motion, skeleton: Skeleton, shape: Outline, shift: F64, scale: float, rule: Ground) -> tuple[F64, F64]:
    """Times (L,) and metres to add at them (L,), linear between; `shift` and `scale` as in `Mover`."""
    if rule == "none":
        return np.zeros(1), np.zeros(1)
    looks = np.linspace(0.0, motion.duration_s, _look_count(motion))
    lowest = np.empty(len(looks))
    for k, t_s in enumerate(looks):
        pose, pelvis = motion.sample(float(t_s))
        lowest[k] = shape.posed(skeleton.pose(pose, pelvis * scale + shift).matrices)[:, 1].min()
    if rule == "frame":
        return looks, -lowest
    return np.zeros(1), np.array([-np.percentile(lowest, LOWEST_PERCENTILE)])
