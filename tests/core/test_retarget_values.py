"""Joints placed by hand on the rest pose of the avatar: which turns follow, and what is said of what stays open."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from trilane.body.joints import JOINT_INDEX, JOINT_NAMES, JOINT_PARENTS
from trilane.scene.motion.bvh_retarget import load_retargeted
from trilane.scene.motion.motion import T_POSE
from trilane.scene.motion.retarget import retarget
from trilane.scene.motion.tracks import Tracks
from trilane.scene.rotations import about, matrix_from_rotvec

REST = {name: T_POSE[index] for name, index in JOINT_INDEX.items()}
ARMS = ("shoulder", "elbow", "wrist", "collar")


def below(name: str) -> list[str]:
    """A joint and all that hang from it."""
    found = [name]
    for joint, parent in zip(JOINT_NAMES[1:], JOINT_PARENTS[1:], strict=True):
        if JOINT_NAMES[parent] in found:
            found.append(joint)
    return found


def posed(*turned: tuple[str, np.ndarray], frames: int = 2) -> dict[str, np.ndarray]:
    """Places (T, 3): the rest pose, with joints turned about themselves, and all that hang from them."""
    places = {name: place.copy() for name, place in REST.items()}
    for joint, turn in turned:
        for name in below(joint):
            places[name] = places[joint] + turn @ (places[name] - places[joint])
    return {name: np.tile(place, (frames, 1)) for name, place in places.items()}


def turn_of(poses: np.ndarray, name: str) -> np.ndarray:
    """Global turn of a joint in the first frame."""
    turn, joint = np.eye(3), JOINT_INDEX[name]
    while joint >= 0:
        turn = matrix_from_rotvec(poses[0, joint]) @ turn
        joint = JOINT_PARENTS[joint]
    return turn


def angle_deg(turn: np.ndarray, about_axis: int) -> float:
    """How far `turn` turns about a coordinate axis; it must turn about no other."""
    expected = about(about_axis, np.arctan2(*_sine_cosine(turn, about_axis)))
    assert turn == pytest.approx(expected, abs=0.06)
    return float(np.degrees(np.arctan2(*_sine_cosine(turn, about_axis))))


def _sine_cosine(turn: np.ndarray, axis: int) -> tuple[float, float]:
    i, j = (axis + 1) % 3, (axis + 2) % 3
    return float(turn[j, i] - turn[i, j]), float(turn[i, i] + turn[j, j])


def without_turns(places: dict[str, np.ndarray]) -> tuple[np.ndarray, tuple[str, ...]]:
    poses, _, notes = retarget(Tracks(places), T_POSE)
    return poses, notes


def test_the_rest_pose_is_the_rest_pose() -> None:
    poses, notes = without_turns(posed())
    assert np.abs(poses).max() < 1e-3
    assert "skeleton: built like the avatar's" in notes


def test_the_spine_turns_from_the_hips_to_the_shoulders() -> None:
    """The left of its parts is that of hips and shoulders, mixed 2:1 and 1:2: at 60 degrees, 19.1 and 40.9."""
    poses, _ = without_turns(posed(("spine3", about(1, np.radians(60)))))
    lefts = [turn_of(poses, name)[:, 0] for name in ("pelvis", "spine1", "spine2", "spine3")]
    degrees = np.degrees([np.arctan2(-left[2], left[0]) for left in lefts])
    assert degrees == pytest.approx([0, 19.1, 40.9, 60], abs=1.0)


@pytest.mark.parametrize("side", ["left", "right"])
def test_straight_legs_are_twisted_as_their_toes(side: str) -> None:
    """The foot is turned out by 30 degrees about the shin; the least twist, which would be none, hardly counts."""
    sign = 1 if side == "left" else -1
    poses, _ = without_turns(posed((f"{side}_ankle", about(1, sign * np.radians(30)))))
    for joint in ("hip", "knee", "ankle"):
        assert angle_deg(turn_of(poses, f"{side}_{joint}"), 1) == pytest.approx(sign * 30, abs=3), joint


@pytest.mark.parametrize("side", ["left", "right"])
def test_a_hand_is_turned_as_its_fingers_lie(side: str) -> None:
    """Thumbs up: the hand is turned about the arm by 70 degrees; without the little finger the thumb tells it."""
    places = posed((f"{side}_wrist", about(0, -np.radians(70))))
    assert angle_deg(turn_of(without_turns(places)[0], f"{side}_wrist"), 0) == pytest.approx(-70, abs=3)
    fewer = {name: place for name, place in places.items() if "pinky" not in name and "index" not in name}
    assert angle_deg(turn_of(without_turns(fewer)[0], f"{side}_wrist"), 0) == pytest.approx(-70, abs=5)
    alone = {name: place for name, place in fewer.items() if "thumb" not in name}
    assert angle_deg(turn_of(without_turns(alone)[0], f"{side}_wrist"), 0) == pytest.approx(0, abs=3)


def steep_feet(places: dict[str, np.ndarray], lower_m: float) -> dict[str, np.ndarray]:
    """The ankles are higher over the toes than the avatar's, in a longer foot: shins end there."""
    for side in ("left", "right"):
        places[f"{side}_foot"] = places[f"{side}_foot"] - [0, lower_m, 0]
    return places


