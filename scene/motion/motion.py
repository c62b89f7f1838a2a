"""A motion from any source: SMPL-X poses at increasing times, which can be sampled at any time.

A motion of one frame can be sampled like a motion of a thousand; a `Motion` does not depend on a file format.
`motion_from_recording` makes a motion from a recording: bad frames are left out, Y is up, the first frame faces +Z, and
the middle of the covered ground is the origin.

**Up** is the axis that the scene states. Otherwise up is the axis along which the body's own up points on average. If
there is no such axis, up is the usual axis of the format. A body that always lies or stands on its hands must not turn
the world over. In files that have a floor, the floor is at 0. Therefore, if the lowest joint stays near 0 along an
axis, this axis is up. If this does not decide, a note says which other axis may be up.

**Stance** says when the feet stand. Each of ankles and toes has its own height while its foot stands. A person stands
while at least one of these joints is at that height.
"""

from __future__ import annotations

import enum
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from trilane.arrays import F64
from trilane.body.joints import JOINT_INDEX, JOINT_NAMES, JOINT_PARENTS
from trilane.errors import BadInputError
from trilane.scene.recordings import NOTHING, Detected, usable_samples
from trilane.scene.rotations import (
    Y_UP_FROM_Z_UP,
    about,
    matrix_from_rotvec,
    quat_from_rotvec,
    rotvec_from_matrix,
    rotvec_from_quat,
    slerp,
)

#: Positions of a plain body's rest joints, millimetres, with the pelvis at the origin; right joints mirror the left
#: ones.
_PLACES_MM = {
    "pelvis": (0, 0, 0), "left_hip": (117, -8, -10), "spine1": (0, 87, -35), "left_knee": (131, -416, 24),
    "spine2": (0, 239, -29), "left_ankle": (131, -859, -1), "spine3": (0, 368, -47), "left_foot": (143, -908, 146),
    "neck": (0, 569, 3), "left_collar": (23, 493, 16), "head": (0, 670, 39), "left_shoulder": (185, 488, 12),
    "left_elbow": (457, 488, 12), "left_wrist": (712, 488, 12), "jaw": (0, 677, 53), "left_eye": (30, 711, 121),
    "left_index1": (825, 483, 40), "left_index2": (853, 483, 44), "left_index3": (878, 483, 47),
    "left_middle1": (824, 488, 12), "left_middle2": (861, 488, 6), "left_middle3": (890, 488, 4),
    "left_pinky1": (807, 483, -30), "left_pinky2": (828, 483, -40), "left_pinky3": (844, 483, -46),
    "left_ring1": (818, 488, -10), "left_ring2": (849, 488, -20), "left_ring3": (875, 488, -26),
    "left_thumb1": (753, 484, 38), "left_thumb2": (766, 461, 59), "left_thumb3": (793, 442, 80),
}  # fmt: skip


def _joints() -> F64:
    rows = [
        np.multiply(_PLACES_MM[name.replace("right_", "left_")], (-1 if name.startswith("right_") else 1, 1, 1))
        for name in JOINT_NAMES
    ]
    return np.array(rows, dtype=np.float64) / 1000


#: Rest joints (55, 3) of a plain body, metres.
T_POSE = _joints()


#: Rest position (3,) of the pelvis of the published neutral SMPL-X body, metres; AMASS files state translations from
#: it.
REST_PELVIS: F64 = np.array([0.003, -0.351, 0.012])
#: Rest position (3,) of the pelvis of SMPL's neutral body, metres, to within 2 cm: betas and sex move it by as much.
SMPL_REST_PELVIS: F64 = np.array([-0.002, -0.23, 0.028])


def rest_leg_m(joints: F64) -> float:
    """Return the length of the left leg of rest `joints` (55, 3), from hip over knee to ankle, metres."""
    hip, knee, ankle = (joints[JOINT_INDEX[f"left_{name}"]] for name in ("hip", "knee", "ankle"))
    return float(np.linalg.norm(knee - hip) + np.linalg.norm(ankle - knee))


