"""One motion, written as BVH in many ways, is the same body; recordings of others against a chain of joints."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from trilane.body.body import ShapedBody
from trilane.body.joints import JOINT_INDEX, JOINT_NAMES, JOINT_PARENTS, Skeleton
from trilane.body.skinning import CpuSkinner
from trilane.scene.motion.builtin import BUILTIN
from trilane.scene.motion.files import load_motion
from trilane.scene.motion.joint_names import DIALECTS
from trilane.scene.motion.motion import Motion
from trilane.scene.mover import make_mover
from trilane.scene.schema import AvatarSpec

BODY = JOINT_NAMES[:22]
#: What must stay within a degree: limbs, and the lines of pelvis, trunk and shoulders.
LIMBS = [
    (f"{side}_{start}", f"{side}_{end}")
    for side in ("left", "right")
    for start, end in (
        ("hip", "knee"), ("knee", "ankle"), ("ankle", "foot"), ("shoulder", "elbow"), ("elbow", "wrist"),
    )
]  # fmt: skip
LINES = [*LIMBS, ("right_hip", "left_hip"), ("pelvis", "neck"), ("right_shoulder", "left_shoulder"), ("neck", "head")]
#: Degrees and metres that the issue allows.
MOST_DEG, MOST_M = 1.0, 0.005
UNITS_M = (1.0, 0.01, 0.0254, 0.0254 / 0.45, 0.017)
FRAMES_S = np.linspace(0.2, 9.7, 7)
#: Ends of the limbs that no joint of the body stands for, from the joint, metres.
TIPS = {
    "head": (0, 0.18, 0.02),
    "left_wrist": (0.11, 0, 0),
    "right_wrist": (-0.11, 0, 0),
    "left_foot": (0, -0.01, 0.06),
}


@dataclass(frozen=True)
class Style:
    """How a file is written. `bent`: whether bones lie in random directions at zero."""

    seed: int
    bent: bool = True
    axes: bool = True
    family: str = "SMPL-X"
    extra: bool = True


def random_turn(random: np.random.Generator) -> np.ndarray:
    """A rotation matrix, all equally likely."""
    q, r = np.linalg.qr(random.normal(size=(3, 3)))
    q = q * np.sign(np.diag(r))
    return np.asarray(q * np.linalg.det(q))


def rodrigues(v: np.ndarray) -> np.ndarray:
    """Rotation matrices (..., 3, 3) of axis-angle vectors."""
    angle = np.linalg.norm(v, axis=-1)[..., None, None]
    a = v / np.maximum(angle[..., 0], 1e-12)
    zero = np.zeros(a.shape[:-1])
    rows = [[zero, -a[..., 2], a[..., 1]], [a[..., 2], zero, -a[..., 0]], [-a[..., 1], a[..., 0], zero]]
    cross = np.moveaxis(np.array(rows), (0, 1), (-2, -1))
    return np.asarray(np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross)


def chain(poses: np.ndarray, pelvis: np.ndarray, rest: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Global turns (T, 55, 3, 3) and places (T, 55, 3) of the joints."""
    local = rodrigues(poses)
    turns, places = local.copy(), np.empty((*poses.shape[:2], 3))
    places[:, 0] = pelvis
    for joint, parent in enumerate(JOINT_PARENTS[1:], 1):
        turns[:, joint] = turns[:, parent] @ local[:, joint]
        places[:, joint] = places[:, parent] + turns[:, parent] @ (rest[joint] - rest[parent])
    return turns, places


def euler(turn: np.ndarray, order: str) -> np.ndarray:
    """Degrees of turns about the axes of `order`, one after the other, of a matrix (3, 3)."""
    i, j, k = ("XYZ".index(axis) for axis in order)
    sign = 1.0 if (j - i) % 3 == 1 else -1.0
    second = np.arctan2(sign * turn[i, k], np.hypot(turn[i, i], turn[i, j]))
    first = np.arctan2(-sign * turn[j, k], turn[k, k])
    third = np.arctan2(-sign * turn[i, j], turn[i, i])
    return np.degrees([first, second, third])


