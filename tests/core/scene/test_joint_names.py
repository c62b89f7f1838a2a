"""Joint names of programs, typed from the programs' own lists, what a scene states of joints, and units by hand."""

from __future__ import annotations

from pathlib import Path

import pytest

from trilane.body.joints import JOINT_NAMES
from trilane.errors import BadInputError
from trilane.scene.motion.bvh import unit_of
from trilane.scene.motion.joint_names import DIALECTS, REQUIRED, match_names, plain

HERE = Path("a.bvh")
BODY = tuple(
    """pelvis left_hip right_hip spine1 left_knee right_knee spine2 left_ankle right_ankle spine3 left_foot
right_foot neck left_collar right_collar head left_shoulder right_shoulder left_elbow right_elbow
left_wrist right_wrist""".split()  # noqa: SIM905
)

#: Family -> names of BODY's joints in their order (`-`: none), and behind `|` names of no joint of the body.
AS_WRITTEN = {
    "LaFAN1": """Hips LeftUpLeg RightUpLeg Spine LeftLeg RightLeg Spine1 LeftFoot RightFoot Spine2 LeftToe RightToe
    Neck LeftShoulder RightShoulder Head LeftArm RightArm LeftForeArm RightForeArm LeftHand RightHand""",
    "Unity and VRM 0": """Hips LeftUpperLeg RightUpperLeg Spine LeftLowerLeg RightLowerLeg Chest LeftFoot RightFoot
    UpperChest LeftToes RightToes Neck LeftShoulder RightShoulder Head LeftUpperArm RightUpperArm LeftLowerArm
    RightLowerArm LeftHand RightHand""",
    "VRoid": """J_Bip_C_Hips J_Bip_L_UpperLeg J_Bip_R_UpperLeg J_Bip_C_Spine J_Bip_L_LowerLeg J_Bip_R_LowerLeg
    J_Bip_C_Chest J_Bip_L_Foot J_Bip_R_Foot J_Bip_C_UpperChest J_Bip_L_ToeBase J_Bip_R_ToeBase J_Bip_C_Neck
    J_Bip_L_Shoulder J_Bip_R_Shoulder J_Bip_C_Head J_Bip_L_UpperArm J_Bip_R_UpperArm J_Bip_L_LowerArm J_Bip_R_LowerArm
    J_Bip_L_Hand J_Bip_R_Hand | Root J_Sec_Hair1_01 J_Adj_L_FaceEye""",
    "Bandai Namco": """Hips UpperLeg_L UpperLeg_R Spine LowerLeg_L LowerLeg_R Chest Foot_L Foot_R - Toes_L Toes_R Neck
    Shoulder_L Shoulder_R Head UpperArm_L UpperArm_R LowerArm_L LowerArm_R Hand_L Hand_R | joint_Root""",
    "Unreal 5": """pelvis thigh_l thigh_r spine_01 calf_l calf_r spine_03 foot_l foot_r spine_05 ball_l ball_r neck_01
    clavicle_l clavicle_r head upperarm_l upperarm_r lowerarm_l lowerarm_r hand_l hand_r | root spine_02 spine_04
    neck_02 thigh_twist_01_l ik_hand_l index_metacarpal_l""",
    "Unreal 4": """pelvis thigh_l thigh_r spine_01 calf_l calf_r spine_02 foot_l foot_r spine_03 ball_l ball_r neck_01
    clavicle_l clavicle_r head upperarm_l upperarm_r lowerarm_l lowerarm_r hand_l hand_r | root thigh_twist_01_l
    ik_foot_root""",
    "Rigify": """DEF-spine DEF-thigh.L DEF-thigh.R DEF-spine.001 DEF-shin.L DEF-shin.R DEF-spine.002 DEF-foot.L
    DEF-foot.R DEF-spine.003 DEF-toe.L DEF-toe.R DEF-spine.004 DEF-shoulder.L DEF-shoulder.R DEF-spine.006
    DEF-upper_arm.L DEF-upper_arm.R DEF-forearm.L DEF-forearm.R DEF-hand.L DEF-hand.R | DEF-spine.005 DEF-thigh.L.001
    DEF-upper_arm.R.001""",
    "Rigify, basic": """spine thigh.L thigh.R spine.001 shin.L shin.R spine.002 foot.L foot.R spine.003 toe.L toe.R
    spine.004 shoulder.L shoulder.R spine.005 upper_arm.L upper_arm.R forearm.L forearm.R hand.L hand.R | heel.02.L
    breast.L pelvis.L""",
    "Xsens": """Hips LeftHip RightHip Chest LeftKnee RightKnee Chest2 LeftAnkle RightAnkle Chest4 LeftToe RightToe Neck
    LeftCollar RightCollar Head LeftShoulder RightShoulder LeftElbow RightElbow LeftWrist RightWrist | Chest3""",
    "Xsens segments": """Pelvis LeftUpperLeg RightUpperLeg L5 LeftLowerLeg RightLowerLeg T12 LeftFoot RightFoot T8
    LeftToe RightToe Neck LeftShoulder RightShoulder Head LeftUpperArm RightUpperArm LeftForeArm RightForeArm LeftHand
    RightHand | L3""",
    "Rokoko": """Hips LeftThigh RightThigh Spine1 LeftShin RightShin Spine2 LeftFoot RightFoot Spine4 LeftToe RightToe
    Neck LeftShoulder RightShoulder Head LeftArm RightArm LeftForeArm RightForeArm LeftHand RightHand | Root Spine3""",
    "Character Creator": """CC_Base_Hip CC_Base_L_Thigh CC_Base_R_Thigh CC_Base_Waist CC_Base_L_Calf CC_Base_R_Calf
    CC_Base_Spine01 CC_Base_L_Foot CC_Base_R_Foot CC_Base_Spine02 CC_Base_L_ToeBase CC_Base_R_ToeBase
    CC_Base_NeckTwist01 CC_Base_L_Clavicle CC_Base_R_Clavicle CC_Base_Head CC_Base_L_Upperarm CC_Base_R_Upperarm
    CC_Base_L_Forearm CC_Base_R_Forearm CC_Base_L_Hand CC_Base_R_Hand | RL_BoneRoot CC_Base_Pelvis
    CC_Base_L_CalfTwist01""",
    "Poser and Daz": """hip lThigh rThigh abdomen lShin rShin - lFoot rFoot chest lToe rToe neck lCollar rCollar head
    lShldr rShldr lForeArm rForeArm lHand rHand | lButtock lEye""",
    "OptiTrack": """Hip LThigh RThigh Ab LShin RShin - LFoot RFoot Chest LToe RToe Neck LShoulder RShoulder Head LUArm
    RUArm LFArm RFArm LHand RHand | LThumb1""",
    "mocopi": """root l_up_leg r_up_leg torso_2 l_low_leg r_low_leg torso_4 l_foot r_foot torso_6 l_toes r_toes neck_1
    l_shoulder r_shoulder head l_up_arm r_up_arm l_low_arm r_low_arm l_hand r_hand | torso_1 torso_3 torso_5 torso_7
    neck_2""",
    "Acclaim": """root lfemur rfemur lowerback ltibia rtibia upperback lfoot rfoot thorax ltoes rtoes lowerneck
    lclavicle rclavicle head lhumerus rhumerus lradius rradius lwrist rwrist | lhipjoint rhipjoint upperneck lhand
    lfingers lthumb""",
    "Mixamo": """mixamorig:Hips LeftUpLeg RightUpLeg Spine LeftLeg RightLeg Spine1 LeftFoot RightFoot Spine2
    LeftToeBase RightToeBase Neck LeftShoulder RightShoulder Head LeftArm RightArm LeftForeArm RightForeArm LeftHand
    RightHand""",
    "CMU": """Hips LeftUpLeg RightUpLeg LowerBack LeftLeg RightLeg Spine LeftFoot RightFoot Spine1 LeftToeBase
    RightToeBase Neck LeftShoulder RightShoulder Head LeftArm RightArm LeftForeArm RightForeArm LeftHand RightHand""",
    "MotionBuilder": """Hips LeftHip RightHip LowerBack LeftKnee RightKnee Chest LeftAnkle RightAnkle Chest2 LeftToe
    RightToe Neck LeftCollar RightCollar Head LeftShoulder RightShoulder LeftElbow RightElbow LeftWrist RightWrist""",
    "3ds Max Biped": """Bip01_Pelvis Bip01_L_Thigh Bip01_R_Thigh Bip01_Spine Bip01_L_Calf Bip01_R_Calf Bip01_Spine1
    Bip01_L_Foot Bip01_R_Foot Bip01_Spine2 Bip01_L_Toe0 Bip01_R_Toe0 Bip01_Neck Bip01_L_Clavicle Bip01_R_Clavicle
    Bip01_Head Bip01_L_UpperArm Bip01_R_UpperArm Bip01_L_Forearm Bip01_R_Forearm Bip01_L_Hand Bip01_R_Hand""",
    "SMPL": """Pelvis L_Hip R_Hip Spine1 L_Knee R_Knee Spine2 L_Ankle R_Ankle Spine3 L_Foot R_Foot Neck L_Collar
    R_Collar Head L_Shoulder R_Shoulder L_Elbow R_Elbow L_Wrist R_Wrist""",
    "SMPL-X": " ".join(BODY),
}
MIXAMO = [name.removeprefix("mixamorig:") for name in AS_WRITTEN["Mixamo"].split()]


