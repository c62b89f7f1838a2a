"""Fits: pose, place and shape of the body in each frame, from .npz files with the names of SMPL-X or AMASS.

Rule: a fit holds the arguments of the `smplx` library; every array is checked, and each defect is a fault of its own.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from trilane.arrays import F64
from trilane.body.body import Body
from trilane.body.joints import JOINTS, LEFT_HAND, MAX_VALUE, POSE_SIZE, RIGHT_HAND
from trilane.scene.motion.smpl_files import WHOLE as WIDTHS
from trilane.training.capture.capture_file import Fault

#: For each part of the pose, its place among the 165 numbers and the names that files have for it.
PARTS: dict[tuple[int, int], tuple[str, ...]] = {
    (0, 3): ("global_orient", "root_orient"),
    (3, 66): ("body_pose", "pose_body"),
    (66, 69): ("jaw_pose", "pose_jaw"),
    (69, 72): ("leye_pose",),
    (72, 75): ("reye_pose",),
    (69, 75): ("pose_eye",),
    (LEFT_HAND.start, LEFT_HAND.stop): ("left_hand_pose",),
    (RIGHT_HAND.start, RIGHT_HAND.stop): ("right_hand_pose",),
    (LEFT_HAND.start, RIGHT_HAND.stop): ("pose_hand",),
}
WHOLE = ("poses", "full_pose", "pose")
PLACE = ("transl", "trans")
CAMERA = {"camera_rotation": 9, "camera_translation": 3}
SHAPE = ("betas", "expression")
NAMES = (*WHOLE, *(name for names in PARTS.values() for name in names), *PLACE, *SHAPE, *CAMERA)
#: Sizes of other bodies' arrays, and what they are in words for people.
OTHER_BODIES = {69: "23 joints: the SMPL layout", 72: "24 joints: the SMPL layout", 66: "22 joints", 63: "21 joints"}
#: Joints of a whole pose, by its number of columns in SMPL-H and SMPL-X.
COLUMNS = {width: WIDTHS[width][0] for width in (156, 165)}
REMEDY = "convert the fits to SMPL-X"

Arrays = Mapping[str, NDArray[Any]]


@dataclass(frozen=True)
class Fit:
    """The fit of one frame.

    `pose`: axis-angle (55,3), radians. `place`: translation (3,) added to the root joint, metres.
    `betas`, `expression`: coefficients of the shape. `rotation` (3,3), `translation` (3,): the frame's own camera, or
    None.
    """

    pose: F64
    place: F64
    betas: F64
    expression: F64
    rotation: F64 | None = None
    translation: F64 | None = None


def read_fit(where: str, arrays: Arrays, body: Body, flat_hand_mean: bool) -> tuple[Fit | None, list[Fault]]:
    """Return the fit in the `arrays` of one frame, or None, and its faults.

    `where`: name of the file. `body`: body that gives hand components and the mean hand. `flat_hand_mean`: whether the
    fit's hands already include the mean hand.
    """
    faults: list[Fault] = []
    values = {name: _numbers(f"{where}[{name}]", arrays[name], faults) for name in NAMES if name in arrays}
    pose = _pose(where, values, body, faults)
    place = next((values[name] for name in PLACE if name in values), None)
    if place is None:
        faults.append(Fault(where, "no place of the body", f"an array `{PLACE[0]}` or `{PLACE[1]}`"))
    else:
        _require_size(f"{where}[{PLACE[0] if PLACE[0] in values else PLACE[1]}]", place, 3, faults)
    for name, size in CAMERA.items():
        if name in values:
            _require_size(f"{where}[{name}]", values[name], size, faults)
    betas, expression = (_coefficients(where, name, values, body, faults) for name in SHAPE)
    if faults or place is None:
        return None, faults
    rotation, translation = (values.get(name) for name in CAMERA)
    full = body.full_pose(pose, flat_hand_mean).reshape(JOINTS, 3)
    return Fit(full, place, betas, expression, None if rotation is None else rotation.reshape(3, 3), translation), []


def _numbers(where: str, array: NDArray[Any], faults: list[Fault]) -> F64:
    """Return `array` as a row of numbers; one with anything but finite numbers is a fault, and gives zeros."""
    if array.dtype.kind not in "fiu":
        faults.append(Fault(where, f"dtype {array.dtype}", "numbers"))
        return np.zeros(array.size)
    row = array.astype(np.float64).reshape(-1)
    if not (np.abs(row) <= MAX_VALUE).all():  # `not` includes NaN, which no comparison holds for
        faults.append(Fault(where, "NaN, infinity or a huge number", "finite numbers", "fit the frame again"))
        return np.zeros(array.size)
    return row


def _require_size(where: str, row: F64, size: int, faults: list[Fault]) -> bool:
    if len(row) != size:
        what = f"{len(row)} numbers" + (f" ({OTHER_BODIES[len(row)]})" if len(row) in OTHER_BODIES else "")
        faults.append(Fault(where, what, f"{size}", REMEDY if len(row) in OTHER_BODIES else ""))
    return len(row) == size


def _pose(where: str, values: Mapping[str, F64], body: Body, faults: list[Fault]) -> F64:
    """Return the pose (165,) from the whole pose's array or from its parts; only root and body are required."""
    for name in WHOLE:
        if name in values:
            return _whole(f"{where}[{name}]", values[name], faults)
    pose = np.zeros(POSE_SIZE)
    for (start, stop), names in PARTS.items():
        found = [name for name in names if name in values]
        if not found and stop <= 66:
            expected = f"`{names[0]}` or `{names[1]}`, or the whole pose as `poses`"
            faults.append(Fault(where, f"no `{names[0]}`", expected))
        for name in found:
            row = values[name]
            if name.endswith("hand_pose") and 0 < len(row) < 45:
                components = body.hand_components[name.startswith("right")]
                row = row @ components[: len(row)] if len(row) <= len(components) else row
            if _require_size(f"{where}[{name}]", row, stop - start, faults):
                pose[start:stop] = row
    return pose


def _whole(where: str, row: F64, faults: list[Fault]) -> F64:
    pose = np.zeros((JOINTS, 3))
    if len(row) in COLUMNS:
        pose[list(COLUMNS[len(row)])] = row.reshape(-1, 3)
    else:
        _require_size(where, row, POSE_SIZE, faults)
    return pose.reshape(-1)


def _coefficients(where: str, name: str, values: Mapping[str, F64], body: Body, faults: list[Fault]) -> F64:
    most = (body.shape_dirs if name == "betas" else body.expression_dirs).shape[2]
    row = values.get(name, np.zeros(0))
    if len(row) > most:
        faults.append(Fault(f"{where}[{name}]", f"{len(row)} coefficients", f"at most {most}, which the body has"))
    return row
