"""Matches a file's joints to the SMPL-X joints by the names that programs use.

The scene's `joint_map` decides first; a table of names decides for all other joints. No joint of the file stands for
two joints of the body. Each family of skeletons has one table. Names are compared without prefix, case and separators.
Of the families that match all required joints, the one with the most matches is chosen; among equals, the first.

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

NO_MAP: Mapping[str, str] = {}
#: Prefix of all names of a file: a namespace, or what Mixamo, 3ds Max, Rigify, VRoid and Character Creator write.
_PREFIX = re.compile(r"^(?:.*:)?(?:mixamorig\d*_?(?=[a-z])|bip0*1|def-|org-|j_bip_|cc_base_)?")


def plain(name: str) -> str:
    """Return `name` without prefix, case and separators: `mixamorig:Left_Hand` -> `lefthand`."""
    return re.sub(r"[^a-z0-9]", "", _PREFIX.sub("", name.lower()))


def _named(names: str, joints: str) -> dict[str, str]:
    """Return {name: joint} for `names` in the order of `joints`, both separated by blanks; the name `-` means none."""
    pairs = zip(names.split(), joints.split(), strict=True)
    return {name: joint for name, joint in pairs if name != "-"}


def _limbs(names: str) -> dict[str, str]:
    """Return {name: joint without side} for `names` of a leg, from hip to toes, and of an arm, from collar to wrist."""
    return _named(names, "hip knee ankle foot collar shoulder elbow wrist")


def _family(
    trunk: str,
    limbs: Mapping[str, str],
    sides: str = "left right",
    more: Mapping[str, str] = NO_MAP,
    behind: bool = False,
) -> dict[str, str]:
    """Return the table {plain name: SMPL-X name} of a family of skeletons.

    `trunk`: names of pelvis, three joints of the spine, neck and head.
    `limbs`: joint by name, without a side.
    `sides`: marks of the left and the right side, separated by a blank, which come before the names of limbs.
    `more`: further joints by name.
    `behind`: whether the marks come after the names of limbs instead.
    """
    table = {**_named(trunk, "pelvis spine1 spine2 spine3 neck head"), **more}
    for mark, side in zip(sides.split(), ("left", "right"), strict=True):
        table |= {plain(name + mark if behind else mark + name): f"{side}_{joint}" for name, joint in limbs.items()}
    return table


_FINGERS = ("index", "middle", "pinky", "ring", "thumb")
_FINGERS_BY_NUMBER = {f"hand{finger}{k}": f"{finger}{k}" for finger in _FINGERS for k in (1, 2, 3)}
_LITTLE_FINGERS = {"little": "pinky", **{finger: finger for finger in _FINGERS if finger != "pinky"}}
_LITTLE_BY_NUMBER = {f"{theirs}{k}": f"{ours}{k}" for theirs, ours in _LITTLE_FINGERS.items() for k in (1, 2, 3)}
_FINGERS_BY_TWO_DIGITS = {f"{finger}0{k}": f"{finger}{k}" for finger in _FINGERS for k in (1, 2, 3)}
_RIGIFY_FINGERS = {
    f"{'' if finger == 'thumb' else 'f'}{finger}0{k}": f"{finger}{k}" for finger in _FINGERS for k in (1, 2, 3)
}


def _phalanges(thumb: str) -> dict[str, str]:
    """Return {name: joint} for Unity's names of the fingers' bones. `thumb`: names of the thumb's three bones."""
    return {
        f"{theirs}{bone}": f"{ours}{k}"
        for theirs, ours in _LITTLE_FINGERS.items()
        for k, bone in enumerate((thumb if ours == "thumb" else "proximal intermediate distal").split(), 1)
    }


_MIXAMO = _limbs("upleg leg foot toebase shoulder arm forearm hand")
_UNITY = _limbs("upperleg lowerleg foot toes shoulder upperarm lowerarm hand")
_ANATOMICAL = _limbs("hip knee ankle toe collar shoulder elbow wrist")
_UNREAL = {**_limbs("thigh calf foot ball clavicle upperarm lowerarm hand"), **_FINGERS_BY_TWO_DIGITS}
_RIGIFY = _limbs("thigh shin foot toe shoulder upperarm forearm hand")
_UNITY_TRUNK, _JAW = "hips spine chest upperchest neck head", {"jaw": "jaw"}
_FACE = {**_JAW, "lefteye": "left_eye", "righteye": "right_eye"}