@pytest.mark.parametrize("family", AS_WRITTEN)
def test_every_name_of_a_family_is_that_joint(family: str) -> None:
    written, _, others = AS_WRITTEN[family].partition("|")
    expected = {ours: name for ours, name in zip(BODY, written.split(), strict=True) if name != "-"}
    names = [*others.split(), *expected.values()]
    found, index_of = match_names(HERE, names)
    assert found == family
    assert {ours: names[index] for ours, index in index_of.items()} == expected


def test_every_family_is_held() -> None:
    assert set(DIALECTS) == set(AS_WRITTEN) | {"VRM 1"}
    assert list(BODY) == list(JOINT_NAMES[:22])
    for table in DIALECTS.values():
        assert set(table.values()) <= set(JOINT_NAMES) and set(REQUIRED) <= set(table.values())


#: Family -> names of the left hand: thumb from its root, then index, middle, ring and little finger.
HANDS = {
    "Unity and VRM 0": [f"left{f}{b}" for f in ("Thumb", "Index", "Middle", "Ring", "Little")
                        for b in ("Proximal", "Intermediate", "Distal")],
    "VRM 1": ["leftThumbMetacarpal", "leftThumbProximal", "leftThumbDistal",
              *(f"left{f}{b}" for f in ("Index", "Middle", "Ring", "Little")
                for b in ("Proximal", "Intermediate", "Distal"))],
    "VRoid": [f"J_Bip_L_{f}{k}" for f in ("Thumb", "Index", "Middle", "Ring", "Little") for k in (1, 2, 3)],
    "Unreal 4": [f"{f}_0{k}_l" for f in ("thumb", "index", "middle", "ring", "pinky") for k in (1, 2, 3)],
    "Rigify": [f"DEF-{f}.0{k}.L" for f in ("thumb", "f_index", "f_middle", "f_ring", "f_pinky") for k in (1, 2, 3)],
}  # fmt: skip