class Wrap(enum.Enum):
    """What follows the last frame. The values are texts for notes."""

    LOOP = "loops"
    BOUNCE = "plays back and forth"
    HOLD = "holds its last frame"


def wrapped_time(t_s: float, length_s: float, wrap: Wrap) -> float:
    """Return the time in [0, `length_s`] whose frame is shown at `t_s`; `wrap`: what follows the last frame."""
    if length_s <= 0:
        return 0.0
    if wrap is Wrap.HOLD:
        return min(max(t_s, 0.0), length_s)
    if wrap is Wrap.LOOP:
        return t_s % length_s
    phase = t_s % (2 * length_s)
    return min(phase, 2 * length_s - phase)


def bracket(times_s: F64, t_s: float) -> tuple[int, int, float]:
    """Return (i, j, share): the neighbours i <= j of `t_s` in increasing `times_s` (T,), and its share of the way.

    The share is 0 at i and 1 at j. A time outside the range counts as the nearest end.
    """
    last = len(times_s) - 1
    j = min(max(int(np.searchsorted(times_s, t_s, side="right")), 1), last) if last else 0
    i = max(j - 1, 0)
    span = times_s[j] - times_s[i]
    fraction = (t_s - times_s[i]) / span if span > 0 else 0.0
    return i, j, float(min(max(fraction, 0.0), 1.0))


@dataclass(frozen=True)
class Motion:
    """Poses over time: Y is up, the first frame faces +Z, the middle of the covered ground is the origin.

    `times_s` (T,): times from 0, strictly increasing.
    `poses` (T, 55, 3): axis-angle, radians, SMPL-X joint order.
    `translation` (T, 3): positions of the pelvis, metres.
    `betas` (n,): shape coefficients; None when unknown.
    `notes`: how the source was read, for people.
    `wrap`: what follows the last frame.
    `leg_m`: length of the recorded person's leg, by which the translation is scaled to another body; None when unknown.
    `travels`: whether the translation was recorded.
    `detected`: facts about the file.
    `stance` (T,): how much the recorded feet stand on the floor, 0 to 1; None when unknown.
    """

    times_s: F64
    poses: F64
    translation: F64
    betas: F64 | None
    notes: tuple[str, ...]
    wrap: Wrap
    leg_m: float | None = None
    travels: bool = True
    detected: Detected = NOTHING
    stance: F64 | None = None

    @property
    def duration_s(self) -> float:
        """Time of the last frame, seconds."""
        return float(self.times_s[-1])

    @cached_property
    def quats(self) -> F64:
        """`poses` as unit quaternions (T, 55, 4)."""
        return quat_from_rotvec(self.poses)

    def sample(self, t_s: float) -> tuple[F64, F64]:
        """Return the pose (55, 3) and the translation (3,) at `t_s`; rotations by slerp, the translation linearly."""
        i, j, fraction = bracket(self.times_s, wrapped_time(t_s, self.duration_s, self.wrap))
        pose = rotvec_from_quat(slerp(self.quats[i], self.quats[j], fraction))
        start, end = self.translation[i], self.translation[j]
        return pose, start + (end - start) * fraction

    def sample_all(self, times_s: F64) -> tuple[F64, F64]:
        """Return poses (N, 55, 3) and translations (N, 3) at `times_s` (N,), as `sample` returns them."""
        brackets = [bracket(self.times_s, wrapped_time(float(t_s), self.duration_s, self.wrap)) for t_s in times_s]
        i, j = (np.array([neighbours[k] for neighbours in brackets]) for k in (0, 1))
        fraction = np.array([fraction for _, _, fraction in brackets])
        poses = rotvec_from_quat(slerp(self.quats[i], self.quats[j], fraction[:, None]))
        start, end = self.translation[i], self.translation[j]
        return poses, start + (end - start) * fraction[:, None]