@dataclass
class Node:
    """A joint of the file: its turns (T, 3, 3) and places (T, 3) in the world, and what hangs from it."""

    name: str
    turns: np.ndarray
    places: np.ndarray
    children: list[Node]
    tip: np.ndarray | None = None


def tree(style: Style, turns: np.ndarray, places: np.ndarray, random: np.random.Generator) -> Node:
    """The tree of joints, in random order, with the names of the family."""
    names: dict[str, str] = {}
    for theirs, ours in DIALECTS[style.family].items():
        names.setdefault(ours, theirs)
    nodes: dict[str, Node] = {}
    for index, name in enumerate(BODY):
        if name not in names:
            continue
        zero = random_turn(random) if style.bent else np.eye(3)
        node = Node(names[name], turns[:, index] @ zero, places[:, index], [])
        nodes[name] = node
        above = JOINT_PARENTS[index]
        while above >= 0 and JOINT_NAMES[above] not in nodes:
            above = JOINT_PARENTS[above]
        if above >= 0:
            _hang(nodes[JOINT_NAMES[above]], node, style, random)
        tip = TIPS.get(name.replace("right_foot", "left_foot"))
        if tip is not None:
            node.tip = places[:, index] + turns[:, index] @ np.array(tip)
    return nodes["pelvis"]


def _hang(parent: Node, node: Node, style: Style, random: np.random.Generator) -> None:
    """`node` below `parent`, with a joint between them at times, which turns about the bone as it likes."""
    if style.extra and random.random() < 0.3:
        bone = node.places - parent.places
        axis = bone / np.linalg.norm(bone, axis=-1, keepdims=True)
        twist = rodrigues(axis * random.uniform(-1, 1, (len(axis), 1)))
        between = Node(f"helper{random.integers(10**6)}", twist @ parent.turns, parent.places + 0.4 * bone, [])
        parent.children.append(between)
        parent = between
    parent.children.insert(random.integers(len(parent.children) + 1), node)


def written(style: Style, poses: np.ndarray, pelvis: np.ndarray, rest: np.ndarray) -> str:
    """The text of a BVH file."""
    random = np.random.default_rng(style.seed)
    turns, places = chain(poses, pelvis, rest)
    unit_m = float(random.choice(UNITS_M))
    world = _axes(style, random)
    root = tree(style, world @ turns, places @ world.T, random)
    lines, columns = ["HIERARCHY"], []

    def write(node: Node, parent: Node | None) -> None:
        above, start = (parent.turns, parent.places) if parent else (np.broadcast_to(np.eye(3), node.turns.shape), 0.0)
        offset = np.swapaxes(above, 1, 2) @ (node.places - start)[..., None]
        order = "".join(random.permutation(list("XYZ")))
        local = np.swapaxes(above, 1, 2) @ node.turns
        place = offset[0, :, 0] / unit_m
        lines.append(f"{'JOINT' if parent else 'ROOT'} {node.name}\n{{\nOFFSET " + " ".join(f"{x:.9f}" for x in place))
        angles = np.array([euler(turn, order) for turn in local])
        channels = [f"{axis}rotation" for axis in order]
        if not parent:
            channels = ["Xposition", "Yposition", "Zposition", *channels]
            columns.append(node.places / unit_m)
        columns.append(angles)
        lines.append(f"CHANNELS {len(channels)} {' '.join(channels)}")
        for child in node.children:
            write(child, node)
        if node.tip is not None:
            tip = np.swapaxes(node.turns, 1, 2)[0] @ (node.tip - node.places)[0] / unit_m
            lines.append("End Site\n{\nOFFSET " + " ".join(f"{x:.9f}" for x in tip) + "\n}")
        lines.append("}")

    write(root, None)
    table = np.concatenate(columns, axis=1)
    rows = [" ".join(f"{value:.9g}" for value in row) for row in table]
    return "\n".join([*lines, "MOTION", f"Frames: {len(rows)}", "Frame Time: 0.1", *rows, ""])


