"""Reads SMPL-X poses from a `.npy` file: (T, 165) or (T, 55, 3), axis-angle.

Rule: the format has no frame rate. When neighbouring frames are similar, 30 frames per second are assumed; when they
differ by more than POSE_SET_STEP_RAD, they are separate poses, one per second.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from trilane.errors import BadInputError
from trilane.files import as_numbers, read_npy
from trilane.scene.detected import Detected
from trilane.scene.motion.motion import JOINTS
from trilane.scene.motion.recorded import RawMotion
from trilane.scene.rotations import matrix_from_rotvec, rotvec_from_matrix

EXPECTED = "SMPL-X poses, an array of shape (T, 165) in radians"
ASSUMED_RATE_HZ = 30.0
POSE_SET_STEP_RAD = 0.7


def load_smplx_npy(path: Path) -> RawMotion:
    """Read `path`. Raises BadInputError for anything but numbers of shape (T, 165) or (T, 55, 3) with T >= 1."""
    array = read_npy(path, EXPECTED)
    if array.shape[1:] not in ((JOINTS * 3,), (JOINTS, 3)) or not len(array):
        raise BadInputError(path, f"shape {array.shape}", EXPECTED)
    poses = as_numbers(path, array, EXPECTED).reshape(-1, JOINTS, 3)
    separate = median_step_rad(poses) > POSE_SET_STEP_RAD
    rate = 1.0 if separate else ASSUMED_RATE_HZ
    rate_note = (
        "neighbours unlike, so taken for separate poses, 1 a second"
        if separate
        else f"no rate in the format, {ASSUMED_RATE_HZ:g} frames/s assumed"
    )
    notes = (f"SMPL-X .npy, {len(poses)} frames", rate_note, f"hands: {hands_note(poses)}", "betas: none in the format")
    detected = Detected("SMPL-X poses (.npy)", f"an array of shape {array.shape}", rate=rate_note)
    return RawMotion(np.arange(len(poses)) / rate, poses, None, None, "y", notes, detected=detected)


def median_step_rad(poses: NDArray[np.float64]) -> float:
    """The largest turn among the 22 body joints from one frame to the next, as the median over all; 0 for one frame."""
    readable = poses[np.isfinite(poses).all(axis=(1, 2)) & (np.abs(poses) < 100).all(axis=(1, 2))]
    if len(readable) < 2:
        return 0.0
    turn = matrix_from_rotvec(readable[:512, :22])
    step = rotvec_from_matrix(np.swapaxes(turn[:-1], -1, -2) @ turn[1:])
    return float(np.median(np.linalg.norm(step, axis=-1).max(axis=1)))


def hands_note(poses: NDArray[np.float64]) -> str:
    """A note on whether the fingers are posed."""
    return "posed (flat-hand zero)" if np.nan_to_num(poses[:, 25:]).any() else "all zero, flat"
