"""A BVH skeleton onto the SMPL-X joints, by name.

Rule: a joint's global turn is the file's, times the fixed turn that lays the SMPL-X rest bone on the file's rest
bone; so limbs point where the recorded limbs point, whatever the file's zero pose is. Trunk and head keep the
file's turns as they are. Joints without a partner follow their parent.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from trilane.arrays import F64
from trilane.body.joints import JOINT_INDEX, JOINT_NAMES, JOINT_PARENTS
from trilane.errors import BadInputError
from trilane.scene.motion.bvh import BvhJoint, load_bvh
from trilane.scene.motion.bvh_joint_names import DIALECTS, plain
from trilane.scene.motion.motion import JOINTS, RawMotion
from trilane.scene.rotations import rotvec_from_matrix, shortest_turn

#: Metres in one unit; `cmu` is the unit of the CMU recordings, 1/0.45 inches.
UNITS_M = {"m": 1.0, "cm": 0.01, "in": 0.0254, "cmu": 0.0254 / 0.45}
USUAL_LEG_M = 0.85
LEAST_LENGTH = 1e-6
REQUIRED = ("pelvis", "left_hip", "right_hip", "left_knee", "right_knee", "left_ankle", "right_ankle")
#: Joint whose bone is laid on the file's -> the joint where that bone ends, and its direction in the T pose.
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


def load_retargeted(path: Path, units: str) -> RawMotion:
    """Read a BVH file onto the 55 joints; `units` is a key of UNITS_M or `auto`.

    Raises BadInputError when the file is no BVH or its names are of no known skeleton.
    """
    bvh = load_bvh(path)
    dialect, where = match_names(path, [joint.name for joint in bvh.joints])
    offsets = _rest_positions(bvh.joints)
    leg = float(np.mean([_leg(offsets, where, side) for side in ("left", "right")]))
    hips = offsets[where["left_hip"]] - offsets[where["right_hip"]]
    if leg < LEAST_LENGTH or np.linalg.norm(hips) < LEAST_LENGTH:
        raise BadInputError(path, "legs of no length or hips in one place", "a skeleton with OFFSETs")
    unit, unit_m = _unit(leg, units)
    turns, places = bvh.forward()
    poses = _local_turns(turns, _rest_turns(bvh.joints, offsets, where), where)
    translation = places[:, where["pelvis"]] * unit_m
    partners = sorted(JOINT_INDEX[name] for name in where)
    hands = sum(index >= 25 for index in partners)
    rate = 1 / bvh.frame_time_s
    notes = (
        f"BVH, {len(bvh.joints)} joints named as in {dialect}, {len(bvh.frames)} frames at {rate:.4g}/s",
        f"units: {unit} (leg of {leg * unit_m:.2f} m)",
        f"{len(where)} joints have a partner, {hands} of them in the hands",
        "betas: none in the format",
    )
    times = np.arange(len(bvh.frames), dtype=np.float64) * bvh.frame_time_s
    return RawMotion(times, poses, translation, None, "y", notes, leg * unit_m)


def match_names(path: Path, names: list[str]) -> tuple[str, dict[str, int]]:
    """The dialect with the most of `names`, and {SMPL-X name: index in `names`}. Raises BadInputError."""
    seen: dict[str, int] = {}
    for index, name in enumerate(names):
        seen.setdefault(plain(name), index)
    found = {
        dialect: {target: seen[source] for source, target in table.items() if source in seen}
        for dialect, table in DIALECTS.items()
    }
    best = max(found, key=lambda dialect: len(found[dialect]))
    missing = [name for name in REQUIRED if name not in found[best]]
    if missing:
        raise BadInputError(
            path,
            f"joints {', '.join(names[:6])} …, of which none is {missing[0]}",
            f"the joint names of {', '.join(DIALECTS)}",
            "rename the joints",
        )
    return best, found[best]


def _rest_positions(joints: list[BvhJoint]) -> F64:
    """Positions (J, 3) in the file's zero pose."""
    places = np.zeros((len(joints), 3))
    for index, joint in enumerate(joints):
        places[index] = joint.offset + (places[joint.parent] if joint.parent >= 0 else 0.0)
    return places


