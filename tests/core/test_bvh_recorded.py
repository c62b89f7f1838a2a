"""Recordings that nobody on the project made: limbs and feet against a chain of joints of this test alone."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from trilane.body.body import ShapedBody
from trilane.body.joints import JOINT_INDEX, JOINT_PARENTS
from trilane.body.kinematics import Skeleton
from trilane.body.skinning import CpuSkinner
from trilane.scene.motion.files import load_motion
from trilane.scene.motion.motion import Motion
from trilane.scene.mover import make_mover
from trilane.scene.schema import AvatarSpec

LIMBS = [
    (f"{side}_{start}", f"{side}_{end}")
    for side in ("left", "right")
    for start, end in (
        ("hip", "knee"), ("knee", "ankle"), ("ankle", "foot"), ("shoulder", "elbow"), ("elbow", "wrist"),
    )
]  # fmt: skip
LINES = [("right_hip", "left_hip"), ("right_shoulder", "left_shoulder"), ("pelvis", "neck"), ("neck", "head")]
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


def rodrigues(v: np.ndarray) -> np.ndarray:
    angle = np.linalg.norm(v, axis=-1)[:, None, None]
    a = v / np.maximum(angle[:, 0], 1e-12)
    zero = np.zeros(len(a))
    rows = [[zero, -a[:, 2], a[:, 1]], [a[:, 2], zero, -a[:, 0]], [-a[:, 1], a[:, 0], zero]]
    cross = np.moveaxis(np.array(rows), -1, 0)
    return np.asarray(np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross)


def places_of(motion: Motion, body: ShapedBody) -> np.ndarray:
    """Places (55, T, 3) of the body's joints, from the pelvis."""
    turns, places = [rodrigues(motion.poses[:, 0])], [np.zeros((len(motion.poses), 3))]
    for joint, parent in enumerate(JOINT_PARENTS[1:], 1):
        turns.append(turns[parent] @ rodrigues(motion.poses[:, joint]))
        places.append(places[parent] + turns[parent] @ (body.joints[joint] - body.joints[parent]))
    return np.array(places)


def recordings(shared_data: Path) -> list[Path]:
    found = sorted((shared_data / "motion").glob("*.bvh"))
    assert found
    return found


def test_limbs_and_lines_are_the_recorded_ones(shared_data: Path, body: ShapedBody) -> None:
    for path in recordings(shared_data):
        theirs = places_in(path)
        motion = load_motion(AvatarSpec(motion=str(path)), Path("/"), body.joints)
        ours, names = places_of(motion, body), motion.detected.joints
        pairs = [pair for pair in LIMBS + LINES if set(pair) <= set(names)]
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
    skinner, chain = CpuSkinner(body, 4, pose_blend=False), Skeleton(body.joints, body.body.parents)
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
        heights = [skinner.vertices(chain.pose(*mover.sample(t_s)))[soles, 1].min() for t_s in motion.times_s[stands]]
        assert np.abs(heights).max() < 0.005, path.name
