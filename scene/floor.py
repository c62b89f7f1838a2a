"""Puts a motion on the floor: how far it is lifted so that the body's lowest point touches y = 0.

Rule: `sequence` lifts the whole motion by one amount, so that jumps leave the floor; `frame` lifts each frame by its
own amount, so that some point always touches the floor.
"""

from __future__ import annotations

from typing import Literal

import numpy as np

from trilane.arrays import F64
from trilane.body.joints import JOINT_INDEX
from trilane.body.kinematics import Skeleton
from trilane.scene.body_outline import Outline
from trilane.scene.motion.motion import Motion

Ground = Literal["auto", "sequence", "frame", "none"]

#: Times per second of a motion at which the lowest point is computed, and how many there are at most.
SAMPLES_PER_S, MAX_SAMPLES = 30, 600
#: With `sequence` 5 % of the frames may dip below the floor, so that one bad frame does not lift all others.
LOWEST_PERCENTILE = 5.0


def leg_length(joints: F64) -> float:
    """Length of the left leg, hip to knee to ankle, of rest joints (55, 3); metres."""
    hip, knee, ankle = (joints[JOINT_INDEX[f"left_{name}"]] for name in ("hip", "knee", "ankle"))
    return float(np.linalg.norm(knee - hip) + np.linalg.norm(ankle - knee))


def ground_rule(motion: Motion, ground: Ground) -> Ground:
    """`ground`, or for `auto`: `sequence` for a motion with a recorded place of the pelvis, `frame` for any other."""
    if ground != "auto":
        return ground
    return "sequence" if motion.travels else "frame"


def _sample_count(motion: Motion) -> int:
    dense = int(motion.duration_s * SAMPLES_PER_S) + 1
    return min(max(len(motion.times_s), dense), MAX_SAMPLES)


def floor_lift(
    motion: Motion, skeleton: Skeleton, shape: Outline, shift: F64, scale: float, rule: Ground
) -> tuple[F64, F64]:
    """Times (L,) in seconds, and metres (L,) by which the body is lifted at them; linear between.

    `motion`: that is put on the floor.
    `skeleton`: of the body that does it.
    `shape`: outline of that body.
    `shift`: as in `Mover`.
    `scale`: as in `Mover`.
    `rule`: any but `auto`.
    """
    if rule == "none":
        return np.zeros(1), np.zeros(1)
    times_s = np.linspace(0.0, motion.duration_s, _sample_count(motion))
    poses, pelvises = motion.sample_all(times_s)
    rows = [
        skeleton.pose(pose, pelvis * scale + shift).matrices[:, 1].copy()
        for pose, pelvis in zip(poses, pelvises, strict=True)
    ]
    lowest = shape.lowest(np.stack(rows))
    if rule == "frame":
        return times_s, -lowest
    return np.zeros(1), np.array([-np.percentile(lowest, LOWEST_PERCENTILE)])
