"""The garments that are shells of the body: which vertices each may cover, and how far it stands off.

Rule: one table; a garment is placed by the body's landmarks, never by coordinates.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from trilane.arrays import F64
from trilane.training.clothing import landmarks as joint
from trilane.training.clothing.landmarks import Landmarks
from trilane.training.clothing.surface_geometry import smoothstep

Covers = Callable[[F64, Landmarks], NDArray[np.bool_]]
Thickness = Callable[[F64, Landmarks], tuple[F64, F64, int]]


def _shirt_covers(at: F64, landmarks: Landmarks) -> NDArray[np.bool_]:
    joints = landmarks.joints
    below_sleeve = np.abs(at[:, 0]) < joints[joint.ELBOW, 0]
    above, below = at[:, 1] > joints[joint.HIP, 1] - 0.16, at[:, 1] < joints[joint.HEAD, 1] - 0.03
    return np.asarray(below_sleeve & above & below)


def _shirt_thickness(at: F64, landmarks: Landmarks) -> tuple[F64, F64, int]:
    joints = landmarks.joints
    along = (np.abs(at[:, 0]) - joints[joint.SHOULDER, 0]) / (joints[joint.ELBOW, 0] - joints[joint.SHOULDER, 0])
    sleeve = smoothstep(0.1, 0.7, along)
    hem = smoothstep(joints[joint.PELVIS, 1] + 0.2, joints[joint.HIP, 1] - 0.06, at[:, 1]) * (along < 0)
    neck = smoothstep(joints[joint.NECK, 1] - 0.09, joints[joint.NECK, 1] - 0.02, at[:, 1])
    folds = 0.003 * np.sin(38.0 * at[:, 1] + 9.0 * at[:, 0] + 3.0 * np.sin(11.0 * at[:, 2] + 5.0 * at[:, 0]))
    offset = (0.022 + 0.014 * np.maximum(sleeve, hem) + folds * (1 - neck)) * (1 - 0.35 * neck)
    return offset, 0.8 * offset, 14


def _trousers_covers(at: F64, landmarks: Landmarks) -> NDArray[np.bool_]:
    joints = landmarks.joints
    hand = np.abs(at[:, 0]) > joints[joint.SHOULDER, 0] + 0.1
    below, above = at[:, 1] < joints[joint.PELVIS, 1] + 0.2, at[:, 1] > joints[joint.ANKLE, 1] - 0.04
    return np.asarray(below & above & ~hand)


def _trousers_thickness(at: F64, landmarks: Landmarks) -> tuple[F64, F64, int]:
    joints = landmarks.joints
    shin = smoothstep(joints[joint.KNEE, 1] + 0.1, joints[joint.ANKLE, 1] + 0.1, at[:, 1])
    waist = smoothstep(joints[joint.HIP, 1] - 0.02, joints[joint.PELVIS, 1] + 0.08, at[:, 1])
    folds = 0.004 * np.sin(31.0 * at[:, 1] + 14.0 * at[:, 0] + 2.0 * np.sin(17.0 * at[:, 2]))
    offset = (0.020 + 0.022 * shin + folds * (0.3 + 0.7 * shin)) * (1 - waist) + 0.009 * waist
    return offset, 0.8 * offset, 20


def _hair_covers(at: F64, landmarks: Landmarks) -> NDArray[np.bool_]:
    return np.asarray(at[:, 1] > landmarks.joints[joint.NECK, 1] + 0.01)


def _hair_thickness(at: F64, landmarks: Landmarks) -> tuple[F64, F64, int]:
    up = smoothstep(landmarks.eye[1] + 0.01, landmarks.crown - 0.02, at[:, 1])
    front = smoothstep(landmarks.eye[2] - 0.09, landmarks.eye[2] + 0.01, at[:, 2])
    nape = smoothstep(landmarks.eye[1] - 0.02, landmarks.eye[1] - 0.1, at[:, 1])
    temple = smoothstep(landmarks.eye[1] + 0.05, landmarks.eye[1], at[:, 1]) * smoothstep(
        landmarks.ear[2] - 0.03, landmarks.ear[2], at[:, 2]
    )
    lock = np.sin(60.0 * at[:, 0] + 25.0 * at[:, 2]) + np.sin(33.0 * at[:, 0] - 41.0 * at[:, 2] + 2.0)
    offset = (0.018 + 0.015 * up + 0.004 * up * front + 0.0022 * lock * up) * (1 - 0.6 * nape) * (1 - 0.7 * temple)
    return offset, 0.75 * offset, 8


def _shorts_covers(at: F64, landmarks: Landmarks) -> NDArray[np.bool_]:
    return np.asarray(_trousers_covers(at, landmarks) & (at[:, 1] > landmarks.joints[joint.KNEE, 1] - 0.02))


def _shorts_thickness(at: F64, landmarks: Landmarks) -> tuple[F64, F64, int]:
    joints = landmarks.joints
    thigh = smoothstep(joints[joint.HIP, 1] - 0.08, joints[joint.KNEE, 1] + 0.06, at[:, 1])
    waist = smoothstep(joints[joint.HIP, 1] - 0.02, joints[joint.PELVIS, 1] + 0.08, at[:, 1])
    folds = 0.003 * np.sin(27.0 * at[:, 0] + 12.0 * at[:, 2] + 2.0 * np.sin(13.0 * at[:, 1]))
    offset = (0.018 + 0.020 * thigh + folds * thigh) * (1 - waist) + 0.009 * waist
    return offset, 0.8 * offset, 20


def _jacket_covers(at: F64, landmarks: Landmarks) -> NDArray[np.bool_]:
    joints = landmarks.joints
    sleeve = np.abs(at[:, 0]) < joints[joint.WRIST, 0]
    above, below = at[:, 1] > joints[joint.HIP, 1] - 0.12, at[:, 1] < joints[joint.HEAD, 1] - 0.02
    return np.asarray(sleeve & above & below)


def _jacket_thickness(at: F64, landmarks: Landmarks) -> tuple[F64, F64, int]:
    joints = landmarks.joints
    along = (np.abs(at[:, 0]) - joints[joint.SHOULDER, 0]) / (joints[joint.WRIST, 0] - joints[joint.SHOULDER, 0])
    cuff = smoothstep(0.75, 0.97, along)
    hem = smoothstep(joints[joint.PELVIS, 1] + 0.14, joints[joint.HIP, 1] + 0.02, at[:, 1]) * (along < 0)
    neck = smoothstep(joints[joint.NECK, 1] - 0.09, joints[joint.NECK, 1] - 0.02, at[:, 1])
    folds = 0.004 * np.sin(29.0 * at[:, 1] + 34.0 * np.abs(at[:, 0]) + 2.0 * np.sin(9.0 * at[:, 2]))
    offset = (0.027 + 0.014 * hem + folds * (1 - neck)) * (1 - 0.45 * cuff) * (1 - 0.25 * neck)
    return offset, 0.8 * offset, 14


def _bob_thickness(at: F64, landmarks: Landmarks) -> tuple[F64, F64, int]:
    """Hair that falls straight to the jaw, over the ears."""
    up = smoothstep(landmarks.eye[1] + 0.01, landmarks.crown - 0.02, at[:, 1])
    front = smoothstep(landmarks.eye[2] - 0.07, landmarks.eye[2] - 0.01, at[:, 2])
    end = smoothstep(landmarks.eye[1] - 0.03, landmarks.eye[1] - 0.09, at[:, 1])
    ear = smoothstep(0.05, 0.0, np.linalg.norm(np.abs(at) * (1, 0, 0) + at * (0, 1, 1) - landmarks.ear, axis=1))
    lock = np.sin(75.0 * at[:, 0] + 60.0 * at[:, 2])
    offset = (0.020 + 0.006 * up + 0.0012 * lock) * (1 - 0.35 * front) * (1 - 0.3 * end) * (1 - 0.7 * ear)
    return offset, 0.75 * offset, 16


#: Garment to the vertices it may cover, and its offset, least offset (metres) and rounds of relaxation.
GARMENTS: dict[str, tuple[Covers, Thickness]] = {
    "trousers": (_trousers_covers, _trousers_thickness),
    "shirt": (_shirt_covers, _shirt_thickness),
    "hair": (_hair_covers, _hair_thickness),
    "shorts": (_shorts_covers, _shorts_thickness),
    "jacket": (_jacket_covers, _jacket_thickness),
    "bob": (_hair_covers, _bob_thickness),
}
