"""BVH: channels in the file's order, turns worked out by hand, and what is wrong named by its line."""

from __future__ import annotations

import itertools
from pathlib import Path

import numpy as np
import pytest

from trilane.body.joints import JOINT_INDEX, JOINT_PARENTS
from trilane.errors import BadInputError
from trilane.scene.motion import bvh as bvh_module
from trilane.scene.motion.bvh import load_bvh
from trilane.scene.motion.files import load_motion
from trilane.scene.motion.motion import T_POSE, Motion
from trilane.scene.rotations import matrix_from_rotvec
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


def test_given_units_are_taken(tmp_path: Path) -> None:
    motion = load(tmp_path / "a.bvh", bvh_text([{}]), units="m")
    assert "units: m, as given (leg of 81.85 m)" in motion.notes


@pytest.mark.parametrize("value", ["nan", "inf", "1e300"])
def test_a_frame_of_wild_numbers_is_left_out(tmp_path: Path, value: str) -> None:
    lines = bvh_text([{}, {}, {}, {}]).splitlines()
    lines[-2] = " ".join([value] * len(lines[-2].split()))
    motion = load(tmp_path / "a.bvh", "\n".join(lines))
    assert len(motion.times_s) == 3
    assert any("1 samples not finite" in note for note in motion.notes)


def test_the_jumping_jacks_jump_with_arms_and_legs(shared_data: Path) -> None:
    spec = AvatarSpec(motion=str(shared_data / "motion" / "cmu_jumping_jacks.bvh"))
    motion = load_motion(spec, Path("/"))
    assert "units: cmu, by the length of the legs (leg of 0.85 m)" in motion.notes
    hands = np.array([[bone(motion, f"{side}_shoulder", k)[1] for side in ("left", "right")] for k in range(125)])
    assert hands.max() > 0.4
    assert hands.min() < -0.85
    assert np.abs(hands[:, 0] - hands[:, 1]).max() < 0.5
    assert np.ptp(motion.translation[:, 1]) > 0.15


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
