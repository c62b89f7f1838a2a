"""Poses in one array, such as that of a `.npy` file: axis-angle turns of SMPL-X, SMPL-H or SMPL, in radians.

Rule: an array has no frame rate. When neighbouring frames are similar, 30 frames per second are assumed; when they
differ by more than POSE_SET_STEP_RAD, they are separate poses, one per second. Its axes may be those of a camera.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from trilane.errors import BadInputError
from trilane.scene.motion.recorded import ANY, RawMotion
from trilane.scene.motion.smpl_turns import WHOLE, shapes, turns_in
from trilane.scene.recordings import Detected
from trilane.scene.rotations import matrix_from_rotvec, rotvec_from_matrix

ASSUMED_RATE_HZ = 30.0
POSE_SET_STEP_RAD = 0.7
_AS_VECTORS = "turn them into axis-angle vectors, such as with scipy.spatial.transform.Rotation.as_rotvec"
#: Shape of a row of what others save -> how it becomes usable.
OTHERS: dict[tuple[int, ...], str] = {
    (263,): "these are HumanML3D's features: make places of joints of them with its recover_from_ric and save those",
    (322,): "these are rows of Motion-X: its columns 0 to 155 are `poses`, 309 to 311 `trans` of an .npz",
    (17,): "these are LLFF's poses_bounds of a camera: export transforms.json or COLMAP's model",
    (251,): "these are the features of KIT-ML: use HumanML3D's places of 22 joints",
    (135,): f"these look like turns of six numbers: {_AS_VECTORS}",
    **{(count, 6): f"these are turns of six numbers: {_AS_VECTORS}" for count in (22, 24, 52, 55)},
    **{(count, 4): f"these are quaternions: {_AS_VECTORS}" for count in (22, 24, 52, 55)},
    **{(count, 3, 3): f"these are matrices: {_AS_VECTORS}" for count in (22, 24, 52, 55)},
}


def motion_of_array(where: str, source: str, array: NDArray[Any]) -> RawMotion:
    """The motion of an `array` (T, W) or (T, W / 3, 3), whose W is a key of WHOLE.

    `where`: the file. `source`: its ending, for people. Raises BadInputError for anything else.
    """
    if array.shape[1:] in OTHERS:
        raise BadInputError(where, f"shape {array.shape}", f"{shapes(WHOLE)}, axis-angle", OTHERS[array.shape[1:]])
    read = turns_in(where, array, WHOLE)
    separate = median_step_rad(read.turns) > POSE_SET_STEP_RAD
    rate = 1.0 if separate else ASSUMED_RATE_HZ
    rate_note = (
        "neighbours unlike, so taken for separate poses, 1 a second"
        if separate
        else f"no rate in the format, {ASSUMED_RATE_HZ:g} frames/s assumed"
    )
    notes = (
        f"{read.whose} {source}, {len(array)} frames",
        rate_note,
        f"hands: {hands_note(read.turns)}",
        "betas: none in the format",
        *read.notes,
    )
    detected = Detected(f"{read.whose} poses ({source})", f"an array of shape {array.shape}", rate=rate_note)
    times = np.arange(len(array)) / rate
    return RawMotion(times, read.turns, None, None, "y", notes, detected=detected, ups=ANY)


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
