"""A recorded motion to a Motion: bad frames left out, Y up, facing +Z at first, centred on the ground it covers.

Rule: up is the axis that the scene states, else the one that the body's own up points along on average, else the usual
one of the format. Where a format has a world of its own, one that lies or stands on its hands throughout does not turn
it over: the floor of the file tells (`on_floor.py`), and where it does not, a note says what else may be up.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from trilane.arrays import F64
from trilane.errors import BadInputError
from trilane.scene.motion.motion import Motion, Wrap
from trilane.scene.motion.on_floor import lies, lowest, stands
from trilane.scene.motion.stance import stance
from trilane.scene.recordings import NOTHING, Detected, usable_samples
from trilane.scene.rotations import Y_UP_FROM_Z_UP, about, matrix_from_rotvec, rotvec_from_matrix

MAX_FRAMES = 200_000
MAX_ANGLE_RAD = 64.0
MAX_PLACE_M = 10_000.0
#: Axis that is up -> the turn (3, 3) that makes it +Y.
UPRIGHT: dict[str, F64] = {
    "y": np.eye(3),
    "z": Y_UP_FROM_Z_UP,
    "x": about(2, np.pi / 2),
    "-y": about(0, np.pi),
    "-z": about(0, np.pi / 2),
    "-x": about(2, -np.pi / 2),
}
#: Axes that may be up in a world, and in the coordinates of anything, such as a camera.
WORLD, ANY = ("y", "z"), tuple(UPRIGHT)
#: The body's own up decides when the cosine between it, on average, and an axis is above this.
LEAST_UP_COSINE = 0.7


@dataclass(frozen=True)
class RawMotion:
    """The content of a motion file, before anything is left out or turned.

    `times_s` (T,): seconds; NaNs and repeated times are still in. `poses` (T, 55, 3): axis-angle, radians, SMPL-X joint
    order. `translation` (T, 3): of the pelvis, metres; None when the format has none. `betas` (n,) or None. `up`: the
    axis that is usually up in the format; `ups`: the axes that may be up in it. `notes`: on the file, for people.
    `leg_m`: hip to ankle of the recorded person; None when unknown. `detected`: what the file is, but for its axes.
    `feet` (T, 2, n, 3): places of n joints of the left and the right foot, metres; None when the format has no places.
    """

    times_s: F64
    poses: F64
    translation: F64 | None
    betas: F64 | None
    up: str
    notes: tuple[str, ...]
    leg_m: float | None = None
    detected: Detected = NOTHING
    ups: tuple[str, ...] = WORLD
    feet: F64 | None = None


def motion_from_recording(raw: RawMotion, where: str, up_axis: str) -> Motion:
    """The motion of a file.

    `raw`: its content. `where`: its path, for messages. `up_axis`: a key of UPRIGHT, or `auto`. Raises BadInputError
    when it has more than MAX_FRAMES frames, is in degrees, or is unreadable in more than half of its frames.
    """
    if len(raw.times_s) > MAX_FRAMES:
        raise BadInputError(where, f"{len(raw.times_s)} frames", f"at most {MAX_FRAMES}")
    shift = np.zeros((len(raw.poses), 3)) if raw.translation is None else raw.translation
    usable, repairs = usable_samples(
        where, raw.times_s, _readable(raw.poses, shift), broken_as=_broken_as(raw.poses, shift)
    )
    times, poses, shift = raw.times_s[usable], raw.poses[usable], shift[usable]
    _check_angles(poses, where)
    roots = matrix_from_rotvec(poses[:, 0])
    up, how, doubt = _up_axis(poses, None if raw.translation is None else shift, raw, up_axis)
    turn = UPRIGHT[up]
    turn = facing(turn @ roots[0]) @ turn
    poses = poses.copy()
    poses[:, 0] = rotvec_from_matrix(turn @ roots)
    translation = shift @ turn.T
    axes = f"{up.upper()} up, {how}"
    return Motion(
        times - times[0],
        poses,
        centred(translation),
        raw.betas,
        (*raw.notes, axes, *doubt, *repairs),
        Wrap.BOUNCE,
        raw.leg_m,
        raw.translation is not None,
        replace(raw.detected, axes=axes),
        None if raw.feet is None else stance((raw.feet[usable] @ turn.T)[..., 1]),
    )


def _readable(poses: F64, shift: F64) -> NDArray[np.bool_]:
    """Whether the numbers of each frame (T,) are finite and its place is within MAX_PLACE_M."""
    finite = np.isfinite(poses).all(axis=(1, 2)) & np.isfinite(shift).all(axis=1)
    with np.errstate(invalid="ignore"):
        return np.asarray(finite & (np.abs(shift) < MAX_PLACE_M).all(axis=1))


def _broken_as(poses: F64, shift: F64) -> str:
    """What those frames are that are not readable."""
    not_finite = not (np.isfinite(poses).all() and np.isfinite(shift).all())
    with np.errstate(invalid="ignore"):
        is_far = bool((np.abs(np.where(np.isfinite(shift), shift, 0.0)) >= MAX_PLACE_M).any())
    far = f"{MAX_PLACE_M / 1000:g} km or more from the origin"
    found = [words for words, holds in (("not finite", not_finite), (far, is_far)) if holds]
    return " or ".join(found) or "without a time"


def _check_angles(poses: F64, where: str) -> None:
    largest = float(np.abs(poses).max())
    if largest > MAX_ANGLE_RAD:
        raise BadInputError(where, f"an angle of {largest:.3g}", "axis-angle in radians", "convert degrees to radians")


def _up_axis(poses: F64, places: F64 | None, raw: RawMotion, stated: str) -> tuple[str, str, tuple[str, ...]]:
    """The axis that is up, how it was decided, and a note where another one may be it.

    `poses` (T, 55, 3) and `places` (T, 3) of the pelvis, if recorded: of the usable frames.
    """
    if stated != "auto":
        return stated, "as given", ()
    mean = matrix_from_rotvec(poses[:, 0])[:, :, 1].mean(axis=0)
    name = next((name for name in raw.ups if (UPRIGHT[name] @ mean)[1] > LEAST_UP_COSINE), None)
    if name is None:
        return raw.up, "as usual for the format", ()
    if name == raw.up or places is None or raw.ups == ANY:
        return name, "as the body stands", ()
    heights, usual = (lowest(poses, places, raw.leg_m, UPRIGHT[axis][1]) for axis in (name, raw.up))
    if stands(heights):
        return name, "as the body stands", ()
    if lies(usual):
        what = f"`up_axis` {name.upper()} if it stands there"
        return raw.up, f"as the body lies, or is upside down, on the file's floor: {what}", ()
    doubt = f"up: one who lies, or is upside down, throughout needs `up_axis` {raw.up.upper()}"
    return name, "as the body stands", (doubt,)


def facing(root: F64) -> F64:
    """Turn about Y (3, 3) after which a body with root turn `root` (3, 3) faces +Z; the identity for one that lies."""
    x, _, z = root[:, 2]
    if np.hypot(x, z) < 0.3:
        return np.eye(3)
    return about(1, -np.arctan2(x, z))


def centred(translation: F64) -> F64:
    """`translation` (T, 3), shifted so that the rectangle of ground that it covers has its middle at the origin."""
    low, high = translation.min(axis=0), translation.max(axis=0)
    middle = (low + high) / 2
    return np.asarray(translation - np.array([middle[0], 0.0, middle[2]]))
