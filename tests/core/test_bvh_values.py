"""BVH by value: turns worked out by hand, names typed from the programs' own lists, limbs against a second chain."""

from __future__ import annotations

import itertools
import math
from pathlib import Path

import numpy as np
import pytest

from trilane.body.joints import JOINT_INDEX
from trilane.errors import BadInputError
from trilane.scene.motion import bvh as bvh_module
from trilane.scene.motion.bvh import load_bvh
from trilane.scene.motion.bvh_joint_names import DIALECTS, plain
from trilane.scene.motion.bvh_retarget import load_retargeted
from trilane.scene.motion.bvh_units import unit_of
from trilane.scene.motion.joint_match import match_names
from trilane.scene.motion.recorded import RawMotion
from trilane.scene.motion.t_pose import T_POSE

#: A turn by +90 degrees takes an axis to: about X y->z, z->-y; about Y z->x, x->-z; about Z x->y, y->-x.
QUARTER = {
    "X": np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]]),
    "Y": np.array([[0, 0, 1], [0, 1, 0], [-1, 0, 0]]),
    "Z": np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1]]),
}
TWO_JOINTS = """HIERARCHY
ROOT a
{
  OFFSET 1 2 3
  CHANNELS 6 Xposition Yposition Zposition %s
  JOINT b
  {
    OFFSET 0 10 0
    CHANNELS 3 %s
    End Site
    {
      OFFSET 0 0 5
    }
  }
}
MOTION
Frames: 1
Frame Time: 0.04
%s
"""


def write(path: Path, text: str) -> Path:
    path.write_text(text)
    return path


def axis_turn(axis: str, degrees: float) -> np.ndarray:
    """Rotation matrix by cosine and sine, apart from the project's own."""
    c, s = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    i, j = {"X": (1, 2), "Y": (2, 0), "Z": (0, 1)}[axis]
    matrix = np.eye(3)
    matrix[i, i] = matrix[j, j] = c
    matrix[i, j], matrix[j, i] = -s, s
    return matrix


@pytest.mark.parametrize("order", ["".join(axes) for axes in itertools.permutations("XYZ")])
@pytest.mark.parametrize("turned", ["100", "010", "001", "110", "011", "111"])
def test_quarter_turns_in_every_order_of_channels(tmp_path: Path, order: str, turned: str) -> None:
    """The root's channels turn one after the other, each about the axes that the one before has turned."""
    channels = " ".join(f"{axis}rotation" for axis in order)
    numbers = " ".join("90" if flag == "1" else "0" for flag in turned)
    text = TWO_JOINTS % (channels, channels, f"7 8 9 {numbers} {numbers}")
    bvh = load_bvh(write(tmp_path / "a.bvh", text))
    expected = np.eye(3, dtype=int)
    for axis, flag in zip(order, turned, strict=True):
        expected = expected @ (QUARTER[axis] if flag == "1" else np.eye(3, dtype=int))
    turns, places = bvh.forward()
    assert turns[0, 0] == pytest.approx(expected, abs=1e-12)
    assert turns[0, 1] == pytest.approx(expected @ expected, abs=1e-12)
    assert places[0, 0].tolist() == [7, 8, 9]
    assert places[0, 1] == pytest.approx([7, 8, 9] + expected @ [0, 10, 0], abs=1e-12)


def test_what_the_file_says_is_read(tmp_path: Path) -> None:
    order = "Zrotation Xrotation Yrotation"
    bvh = load_bvh(write(tmp_path / "a.bvh", TWO_JOINTS % (order, order, "1 2 3 4 5 6 7 8 9")))
    root, joint = bvh.joints
    assert (root.name, root.parent, root.offset.tolist(), root.first, root.tip) == ("a", -1, [1, 2, 3], 0, None)
    assert root.channels == ("Xposition", "Yposition", "Zposition", "Zrotation", "Xrotation", "Yrotation")
    assert (joint.name, joint.parent, joint.offset.tolist(), joint.first) == ("b", 0, [0, 10, 0], 6)
    assert joint.channels == ("Zrotation", "Xrotation", "Yrotation")
    assert joint.tip is not None and joint.tip.tolist() == [0, 0, 5]
    assert bvh.frames.tolist() == [[1, 2, 3, 4, 5, 6, 7, 8, 9]]
    assert bvh.frame_time_s == 0.04


