"""Puts the motion of a BVH skeleton on the SMPL-X joints, which are matched by name.

Rule: a joint's global turn is that of the file times a fixed turn, which lays the SMPL-X rest bone on the file's rest
bone. So every limb points in the direction of the recorded one, whatever the file's zero pose is. Trunk and head take
the file's turns unchanged. A joint that the file does not have follows its parent.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from trilane.arrays import F64
from trilane.body.joints import JOINT_INDEX, JOINT_NAMES, JOINT_PARENTS
from trilane.errors import BadInputError
from trilane.scene.detected import Detected
from trilane.scene.motion.bvh import BvhJoint, load_bvh
from trilane.scene.motion.bvh_units import leg_length, unit_of
from trilane.scene.motion.joint_match import NO_MAP, match_names
from trilane.scene.motion.motion import JOINTS
from trilane.scene.motion.recorded import RawMotion
from trilane.scene.rotations import rotvec_from_matrix, shortest_turn

LEAST_LENGTH = 1e-6
#: Joint whose bone is laid on that of the file -> the joint at the other end of the bone, its direction in the T pose.
LIMBS: dict[str, tuple[str, tuple[float, float, float]]] = {
    "left_hip": ("left_knee", (0.0, -1.0, 0.0)),
    "right_hip": ("right_knee", (0.0, -1.0, 0.0)),
    "left_knee": ("left_ankle", (0.0, -1.0, 0.0)),
    "right_knee": ("right_ankle", (0.0, -1.0, 0.0)),
    "left_ankle": ("left_foot", (0.0, -0.42, 0.91)),
    "right_ankle": ("right_foot", (0.0, -0.42, 0.91)),
    "left_shoulder": ("left_elbow", (1.0, 0.0, 0.0)),
    "right_shoulder": ("right_elbow", (-1.0, 0.0, 0.0)),
    "left_elbow": ("left_wrist", (1.0, 0.0, 0.0)),
    "right_elbow": ("right_wrist", (-1.0, 0.0, 0.0)),
    "left_wrist": ("left_middle1", (1.0, 0.0, 0.0)),
    "right_wrist": ("right_middle1", (-1.0, 0.0, 0.0)),
}


def load_retargeted(path: Path, units: str, joint_map: Mapping[str, str] = NO_MAP) -> RawMotion:
    """Read a BVH file onto the 55 joints; `units` is a key of UNITS_M or `auto`, `joint_map` as of `match_names`.

    Raises BadInputError when the file is no BVH or its names are of no known skeleton.
    """
    bvh = load_bvh(path)
    dialect, index_of = match_names(path, [joint.name for joint in bvh.joints], joint_map)
    offsets = _rest_positions(bvh.joints)
    leg = leg_length(offsets, index_of)
    hips = offsets[index_of["left_hip"]] - offsets[index_of["right_hip"]]
    if leg < LEAST_LENGTH or np.linalg.norm(hips) < LEAST_LENGTH:
        raise BadInputError(path, "legs of no length or hips in one place", "a skeleton with OFFSETs")
    unit, unit_m = unit_of(leg, units)
    turns, places = bvh.forward()
    poses = _local_turns(turns, _rest_turns(bvh.joints, offsets, index_of), index_of)
    translation = places[:, index_of["pelvis"]] * unit_m
    partners = sorted(JOINT_INDEX[name] for name in index_of)
    hands = sum(index >= 25 for index in partners)
    rate = 1 / bvh.frame_time_s
    notes = (
        f"BVH, {len(bvh.joints)} joints named as in {dialect}, {len(bvh.frames)} frames at {rate:.4g}/s",
        f"units: {unit} (leg of {leg * unit_m:.2f} m)",
        f"{len(index_of)} joints have a partner, {hands} of them in the hands",
        "betas: none in the format",
    )
    joints = {name: bvh.joints[index].name for name, index in index_of.items()}
    others = tuple(joint.name for joint in bvh.joints if joint.name not in joints.values())
    reason = f"HIERARCHY, with joint names of {dialect}"
    detected = Detected("BVH", reason, unit=unit, rate="by `Frame Time`", joints=joints, unmapped=others)
    times = np.arange(len(bvh.frames), dtype=np.float64) * bvh.frame_time_s
    return RawMotion(times, poses, translation, None, "y", notes, leg * unit_m, detected)


def _rest_positions(joints: list[BvhJoint]) -> F64:
    """Positions (J, 3) in the file's zero pose."""
    places = np.zeros((len(joints), 3))
    for index, joint in enumerate(joints):
        places[index] = joint.offset + (places[joint.parent] if joint.parent >= 0 else 0.0)
    return places


