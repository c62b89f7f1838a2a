"""BVH: channels in the file's order, names of several skeletons, limbs that point where the recorded ones point."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from trilane.body.joints import JOINT_INDEX, JOINT_NAMES, JOINT_PARENTS
from trilane.errors import BadInputError
from trilane.scene.motion.bvh import load_bvh
from trilane.scene.motion.files import load_motion
from trilane.scene.motion.joint_names import DIALECTS, plain
from trilane.scene.motion.motion import T_POSE, Motion
from trilane.scene.rotations import about, matrix_from_rotvec
from trilane.scene.schema import AvatarSpec

#: name, parent, offset in centimetres: arms hang, legs spread.
SKELETON = (
    ("Hips", None, (0, 95, 0)),
    ("Spine", "Hips", (0, 10, 0)),
    ("Spine1", "Spine", (0, 15, 0)),
    ("Spine2", "Spine1", (0, 15, 0)),
    ("Neck", "Spine2", (0, 15, 0)),
    ("Head", "Neck", (0, 10, 2)),
    ("LeftShoulder", "Spine2", (3, 10, 0)),
    ("LeftArm", "LeftShoulder", (15, 0, 0)),
    ("LeftForeArm", "LeftArm", (0, -28, 0)),
    ("LeftHand", "LeftForeArm", (0, -25, 0)),
    ("RightShoulder", "Spine2", (-3, 10, 0)),
    ("RightArm", "RightShoulder", (-15, 0, 0)),
    ("RightForeArm", "RightArm", (0, -28, 0)),
    ("RightHand", "RightForeArm", (0, -25, 0)),
    ("LeftUpLeg", "Hips", (9, -3, 0)),
    ("LeftLeg", "LeftUpLeg", (12, -38, 0)),
    ("LeftFoot", "LeftLeg", (0, -42, 0)),
    ("LeftToeBase", "LeftFoot", (0, -6, 14)),
    ("RightUpLeg", "Hips", (-9, -3, 0)),
    ("RightLeg", "RightUpLeg", (-12, -38, 0)),
    ("RightFoot", "RightLeg", (0, -42, 0)),
    ("RightToeBase", "RightFoot", (0, -6, 14)),
)
ORDERS = ("Zrotation Yrotation Xrotation", "Xrotation Yrotation Zrotation", "Yrotation Xrotation Zrotation")


def bvh_text(
    frames: list[dict[str, tuple[float, float, float]]],
    order: str = ORDERS[0],
    prefix: str = "",
    scale: float = 1.0,
) -> str:
    """A file of SKELETON; each frame maps a joint to its channel values in `order`; the root stays at its offset."""
    lines: list[str] = []
    depths: list[str] = []

    def write(name: str) -> None:
        parent, offset = next((parent, offset) for n, parent, offset in SKELETON if n == name)
        place = " ".join(f"{side * scale:.6f}" for side in offset)
        lines.extend([f"{'JOINT' if parent else 'ROOT'} {prefix}{name}", "{", f"OFFSET {place}"])
        channels = f"CHANNELS 3 {order}" if parent else f"CHANNELS 6 Xposition Yposition Zposition {order}"
        lines.append(channels)
        depths.append(name)
        children = [n for n, p, _ in SKELETON if p == name]
        for child in children:
            write(child)
        if not children:
            lines.extend(["End Site", "{", "OFFSET 0 -5 0", "}"])
        lines.append("}")

    write("Hips")
    rows = []
    for frame in frames:
        row = [0.0, 95.0 * scale, 0.0]
        for name in depths:
            row.extend(frame.get(name, (0.0, 0.0, 0.0)))
        rows.append(" ".join(f"{value:.9g}" for value in row))
    return "\n".join(["HIERARCHY", *lines, "MOTION", f"Frames: {len(frames)}", "Frame Time: 0.0333333", *rows]) + "\n"


def load(path: Path, text: str, **spec: str) -> Motion:
    path.write_text(text)
    return load_motion(AvatarSpec.model_validate({"motion": str(path), **spec}), Path("/"))


#: Joint -> the joint at the other end of its bone.
ENDS = {
    f"{side}_{start}": f"{side}_{end}"
    for side in ("left", "right")
    for start, end in (("hip", "knee"), ("knee", "ankle"), ("shoulder", "elbow"), ("elbow", "wrist"))
}


def bone(motion: Motion, name: str, frame: int = 0) -> np.ndarray:
    """World direction of a limb's bone, from that between the rest joints."""
    turn = np.eye(3)
    joint = JOINT_INDEX[name]
    while joint >= 0:
        turn = matrix_from_rotvec(motion.poses[frame, joint]) @ turn
        joint = JOINT_PARENTS[joint]
    rest = T_POSE[JOINT_INDEX[ENDS[name]]] - T_POSE[JOINT_INDEX[name]]
    return turn @ rest / np.linalg.norm(rest)


def test_the_zero_pose_of_the_file_is_kept(tmp_path: Path) -> None:
    motion = load(tmp_path / "a.bvh", bvh_text([{}]))
    assert bone(motion, "left_shoulder") == pytest.approx([0, -1, 0], abs=1e-9)
    assert bone(motion, "right_elbow") == pytest.approx([0, -1, 0], abs=1e-9)
    spread = np.array([12, -38, 0]) / np.hypot(12, 38)
    assert bone(motion, "left_hip") == pytest.approx(spread, abs=1e-6)
    assert bone(motion, "left_knee") == pytest.approx([0, -1, 0], abs=1e-6)