def test_positions_replace_the_offset_axis_by_axis(tmp_path: Path) -> None:
    text = (TWO_JOINTS % ("Zrotation", "Yposition Zposition Xrotation", "90 4 6 0")).replace(
        "CHANNELS 6 Xposition Yposition Zposition", "CHANNELS 1"
    )
    _, places = load_bvh(write(tmp_path / "a.bvh", text)).forward()
    assert places[0].tolist() == [[1, 2, 3], pytest.approx([1 - 4, 2, 3 + 6])]


GOOD = TWO_JOINTS % ("Zrotation Xrotation Yrotation", "Zrotation Xrotation Yrotation", "1 2 3 4 5 6 7 8 9")
#: What is replaced by what -> line of the file, and the rest of the sentence.
SENTENCES = [
    ("ROOT a", "JOINT a", 2, "found 'JOINT', expected ROOT"),
    ("HIERARCHY", "HIER", 1, "found 'HIER', expected HIERARCHY"),
    ("  JOINT b", "  BONE b", 6, "found 'BONE', expected JOINT or END or CHANNELS or }"),
    ("ROOT a\n{", "ROOT a\n(", 3, "found '(', expected {"),
    ("End Site", "End Point", 10, "found 'Point', expected SITE"),
    ("OFFSET 0 0 5", "PLACE 0 0 5", 12, "found 'PLACE', expected OFFSET"),
    ("OFFSET 0 0 5", "OFFSET 0 inf 5", 12, "found 'inf', expected a finite number"),
    ("OFFSET 0 0 5", "OFFSET 0 zero 5", 12, "found 'zero', expected a finite number"),
    ("CHANNELS 3 ", "CHANNELS 7 ", 9, "found 7 channels, expected 0 to 6"),
    ("CHANNELS 3 ", "CHANNELS -1 ", 9, "found -1 channels, expected 0 to 6"),
    ("CHANNELS 3 ", "CHANNELS 2.5 ", 9, "found 2.5 channels, expected 0 to 6"),
    ("CHANNELS 3 Z", "CHANNELS 3 W", 9, "found 'Wrotation', expected a channel such as Zrotation or Xposition"),
    ("Frames: 1", "Frames: 0", 17, "found 0 frames, expected 1 to 200000"),
    ("Frames: 1", "Frames: 1.5", 17, "found 1.5 frames, expected 1 to 200000"),
    ("Frames: 1", "Frames: x", 17, "found 'Frames: x', expected `FRAMES: NUMBER`"),
    ("Frames: 1", "Frame: 1", 17, "found 'Frame: 1', expected `FRAMES: NUMBER`"),
    ("Frames: 1", "Frames: 2", 19, "found 1 frames, then the end, expected 2 frames"),
    ("Frame Time: 0.04", "Frame Time: 0.0009", 18, "found 0.0009 s a frame, expected 0.001 to 1"),
    ("Frame Time: 0.04", "Frame Time: 1.01", 18, "found 1.01 s a frame, expected 0.001 to 1"),
    ("Frame Time: 0.04", "Time: 0.04", 18, "found 'Time: 0.04', expected `FRAME TIME: NUMBER`"),
    ("7 8 9\n", "7 8\n", 19, "found 8 numbers, expected 9, one for each channel"),
    ("7 8 9\n", "7 8 9 10\n", 19, "found 10 numbers, expected 9, one for each channel"),
    ("7 8 9\n", "7 8 x\n", 19, "found could not convert string to float: 'x', expected numbers"),
]


@pytest.mark.parametrize(("part", "replacement", "line", "sentence"), SENTENCES)
def test_what_is_wrong_is_named_by_its_line(
    tmp_path: Path, part: str, replacement: str, line: int, sentence: str
) -> None:
    path = write(tmp_path / "a.bvh", GOOD.replace(part, replacement, 1))
    with pytest.raises(BadInputError) as raised:
        load_bvh(path)
    assert str(raised.value) == f"{path}, line {line}: {sentence}"


def test_files_that_end_too_early(tmp_path: Path) -> None:
    expected = "expected a BVH file: HIERARCHY, MOTION, Frames, Frame Time, one line of channels a frame"
    for text, sentence in (
        (GOOD.split("MOTION")[0], "line 15: found the end of the file, expected a line MOTION"),
        (GOOD.split("  JOINT")[0], f"line 5: found the end of the file, {expected}"),
        (GOOD.split("Frames")[0], "line 17: found '', expected `FRAMES: NUMBER`"),
        (GOOD.split("Frame Time")[0], "line 18: found '', expected `FRAME TIME: NUMBER`"),
    ):
        path = write(tmp_path / "a.bvh", text)
        with pytest.raises(BadInputError) as raised:
            load_bvh(path)
        assert str(raised.value) == f"{path}, {sentence}"


