"""Matches a file's joints to the body's: names that programs have for the SMPL-X joints.

The statements of the scene (`joint_map`) come first; a table of names fills the rest; no joint of the file stands for
two of the body's. There is one table per family of skeletons, and names are compared without prefix, case and
separators. The family whose table has the most of a file's names is taken, the first one among equals.

Sources of the names, besides files of those programs: Unity's `HumanBodyBones`
(https://docs.unity3d.com/ScriptReference/HumanBodyBones.html); VRM's humanoid bones, 0.x and 1.0
(https://github.com/vrm-c/vrm-specification); Unreal's mannequins (UE4 with 3 spine bones, UE5 with 5); Blender's Rigify
human meta-rig; LaFAN1 (https://github.com/ubisoft/ubisoft-laforge-animation-dataset); Bandai Namco's motion dataset
(https://github.com/BandaiNamcoResearchInc/Bandai-Namco-Research-Motiondataset); Xsens MVN's BVH and segment names;
Rokoko's Newton skeleton; Reallusion's Character Creator; Poser's and Daz's figures; OptiTrack Motive's own bones;
Sony's mocopi; the bones of CMU's Acclaim files (.asf), which converters keep.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path

from trilane.body.joints import JOINT_NAMES
from trilane.errors import BadInputError, did_you_mean

#: Prefixes before all names: a namespace, or those that Mixamo, 3ds Max, Rigify, VRoid and Character Creator write.
_PREFIX = re.compile(r"^(?:.*:)?(?:mixamorig\d*_?(?=[a-z])|bip0*1|def-|org-|j_bip_|cc_base_)?")


def plain(name: str) -> str:
    """Return `name` without prefix, case and separators: `mixamorig:Left_Hand` -> `lefthand`."""
    return re.sub(r"[^a-z0-9]", "", _PREFIX.sub("", name.lower()))


def _sided(pattern: dict[str, str], left: str, right: str, *, behind: bool = False) -> dict[str, str]:
    """Return `pattern` for both sides, with the sides' marks before the names, or `behind` them."""
    sides = ((left, "left"), (right, "right"))
    return {
        plain(source + side if behind else side + source): f"{name}_{target}"
        for side, name in sides
        for source, target in pattern.items()
    }


_FINGERS = ("index", "middle", "pinky", "ring", "thumb")
_FINGERS_BY_NUMBER = {f"hand{finger}{k}": f"{finger}{k}" for finger in _FINGERS for k in (1, 2, 3)}
_LITTLE_FINGERS = {"little": "pinky", **{finger: finger for finger in _FINGERS if finger != "pinky"}}
_LITTLE_BY_NUMBER = {f"{theirs}{k}": f"{ours}{k}" for theirs, ours in _LITTLE_FINGERS.items() for k in (1, 2, 3)}
_FINGERS_BY_TWO_DIGITS = {f"{finger}0{k}": f"{finger}{k}" for finger in _FINGERS for k in (1, 2, 3)}
_RIGIFY_FINGERS = {
    f"{'' if finger == 'thumb' else 'f'}{finger}0{k}": f"{finger}{k}" for finger in _FINGERS for k in (1, 2, 3)
}


def _phalanges(thumb: tuple[str, str, str]) -> dict[str, str]:
    """Return Unity's names of the fingers' bones.

    `thumb`: names of the thumb's three bones.
    """
    usual = ("proximal", "intermediate", "distal")
    return {
        f"{theirs}{bone}": f"{ours}{k}"
        for theirs, ours in _LITTLE_FINGERS.items()
        for k, bone in enumerate(thumb if ours == "thumb" else usual, 1)
    }


_MIXAMO_LIMBS = {
    "upleg": "hip", "leg": "knee", "foot": "ankle", "toebase": "foot", "shoulder": "collar",
    "arm": "shoulder", "forearm": "elbow", "hand": "wrist",
}  # fmt: skip
_UNITY_LIMBS = {
    "upperleg": "hip", "lowerleg": "knee", "foot": "ankle", "toes": "foot", "shoulder": "collar",
    "upperarm": "shoulder", "lowerarm": "elbow", "hand": "wrist",
}  # fmt: skip
_ANATOMICAL_LIMBS = {
    "hip": "hip", "knee": "knee", "ankle": "ankle", "toe": "foot", "collar": "collar",
    "shoulder": "shoulder", "elbow": "elbow", "wrist": "wrist",
}  # fmt: skip
_UNREAL_LIMBS = {
    "thigh": "hip", "calf": "knee", "foot": "ankle", "ball": "foot", "clavicle": "collar",
    "upperarm": "shoulder", "lowerarm": "elbow", "hand": "wrist",
}  # fmt: skip
_RIGIFY_LIMBS = {
    "thigh": "hip", "shin": "knee", "foot": "ankle", "toe": "foot", "shoulder": "collar",
    "upperarm": "shoulder", "forearm": "elbow", "hand": "wrist",
}  # fmt: skip
_UNITY_TRUNK = {
    "hips": "pelvis", "spine": "spine1", "chest": "spine2", "upperchest": "spine3", "neck": "neck", "head": "head",
    "jaw": "jaw",
}  # fmt: skip

