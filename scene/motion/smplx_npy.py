"""SMPL-X poses in a `.npy` file: (T, 165) or (T, 55, 3) axis-angle.

Rule: the format has no rate. Neighbours alike are a recording at 30 frames a second; neighbours wholly unlike are
separate poses, one a second.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from trilane.errors import BadInputError
from trilane.files import as_numbers, read_npy
from trilane.scene.motion.motion import JOINTS, RawMotion
from trilane.scene.rotations import matrix_from_rotvec, rotvec_from_matrix

EXPECTED = "SMPL-X poses, an array of shape (T, 165) in radians"
ASSUMED_RATE_HZ = 30.0
POSE_SET_STEP_RAD = 0.7


def load_smplx_npy(path: Path) -> RawMotion:
    """Read `path`. Raises BadInputError on anything but finite-sized (T, 165) or (T, 55, 3) numbers, T >= 1."""
    array = read_npy(path, EXPECTED)
    if array.shape[1:] not in ((JOINTS * 3,), (JOINTS, 3)) or not len(array):
        raise BadInputError(path, f"shape {array.shape}", EXPECTED)
    poses = as_numbers(path, array, EXPECTED).reshape(-1, JOINTS, 3)
    separate = median_step_rad(poses) > POSE_SET_STEP_RAD
    rate = 1.0 if separate else ASSUMED_RATE_HZ
    taken = (
        "neighbours unlike, so taken for separate poses, 1 a second"
        if separate
        else f"no rate in the format, {ASSUMED_RATE_HZ:g} frames/s assumed"
    )
    notes = (f"SMPL-X .npy, {len(poses)} frames", taken, f"hands: {hands_note(poses)}", "betas: none in the format")
    return RawMotion(np.arange(len(poses)) / rate, poses, None, None, "y", notes)


def median_step_rad(poses: NDArray[np.float64]) -> float:
    """Median over neighbouring frames of the largest turn among the 22 body joints; 0 for one frame."""
    sound = poses[np.isfinite(poses).all(axis=(1, 2)) & (np.abs(poses) < 100).all(axis=(1, 2))]
    if len(sound) < 2:
        return 0.0
    turn = matrix_from_rotvec(sound[:512, :22])
    step = rotvec_from_matrix(np.swapaxes(turn[:-1], -1, -2) @ turn[1:])
    return float(np.median(np.linalg.norm(step, axis=-1).max(axis=1)))


def hands_note(poses: NDArray[np.float64]) -> str:
    """Whether the fingers are posed, for the notes."""
    return "posed (flat-hand zero)" if np.nan_to_num(poses[:, 25:]).any() else "all zero, flat"