#: Tables {plain name: SMPL-X name} by family of skeletons.
DIALECTS: dict[str, dict[str, str]] = {
    "Mixamo": _family("hips spine spine1 spine2 neck head", {**_MIXAMO, **_FINGERS_BY_NUMBER}),
    "CMU": _family(
        "hips lowerback spine spine1 neck head", {**_MIXAMO, "handindex1": "index1", "thumb": "thumb1"}
    ),
    "MotionBuilder": _family("hips lowerback chest chest2 neck head", _ANATOMICAL),
    "3ds Max Biped": _family(
        "pelvis spine spine1 spine2 neck head", _limbs("thigh calf foot toe0 clavicle upperarm forearm hand"), "l r"
    ),
    "SMPL": _family(
        "pelvis spine1 spine2 spine3 neck head", _limbs("hip knee ankle foot collar shoulder elbow wrist"), "l r"
    ),
    "SMPL-X": {plain(name): name for name in JOINT_NAMES},
    "LaFAN1": _family("hips spine spine1 spine2 neck head", {**_MIXAMO, "toe": "foot"}),
    "Unity and VRM 0": _family(
        _UNITY_TRUNK, {**_UNITY, **_phalanges("proximal intermediate distal")}, more=_FACE
    ),
    "VRM 1": _family(_UNITY_TRUNK, {**_UNITY, **_phalanges("metacarpal proximal distal")}, more=_FACE),
    "VRoid": _family(
        "chips cspine cchest cupperchest cneck chead", {**_UNITY, "toebase": "foot", **_LITTLE_BY_NUMBER}, "l r"
    ),
    "Bandai Namco": _family(_UNITY_TRUNK, _UNITY, "l r", _JAW, behind=True),
    "Unreal 5": _family("pelvis spine01 spine03 spine05 neck01 head", _UNREAL, "l r", behind=True),
    "Unreal 4": _family("pelvis spine01 spine02 spine03 neck01 head", _UNREAL, "l r", behind=True),
    "Rigify": _family(
        "spine spine001 spine002 spine003 spine004 spine006",
        {**_RIGIFY, "eye": "eye", **_RIGIFY_FINGERS}, "l r", _JAW, behind=True,
    ),
    "Rigify, basic": _family("spine spine001 spine002 spine003 spine004 spine005", _RIGIFY, "l r", behind=True),
    "Xsens": _family("hips chest chest2 chest4 neck head", _ANATOMICAL),
    "Xsens segments": _family(
        "pelvis l5 t12 t8 neck head", _limbs("upperleg lowerleg foot toe shoulder upperarm forearm hand")
    ),
    "Rokoko": _family(
        "hips spine1 spine2 spine4 neck head", _limbs("thigh shin foot toe shoulder arm forearm hand")
    ),
    "Character Creator": _family(
        "hip waist spine01 spine02 necktwist01 head",
        _limbs("thigh calf foot toebase clavicle upperarm forearm hand"), "l r",
    ),
    "Poser and Daz": _family(
        "hip abdomen - chest neck head", _limbs("thigh shin foot toe collar shldr forearm hand"), "l r"
    ),
    "OptiTrack": _family("hip ab - chest neck head", _limbs("thigh shin foot toe shoulder uarm farm hand"), "l r"),
    "mocopi": _family(
        "root torso2 torso4 torso6 neck1 head", _limbs("upleg lowleg foot toes shoulder uparm lowarm hand"), "l r"
    ),
    "Acclaim": _family(
        "root lowerback upperback thorax lowerneck head",
        {**_limbs("femur tibia foot toes clavicle humerus radius wrist"), "hand": "wrist"}, "l r",
    ),
}  # fmt: skip


REQUIRED = ("pelvis", "left_hip", "right_hip", "left_knee", "right_knee", "left_ankle", "right_ankle")
#: Names of the pelvis in most families. They are used in addition to any table, as they cannot mean another joint.
PELVIS = ("hips", "pelvis", "hip")
#: Key of the scene that maps joints by hand.
STATED = "joint_map"


def match_names(path: Path, names: list[str], joint_map: Mapping[str, str] = NO_MAP) -> tuple[str, dict[str, int]]:
    """Return (family that fits best, index in `names` of each matched joint by SMPL-X name).

    `joint_map`: name in the file by SMPL-X name, or "" for none. The map overrides the tables, and the returned family
    mentions the map. Raises BadInputError about `path` when the file lacks a joint that the map names, or when a
    REQUIRED joint is unmatched.
    """
    stated = {target: _stated(path, names, target, source) for target, source in joint_map.items()}
    index_of: dict[str, int] = {}
    for index, name in enumerate(names):
        index_of.setdefault(plain(name), index)
    matches = {family: _by_table(table, index_of) for family, table in DIALECTS.items()}
    best = max(matches, key=lambda family: (not _missing(matches[family], stated), len(matches[family])))
    taken = set(stated.values())
    found = {name: index for name, index in matches[best].items() if name not in stated and index not in taken}
    found |= {name: index for name, index in stated.items() if index is not None}
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
    """Return the REQUIRED joints that are matched to a joint of the file neither in `found` nor in `stated`."""
    return [name for name in REQUIRED if name not in found and stated.get(name) is None]


def _stated(path: Path, names: list[str], target: str, source: str) -> int | None:
    """Return the index of the joint whose name is `source`, or has the same `plain` name; None if `source` is ""."""
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
    """Return the index of each joint that `table` matches, by SMPL-X name; the pelvis is also found by PELVIS.

    `index_of`: index by plain name. If several names match a joint, the first one in the table counts.
    """
    found: dict[str, int] = {}
    for source, target in table.items():
        if source in index_of:
            found.setdefault(target, index_of[source])
    named = next((index_of[name] for name in PELVIS if name in index_of), None)
    if named is not None and named not in found.values():
        found.setdefault("pelvis", named)
    return found