def _axes(style: Style, random: np.random.Generator) -> np.ndarray:
    """The world's axes: Y or Z up, either way, and any heading."""
    if not style.axes:
        return np.eye(3)
    heading = rodrigues(np.array([0, random.uniform(-np.pi, np.pi), 0]))
    up = rodrigues(np.array([random.choice([0, np.pi / 2, np.pi, -np.pi / 2]), 0, 0]))
    return np.asarray(up @ heading)


def the_motion() -> tuple[np.ndarray, np.ndarray]:
    """Some frames of a walk with a wave and a turn: poses (T, 55, 3) and places of the pelvis (T, 3)."""
    return BUILTIN["walk-wave-turn"]().sample_all(FRAMES_S)


@dataclass(frozen=True)
class Seen:
    """Of a body over time: directions of LINES (n, T, 3), and its lowest vertex under the pelvis (T,)."""

    lines: np.ndarray
    lowest: np.ndarray


def seen(poses: np.ndarray, pelvis: np.ndarray, body: ShapedBody) -> Seen:
    """From places of joints by the chain of this test, turned to where the pelvis faces at first."""
    turns, places = chain(poses, pelvis, body.joints)
    x, _, z = turns[0, 0, :, 2]
    back = rodrigues(np.array([0, -np.arctan2(x, z), 0]))
    bones = np.array([places[:, JOINT_INDEX[end]] - places[:, JOINT_INDEX[start]] for start, end in LINES]) @ back.T
    posed, skinner = Skeleton(body.joints, body.body.parents), CpuSkinner(body, 4, pose_blend=False)
    lowest = [
        float(skinner.vertices(posed.pose(pose, place - body.joints[0]))[:, 1].min()) - place[1]
        for pose, place in zip(poses, pelvis, strict=True)
    ]
    return Seen(bones / np.linalg.norm(bones, axis=-1, keepdims=True), np.array(lowest))


def load(path: Path, text: str, body: ShapedBody) -> Motion:
    path.write_text(text)
    return load_motion(AvatarSpec(motion=str(path)), Path("/"), body.joints)


def same_body(style: Style, motion: Motion, body: ShapedBody, truth: Seen) -> None:
    """`motion` shows the body `truth`."""
    found = seen(motion.poses, motion.translation, body)
    off = np.degrees(np.arccos(np.clip((found.lines * truth.lines).sum(axis=-1), -1, 1))).max(axis=1)
    assert off.max() < MOST_DEG, (style, dict(zip(LINES, off.round(2), strict=True)))
    assert np.abs(found.lowest - truth.lowest).max() < MOST_M, (style, found.lowest - truth.lowest)


@pytest.fixture(scope="module")
def truth(body: ShapedBody) -> Seen:
    return seen(*the_motion(), body)


def in_families(count: int) -> list[Style]:
    """Random styles; each family of names in turn."""
    return [Style(seed, family=list(DIALECTS)[seed % len(DIALECTS)]) for seed in range(count)]


@pytest.mark.parametrize("style", in_families(len(DIALECTS)), ids=lambda style: style.family)
def test_the_same_body_whatever_the_file_is_like(tmp_path: Path, body: ShapedBody, truth: Seen, style: Style) -> None:
    same_body(style, load(tmp_path / "a.bvh", written(style, *the_motion(), body.joints), body), body, truth)


@pytest.mark.slow
def test_three_hundred_files_of_the_same_body(tmp_path: Path, body: ShapedBody, truth: Seen) -> None:
    for style in in_families(300):
        same_body(style, load(tmp_path / "a.bvh", written(style, *the_motion(), body.joints), body), body, truth)


def another_build(rest: np.ndarray, in_neck: bool) -> np.ndarray:
    """Rest joints (55, 3) as another program places them: deeper, higher, steep feet, collars in the neck."""
    other = rest * 0.93
    moved = {
        "pelvis": (0, 0.05, -0.04), "spine1": (0, 0.01, 0.03), "spine2": (0, -0.02, 0.03), "spine3": (0, 0.03, 0.04),
        "neck": (0, -0.02, -0.02), "head": (0, 0.01, -0.05),
    }  # fmt: skip
    for name, by in moved.items():
        other[JOINT_INDEX[name]] += by
    for side in ("left", "right"):
        if in_neck:
            other[JOINT_INDEX[f"{side}_collar"]] = other[JOINT_INDEX["neck"]]
        other[JOINT_INDEX[f"{side}_ankle"]] += (0, 0.05, 0)
    return np.asarray(other)


