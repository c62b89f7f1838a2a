"""Regions of a body's surface, by name, for reports of what a capture shows.

Rule: every vertex is in one region; all are found from the body at rest: its joints, skin weights and normals.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from trilane.arrays import F64, Mask
from trilane.body.joints import JOINT_INDEX, JOINT_NAMES
from trilane.training.body_arrays import BodyArrays
from trilane.training.clothing.surface_geometry import vertex_normals

#: Region -> beginnings of the names of the joints that move its vertices most; the first that fits.
BY_JOINT = {
    "face and head": ("head", "jaw", "left_eye", "right_eye", "neck"),
    "left hand": ("left_wrist", *(f"left_{finger}" for finger in ("index", "middle", "pinky", "ring", "thumb"))),
    "right hand": ("right_wrist", *(f"right_{finger}" for finger in ("index", "middle", "pinky", "ring", "thumb"))),
    "arms": ("left_shoulder", "right_shoulder", "left_elbow", "right_elbow"),
    "legs": ("left_hip", "right_hip", "left_knee", "right_knee"),
    "feet": ("left_ankle", "right_ankle", "left_foot", "right_foot"),
    "torso": ("pelvis", "spine", "left_collar", "right_collar"),
}
SOLES, ARMPITS, CROWN = "soles", "armpits", "top of head"
REGIONS = (*BY_JOINT, SOLES, ARMPITS, CROWN)
#: A normal that points down, or up, by at least this much: within 45 degrees of the vertical.
STEEP = 0.7
#: Part of the head's height that is its top; reach of an armpit about the shoulder, of the upper arm's length.
CROWN_SHARE, ARMPIT_REACH = 0.25, 0.5


def vertex_regions(body: BodyArrays) -> NDArray[np.int64]:
    """(V,): the index in `REGIONS` of each vertex."""
    by_joint = np.array([_region_of(name) for name in JOINT_NAMES])
    regions: NDArray[np.int64] = by_joint[body.weights.argmax(axis=1)]
    up = vertex_normals(body.vertices, body.faces)[:, 1]
    for name, inside in (
        (SOLES, (regions == REGIONS.index("feet")) & (up < -STEEP)),
        (ARMPITS, _near_armpit(body) & (up < -STEEP)),
        (CROWN, _on_crown(body, regions) & (up > STEEP)),
    ):
        regions[inside] = REGIONS.index(name)
    return regions


def _region_of(joint: str) -> int:
    return next(k for k, starts in enumerate(BY_JOINT.values()) if joint.startswith(starts))


def _near_armpit(body: BodyArrays) -> Mask:
    near = np.zeros(len(body.vertices), bool)
    for side in ("left", "right"):
        shoulder, elbow = (body.joints[JOINT_INDEX[f"{side}_{name}"]] for name in ("shoulder", "elbow"))
        reach = ARMPIT_REACH * float(np.linalg.norm(elbow - shoulder))
        near |= np.linalg.norm(body.vertices - shoulder, axis=1) < reach
    return near


def _on_crown(body: BodyArrays, regions: NDArray[np.int64]) -> Mask:
    head = regions == REGIONS.index("face and head")
    low: F64 = body.joints[JOINT_INDEX["head"], 1]
    high = body.vertices[head, 1].max()
    return np.asarray(head & (body.vertices[:, 1] > high - CROWN_SHARE * (high - low)))