#: Number of joints of the body; in the joint order, face and hands come after them.
BODY_JOINT_COUNT = 22
#: Most frames that are examined, evenly spread over the motion.
MOST_LOOKED_AT = 200
#: A person lies, or stands on the hands, if the median height of the lowest joint is in LIES_M. Also, 80 % of the
#: heights must be within LIES_SPREAD_M; metres. Joints of a lying person are up to half a trunk's depth above the
#: floor.
LIES_M, LIES_SPREAD_M = (-0.02, 0.17), 0.08
#: The same ranges for a person who stands or walks. Toes are 2 to 5 cm above the floor, and floors of recordings are
#: off by centimetres.
STANDS_M, STANDS_SPREAD_M = (-0.12, 0.25), 0.25


def joint_places(poses: F64, places: F64, leg_m: float | None) -> F64:
    """Return the positions (T, 22, 3) of a plain body's joints, metres.

    `poses` (T, 55, 3): axis-angle. `places` (T, 3): positions of the pelvis, metres. `leg_m`: length of a leg, metres,
    to which the body is scaled; None for the plain body's length.
    """
    rest = T_POSE * (leg_m / rest_leg_m(T_POSE) if leg_m else 1.0)
    turns = matrix_from_rotvec(poses[:, :BODY_JOINT_COUNT])
    found = np.repeat(places[:, None], BODY_JOINT_COUNT, axis=1)
    for joint, parent in enumerate(JOINT_PARENTS[1:BODY_JOINT_COUNT], 1):
        found[:, joint] = found[:, parent] + turns[:, parent] @ (rest[joint] - rest[parent])
        turns[:, joint] = turns[:, parent] @ turns[:, joint]
    return found


def lowest(poses: F64, places: F64, leg_m: float | None, up: F64) -> F64:
    """Return the height (n,), metres, of the lowest joint in n <= MOST_LOOKED_AT frames.

    `up` (3,): direction of heights. The other parameters are as in `joint_places`.
    """
    some = np.linspace(0, len(poses) - 1, min(len(poses), MOST_LOOKED_AT)).round().astype(int)
    return np.asarray((joint_places(poses[some], places[some], leg_m) @ up).min(axis=1))


def lies(heights: F64) -> bool:
    """Return whether a person lies, or stands on the hands. `heights` (n,): heights of the lowest joint, metres."""
    return _are_within(heights, LIES_M, LIES_SPREAD_M)


def stands(heights: F64) -> bool:
    """Return whether a person stands or walks. `heights` (n,): heights of the lowest joint, metres."""
    return _are_within(heights, STANDS_M, STANDS_SPREAD_M)


def _are_within(heights: F64, within: tuple[float, float], spread: float) -> bool:
    low, middle, high = np.quantile(heights, (0.1, 0.5, 0.9))
    return bool(within[0] <= middle <= within[1] and high - low <= spread)


#: The height at which a joint stands is this percentile of its heights.
STANDING_PERCENTILE = 5.0
#: A joint stands if it is at most FOOT_STANDS_M above that height, and flies from FOOT_FLIES_M above it on; metres.
FOOT_STANDS_M, FOOT_FLIES_M = 0.03, 0.06


def stance(heights: F64) -> F64:
    """Return how much the person stands, for each frame (T,): 1 on the floor, 0 in the air.

    `heights` (T, 2, n): heights of n recorded joints of the left and the right foot, metres.
    """
    standing = np.percentile(heights, STANDING_PERCENTILE, axis=(0, 1))
    above = (heights - standing).min(axis=(1, 2))
    return np.asarray(np.clip((FOOT_FLIES_M - above) / (FOOT_FLIES_M - FOOT_STANDS_M), 0.0, 1.0))


MAX_FRAMES = 200_000
MAX_ANGLE_RAD = 64.0
MAX_PLACE_M = 10_000.0
#: For each axis, the rotation (3, 3) that makes it +Y.
UPRIGHT: dict[str, F64] = {
    "y": np.eye(3),
    "z": Y_UP_FROM_Z_UP,
    "x": about(2, np.pi / 2),
    "-y": about(0, np.pi),
    "-z": about(0, np.pi / 2),
    "-x": about(2, -np.pi / 2),
}
#: Axes that may be up: in a world, and in arbitrary coordinates such as a camera's.
WORLD, ANY = ("y", "z"), tuple(UPRIGHT)
#: The body's own up decides if its mean cosine with an axis is above this.
LEAST_UP_COSINE = 0.7