def _leg(offsets: F64, where: dict[str, int], side: str) -> float:
    hip, knee, ankle = (offsets[where[f"{side}_{part}"]] for part in ("hip", "knee", "ankle"))
    return float(np.linalg.norm(knee - hip) + np.linalg.norm(ankle - knee))


def _unit(leg: float, units: str) -> tuple[str, float]:
    if units != "auto":
        return f"{units}, as given", UNITS_M[units]
    name = min(UNITS_M, key=lambda unit: abs(np.log(leg * UNITS_M[unit] / USUAL_LEG_M)))
    if 0.6 < leg * UNITS_M[name] / USUAL_LEG_M < 1.6:
        return f"{name}, by the length of the legs", UNITS_M[name]
    return f"unknown, scaled to a leg of {USUAL_LEG_M} m", USUAL_LEG_M / leg


def _rest_turns(joints: list[BvhJoint], offsets: F64, where: dict[str, int]) -> dict[str, F64]:
    """{SMPL-X name: matrix (3, 3) from the SMPL-X rest frame to the file's zero-pose frame}."""
    frame = _body_frame(offsets, where)
    turns: dict[str, F64] = {}
    for index, name in enumerate(JOINT_NAMES):
        above = turns.get(JOINT_NAMES[JOINT_PARENTS[index]], frame) if index else frame
        turns[name] = above if name in LIMBS or index >= 25 else frame
        bone = _file_bone(name, joints, offsets, where) if name in LIMBS else None
        if bone is not None:
            ours = above @ np.array(LIMBS[name][1])
            turns[name] = shortest_turn(ours, bone, fallback=frame[:, 0]) @ above
    return turns


def _file_bone(name: str, joints: list[BvhJoint], offsets: F64, where: dict[str, int]) -> F64 | None:
    """Direction (3,) of the bone in the file's zero pose, or None when the file does not tell."""
    if name not in where:
        return None
    end = LIMBS[name][0]
    index = where[name]
    bone = offsets[where[end]] - offsets[index] if end in where else _furthest_below(index, joints, offsets)
    return bone if np.linalg.norm(bone) > 1e-6 else None


def _furthest_below(index: int, joints: list[BvhJoint], offsets: F64) -> F64:
    """From a joint to the furthest end site below it, (3,)."""
    below = {index}
    best = np.zeros(3)
    for k, joint in enumerate(joints):
        if joint.parent in below:
            below.add(k)
        if k in below and joint.tip is not None:
            reach = offsets[k] + joint.tip - offsets[index]
            best = max(best, reach, key=np.linalg.norm)
    return best


def _body_frame(offsets: F64, where: dict[str, int]) -> F64:
    """Columns: the body's left, up and forward in the file's zero pose; snapped to the axes when within 20 degrees."""
    hips = (offsets[where["left_hip"]] + offsets[where["right_hip"]]) / 2
    left = offsets[where["left_hip"]] - offsets[where["right_hip"]]
    top = next((where[name] for name in ("head", "neck", "spine3", "spine2", "spine1") if name in where), None)
    up = offsets[top] - hips if top is not None else hips - offsets[where["left_ankle"]]
    forward = np.cross(left, up)
    columns = np.stack([np.cross(up, forward), up, forward], axis=1)
    frame = columns / np.linalg.norm(columns, axis=0)
    snapped = np.round(frame)
    close = np.abs(np.linalg.det(snapped) - 1) < 1e-9 and np.trace(snapped.T @ frame) > 1 + 2 * np.cos(np.radians(20))
    return np.asarray(snapped if close else frame)


def _local_turns(turns: F64, rest: dict[str, F64], where: dict[str, int]) -> F64:
    """Axis-angle (T, 55, 3) of the SMPL-X joints from the file's global turns (T, J, 3, 3)."""
    globals_: list[F64] = []
    poses = np.zeros((len(turns), JOINTS, 3))
    for index, name in enumerate(JOINT_NAMES):
        above = globals_[JOINT_PARENTS[index]] if index else np.broadcast_to(np.eye(3), (len(turns), 3, 3))
        turn = turns[:, where[name]] @ rest[name] if name in where else above
        globals_.append(turn)
        poses[:, index] = rotvec_from_matrix(np.swapaxes(above, -1, -2) @ turn)
    return poses