#: Tables {plain name: SMPL-X name} by family of skeletons.
DIALECTS: dict[str, dict[str, str]] = {
    "Mixamo": {
        "hips": "pelvis", "spine": "spine1", "spine1": "spine2", "spine2": "spine3", "neck": "neck", "head": "head",
        **_sided({**_MIXAMO_LIMBS, **_FINGERS_BY_NUMBER}, "left", "right"),
    },
    "CMU": {
        "hips": "pelvis", "lowerback": "spine1", "spine": "spine2", "spine1": "spine3", "neck": "neck", "head": "head",
        **_sided({**_MIXAMO_LIMBS, "handindex1": "index1", "thumb": "thumb1"}, "left", "right"),
    },
    "MotionBuilder": {
        "hips": "pelvis", "lowerback": "spine1", "chest": "spine2", "chest2": "spine3", "neck": "neck", "head": "head",
        **_sided(_ANATOMICAL_LIMBS, "left", "right"),
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
    "LaFAN1": {
        "hips": "pelvis", "spine": "spine1", "spine1": "spine2", "spine2": "spine3", "neck": "neck", "head": "head",
        **_sided({**_MIXAMO_LIMBS, "toe": "foot"}, "left", "right"),
    },
    "Unity and VRM 0": {
        **_UNITY_TRUNK, "lefteye": "left_eye", "righteye": "right_eye",
        **_sided({**_UNITY_LIMBS, **_phalanges(("proximal", "intermediate", "distal"))}, "left", "right"),
    },
    "VRM 1": {
        **_UNITY_TRUNK, "lefteye": "left_eye", "righteye": "right_eye",
        **_sided({**_UNITY_LIMBS, **_phalanges(("metacarpal", "proximal", "distal"))}, "left", "right"),
    },
    "VRoid": {
        **{f"c{theirs}": ours for theirs, ours in _UNITY_TRUNK.items() if ours != "jaw"},
        **_sided({**_UNITY_LIMBS, "toebase": "foot", **_LITTLE_BY_NUMBER}, "l", "r"),
    },
    "Bandai Namco": {
        **_UNITY_TRUNK,
        **_sided(_UNITY_LIMBS, "l", "r", behind=True),
    },
    "Unreal 5": {
        "pelvis": "pelvis", "spine01": "spine1", "spine03": "spine2", "spine05": "spine3", "neck01": "neck",
        "head": "head",
        **_sided({**_UNREAL_LIMBS, **_FINGERS_BY_TWO_DIGITS}, "l", "r", behind=True),
    },
    "Unreal 4": {
        "pelvis": "pelvis", "spine01": "spine1", "spine02": "spine2", "spine03": "spine3", "neck01": "neck",
        "head": "head",
        **_sided({**_UNREAL_LIMBS, **_FINGERS_BY_TWO_DIGITS}, "l", "r", behind=True),
    },
    "Rigify": {
        "spine": "pelvis", "spine001": "spine1", "spine002": "spine2", "spine003": "spine3", "spine004": "neck",
        "spine006": "head", "jaw": "jaw",
        **_sided({**_RIGIFY_LIMBS, "eye": "eye", **_RIGIFY_FINGERS}, "l", "r", behind=True),
    },
    "Rigify, basic": {
        "spine": "pelvis", "spine001": "spine1", "spine002": "spine2", "spine003": "spine3", "spine004": "neck",
        "spine005": "head",
        **_sided(_RIGIFY_LIMBS, "l", "r", behind=True),
    },
    "Xsens": {
        "hips": "pelvis", "chest": "spine1", "chest2": "spine2", "chest4": "spine3", "neck": "neck", "head": "head",
        **_sided(_ANATOMICAL_LIMBS, "left", "right"),
    },
    "Xsens segments": {
        "pelvis": "pelvis", "l5": "spine1", "t12": "spine2", "t8": "spine3", "neck": "neck", "head": "head",
        **_sided(
            {"upperleg": "hip", "lowerleg": "knee", "foot": "ankle", "toe": "foot", "shoulder": "collar",
             "upperarm": "shoulder", "forearm": "elbow", "hand": "wrist"},
            "left", "right",
        ),
    },
    "Rokoko": {
        "hips": "pelvis", "spine1": "spine1", "spine2": "spine2", "spine4": "spine3", "neck": "neck", "head": "head",
        **_sided(
            {"thigh": "hip", "shin": "knee", "foot": "ankle", "toe": "foot", "shoulder": "collar",
             "arm": "shoulder", "forearm": "elbow", "hand": "wrist"},
            "left", "right",
        ),
    },
    "Character Creator": {
        "hip": "pelvis", "waist": "spine1", "spine01": "spine2", "spine02": "spine3", "necktwist01": "neck",
        "head": "head",
        **_sided(
            {"thigh": "hip", "calf": "knee", "foot": "ankle", "toebase": "foot", "clavicle": "collar",
             "upperarm": "shoulder", "forearm": "elbow", "hand": "wrist"},
            "l", "r",
        ),
    },
    "Poser and Daz": {
        "hip": "pelvis", "abdomen": "spine1", "chest": "spine3", "neck": "neck", "head": "head",
        **_sided(
            {"thigh": "hip", "shin": "knee", "foot": "ankle", "toe": "foot", "collar": "collar",
             "shldr": "shoulder", "forearm": "elbow", "hand": "wrist"},
            "l", "r",
        ),
    },
    "OptiTrack": {
        "hip": "pelvis", "ab": "spine1", "chest": "spine3", "neck": "neck", "head": "head",
        **_sided(
            {"thigh": "hip", "shin": "knee", "foot": "ankle", "toe": "foot", "shoulder": "collar",
             "uarm": "shoulder", "farm": "elbow", "hand": "wrist"},
            "l", "r",
        ),
    },
    "mocopi": {
        "root": "pelvis", "torso2": "spine1", "torso4": "spine2", "torso6": "spine3", "neck1": "neck", "head": "head",
        **_sided(
            {"upleg": "hip", "lowleg": "knee", "foot": "ankle", "toes": "foot", "shoulder": "collar",
             "uparm": "shoulder", "lowarm": "elbow", "hand": "wrist"},
            "l", "r",
        ),
    },
    "Acclaim": {
        "root": "pelvis", "lowerback": "spine1", "upperback": "spine2", "thorax": "spine3", "lowerneck": "neck",
        "head": "head",
        **_sided(
            {"femur": "hip", "tibia": "knee", "foot": "ankle", "toes": "foot", "clavicle": "collar",
             "humerus": "shoulder", "radius": "elbow", "wrist": "wrist", "hand": "wrist"},
            "l", "r",
        ),
    },
}  # fmt: skip


REQUIRED = ("pelvis", "left_hip", "right_hip", "left_knee", "right_knee", "left_ankle", "right_ankle")
#: Names of the pelvis in most families: found beside any other table, since it is one joint and no limb.
PELVIS = ("hips", "pelvis", "hip")
#: Source of the names of joints that are in no table.
STATED = "joint_map"
NO_MAP: Mapping[str, str] = {}


def match_names(path: Path, names: list[str], joint_map: Mapping[str, str] = NO_MAP) -> tuple[str, dict[str, int]]:
    """Return the source of the names, such as the family that fits best, and {SMPL-X name: index in `names`}.

    `joint_map`: name in the file by SMPL-X name, or empty for none; it overrules the tables. Raises BadInputError about
    `path` when the file has no joint that the map names, or REQUIRED ones have no partner.
    """
    stated = {target: _stated(path, names, target, source) for target, source in joint_map.items()}
    index_of: dict[str, int] = {}
    for index, name in enumerate(names):
        index_of.setdefault(plain(name), index)
    matches = {family: _by_table(table, index_of) for family, table in DIALECTS.items()}
    best = max(matches, key=lambda family: (not _missing(matches[family], stated), len(matches[family])))
    found = _overruled(matches[best], stated)
    missing = _missing(found, {})
    if missing:
        raise BadInputError(
            path,
            f"joints {', '.join(names[:6])} …, and none is {missing[0]}",
            f"the joint names of {', '.join(DIALECTS)}",
            f'say which is which in the scene: joint_map = {{{missing[0]} = "...", ...}} for {", ".join(missing)}',
        )
    return " and ".join(word for word, used in ((best, matches[best]), (STATED, joint_map)) if used), found


def _missing(found: Mapping[str, int], stated: Mapping[str, int | None]) -> list[str]:
    """Return the REQUIRED joints that neither has."""
    return [name for name in REQUIRED if name not in found and stated.get(name) is None]


def _stated(path: Path, names: list[str], target: str, source: str) -> int | None:
    """Return the index of the joint `source`, in the file's case or another one; None for an empty name."""
    if not source:
        return None
    if source in names:
        return names.index(source)
    for index, name in enumerate(names):
        if plain(name) == plain(source):
            return index
    near = did_you_mean(source, names) or f"the file has {', '.join(names[:40])}"
    raise BadInputError(path, f"no joint {source!r}, which joint_map names for {target}", "a joint of the file", near)


def _by_table(table: Mapping[str, str], index_of: Mapping[str, int]) -> dict[str, int]:
    """Return {SMPL-X name: index} of what `table` finds, and the pelvis; of several names the first in the table."""
    found: dict[str, int] = {}
    for source, target in table.items():
        if source in index_of:
            found.setdefault(target, index_of[source])
    named = next((index_of[name] for name in PELVIS if name in index_of), None)
    if named is not None and named not in found.values():
        found.setdefault("pelvis", named)
    return found


def _overruled(found: Mapping[str, int], stated: Mapping[str, int | None]) -> dict[str, int]:
    """Return `found` without joints that are `stated`, or whose joint of the file is."""
    taken = set(stated.values())
    kept = {target: index for target, index in found.items() if target not in stated and index not in taken}
    return kept | {target: index for target, index in stated.items() if index is not None}
