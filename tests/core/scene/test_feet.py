"""Feet of a skeleton whose bones fall more steeply, or less, than the avatar's: as recorded, but not through the floor.

The recorded person has the avatar's own limbs, with the toes lower or higher under the ankle. It stands, then lifts the
left foot to the front and lowers it again, with the sole at any angle.
"""

from __future__ import annotations

import numpy as np
import pytest

from trilane.body.body import ShapedBody
from trilane.body.joints import JOINT_INDEX, JOINT_NAMES, JOINT_PARENTS, Skeleton
from trilane.body.skinning import CpuSkinner
from trilane.scene.motion.bvh import feet_of
from trilane.scene.motion.motion import RawMotion, motion_from_recording, rest_leg_m
from trilane.scene.motion.retarget import HEEL_BEHIND, retarget
from trilane.scene.motion.tracks import Tracks
from trilane.scene.mover import DEEPEST_M, make_mover
from trilane.scene.rotations import matrix_from_rotvec
from trilane.scene.schema import AvatarSpec

STILL, MOVING = 30, 60
FOOT_JOINTS = ("left_ankle", "right_ankle", "left_foot", "right_foot")


def turn_about_x(angle: float) -> np.ndarray:
    """Turn that moves what is in front of the axis down by `angle`, radians."""
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[1, 0, 0], [0, c, -s], [0, s, c]])


def recording(rest: np.ndarray, lower_m: float) -> tuple[Tracks, np.ndarray]:
    """The person, and how steeply the left foot's bone falls in each frame, radians.

    `rest` (55, 3): joints of the avatar. `lower_m`: by how much the toes are lower than its own.
    """
    other = rest.copy()
    for side in ("left", "right"):
        other[JOINT_INDEX[f"{side}_foot"]] -= (0, lower_m, 0)
    frames = []
    for k in range(STILL + MOVING):
        lifted = np.sin(np.pi * max(0, k - STILL) / MOVING) ** 2
        sole = 0.5 * np.sin(4 * np.pi * max(0, k - STILL) / MOVING)  # toes down, up, down, up
        turns = {"left_hip": turn_about_x(-0.9 * lifted), "left_knee": turn_about_x(1.5 * lifted)}
        turns["left_ankle"] = turn_about_x(-0.6 * lifted + sole * min(1.0, 2 * lifted))
        frames.append(places_of(turns, other))
    places = np.array(frames)
    foot = places[:, JOINT_INDEX["left_foot"]] - places[:, JOINT_INDEX["left_ankle"]]
    return Tracks({name: places[:, index] for name, index in JOINT_INDEX.items()}), falls(foot)


def places_of(local: dict[str, np.ndarray], rest: np.ndarray, pelvis: np.ndarray | None = None) -> np.ndarray:
    """Places (55, 3) of the joints under turns relative to their parents."""
    turns, places = [local.get("pelvis", np.eye(3))], [rest[0] if pelvis is None else pelvis]
    for joint, parent in enumerate(JOINT_PARENTS[1:], 1):
        turns.append(turns[parent] @ local.get(JOINT_NAMES[joint], np.eye(3)))
        places.append(places[parent] + turns[parent] @ (rest[joint] - rest[parent]))
    return np.array(places)


def falls(ways: np.ndarray) -> np.ndarray:
    return np.asarray(np.arcsin(-ways[..., 1] / np.linalg.norm(ways, axis=-1)))


def shown(poses: np.ndarray, pelvis: np.ndarray, rest: np.ndarray) -> np.ndarray:
    """Places (T, 55, 3) of the avatar's joints."""
    turns = [dict(zip(JOINT_NAMES, matrix_from_rotvec(pose), strict=True)) for pose in poses]
    return np.array([places_of(turn, rest, place) for turn, place in zip(turns, pelvis, strict=True)])


@pytest.mark.parametrize("lower_m", [0.03, 0.05, 0.08])
def test_steep_feet_fall_as_recorded_until_the_toes_are_as_low_as_those_of_a_flat_foot(
    body: ShapedBody, lower_m: float
) -> None:
    rest = body.joints
    tracks, recorded = recording(rest, lower_m)
    poses, pelvis, notes = retarget(tracks, rest)
    assert any("steeper than the avatar's where they are planted, so they are laid flat" in note for note in notes)
    ankle, toes = (shown(poses, pelvis, rest)[:, JOINT_INDEX[f"left_{part}"]] for part in ("ankle", "foot"))
    bone = rest[JOINT_INDEX["left_foot"]] - rest[JOINT_INDEX["left_ankle"]]
    lowest = rest[JOINT_INDEX["left_foot"], 1]
    as_recorded = ankle[:, 1] - np.linalg.norm(bone) * np.sin(recorded)
    clear, below = as_recorded > lowest + 0.002, as_recorded < lowest - 0.002
    assert min(clear.sum(), below.sum()) > 20
    found = falls(toes - ankle)
    assert np.degrees(np.abs(found - recorded)[clear]).max() < 1
    assert toes[below, 1] == pytest.approx(lowest, abs=1e-3)
    assert np.degrees(np.abs(found[:STILL] - falls(bone))).max() < 0.5


def test_flat_feet_fall_as_recorded_until_the_heels_are_on_the_floor(body: ShapedBody) -> None:
    """The heel is HEEL_BEHIND of the bone behind the ankle: what the toes rise, it sinks by that share."""
    rest = body.joints
    tracks, recorded = recording(rest, -0.04)
    poses, pelvis, _ = retarget(tracks, rest)
    ankle, toes = (shown(poses, pelvis, rest)[:, JOINT_INDEX[f"left_{part}"]] for part in ("ankle", "foot"))
    bone = rest[JOINT_INDEX["left_foot"]] - rest[JOINT_INDEX["left_ankle"]]
    found, rise = falls(toes - ankle), ankle[:, 1] - rest[JOINT_INDEX["left_ankle"], 1]
    sunk = HEEL_BEHIND * np.linalg.norm(bone) * np.sin(falls(bone) - found)
    kept = np.abs(found - recorded) < np.radians(1)
    assert kept.sum() > 20
    assert (sunk < np.maximum(rise, 0) + 1e-3)[found < falls(bone)].all()
    assert (np.abs(sunk - rise) < 2e-3)[~kept].all()
    assert np.degrees(np.abs(found[:STILL] - falls(bone))).max() < 0.5


@pytest.mark.parametrize("lower_m", [-0.04, 0.05, 0.08])
def test_no_toe_and_no_heel_is_below_the_floor(body: ShapedBody, lower_m: float) -> None:
    """By every vertex of the feet: on the floor while they stand, and never deeper than any point of a body may be."""
    tracks, _ = recording(body.joints, lower_m)
    poses, pelvis, notes = retarget(tracks, body.joints)
    times = np.arange(len(poses)) / 30
    raw = RawMotion(times, poses, pelvis, None, "y", notes, rest_leg_m(body.joints), feet=feet_of(tracks))
    motion = motion_from_recording(raw, "by hand", "y")
    mover = make_mover(AvatarSpec(motion="by hand"), motion, body)
    skinner, chain = CpuSkinner(body, 4, pose_blend=False), Skeleton(body.joints, body.body.parents)
    soles = np.isin(body.body.weights.argmax(axis=1), [JOINT_INDEX[name] for name in FOOT_JOINTS])
    lowest = np.array([skinner.vertices(chain.pose(*mover.sample(t_s)))[soles, 1].min() for t_s in times])
    assert lowest.min() > -DEEPEST_M - 1e-3
    assert np.abs(lowest[:STILL]).max() < 0.005
