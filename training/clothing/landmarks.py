"""Where things are on a body at rest: the measures that garments and paint are placed by.

Rule: everything is measured from the body's arrays (rest pose, metres); no coordinate is written down.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from trilane.arrays import F64

PELVIS, HIP, KNEE, ANKLE, FOOT, NECK, HEAD, SHOULDER, ELBOW, WRIST = 0, 1, 4, 7, 10, 12, 15, 16, 18, 20
LEFT_EYE, RIGHT_EYE = 23, 24
LEG = {1: (7, 10), -1: (8, 11)}  # ankle and toe joint of the left (+X) and right foot


@dataclass(frozen=True)
class Landmarks:
    """`joints` (55,3). `eye` (3,): centre of the left eyeball, `eye_radius` metres; `eyeball` (V,) bool: its vertices
    and those of the right one. `ear` (3,): tip of the left ear. `crown`: greatest y. `sole`: least y.
    """

    joints: F64
    eye: F64
    eye_radius: float
    eyeball: NDArray[np.bool_]
    ear: F64
    crown: float
    sole: float

    @property
    def height(self) -> float:
        return self.crown - self.sole


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