def _rest_turns(joints: list[BvhJoint], offsets: F64, index_of: dict[str, int]) -> dict[str, F64]:
    """{SMPL-X name: matrix (3, 3) from the SMPL-X rest frame to the file's zero-pose frame}."""
    frame = _body_frame(offsets, index_of)
    turns: dict[str, F64] = {}
    for index, name in enumerate(JOINT_NAMES):
        above = turns.get(JOINT_NAMES[JOINT_PARENTS[index]], frame) if index else frame
        turns[name] = above if name in LIMBS or index >= 25 else frame
        bone = _file_bone(name, joints, offsets, index_of) if name in LIMBS else None
        if bone is not None:
            ours = above @ np.array(LIMBS[name][1])
            turns[name] = shortest_turn(ours, bone, fallback=frame[:, 0]) @ above
    return turns


def _file_bone(name: str, joints: list[BvhJoint], offsets: F64, index_of: dict[str, int]) -> F64 | None:
    """Direction (3,) of the bone that begins at joint `name`, in the file's zero pose; None when it has none."""
    if name not in index_of:
        return None
    end = LIMBS[name][0]
    index = index_of[name]
    bone = offsets[index_of[end]] - offsets[index] if end in index_of else _to_furthest_tip(index, joints, offsets)
    return bone if np.linalg.norm(bone) > 1e-6 else None


def _to_furthest_tip(index: int, joints: list[BvhJoint], offsets: F64) -> F64:
    """Vector (3,) from a joint to the furthest end site below it; zero when there is none."""
    below = {index}
    best = np.zeros(3)
    for k, joint in enumerate(joints):
        if joint.parent in below:
            below.add(k)
        if k in below and joint.tip is not None:
            reach = offsets[k] + joint.tip - offsets[index]
            best = max(best, reach, key=np.linalg.norm)
    return best


def _body_frame(offsets: F64, index_of: dict[str, int]) -> F64:
    """The body's left, up and forward as columns (3, 3), in the file's zero pose; snapped to axes within 20 degrees."""
    hips = (offsets[index_of["left_hip"]] + offsets[index_of["right_hip"]]) / 2
    left = offsets[index_of["left_hip"]] - offsets[index_of["right_hip"]]
    top = next((index_of[name] for name in ("head", "neck", "spine3", "spine2", "spine1") if name in index_of), None)
    up = offsets[top] - hips if top is not None else hips - offsets[index_of["left_ankle"]]
    forward = np.cross(left, up)
    columns = np.stack([np.cross(up, forward), up, forward], axis=1)
    frame = columns / np.linalg.norm(columns, axis=0)
    snapped = np.round(frame)
    close = np.abs(np.linalg.det(snapped) - 1) < 1e-9 and np.trace(snapped.T @ frame) > 1 + 2 * np.cos(np.radians(20))
    return np.asarray(snapped if close else frame)


def _local_turns(turns: F64, rest: dict[str, F64], index_of: dict[str, int]) -> F64:
    """Axis-angle (T, 55, 3) of the SMPL-X joints from the file's global turns (T, J, 3, 3)."""
    globals_: list[F64] = []
    poses = np.zeros((len(turns), JOINTS, 3))
    for index, name in enumerate(JOINT_NAMES):
        above = globals_[JOINT_PARENTS[index]] if index else np.broadcast_to(np.eye(3), (len(turns), 3, 3))
        turn = turns[:, index_of[name]] @ rest[name] if name in index_of else above
        globals_.append(turn)
        poses[:, index] = rotvec_from_matrix(np.swapaxes(above, -1, -2) @ turn)
    return poses