@pytest.mark.parametrize(("lower_m", "degrees"), [(0.08, 23), (-0.04, -15), (0.01, 0), (0.2, 27)])
def test_feet_of_another_slope_stand_on_their_soles(lower_m: float, degrees: float) -> None:
    """Toes are 49 mm below the ankle and 147 mm before it: atan(129 / 147) - atan(49 / 147) is 23 degrees.

    Where they are 249 mm below it, which is 41 degrees more, the heel is raised by 14 of them.
    """
    poses, notes = without_turns(steep_feet(posed(), lower_m))
    word = "steeper" if degrees > 0 else "flatter"
    said = f"feet: {abs(degrees)}° {word} than the avatar's where they are planted, so soles are laid on recorded soles"
    assert any(said in note for note in notes) == bool(degrees)
    assert angle_deg(turn_of(poses, "left_ankle"), 0) == pytest.approx({0: 3, 27: 14}.get(degrees, 0), abs=1)


@pytest.mark.parametrize("side", ["left", "right"])
def test_the_foot_that_stands_on_its_toes_tells_no_slope(side: str) -> None:
    places = steep_feet(posed(), 0.08)
    foot = places[f"{side}_foot"] - places[f"{side}_ankle"]
    places[f"{side}_foot"] = places[f"{side}_ankle"] + foot @ about(0, np.radians(20)).T
    poses, notes = without_turns(places)
    assert any("feet: 23° steeper" in note for note in notes)
    other = "right" if side == "left" else "left"
    assert angle_deg(turn_of(poses, f"{other}_ankle"), 0) == pytest.approx(0, abs=1)
    assert angle_deg(turn_of(poses, f"{side}_ankle"), 0) == pytest.approx(20, abs=1)


def test_feet_of_one_who_crouches_throughout_stand_on_their_soles() -> None:
    """Nobody stands, so the axis that is next to the body's up is up."""
    crouch = [(f"{side}_{joint}", about(0, np.radians(by))) for side in ("left", "right")
              for joint, by in (("hip", -70), ("knee", 100), ("ankle", -30))]  # fmt: skip
    places = posed(*crouch)
    for name in below("spine1"):
        places[name] = places[name] @ about(0, np.radians(35)).T
    places["left_shoulder"] = places["left_shoulder"] + [-0.03, 0.06, 0.02]  # the collars are as at rest, then
    poses, notes = without_turns(steep_feet(places, 0.08))
    assert any("no frame has straight legs" in note for note in notes)
    shoulders = (places["left_shoulder"] - places["right_shoulder"])[0]
    assert turn_of(poses, "spine3")[:, 0] == pytest.approx(shoulders / np.linalg.norm(shoulders), abs=1e-6)
    assert angle_deg(turn_of(poses, "left_ankle"), 0) == pytest.approx(0, abs=1)


def test_feet_that_point_backwards_are_said() -> None:
    places = posed()
    mirrored = {name: place * [1, 1, -1] for name, place in places.items()}
    assert any("feet point backwards" in note for note in without_turns(mirrored)[1])
    assert not any("feet point backwards" in note for note in without_turns(places)[1])


def test_a_joint_between_pelvis_and_thigh_may_turn(tmp_path: Path) -> None:
    """It lifts the left hip by 4 cm: the pelvis leans as the line of the hips, and the thigh stays upright."""
    lines = ["HIERARCHY"]

    def joint(name: str, parent: str, offset: np.ndarray, *inner: str) -> None:
        lines.append(f"{'JOINT' if parent else 'ROOT'} {name}\n{{\nOFFSET {' '.join(f'{x:.6f}' for x in offset)}")
        lines.append("CHANNELS 3 Xrotation Yrotation Zrotation")
        for child in inner:
            joint(child, name, REST[child] - REST[name], *children[child])
        lines.append("End Site\n{\nOFFSET 0 0 0\n}\n}") if not inner else lines.append("}")

    children: dict[str, list[str]] = {name: [] for name in JOINT_NAMES[:22]}
    for name, parent in zip(JOINT_NAMES[1:22], JOINT_PARENTS[1:22], strict=True):
        children[JOINT_NAMES[parent]].append(name)
    joint("pelvis", "", np.zeros(3), *children["pelvis"])
    text = "\n".join(lines)
    hip = text.index("JOINT left_hip")
    depth, end = 0, hip
    while not (depth == 0 and text[end] == "}"):
        depth += {"{": 1, "}": -1}.get(text[end], 0)
        end += 1
        if depth == 1 and text[end] == "}":
            depth = 0
    between = "JOINT LHipJoint\n{\nOFFSET 0 0 0\nCHANNELS 3 Zrotation Xrotation Yrotation\n"
    text = text[:hip] + between + text[hip : end + 1] + "\n}" + text[end + 1 :]
    lift = np.degrees(np.arctan2(0.04, 0.117))
    row = [0.0] * 3 + [lift] + [0.0] * 2 + [0.0, 0.0, -lift] + [0.0] * (3 * 20)
    path = tmp_path / "a.bvh"
    path.write_text(f"{text}\nMOTION\nFrames: 1\nFrame Time: 0.1\n{' '.join(map(str, row))}\n")
    raw = load_retargeted(path, "m", rest=T_POSE)
    lean = turn_of(raw.poses, "pelvis")[:, 0]
    x, y = 0.117 * np.cos(np.radians(lift)) + 0.008 * np.sin(np.radians(lift)), 0.117 * np.sin(np.radians(lift))
    y += -0.008 * np.cos(np.radians(lift)) + 0.008
    assert lean == pytest.approx(np.array([x + 0.117, y, 0]) / np.hypot(x + 0.117, y), abs=1e-6)
    assert turn_of(raw.poses, "left_hip")[:, 1] == pytest.approx([0, 1, 0], abs=0.02)
