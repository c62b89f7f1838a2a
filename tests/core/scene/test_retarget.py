"""Recorded joints on the avatar: turns from directions by hand, and limbs against a second chain of joints."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from trilane.body.joints import JOINT_INDEX, JOINT_NAMES, JOINT_PARENTS
from trilane.errors import BadInputError
from trilane.scene.motion.bvh import load_retargeted
from trilane.scene.motion.motion import T_POSE, RawMotion
from trilane.scene.motion.retarget import retarget
from trilane.scene.motion.tracks import (
    Tracks,
    angle_between,
    frames_along,
    hinge,
    least_turns,
    level_with,
    limb_turns,
    mean_turn,
    unit,
)
from trilane.scene.rotations import about, matrix_from_rotvec

REST = {name: T_POSE[index] for name, index in JOINT_INDEX.items()}


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
    said = f"feet: {abs(degrees)}° {word} than the avatar's where they are planted, so they are laid flat there"
    assert any(said in note for note in notes) == bool(degrees)
    assert angle_deg(turn_of(poses, "left_ankle"), 0) == pytest.approx({0: 3, 27: 14}.get(degrees, 0), abs=1)


@pytest.mark.parametrize("side", ["left", "right"])
def test_the_foot_whose_toes_are_lower_tells_no_slope_and_is_laid_flat_too(side: str) -> None:
    """Both ankles are as high, so the toes of a foot that is turned down by 20 degrees are below the floor."""
    places = steep_feet(posed(), 0.08)
    foot = places[f"{side}_foot"] - places[f"{side}_ankle"]
    places[f"{side}_foot"] = places[f"{side}_ankle"] + foot @ about(0, np.radians(20)).T
    poses, notes = without_turns(places)
    assert any("feet: 23° steeper" in note for note in notes)
    for each in ("left", "right"):
        assert angle_deg(turn_of(poses, f"{each}_ankle"), 0) == pytest.approx(0, abs=1)


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


X, Y, Z = np.eye(3)


def test_frames_are_rotations_with_one_direction_exact() -> None:
    left, up = np.array([[2.0, 0, 0], [0, 0, -3], [0, 0, -1]]), np.array([[1.0, 5, 0], [0, 1, 0], [0, 0, 4]])
    for first, exact, other in (("left", left, up), ("up", up, left)):
        frames = frames_along(exact, other, first)
        assert np.linalg.det(frames) == pytest.approx(1)
        assert frames @ np.swapaxes(frames, 1, 2) == pytest.approx(np.tile(np.eye(3), (3, 1, 1)))
        assert frames[:, :, 0 if first == "left" else 1] == pytest.approx(unit(exact))
        assert (np.einsum("ta,ta->t", frames[:2, :, 1 if first == "left" else 0], other[:2]) > 0).all()
    assert frames_along(left, up, "left")[1] == pytest.approx(np.stack([-Z, Y, np.cross(-Z, Y)], axis=1))


def test_the_least_turn_between_any_two_directions() -> None:
    """Its angle is the one between them and its axis is perpendicular to both, also for opposite ones."""
    random = np.random.default_rng(3)
    a, b = random.normal(size=(2, 50, 3))
    b[0], b[1], b[2] = 3 * a[0], -a[1], -a[2] + 1e-9
    turns = least_turns(a, b)
    assert np.linalg.det(turns) == pytest.approx(1)
    assert (turns @ unit(a)[..., None])[..., 0] == pytest.approx(unit(b), abs=1e-7)
    cosines = (np.trace(turns, axis1=1, axis2=2) - 1) / 2
    assert np.arccos(np.clip(cosines, -1, 1)) == pytest.approx(angle_between(a, b), abs=1e-6)
    assert least_turns(np.zeros((1, 3)), X[None]) == pytest.approx(np.eye(3)[None])


def test_a_mean_of_turns_is_in_their_middle() -> None:
    assert mean_turn(about(1, np.radians([10.0, 30.0, 50.0]))) == pytest.approx(about(1, np.radians(30)))
    base, turns = about(0, np.array([0.3, 0.9, 2.0])), about(0, np.array([0.3, 0.9, 2.0])) @ about(2, 1.1)
    turns[2] = turns[2] @ about(1, 0.7)
    levelled = level_with(turns, base, np.array([True, True, False]))
    assert levelled[:2] == pytest.approx(base[:2])
    assert levelled[2] == pytest.approx(base[2] @ about(2, 1.1) @ about(1, 0.7) @ about(2, -1.1))


def test_a_hinge_counts_from_15_degrees_on() -> None:
    for degrees, length in ((14.0, 0.0), (-14.0, 0.0), (30.0, 0.5 - math.sin(math.radians(15))), (90.0, None)):
        lower = [math.cos(math.radians(degrees)), math.sin(math.radians(degrees)), 0]
        axis = hinge(np.array([[7.0, 0, 0]]), 2 * np.array([lower]))[0]
        assert axis == pytest.approx((1 - math.sin(math.radians(15)) if length is None else length) * Z)


@pytest.mark.parametrize("twist", [0.0, 1.0, 3.0, -2.0])
def test_a_limb_twists_as_its_carrier_up_to_a_constant(twist: float) -> None:
    """The carrier turns about the bone by 0, 0.4 and 0.8 rad; a bend about Z in the first frame tells the zero."""
    turns = about(0, np.array([0.0, 0.4, 0.8]))
    carrier = turns @ about(0, twist) @ about(1, 0.5)  # whose bone is where X is before the last turn
    bones = np.tile(X, (3, 1))
    axes = np.array([Z, 0 * Z, 0 * Z])
    found = limb_turns(Y, bones, carrier, [(X, axes)])
    assert (found @ Y) == pytest.approx(bones)
    assert found[0] @ X == pytest.approx(Z)
    assert found == pytest.approx(turns @ found[0])
    free = limb_turns(Y, bones, carrier, [])
    assert (free @ Y) == pytest.approx(bones)


def axis_turn(axis: str, degrees: float) -> np.ndarray:
    """Rotation matrix by cosine and sine, apart from the project's own."""
    c, s = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    i, j = {"X": (1, 2), "Y": (2, 0), "Z": (0, 1)}[axis]
    matrix = np.eye(3)
    matrix[i, i] = matrix[j, j] = c
    matrix[i, j], matrix[j, i] = -s, s
    return matrix


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
    path.write_text(text)
    return load_retargeted(path, units)


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
INDEX = {name: k for k, name in enumerate(JOINT_NAMES[:22])} | FINGER_INDEX


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
        "skeleton: not built like the avatar's; how trunk and shoulders stand at rest comes from the straightest legs, "
        "3 of 3 frames",
        "head: as the file turns it, straight ahead on average",
        "betas: none in the format",
    )
    assert recorded(tmp_path / "a.bvh", text_of([{}]), "in").leg_m == pytest.approx((left + right) / 2 * 0.0254)


def test_a_skeleton_that_faces_elsewhere_is_turned_as_a_whole(tmp_path: Path) -> None:
    """The zero pose faces +X, or lies in a Z-up world: pelvis and limbs take the same turn."""
    upright = recorded(tmp_path / "a.bvh", text_of([{}]))
    for world in (axis_turn("Y", 90), axis_turn("X", 90), axis_turn("Z", 90), axis_turn("X", 90) @ axis_turn("Y", 90)):
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