@dataclass(frozen=True)
class RawMotion:
    """The content of a motion file, before frames are left out and the world is turned.

    `times_s` (T,): seconds; may contain NaN and repeated times.
    `poses` (T, 55, 3): axis-angle, radians, SMPL-X joint order.
    `translation` (T, 3): positions of the pelvis, metres; None when the format has none.
    `betas` (n,): shape coefficients; None when the file has none.
    `up`: axis that is usually up in the format. `ups`: all axes that may be up.
    `notes`: notes on the file, for people.
    `leg_m`: length of the recorded person's leg, metres; None when unknown.
    `detected`: facts about the file, but not its axes.
    `feet` (T, 2, n, 3): positions of n joints of the left and the right foot, metres; None when unknown.
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
    """Return the motion of a file.

    `raw`: content of the file. `where`: path of the file, for messages. `up_axis`: a key of UPRIGHT, or `auto`.
    Raises BadInputError when the file has more than MAX_FRAMES frames, is in degrees, or is unreadable in more than
    half of its frames.
    """
    if len(raw.times_s) > MAX_FRAMES:
        raise BadInputError(where, f"{len(raw.times_s)} frames", f"at most {MAX_FRAMES}")
    shift = np.zeros((len(raw.poses), 3)) if raw.translation is None else raw.translation
    usable, repairs = usable_samples(
        where, raw.times_s, _readable(raw.poses, shift), broken_as=_broken_as(raw.poses, shift)
    )
    times, poses, shift = raw.times_s[usable], raw.poses[usable], shift[usable]
    largest = float(np.abs(poses).max())
    if largest > MAX_ANGLE_RAD:
        raise BadInputError(where, f"an angle of {largest:.3g}", "axis-angle in radians", "convert degrees to radians")
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
    """Return a mask (T,) of the frames whose numbers are finite and whose position `shift` is within MAX_PLACE_M."""
    finite = np.isfinite(poses).all(axis=(1, 2)) & np.isfinite(shift).all(axis=1)
    with np.errstate(invalid="ignore"):
        return np.asarray(finite & (np.abs(shift) < MAX_PLACE_M).all(axis=1))


def _broken_as(poses: F64, shift: F64) -> str:
    """Return what is wrong with the unreadable frames, in words. `poses`, `shift`: as in `_readable`."""
    not_finite = not (np.isfinite(poses).all() and np.isfinite(shift).all())
    with np.errstate(invalid="ignore"):
        is_far = bool((np.abs(np.where(np.isfinite(shift), shift, 0.0)) >= MAX_PLACE_M).any())
    far = f"{MAX_PLACE_M / 1000:g} km or more from the origin"
    found = [words for words, holds in (("not finite", not_finite), (far, is_far)) if holds]
    return " or ".join(found) or "without a time"


def _up_axis(poses: F64, places: F64 | None, raw: RawMotion, stated: str) -> tuple[str, str, tuple[str, ...]]:
    """Return (axis that is up, reason in words, a note if another axis may be up)."""
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
    """Return the rotation (3, 3) about Y after which a body with root rotation `root` (3, 3) faces +Z.

    The result is the identity for a body that lies.
    """
    x, _, z = root[:, 2]
    if np.hypot(x, z) < 0.3:
        return np.eye(3)
    return about(1, -np.arctan2(x, z))


def centred(translation: F64) -> F64:
    """Return `translation` (T, 3), shifted so that the middle of the covered ground's rectangle is the origin."""
    low, high = translation.min(axis=0), translation.max(axis=0)
    middle = (low + high) / 2
    return np.asarray(translation - np.array([middle[0], 0.0, middle[2]]))
