"""A BVH on the body, by value: limbs against a second chain of joints."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from trilane.body.joints import JOINT_INDEX, JOINT_NAMES
from trilane.errors import BadInputError
from trilane.scene.motion.bvh_retarget import load_retargeted
from trilane.scene.motion.motion import T_POSE
from trilane.scene.motion.recorded import RawMotion


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


def test_joints_of_the_body_without_a_partner_are_named(tmp_path: Path) -> None:
    text = text_of([{}]).replace("JOINT left_elbow", "JOINT bone_7").replace("JOINT spine2", "JOINT bone_8")
    assert recorded(tmp_path / "a.bvh", text).notes[3] == (
        "spine2, left_elbow: no partner, so they follow their parents; `joint_map` of the avatar names partners"
    )
