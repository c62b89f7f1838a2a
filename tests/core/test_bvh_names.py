"""Joint names and units of a BVH: names typed from the programs' own lists, units by hand."""

from __future__ import annotations

from pathlib import Path

import pytest

from trilane.body.joints import JOINT_NAMES
from trilane.errors import BadInputError
from trilane.scene.motion.bvh_retarget import unit_of
from trilane.scene.motion.joint_names import DIALECTS, match_names, plain

BODY = """pelvis left_hip right_hip spine1 left_knee right_knee spine2 left_ankle right_ankle spine3 left_foot
right_foot neck left_collar right_collar head left_shoulder right_shoulder left_elbow right_elbow
left_wrist right_wrist"""
#: Names as the programs write them, in the order of BODY ("-": the skeleton has no such joint).
AS_WRITTEN = {
    "Mixamo": """mixamorig:Hips LeftUpLeg RightUpLeg Spine LeftLeg RightLeg Spine1 LeftFoot RightFoot Spine2
        LeftToeBase RightToeBase Neck LeftShoulder RightShoulder Head LeftArm RightArm LeftForeArm RightForeArm
        LeftHand RightHand""",
    "CMU": """Hips LeftUpLeg RightUpLeg LowerBack LeftLeg RightLeg Spine LeftFoot RightFoot Spine1
        LeftToeBase RightToeBase Neck LeftShoulder RightShoulder Head LeftArm RightArm LeftForeArm RightForeArm
        LeftHand RightHand""",
    "MotionBuilder": """Hips LeftHip RightHip LowerBack LeftKnee RightKnee Chest LeftAnkle RightAnkle Chest2
        LeftToe RightToe Neck LeftCollar RightCollar Head LeftShoulder RightShoulder LeftElbow RightElbow
        LeftWrist RightWrist""",
    "3ds Max Biped": """Bip01_Pelvis Bip01_L_Thigh Bip01_R_Thigh Bip01_Spine Bip01_L_Calf Bip01_R_Calf Bip01_Spine1
        Bip01_L_Foot Bip01_R_Foot Bip01_Spine2 Bip01_L_Toe0 Bip01_R_Toe0 Bip01_Neck Bip01_L_Clavicle Bip01_R_Clavicle
        Bip01_Head Bip01_L_UpperArm Bip01_R_UpperArm Bip01_L_Forearm Bip01_R_Forearm Bip01_L_Hand Bip01_R_Hand""",
    "SMPL": """Pelvis L_Hip R_Hip Spine1 L_Knee R_Knee Spine2 L_Ankle R_Ankle Spine3 L_Foot R_Foot Neck L_Collar
        R_Collar Head L_Shoulder R_Shoulder L_Elbow R_Elbow L_Wrist R_Wrist""",
    "SMPL-X": BODY,
}
FINGERS = {"Thumb": "thumb", "Index": "index", "Middle": "middle", "Ring": "ring", "Pinky": "pinky"}


def test_the_body_is_in_the_order_of_its_joints() -> None:
    assert BODY.split() == list(JOINT_NAMES[:22])


@pytest.mark.parametrize("dialect", AS_WRITTEN)
def test_every_name_of_a_skeleton_is_that_joint(dialect: str) -> None:
    names = AS_WRITTEN[dialect].split()
    found, index_of = match_names(Path("a.bvh"), names)
    assert found == dialect
    assert {name: names[index] for name, index in index_of.items()} == dict(zip(BODY.split(), names, strict=True))


def test_fingers_have_their_own_names() -> None:
    names = AS_WRITTEN["Mixamo"].split()
    hands = {
        f"{s}Hand{f}{k}": f"{s.lower()}_{ours}{k}"
        for s in ("Left", "Right")
        for f, ours in FINGERS.items()
        for k in (1, 2, 3)
    }
    _, index_of = match_names(Path("a.bvh"), [*names, *hands])
    assert {(names + list(hands))[index]: name for name, index in index_of.items() if index >= 22} == hands
    assert DIALECTS["CMU"]["lefthandindex1"] == "left_index1" and DIALECTS["CMU"]["righthandindex1"] == "right_index1"
    assert DIALECTS["CMU"]["leftthumb"] == "left_thumb1" and DIALECTS["CMU"]["rightthumb"] == "right_thumb1"
    assert DIALECTS["SMPL-X"]["leftpinky2"] == "left_pinky2" and DIALECTS["SMPL-X"]["jaw"] == "jaw"
    assert [len(DIALECTS[name]) for name in AS_WRITTEN] == [52, 26, 22, 22, 22, 55]


def test_names_without_prefix_case_and_separators() -> None:
    assert plain("mixamorig:Left_Hand") == "lefthand"
    assert plain("a:b:Hips") == "hips"
    assert plain("Bip01 L Thigh") == "lthigh"
    assert plain("Chest2") == "chest2"


def test_a_name_twice_is_the_first_and_a_joint_that_must_be_there_is_named() -> None:
    names = [*AS_WRITTEN["SMPL"].split(), "Pelvis"]
    assert match_names(Path("a.bvh"), names)[1]["pelvis"] == 0
    for required in ("Pelvis", "L_Hip", "R_Hip", "L_Knee", "R_Knee", "L_Ankle", "R_Ankle"):
        rest = [name for name in names if name != required]
        ours = dict(zip(AS_WRITTEN["SMPL"].split(), BODY.split(), strict=True))[required]
        with pytest.raises(BadInputError) as raised:
            match_names(Path("a.bvh"), rest)
        assert str(raised.value) == (
            f"a.bvh: found joints {', '.join(rest[:6])} …, of which none is {ours}, expected the joint names of "
            f'{", ".join(DIALECTS)}; say which is which in the scene: joint_map = {{{ours} = "...", ...}} for {ours}'
        )


def test_units_by_hand() -> None:
    """Legs of 0.85 m in each unit, and the last length that is still taken for a leg: 1.6 x 0.85 = 1.36 m."""
    for name, metres in (("m", 1.0), ("cm", 0.01), ("in", 0.0254), ("cmu", 0.0254 / 0.45)):
        assert unit_of(0.85 / metres, "auto") == (f"{name}, by the length of the legs", metres)
        assert unit_of(123.0, name) == (f"{name}, as given", metres)
    for leg_m, name in ((0.85 * 1.48, "cmu"), (0.85 * 1.50, "in")):  # a cmu is 2.22 inches: the middle is 1.49
        assert unit_of(leg_m / (0.0254 / 0.45), "auto")[0] == f"{name}, by the length of the legs"
    assert unit_of(1.35, "auto") == ("m, by the length of the legs", 1.0)
    assert unit_of(1.37, "auto") == ("unknown, scaled to a leg of 0.85 m", 0.85 / 1.37)
    assert unit_of(0.511, "auto")[1] == 1.0
    assert unit_of(0.509, "auto") == ("unknown, scaled to a leg of 0.85 m", 0.85 / 0.509)
