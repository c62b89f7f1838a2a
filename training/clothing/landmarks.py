"""Landmarks of a body at rest, by which garments and paint are placed: joints, eyes, ears, top and bottom.

Rule: everything is measured from the body's arrays (rest pose, metres); no coordinate is a constant.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from trilane.arrays import F64
from trilane.body.joints import JOINT_INDEX

PELVIS, NECK, HEAD = JOINT_INDEX["pelvis"], JOINT_INDEX["neck"], JOINT_INDEX["head"]
#: Of joints that both sides have, the left one.
HIP, KNEE, ANKLE, FOOT = (JOINT_INDEX[f"left_{name}"] for name in ("hip", "knee", "ankle", "foot"))
SHOULDER, ELBOW, WRIST = (JOINT_INDEX[f"left_{name}"] for name in ("shoulder", "elbow", "wrist"))
LEFT_EYE, RIGHT_EYE = JOINT_INDEX["left_eye"], JOINT_INDEX["right_eye"]
#: Ankle of each foot by its side: 1 is the left one (+X), -1 the right one.
ANKLES = {1: JOINT_INDEX["left_ankle"], -1: JOINT_INDEX["right_ankle"]}


@dataclass(frozen=True)
class Landmarks:
    """Positions in metres, rest pose.

    `joints` (55,3). `eye` (3,): centre of the left eyeball; `eye_radius`: its radius. `eyeball` (V,) bool: whether a
    vertex is of either eyeball. `ear` (3,): tip of the left ear. `crown`: greatest y. `sole`: least y.
    """

    joints: F64
    eye: F64
    eye_radius: float
    eyeball: NDArray[np.bool_]
    ear: F64
    crown: float
    sole: float


def find_landmarks(vertices: F64, joints: F64, weights: NDArray[np.floating[Any]]) -> Landmarks:
    """Landmarks of a body at rest. `vertices` (V,3), `joints` (55,3), `weights` (V,55)."""
    eyeball = weights[:, [LEFT_EYE, RIGHT_EYE]].sum(axis=1) > 0.5
    left = vertices[weights[:, LEFT_EYE] > 0.5]
    eye = 0.5 * (left.min(axis=0) + left.max(axis=0))
    head = vertices[(weights[:, HEAD] > 0.5) & (vertices[:, 1] < eye[1])]
    return Landmarks(
        joints=joints,
        eye=eye,
        eye_radius=float(np.ptp(left[:, 1]) / 2),
        eyeball=eyeball,
        ear=head[np.argmax(head[:, 0])],
        crown=float(vertices[:, 1].max()),
        sole=float(vertices[:, 1].min()),
    )
