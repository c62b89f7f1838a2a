"""Names that BVH skeletons of several programs have for the SMPL-X joints.

Rule: one table per family of skeletons; names are compared without prefix, case and separators.
"""

from __future__ import annotations

import re

from trilane.body.joints import JOINT_NAMES


def plain(name: str) -> str:
    """`name` without prefix, case and separators: `mixamorig:Left_Hand` -> `lefthand`."""
    return re.sub(r"[^a-z0-9]", "", name.rsplit(":", 1)[-1].lower().removeprefix("bip01"))


def _sided(pattern: dict[str, str], left: str, right: str) -> dict[str, str]:
    sides = ((left, "left"), (right, "right"))
    return {plain(side + source): f"{name}_{target}" for side, name in sides for source, target in pattern.items()}


_FINGERS_BY_NUMBER = {
    f"hand{finger}{k}": f"{finger}{k}" for finger in ("index", "middle", "pinky", "ring", "thumb") for k in (1, 2, 3)
}

#: Skeleton family -> {plain name: SMPL-X name}.
DIALECTS: dict[str, dict[str, str]] = {
    "Mixamo": {
        "hips": "pelvis", "spine": "spine1", "spine1": "spine2", "spine2": "spine3", "neck": "neck", "head": "head",
        **_sided(
            {"upleg": "hip", "leg": "knee", "foot": "ankle", "toebase": "foot", "shoulder": "collar",
             "arm": "shoulder", "forearm": "elbow", "hand": "wrist", **_FINGERS_BY_NUMBER},
            "left", "right",
        ),
    },
    "CMU": {
        "hips": "pelvis", "lowerback": "spine1", "spine": "spine2", "spine1": "spine3", "neck": "neck", "head": "head",
        **_sided(
            {"upleg": "hip", "leg": "knee", "foot": "ankle", "toebase": "foot", "shoulder": "collar",
             "arm": "shoulder", "forearm": "elbow", "hand": "wrist", "handindex1": "index1", "thumb": "thumb1"},
            "left", "right",
        ),
    },
    "MotionBuilder": {
        "hips": "pelvis", "lowerback": "spine1", "chest": "spine2", "chest2": "spine3", "neck": "neck", "head": "head",
        **_sided(
            {"hip": "hip", "knee": "knee", "ankle": "ankle", "toe": "foot", "collar": "collar",
             "shoulder": "shoulder", "elbow": "elbow", "wrist": "wrist"},
            "left", "right",
        ),
    },
    "3ds Max Biped": {
        "pelvis": "pelvis", "spine": "spine1", "spine1": "spine2", "spine2": "spine3", "neck": "neck", "head": "head",
        **_sided(
            {"thigh": "hip", "calf": "knee", "foot": "ankle", "toe0": "foot", "clavicle": "collar",
             "upperarm": "shoulder", "forearm": "elbow", "hand": "wrist"},
            "l", "r",
        ),
    },
    "SMPL": {
        **{name: name for name in ("pelvis", "spine1", "spine2", "spine3", "neck", "head")},
        **_sided(
            {name: name for name in ("hip", "knee", "ankle", "foot", "collar", "shoulder", "elbow", "wrist")},
            "l", "r",
        ),
    },
    "SMPL-X": {plain(name): name for name in JOINT_NAMES},
}  # fmt: skip