@pytest.mark.parametrize("seed", range(3))
def test_a_skeleton_of_another_build_is_the_same_body_too(tmp_path: Path, body: ShapedBody, seed: int) -> None:
    """The plainest file of it, which has the T pose at zero, says what the others must be; limbs are as recorded."""
    poses, pelvis = the_motion()
    rest = another_build(body.joints, in_neck=seed < 2)
    plain = Style(seed, bent=False, axes=False, extra=False)
    first = load(tmp_path / "a.bvh", written(plain, poses, pelvis, rest), body)
    said = seen(first.poses, first.translation, body)
    other = load(tmp_path / "b.bvh", written(Style(seed + 50), poses, pelvis, rest), body)
    same_body(Style(seed + 50), other, body, said)
    _, places = chain(poses, pelvis, rest)
    exact = [line for line in LINES if "ankle" not in line[0]]
    bones = np.array([places[:, JOINT_INDEX[end]] - places[:, JOINT_INDEX[start]] for start, end in exact])
    ours = np.array([said.lines[LINES.index(line)] for line in exact])
    cosines = (bones * ours).sum(axis=-1) / np.linalg.norm(bones, axis=-1)
    assert np.degrees(np.arccos(np.clip(cosines, -1, 1))).max() < MOST_DEG
    assert any("steeper than the avatar's where they are planted" in note for note in first.notes)


def test_frames_of_a_t_pose_before_the_motion_are_left_out(tmp_path: Path, body: ShapedBody, truth: Seen) -> None:
    poses, pelvis = the_motion()
    lead = np.concatenate([np.zeros((3, 55, 3)), poses]), np.concatenate([np.zeros((3, 3)), pelvis])
    motion = load(tmp_path / "a.bvh", written(Style(5), *lead, body.joints), body)
    assert "a T pose before the motion, which jumps away from it: left out, 3 of the frames" in motion.notes
    same_body(Style(5), motion, body, truth)
    slow = np.linspace(0, 1, 12)[:, None, None] * poses[0]  # a T pose that becomes the first pose is part of the motion
    whole = np.concatenate([slow, poses]), np.concatenate([np.repeat(pelvis[:1], 12, axis=0), pelvis])
    motion = load(tmp_path / "b.bvh", written(Style(5), *whole, body.joints), body)
    assert len(motion.times_s) == 12 + len(poses)
    assert "begins in a T pose and moves on from it; `start_s` leaves it out" in motion.notes


@pytest.mark.parametrize("first", [True, False])
def test_of_two_roots_the_person_with_more_joints_is_shown(
    tmp_path: Path, body: ShapedBody, truth: Seen, first: bool
) -> None:
    """Who stands in a T pose beside is of a family with fewer joints."""
    poses, pelvis = the_motion()
    texts = [written(Style(1), poses, pelvis, body.joints)]
    texts.append(written(Style(2, family="Poser and Daz"), poses * 0, pelvis, body.joints))
    heads, tails = zip(*(text.split("MOTION\n") for text in texts[:: 1 if first else -1]), strict=True)
    rows = [" ".join(both) for both in zip(*(tail.splitlines()[2:] for tail in tails), strict=True)]
    both = heads[0] + heads[1].removeprefix("HIERARCHY\n") + "\n".join(["MOTION", *tails[0].splitlines()[:2], *rows])
    motion = load(tmp_path / "a.bvh", both, body)
    assert "2 ROOTs: the person of pelvis is shown, not hip" in motion.notes
    same_body(Style(1), motion, body, truth)


