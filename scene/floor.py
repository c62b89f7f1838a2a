"""Puts a motion on the floor: how far it is lifted so that the body's lowest point touches y = 0.

Rule: `sequence` lifts the whole motion by one amount, so that jumps leave the floor; `frame` lifts each frame by its
own amount, so that some point always touches the floor; `stance`, for a recording that tells when its feet stand, lifts
each frame so that feet that stand are on the floor, and the others as much as those do on average.
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
Rule = Literal["sequence", "frame", "stance", "none"]

#: Times per second of a motion at which the lowest point is computed.
SAMPLES_PER_S = 30
#: How many there are at most: with `stance` those of 200 s, beyond which feet are less exactly on the floor.
MAX_SAMPLES: dict[Rule, int] = {"sequence": 600, "frame": 600, "stance": 6000}
#: With `sequence` 5 % of the frames may dip below the floor, so that one bad frame does not lift all others.
LOWEST_PERCENTILE = 5.0
#: With `stance` no point of the body is further below the floor, metres: hands and knees may be of another length.
DEEPEST_M = 0.03


def leg_length(joints: F64) -> float:
    """Length of the left leg, hip to knee to ankle, of rest joints (55, 3); metres."""
    hip, knee, ankle = (joints[JOINT_INDEX[f"left_{name}"]] for name in ("hip", "knee", "ankle"))
    return float(np.linalg.norm(knee - hip) + np.linalg.norm(ankle - knee))


def ground_rule(motion: Motion, ground: Ground) -> Rule:
    """`ground`, or for `auto`: what `motion` allows.

    That is `stance` when it tells when its feet stand, `sequence` when it has a recorded place of the pelvis, else
    `frame`.
    """
    if ground != "auto":
        return ground
    if not motion.travels:
        return "frame"
    return "sequence" if motion.stance is None else "stance"


def _sample_count(motion: Motion, rule: Rule) -> int:
    dense = int(motion.duration_s * SAMPLES_PER_S) + 1
    return min(max(len(motion.times_s), dense), MAX_SAMPLES[rule])


def floor_lift(
    motion: Motion, skeleton: Skeleton, shape: Outline, shift: F64, scale: float, rule: Rule, soles: Outline
) -> tuple[F64, F64]:
    """Times (L,) in seconds, and metres (L,) by which the body is lifted at them; linear between.

    `motion`: that is put on the floor.
    `skeleton`: of the body that does it.
    `shape`: outline of that body.
    `shift`: as in `Mover`.
    `scale`: as in `Mover`.
    `rule`: of `ground_rule`.
    `soles`: outline of the body's feet.
    """
    if rule == "none":
        return np.zeros(1), np.zeros(1)
    times_s = np.linspace(0.0, motion.duration_s, _sample_count(motion, rule))
    poses, pelvises = motion.sample_all(times_s)
    rows = [
        skeleton.pose(pose, pelvis * scale + shift).matrices[:, 1].copy()
        for pose, pelvis in zip(poses, pelvises, strict=True)
    ]
    heights = np.stack(rows)
    lowest = shape.lowest(heights)
    if rule == "frame":
        return times_s, -lowest
    if rule == "stance" and motion.stance is not None:
        stance = np.interp(times_s, motion.times_s, motion.stance)
        return times_s, _lift_of_feet(soles.lowest(heights), lowest, stance)
    return np.zeros(1), np.array([-np.percentile(lowest, LOWEST_PERCENTILE)])


def _lift_of_feet(feet: F64, lowest: F64, stance: F64) -> F64:
    """Metres (L,) of lift, of the lowest points of the feet (L,) and of the whole body (L,), and the stance (L,)."""
    usual = -float(np.average(feet, weights=stance)) if stance.any() else -np.percentile(lowest, LOWEST_PERCENTILE)
    lift = usual + stance * (-feet - usual)
    return np.maximum(lift, -lowest - DEEPEST_M)