@pytest.mark.parametrize("family", HANDS)
def test_fingers_from_their_roots(family: str) -> None:
    written, _, _ = AS_WRITTEN["Unity and VRM 0" if family == "VRM 1" else family].partition("|")
    names = [*written.split(), *HANDS[family]]
    found, index_of = match_names(HERE, names)
    assert found == family
    ours = [f"left_{finger}{k}" for finger in ("thumb", "index", "middle", "ring", "pinky") for k in (1, 2, 3)]
    assert [names[index_of[name]] for name in ours] == HANDS[family]


def test_what_stands_before_all_names_is_no_part_of_them() -> None:
    for written, name in (
        ("mixamorig:LeftUpLeg", "leftupleg"),
        ("mixamorig1:LeftUpLeg", "leftupleg"),
        ("mixamorig_LeftUpLeg", "leftupleg"),
        ("mixamorigLeftUpLeg", "leftupleg"),
        ("Bip001 L Thigh", "lthigh"),
        ("Bip01_L_Thigh", "lthigh"),
        ("ORG-thigh.L", "thighl"),
        ("J_Bip_C_Hips", "chips"),
        ("CC_Base_Hip", "hip"),
        ("Character1:Ctrl:Hips", "hips"),
        ("Definition", "definition"),
        ("a:b:Hips", "hips"),
        ("Chest2", "chest2"),
    ):
        assert plain(written) == name