def test_limits_on_either_side(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert (bvh_module.MAX_JOINTS, bvh_module.MAX_FRAMES) == (1000, 200_000)
    path = tmp_path / "a.bvh"
    for time in ("0.001", "1"):
        assert load_bvh(write(path, GOOD.replace("0.04", time))).frame_time_s == float(time)
    loose = GOOD.replace("Frames: 1", " frames:  1 ").replace("Frame Time", "FRAME  TIME").replace("MOTION", " Motion ")
    two = loose + "\n1 1 1 1 1 1 1 1 1\n"
    assert len(load_bvh(write(path, two)).frames) == 1  # lines after the last frame are ignored
    monkeypatch.setattr(bvh_module, "MAX_JOINTS", 2)
    monkeypatch.setattr(bvh_module, "MAX_FRAMES", 1)
    load_bvh(write(path, GOOD))
    with pytest.raises(BadInputError, match="line 17: found 2 frames, expected 1 to 1"):
        load_bvh(write(path, two.replace("s:  1", "s: 2")))
    monkeypatch.setattr(bvh_module, "MAX_JOINTS", 1)
    with pytest.raises(BadInputError, match="line 6: found more than 1 joints, expected a human skeleton"):
        load_bvh(write(path, GOOD))


# --- names ---

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


# --- units ---


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


# --- retargeting ---

#: Joint, parent, offset in centimetres, end site: a T pose facing +Z; legs a little apart, arms a little down.
SKELETON: list[tuple[str, str, tuple[float, float, float], tuple[float, float, float] | None]] = [
    ("pelvis", "", (1, 90, 2), None),
    ("left_hip", "pelvis", (9, -5, 0), None),
    ("left_knee", "left_hip", (1, -40, 1), None),
    ("left_ankle", "left_knee", (0, -42, -3), None),
    ("left_foot", "left_ankle", (2, -6, 13), (0, 0, 6)),
    ("right_hip", "pelvis", (-9, -5, 0), None),
    ("right_knee", "right_hip", (-2, -41, 0), None),
    ("right_ankle", "right_knee", (0, -41, -2), None),
    ("right_foot", "right_ankle", (-1, -5, 14), (0, 0, 6)),
    ("spine1", "pelvis", (0, 12, -1), None),
    ("spine2", "spine1", (0, 13, 0), None),
    ("spine3", "spine2", (0, 6, 0), None),
    ("neck", "spine3", (0, 20, -2), None),
    ("head", "neck", (0, 9, 3), (0, 15, 0)),
    ("left_collar", "spine3", (5, 12, 0), None),
    ("left_shoulder", "left_collar", (12, 3, 0), None),
    ("left_elbow", "left_shoulder", (26, -4, 1), None),
    ("left_wrist", "left_elbow", (25, -2, 2), None),
    ("left_middle1", "left_wrist", (9, -1, 1), (3, 0, 0)),
    ("right_collar", "spine3", (-5, 12, 0), None),
    ("right_shoulder", "right_collar", (-12, 3, 0), None),
    ("right_elbow", "right_shoulder", (-26, 3, 0), None),
    ("right_wrist", "right_elbow", (-24, 0, 4), None),
    ("right_thumb", "right_wrist", (-6, 0, 9), (-1, 0, 2)),
    ("right_nails", "right_wrist", (-8, 1, 2), (-7, 1, 0)),
]
PARENT = {name: parent for name, parent, _, _ in SKELETON}
OFFSET = {name: np.array(offset, float) for name, _, offset, _ in SKELETON}
#: Joint -> the joint or point that its bone ends at.
BONES = {
    "left_hip": "left_knee", "left_knee": "left_ankle", "left_ankle": "left_foot",
    "right_hip": "right_knee", "right_knee": "right_ankle", "right_ankle": "right_foot",
    "left_shoulder": "left_elbow", "left_elbow": "left_wrist", "left_wrist": "left_middle1",
    "right_shoulder": "right_elbow", "right_elbow": "right_wrist",
}  # fmt: skip


def t_direction(name: str) -> np.ndarray:
    """Of a limb's bone, between the rest joints."""
    end = BONES.get(name, "right_middle1")
    return T_POSE[JOINT_INDEX[end]] - T_POSE[JOINT_INDEX[name]]


def text_of(
    angles: list[dict[str, tuple[float, float, float]]], world: np.ndarray | None = None, drop: tuple[str, ...] = ()
) -> str:
    """A file of SKELETON, channels Y, Z, X; `world` turns all offsets; `drop`: left out, with what is below."""
    turn = np.eye(3) if world is None else world
    lines, order = ["HIERARCHY"], []

    def add(name: str) -> None:
        order.append(name)
        offset, tip = next((o, t) for n, _, o, t in SKELETON if n == name)
        lines.extend(
            [f"{'JOINT' if PARENT[name] else 'ROOT'} {name}", "{", "OFFSET " + " ".join(map(str, turn @ offset))]
        )
        places = "" if PARENT[name] else "Xposition Yposition Zposition "
        lines.append(f"CHANNELS {3 if PARENT[name] else 6} {places}Yrotation Zrotation Xrotation")
        for child in PARENT:
            if PARENT[child] == name and child not in drop:
                add(child)
        if tip is not None:
            lines.extend(["End Site", "{", "OFFSET " + " ".join(map(str, turn @ tip)), "}"])
        lines.append("}")

    add("pelvis")
    rows = [
        " ".join(map(str, [10.0 * k, 90.0, -5.0 * k, *(v for name in order for v in frame.get(name, (0, 0, 0)))]))
        for k, frame in enumerate(angles)
    ]
    return "\n".join([*lines, "MOTION", f"Frames: {len(angles)}", "Frame Time: 0.05", *rows, ""])


def recorded(path: Path, text: str, units: str = "auto") -> RawMotion:
    return load_retargeted(write(path, text), units)


def file_turns(frame: dict[str, tuple[float, float, float]]) -> dict[str, np.ndarray]:
    """Global turns of SKELETON's joints: Y, then Z, then X, down the chain."""
    turns: dict[str, np.ndarray] = {"": np.eye(3)}
    for name, parent, _, _ in SKELETON:
        y, z, x = frame.get(name, (0, 0, 0))
        turns[name] = turns[parent] @ axis_turn("Y", y) @ axis_turn("Z", z) @ axis_turn("X", x)
    return turns


PARENTS_OF_OURS = {
    **{name: parent for name, parent, _, _ in SKELETON if name not in ("right_thumb", "right_nails")},
    "left_index1": "left_wrist", "right_index1": "right_wrist", "left_index2": "left_index1", "jaw": "head",
}  # fmt: skip
FINGER_INDEX = {"jaw": 22, "left_index1": 25, "left_index2": 26, "left_middle1": 28, "right_index1": 40}
INDEX = {name: k for k, name in enumerate(BODY.split())} | FINGER_INDEX


def our_turn(raw: RawMotion, name: str, frame: int) -> np.ndarray:
    """Global turn of one of our joints, from the axis-angles by Rodrigues' formula."""
    v = raw.poses[frame, INDEX[name]]
    angle = float(np.linalg.norm(v))
    a = v / angle if angle else v
    cross = np.array([[0, -a[2], a[1]], [a[2], 0, -a[0]], [-a[1], a[0], 0]])
    turn = np.eye(3) + math.sin(angle) * cross + (1 - math.cos(angle)) * cross @ cross
    parent = PARENTS_OF_OURS[name]
    return (our_turn(raw, parent, frame) if parent else np.eye(3)) @ turn


def some_angles(seed: int) -> dict[str, tuple[float, float, float]]:
    random = np.random.default_rng(seed)
    return {name: tuple(random.uniform(-170, 170, 3)) for name, _, _, _ in SKELETON}  # type: ignore[misc]


@pytest.mark.parametrize("seed", range(3))
def test_every_limb_points_where_the_files_own_chain_points(tmp_path: Path, seed: int) -> None:
    frames = [some_angles(seed), {}, some_angles(seed + 100)]
    raw = recorded(tmp_path / "a.bvh", text_of(frames))
    for k, frame in enumerate(frames):
        turns = file_turns(frame)
        ends = {name: OFFSET[end] for name, end in BONES.items()}
        if any(
            "soles are laid on" in note for note in raw.notes
        ):  # some wild poses look as if feet were planted steeply
            ends = {name: end for name, end in ends.items() if "ankle" not in name}
        ends["right_wrist"] = OFFSET["right_nails"]  # no middle finger: the joint below that is no thumb
        for name, end in ends.items():
            bone = turns[name] @ end / np.linalg.norm(end)
            ours = our_turn(raw, name, k) @ t_direction(name)
            assert ours / np.linalg.norm(ours) == pytest.approx(bone, abs=1e-6), name
        left = turns["pelvis"] @ (OFFSET["left_hip"] - OFFSET["right_hip"])
        assert our_turn(raw, "pelvis", k)[:, 0] == pytest.approx(left / np.linalg.norm(left), abs=1e-9)
        for name, parent in (("jaw", "head"), ("left_index2", "left_wrist"), ("right_index1", "right_wrist")):
            assert our_turn(raw, name, k) == pytest.approx(our_turn(raw, parent, k), abs=1e-9), name


def test_limbs_are_not_twisted_in_a_t_pose(tmp_path: Path) -> None:
    """No bone of SKELETON is more than 16 degrees from that of the avatar, so no joint may be turned by much more."""
    raw = recorded(tmp_path / "a.bvh", text_of([{}]))
    for name in (*BONES, "right_wrist", "pelvis", "spine1", "spine2", "spine3", "neck", "head", "left_collar"):
        cosine = (np.trace(our_turn(raw, name, 0)) - 1) / 2
        assert math.degrees(math.acos(min(cosine, 1.0))) < 25, name


def about_x(degrees: float, vector: tuple[float, float, float]) -> np.ndarray:
    return axis_turn("X", degrees) @ vector


def test_arms_and_legs_twist_as_they_bend(tmp_path: Path) -> None:
    """Knees that bend backwards turn shins about the body's left, elbows forearms about the body's up, and no more."""
    frame = {"left_knee": (0.0, 0.0, 90.0), "left_elbow": (-90.0, 0.0, 0.0)}  # about Y, Z, X
    raw = recorded(tmp_path / "a.bvh", text_of([frame, {}, {}]))
    assert our_turn(raw, "left_knee", 0)[:, 0] == pytest.approx([1, 0, 0], abs=0.12)
    assert our_turn(raw, "left_hip", 0) == pytest.approx(our_turn(raw, "left_hip", 1), abs=1e-9)
    assert our_turn(raw, "left_elbow", 0)[:, 1] == pytest.approx([0, 1, 0], abs=0.2)


def test_a_motion_in_metres_and_seconds_with_its_notes(tmp_path: Path) -> None:
    raw = recorded(tmp_path / "a.bvh", text_of([{}, {}, {}]))
    assert raw.times_s == pytest.approx([0, 0.05, 0.1])
    above = np.array([0, 0.0084, 0.0091])  # of the avatar's pelvis over its hips, at the size of these legs, 3.7° back
    hips = np.array([[0, 0.85, 0], [0.1, 0.85, -0.05], [0.2, 0.85, -0.1]])
    assert raw.translation == pytest.approx(hips + above, abs=5e-4)
    left = math.sqrt(1 + 1600 + 1) + math.sqrt(42**2 + 9)
    right = math.sqrt(4 + 41**2) + math.sqrt(41**2 + 4)
    assert raw.leg_m == pytest.approx((left + right) / 2 / 100)
    assert (raw.up, raw.betas) == ("y", None)
    assert raw.notes == (
        "BVH, 25 joints named as in SMPL-X, 3 frames at 20/s",
        "units: cm, by the length of the legs (leg of 0.82 m)",
        "23 joints have a partner, 1 of them in the hands",
        "skeleton: not built like the avatar's; how trunk and shoulders stand at rest is told by the straightest legs, "
        "3 of 3 frames",
        "head: as the file turns it, straight ahead on average",
        "betas: none in the format",
    )
    assert recorded(tmp_path / "a.bvh", text_of([{}]), "in").leg_m == pytest.approx((left + right) / 2 * 0.0254)


def test_fingers_are_counted_and_begin_as_their_wrist_lies(tmp_path: Path) -> None:
    for name, count in (("left_index1", 2), ("jaw", 1), ("right_thumb3", 2)):
        raw = recorded(tmp_path / "a.bvh", text_of([{}]).replace("JOINT right_nails", f"JOINT {name}"))
        assert f"24 joints have a partner, {count} of them in the hands" in raw.notes
        assert our_turn(raw, "left_index1", 0) == pytest.approx(our_turn(raw, "left_wrist", 0), abs=1e-9)


def test_a_skeleton_that_faces_elsewhere_is_turned_as_a_whole(tmp_path: Path) -> None:
    """The zero pose faces +X, or lies in a Z-up world: pelvis and limbs take the same turn."""
    upright = recorded(tmp_path / "a.bvh", text_of([{}]))
    for world in (QUARTER["Y"], QUARTER["X"], QUARTER["Z"], QUARTER["X"] @ QUARTER["Y"]):
        raw = recorded(tmp_path / "b.bvh", text_of([{}], world))
        for name in (*BONES, "pelvis", "head", "left_collar", "right_foot"):
            assert our_turn(raw, name, 0) == pytest.approx(world @ our_turn(upright, name, 0), abs=1e-9), name


@pytest.mark.parametrize("drop", [("neck",), ("neck", "spine3"), ("neck", "spine2"), ("spine1",)])
def test_a_trunk_that_lacks_joints_still_stands(tmp_path: Path, drop: tuple[str, ...]) -> None:
    """Up is towards the shoulders, the head or the highest joint of the trunk; without a trunk, away from the knees."""
    raw = recorded(tmp_path / "a.bvh", text_of([{"pelvis": (30, 0, 0)}], None, drop))
    assert our_turn(raw, "pelvis", 0)[:, 0] == pytest.approx(axis_turn("Y", 30)[:, 0], abs=1e-9)
    for name in ("pelvis", "spine2", "head"):
        assert our_turn(raw, name, 0) == pytest.approx(axis_turn("Y", 30), abs=0.2), name
    if "spine1" in drop:  # arms and all
        assert our_turn(raw, "left_shoulder", 0) == pytest.approx(our_turn(raw, "spine3", 0), abs=1e-9)


def test_a_foot_without_toes_points_along_its_end_site(tmp_path: Path) -> None:
    text = text_of([{}], None, ("left_foot",))
    place = "OFFSET " + " ".join(map(str, np.eye(3) @ (0, -42, -3)))
    head, tail = text.split(place)
    channels = "\nCHANNELS 3 Yrotation Zrotation Xrotation\n"
    assert tail.startswith(channels)
    sites = "End Site\n{\nOFFSET 0 0 2\n}\nEnd Site\n{\nOFFSET 3 -1.7 4\n}\n"
    raw = recorded(tmp_path / "a.bvh", head + place + channels + sites + tail.removeprefix(channels))
    ours = our_turn(raw, "left_ankle", 0) @ t_direction("left_ankle")
    assert ours / np.linalg.norm(ours) == pytest.approx(np.array([3, -1.7, 4]) / math.sqrt(27.89), abs=1e-9)
    mark = "End Site\n{\nOFFSET 0 1.5 0\n}\n"  # of legs of 82 cm, 1.64 cm are the least
    marked = head + place + channels + mark + tail.removeprefix(channels)
    for bare in (recorded(tmp_path / "b.bvh", text), recorded(tmp_path / "c.bvh", marked)):
        assert our_turn(bare, "left_ankle", 0) == pytest.approx(our_turn(bare, "left_knee", 0), abs=1e-9)


@pytest.mark.parametrize("bones", ["legs", "hips"])
def test_a_skeleton_without_lengths_is_refused(tmp_path: Path, bones: str) -> None:
    text = text_of([{}])
    names = ("left_knee", "left_ankle", "right_knee", "right_ankle") if bones == "legs" else ("left_hip", "right_hip")
    for name in names:
        text = text.replace("OFFSET " + " ".join(map(str, np.eye(3) @ OFFSET[name])), "OFFSET 0 0 0")
    with pytest.raises(BadInputError) as raised:
        recorded(tmp_path / "a.bvh", text)
    assert str(raised.value) == (
        f"{tmp_path}/a.bvh: found legs of no length or hips in one place, expected a skeleton with OFFSETs"
    )


def test_joints_of_the_body_without_a_partner_are_named(tmp_path: Path) -> None:
    text = text_of([{}]).replace("JOINT left_elbow", "JOINT bone_7").replace("JOINT spine2", "JOINT bone_8")
    assert recorded(tmp_path / "a.bvh", text).notes[3] == (
        "spine2, left_elbow: no partner, so they follow their parents; `joint_map` of the avatar names partners"
    )