def test_a_forearm_without_a_hand_points_to_its_end(tmp_path: Path, body: ShapedBody, truth: Seen) -> None:
    """The wrists have no partner; the bone of the forearm ends where the file's next joint is, of whatever name."""
    path = tmp_path / "a.bvh"
    path.write_text(written(Style(7, extra=False), *the_motion(), body.joints))
    spec = AvatarSpec(motion=str(path), joint_map={"left_wrist": "", "right_wrist": ""})
    motion = load_motion(spec, Path("/"), body.joints)
    found = seen(motion.poses, motion.translation, body).lines
    arms = [k for k, line in enumerate(LINES) if line[0].endswith(("shoulder", "elbow"))]
    cosines = (found[arms] * truth.lines[arms]).sum(axis=-1)
    assert np.degrees(np.arccos(np.clip(cosines, -1, 1))).max() < MOST_DEG


@pytest.mark.parametrize("axis", ["x", "-x", "y", "-y", "z", "-z"])
def test_an_axis_that_the_scene_states_is_up(tmp_path: Path, body: ShapedBody, truth: Seen, axis: str) -> None:
    """Along X a body is taken to lie, unless the scene says that it stands."""
    poses, pelvis = the_motion()
    up = np.eye(3)["xyz".index(axis[-1])] * (-1 if axis[0] == "-" else 1)
    beside = np.roll(up, 1)
    world = np.stack([np.cross(up, beside), up, beside], axis=1)
    turns = poses.copy()
    turns[:, 0] = [logarithm(world @ turn) for turn in rodrigues(poses[:, 0])]
    path = tmp_path / "a.bvh"
    path.write_text(written(Style(3, axes=False), turns, pelvis @ world.T, body.joints))
    same_body(Style(3), load_motion(AvatarSpec(motion=str(path), up_axis=axis), Path("/"), body.joints), body, truth)


def logarithm(turn: np.ndarray) -> np.ndarray:
    """The axis-angle vector of a rotation matrix, by its eigenvector of 1."""
    values, vectors = np.linalg.eig(turn)
    axis = np.real(vectors[:, np.abs(values - 1).argmin()])
    sine = np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]]) @ axis / 2
    return np.asarray(axis * np.arctan2(sine, (np.trace(turn) - 1) / 2))


RECORDED_LINES = [("right_hip", "left_hip"), ("right_shoulder", "left_shoulder"), ("pelvis", "neck"), ("neck", "head")]
#: A toe stands that is slower and less above the floor of the recording; metres a second, metres.
SLOW_M_S, LOW_M = 0.15, 0.03
FEET = ("left_foot", "right_foot", "left_ankle", "right_ankle")


def axis_turn(axis: str, degrees: np.ndarray) -> np.ndarray:
    c, s, zero, one = np.cos(np.radians(degrees)), np.sin(np.radians(degrees)), 0 * degrees, 1 + 0 * degrees
    rows = {
        "X": [[one, zero, zero], [zero, c, -s], [zero, s, c]],
        "Y": [[c, zero, s], [zero, one, zero], [-s, zero, c]],
        "Z": [[c, -s, zero], [s, c, zero], [zero, zero, one]],
    }
    return np.moveaxis(np.array(rows[axis]), -1, 0)


def places_in(path: Path) -> dict[str, np.ndarray]:
    """Places (T, 3) of the joints of a file, from its words alone."""
    head, _, tail = path.read_text().partition("MOTION")
    rows = np.array([line.split() for line in tail.strip().splitlines()[2:]], dtype=float)
    found: dict[str, np.ndarray] = {}
    stack: list[tuple[np.ndarray, np.ndarray]] = [(np.tile(np.eye(3), (len(rows), 1, 1)), np.zeros((len(rows), 3)))]
    words, column, name = iter(head.split()), 0, ""
    for word in words:
        if word in ("ROOT", "JOINT", "End"):
            name = next(words)
        elif word == "OFFSET":
            turn, place = stack[-1]
            offset = np.array([float(next(words)) for _ in range(3)])
            stack.append((turn, place + turn @ offset))
            found.setdefault(name, stack[-1][1])
        elif word == "CHANNELS":
            turn, place = stack[-1]
            for _ in range(int(next(words))):
                kind = next(words)
                if kind.endswith("rotation"):
                    turn = turn @ axis_turn(kind[0], rows[:, column])
                else:
                    place = place.copy()
                    place[:, "XYZ".index(kind[0])] = rows[:, column]
                column += 1
            stack[-1] = turn, place
            found[name] = place
        elif word == "}":
            stack.pop()
    return found