def test_what_the_scene_states_comes_first_and_tables_fill_the_rest() -> None:
    names = [*MIXAMO, "Tail", "OldHead"]
    found, index_of = match_names(HERE, names, {"head": "OldHead", "neck": "", "jaw": "tail"})
    assert found == "Mixamo and joint_map"
    assert (names[index_of["head"]], names[index_of["jaw"]]) == ("OldHead", "Tail")
    assert "neck" not in index_of and index_of["left_hip"] == 1


def test_a_joint_of_the_file_is_one_joint_of_the_body() -> None:
    """Spine2 is stated to be spine1; the table's spine1 has gone, and spine3 has no partner any more."""
    _, index_of = match_names(HERE, MIXAMO, {"spine1": "Spine2"})
    assert MIXAMO[index_of["spine1"]] == "Spine2" and "spine3" not in index_of
    assert len(set(index_of.values())) == len(index_of)


def test_joints_of_no_table_can_all_be_stated() -> None:
    names = [f"bone{k}" for k in range(9)]
    stated = {ours: names[k + 1] for k, ours in enumerate(REQUIRED)}
    found, index_of = match_names(HERE, names, stated)
    assert found == "joint_map"
    assert {ours: names[index] for ours, index in index_of.items()} == stated
    with pytest.raises(BadInputError, match=r"none is left_hip.*joint_map = {left_hip = .*for left_hip, right_hip"):
        match_names(HERE, names, {"pelvis": "bone0"})


def test_a_joint_that_is_stated_but_not_there_is_named_with_the_near_one() -> None:
    with pytest.raises(BadInputError) as raised:
        match_names(HERE, MIXAMO, {"left_hip": "LeftUpLegg"})
    assert str(raised.value) == (
        "a.bvh: found no joint 'LeftUpLegg', which joint_map names for left_hip, expected a joint of the file; "
        "did you mean 'LeftUpLeg'?"
    )
    with pytest.raises(BadInputError, match="the file has Hips, LeftUpLeg"):
        match_names(HERE, MIXAMO, {"left_hip": "qqq"})


def test_the_pelvis_may_have_the_name_of_another_family() -> None:
    """As in files of Vicon Shogun: Pelvis, and limbs as Mixamo writes them."""
    names = ["Pelvis", *MIXAMO[1:]]
    assert match_names(HERE, names) == match_names(HERE, MIXAMO)
    # the floor under a person is no pelvis
    with pytest.raises(BadInputError, match="none is pelvis"):
        match_names(HERE, ["Root", *MIXAMO[1:]])


FINGERS = {"Thumb": "thumb", "Index": "index", "Middle": "middle", "Ring": "ring", "Pinky": "pinky"}


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


def test_a_name_twice_is_the_first_and_a_joint_that_must_be_there_is_named() -> None:
    names = [*AS_WRITTEN["SMPL"].split(), "Pelvis"]
    assert match_names(Path("a.bvh"), names)[1]["pelvis"] == 0
    for required in ("Pelvis", "L_Hip", "R_Hip", "L_Knee", "R_Knee", "L_Ankle", "R_Ankle"):
        rest = [name for name in names if name != required]
        ours = dict(zip(AS_WRITTEN["SMPL"].split(), BODY, strict=True))[required]
        with pytest.raises(BadInputError) as raised:
            match_names(Path("a.bvh"), rest)
        assert str(raised.value) == (
            f"a.bvh: found joints {', '.join(rest[:6])} …, and none is {ours}, expected the joint names of "
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