@pytest.mark.parametrize("order", ORDERS)
def test_channels_turn_in_the_files_order(tmp_path: Path, order: str) -> None:
    angles = (20.0, -35.0, 50.0)
    motion = load(tmp_path / "a.bvh", bvh_text([{"LeftArm": angles}], order))
    turn = np.eye(3)
    for channel, angle in zip(order.split(), angles, strict=True):
        turn = turn @ about("XYZ".index(channel[0]), np.radians(angle))
    assert bone(motion, "left_shoulder") == pytest.approx(turn @ [0, -1, 0], abs=1e-6)


@given(st.tuples(*[st.floats(-180, 180)] * 3), st.tuples(*[st.floats(-180, 180)] * 3))
@settings(max_examples=25)
def test_limbs_point_where_the_recorded_limbs_point(
    tmp_path_factory: pytest.TempPathFactory, shoulder: tuple[float, ...], elbow: tuple[float, ...]
) -> None:
    path = tmp_path_factory.mktemp("bvh") / "a.bvh"
    motion = load(path, bvh_text([{}, {"LeftArm": shoulder, "LeftForeArm": elbow}]))  # type: ignore[dict-item]
    bvh = load_bvh(path)
    _, places = bvh.forward()
    index = {joint.name: k for k, joint in enumerate(bvh.joints)}
    for name, start, end in (("left_shoulder", "LeftArm", "LeftForeArm"), ("left_elbow", "LeftForeArm", "LeftHand")):
        recorded = places[1, index[end]] - places[1, index[start]]
        assert bone(motion, name, 1) == pytest.approx(recorded / np.linalg.norm(recorded), abs=1e-6)


@pytest.mark.parametrize(("scale", "note"), [(1.0, "cm"), (0.01, "m"), (1 / 2.54, "in"), (0.01 / 0.056444, "cmu")])
def test_units_are_told_by_the_legs(tmp_path: Path, scale: float, note: str) -> None:
    motion = load(tmp_path / "a.bvh", bvh_text([{}], scale=scale))
    assert f"units: {note}, by the length of the legs (leg of 0.82 m)" in motion.notes
    assert motion.translation[0, 1] == pytest.approx(0.92 + 0.0077, abs=2e-3)  # hips, and the avatar's pelvis over them


def test_given_units_are_taken(tmp_path: Path) -> None:
    motion = load(tmp_path / "a.bvh", bvh_text([{}]), units="m")
    assert "units: m, as given (leg of 81.85 m)" in motion.notes


def test_a_prefix_is_no_part_of_a_name(tmp_path: Path) -> None:
    motion = load(tmp_path / "a.bvh", bvh_text([{}], prefix="mixamorig:"))
    assert any("named as in Mixamo" in note for note in motion.notes)


def test_names_are_of_joints_that_exist() -> None:
    for table in DIALECTS.values():
        assert set(table.values()) <= set(JOINT_NAMES)
        assert all(plain(name) == name for name in table)


BROKEN = {
    "Frames: 1": ("Frames: 9", "1 frames, then the end"),
    "HIERARCHY": ("HIERARCHIE", "'HIERARCHIE'"),
    "MOTION": ("", "a line MOTION"),
    "Frame Time: 0.0333333": ("Frame Time: 0", "0 s a frame"),
    "Frames: ": ("Frame: ", "`FRAMES: NUMBER`"),
    "OFFSET 0.000000 10.000000 0.000000": ("OFFSET 0.0 nan 0.0", "'nan'"),
    "CHANNELS 3 Zrotation": ("CHANNELS 3 Wrotation", "'Wrotation'"),
    "LeftUpLeg": ("Tail", "none is left_hip"),
    "95 0 0": ("95 0 zero", "could not convert"),
    "OFFSET 9.000000 -3.000000": ("OFFSET -9.000000 -3.000000", "hips in one place"),
    "0 95 0 0": ("0 95 0", "one for each channel"),
}


@pytest.mark.parametrize("part", BROKEN)
def test_broken_files_are_named_by_line(tmp_path: Path, part: str) -> None:
    text = bvh_text([{}])
    assert part in text
    replacement, found = BROKEN[part]
    with pytest.raises(BadInputError) as raised:
        load(tmp_path / "a.bvh", text.replace(part, replacement, 1))
    assert found in str(raised.value)
    assert "a.bvh" in str(raised.value)


@pytest.mark.parametrize("value", ["nan", "inf", "1e300"])
def test_a_frame_of_wild_numbers_is_left_out(tmp_path: Path, value: str) -> None:
    lines = bvh_text([{}, {}, {}, {}]).splitlines()
    lines[-2] = " ".join([value] * len(lines[-2].split()))
    motion = load(tmp_path / "a.bvh", "\n".join(lines))
    assert len(motion.times_s) == 3
    assert any("1 samples not finite" in note for note in motion.notes)


@given(st.integers(0, 2600))
@settings(max_examples=40)
def test_a_file_cut_anywhere_is_refused_or_read(tmp_path_factory: pytest.TempPathFactory, length: int) -> None:
    text = bvh_text([{}])[:length]
    path = tmp_path_factory.mktemp("cut") / "a.bvh"
    try:
        load(path, text)
    except BadInputError as error:
        assert "a.bvh" in str(error)


def test_the_jumping_jacks_jump_with_arms_and_legs(shared_data: Path) -> None:
    spec = AvatarSpec(motion=str(shared_data / "motion" / "cmu_jumping_jacks.bvh"))
    motion = load_motion(spec, Path("/"))
    assert "units: cmu, by the length of the legs (leg of 0.85 m)" in motion.notes
    hands = np.array([[bone(motion, f"{side}_shoulder", k)[1] for side in ("left", "right")] for k in range(125)])
    assert hands.max() > 0.4
    assert hands.min() < -0.85
    assert np.abs(hands[:, 0] - hands[:, 1]).max() < 0.5
    assert np.ptp(motion.translation[:, 1]) > 0.15