def places_of(motion: Motion, body: ShapedBody) -> np.ndarray:
    """Places (55, T, 3) of the body's joints, from the pelvis."""
    _, places = chain(motion.poses, np.zeros((len(motion.poses), 3)), body.joints)
    return places.swapaxes(0, 1)


def recordings(shared_data: Path) -> list[Path]:
    found = sorted((shared_data / "motion").glob("*.bvh"))
    assert found
    return found


def test_limbs_and_lines_are_the_recorded_ones(shared_data: Path, body: ShapedBody) -> None:
    for path in recordings(shared_data):
        theirs = places_in(path)
        motion = load_motion(AvatarSpec(motion=str(path)), Path("/"), body.joints)
        ours, names = places_of(motion, body), motion.detected.joints
        pairs = [pair for pair in LIMBS + RECORDED_LINES if set(pair) <= set(names)]
        assert len(pairs) >= 12
        recorded = np.array([theirs[names[end]] - theirs[names[start]] for start, end in pairs])
        recorded = recorded[:, -len(motion.poses) :]
        found = np.array([ours[JOINT_INDEX[end]] - ours[JOINT_INDEX[start]] for start, end in pairs])
        recorded /= np.linalg.norm(recorded, axis=-1, keepdims=True)
        found /= np.linalg.norm(found, axis=-1, keepdims=True)
        flat = recorded.reshape(-1, 3), found.reshape(-1, 3)  # the heading is what brings both together at best
        heading = np.arctan2(
            (flat[1][:, 0] * flat[0][:, 2] - flat[1][:, 2] * flat[0][:, 0]).sum(),
            (flat[1][:, 0] * flat[0][:, 0] + flat[1][:, 2] * flat[0][:, 2]).sum(),
        )
        turned = recorded @ axis_turn("Y", np.degrees([heading]))[0].T
        off = np.degrees(np.arccos(np.clip((turned * found).sum(axis=-1), -1, 1))).mean(axis=1)
        assert off.max() <= 1, (path.name, dict(zip(pairs, off.round(2), strict=True)))


def test_feet_that_stand_are_on_the_floor(shared_data: Path, body: ShapedBody) -> None:
    """By all vertices of the feet, in frames in which a recorded toe is slow and low."""
    skinner, skeleton = CpuSkinner(body, 4, pose_blend=False), Skeleton(body.joints, body.body.parents)
    soles = np.isin(body.body.weights.argmax(axis=1), [JOINT_INDEX[name] for name in FEET])
    for path in recordings(shared_data):
        spec = AvatarSpec(motion=str(path))
        motion = load_motion(spec, Path("/"), body.joints)
        mover = make_mover(spec, motion, body)
        theirs, names = places_in(path), motion.detected.joints
        thigh, shin = (
            np.median(np.linalg.norm(theirs[names[f"left_{end}"]] - theirs[names[f"left_{start}"]], axis=1))
            for start, end in (("hip", "knee"), ("knee", "ankle"))
        )
        toes = np.array([theirs[names[name]] for name in FEET[:2]])[:, -len(motion.poses) :]
        toes *= motion.leg_m / (thigh + shin)
        slow = np.linalg.norm(np.gradient(toes, axis=1), axis=-1) < SLOW_M_S * motion.times_s[1]
        stands = (slow & (toes[..., 1] - np.percentile(toes[..., 1], 2) < LOW_M)).any(axis=0)
        assert stands.sum() > 20
        heights = [
            skinner.vertices(skeleton.pose(*mover.sample(t_s)))[soles, 1].min() for t_s in motion.times_s[stands]
        ]
        assert np.abs(heights).max() < 0.005, path.name
