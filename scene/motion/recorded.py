"""A raw recording to a Motion: mended, turned Y up, facing +Z at first, in the middle of the ground it covers.

Rule: up is what is given, else the axis that the body's own up points along on average, else the format's usual one.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from trilane.arrays import F64
from trilane.errors import BadInputError
from trilane.scene.motion.motion import Motion, RawMotion, Wrap
from trilane.scene.motion.usable_samples import kept_samples
from trilane.scene.rotations import Y_UP_FROM_Z_UP, about, matrix_from_rotvec, rotvec_from_matrix

MAX_FRAMES = 200_000
MAX_ANGLE_RAD = 64.0
MAX_PLACE_M = 10_000.0
#: Cosine above which the body's mean up axis decides.
SURE = 0.7


def finish(raw: RawMotion, where: str, up_axis: str) -> Motion:
    """Make a Motion of what a file said; `up_axis` is `y`, `z` or `auto`.

    Raises BadInputError when it is too long, in degrees, or for the most part unreadable.
    """
    if len(raw.times_s) > MAX_FRAMES:
        raise BadInputError(where, f"{len(raw.times_s)} frames", f"at most {MAX_FRAMES}")
    shift = np.zeros((len(raw.poses), 3)) if raw.translation is None else raw.translation
    kept, repairs = kept_samples(where, raw.times_s, _sound(raw.poses, shift))
    times, poses, shift = raw.times_s[kept], raw.poses[kept], shift[kept]
    _check_angles(poses, where)
    roots = matrix_from_rotvec(poses[:, 0])
    up, how = _up_axis(roots, raw.up, up_axis)
    turn = Y_UP_FROM_Z_UP if up == "z" else np.eye(3)
    turn = _facing(turn @ roots[0]) @ turn
    poses = poses.copy()
    poses[:, 0] = rotvec_from_matrix(turn @ roots)
    translation = shift @ turn.T
    wrap = Wrap.BOUNCE
    notes = (*raw.notes, f"{up.upper()} up, {how}", *repairs, _end_note(times, wrap))
    return Motion(
        times - times[0], poses, centred(translation), raw.betas, notes, wrap, raw.leg_m, raw.translation is not None
    )


def _sound(poses: F64, shift: F64) -> NDArray[np.bool_]:
    """Frames (T,) whose numbers are finite and whose place is on this planet."""
    finite = np.isfinite(poses).all(axis=(1, 2)) & np.isfinite(shift).all(axis=1)
    with np.errstate(invalid="ignore"):
        return np.asarray(finite & (np.abs(shift) < MAX_PLACE_M).all(axis=1))


def _check_angles(poses: F64, where: str) -> None:
    largest = float(np.abs(poses).max())
    if largest > MAX_ANGLE_RAD:
        raise BadInputError(where, f"an angle of {largest:.3g}", "axis-angle in radians", "convert degrees to radians")


def _up_axis(roots: F64, usual: str, given: str) -> tuple[str, str]:
    if given != "auto":
        return given, "as given"
    mean = roots[:, :, 1].mean(axis=0)
    for index, name in ((1, "y"), (2, "z")):
        if mean[index] > SURE:
            return name, "as the body stands"
    return usual, "as usual for the format"


def _facing(root: F64) -> F64:
    """Turn about Y (3, 3) after which a body with root turn `root` (3, 3) faces +Z; none for one that lies."""
    x, _, z = root[:, 2]
    if np.hypot(x, z) < 0.3:
        return np.eye(3)
    return about(1, -np.arctan2(x, z))


def centred(translation: F64) -> F64:
    """`translation` (T, 3) with the middle of its ground rectangle over the origin."""
    low, high = translation.min(axis=0), translation.max(axis=0)
    middle = (low + high) / 2
    return np.asarray(translation - np.array([middle[0], 0.0, middle[2]]))


def _end_note(times_s: F64, wrap: Wrap) -> str:
    if len(times_s) == 1:
        return "one frame: held"
    return f"{times_s[-1] - times_s[0]:.2f} s, then {wrap.value}"
