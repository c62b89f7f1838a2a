"""A motion from any source: SMPL-X poses at increasing times, sampled at any time between and beyond them.

A motion of one frame can be sampled like one of a thousand; nothing here depends on a file format.
"""

from __future__ import annotations

import enum
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from trilane.arrays import F64
from trilane.body.joints import JOINT_INDEX, JOINT_NAMES
from trilane.scene.recordings import NOTHING, Detected
from trilane.scene.rotations import quat_from_rotvec, rotvec_from_quat, slerp

#: Places in millimetres with the pelvis at the origin; right joints are the left ones, mirrored.
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
    """Return the joints (55, 3), metres."""
    rows = [
        np.multiply(_PLACES_MM[name.replace("right_", "left_")], (-1 if name.startswith("right_") else 1, 1, 1))
        for name in JOINT_NAMES
    ]
    return np.array(rows, dtype=np.float64) / 1000


#: Rest joints (55, 3), metres.
T_POSE = _joints()


#: Rest place of the pelvis of the published neutral SMPL-X body, metres; translations in AMASS files start from it.
REST_PELVIS: F64 = np.array([0.003, -0.351, 0.012])
#: Rest place of the pelvis of SMPL's neutral body, to some 2 cm: betas and sex move it by as much.
SMPL_REST_PELVIS: F64 = np.array([-0.002, -0.23, 0.028])


def rest_leg_m(joints: F64) -> float:
    """Return the length of the left leg of rest `joints` (55, 3), hip to knee to ankle, metres."""
    hip, knee, ankle = (joints[JOINT_INDEX[f"left_{name}"]] for name in ("hip", "knee", "ankle"))
    return float(np.linalg.norm(knee - hip) + np.linalg.norm(ankle - knee))


class Wrap(enum.Enum):
    """What follows the last frame. The values are words for notes."""

    LOOP = "loops"
    BOUNCE = "plays back and forth"
    HOLD = "holds its last frame"


def wrapped_time(t_s: float, length_s: float, wrap: Wrap) -> float:
    """Return the time in [0, length_s] whose frame is shown at `t_s`; 0 for a length of 0."""
    if length_s <= 0:
        return 0.0
    if wrap is Wrap.HOLD:
        return min(max(t_s, 0.0), length_s)
    if wrap is Wrap.LOOP:
        return t_s % length_s
    phase = t_s % (2 * length_s)
    return min(phase, 2 * length_s - phase)


def bracket(times_s: F64, t_s: float) -> tuple[int, int, float]:
    """Return the neighbours `i <= j` of `t_s` in increasing `times_s` (T,), and its share of the way, 0 to 1."""
    last = len(times_s) - 1
    j = min(max(int(np.searchsorted(times_s, t_s, side="right")), 1), last) if last else 0
    i = max(j - 1, 0)
    span = times_s[j] - times_s[i]
    fraction = (t_s - times_s[i]) / span if span > 0 else 0.0
    return i, j, float(min(max(fraction, 0.0), 1.0))


@dataclass(frozen=True)
class Motion:
    """Poses over time, upright, facing +Z at first, in the middle of the ground they cover.

    `times_s` (T,): times from 0, strictly increasing. `poses` (T, 55, 3): axis-angle, radians, SMPL-X joint order.
    `translation` (T, 3): place of the pelvis, metres, Y up. `betas` (n,): coefficients of the shape, or None. `notes`:
    how the source was read, for people. `wrap`: what follows the last frame. `leg_m`: hip to ankle of the recorded
    person, by which the translation is scaled to another body; None when unknown. `travels`: whether the translation
    was recorded. `detected`: facts about its file. `stance` (T,): how much the recorded feet stand on the floor, 0 to
    1; None when unknown.
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
        """Time of the last frame."""
        return float(self.times_s[-1])

    @cached_property
    def quats(self) -> F64:
        """Return `poses` as unit quaternions (T, 55, 4)."""
        return quat_from_rotvec(self.poses)

    def sample(self, t_s: float) -> tuple[F64, F64]:
        """Return pose (55, 3) and translation (3,) at `t_s`: turns interpolated by slerp, the translation linearly."""
        i, j, fraction = bracket(self.times_s, wrapped_time(t_s, self.duration_s, self.wrap))
        pose = rotvec_from_quat(slerp(self.quats[i], self.quats[j], fraction))
        start, end = self.translation[i], self.translation[j]
        return pose, start + (end - start) * fraction

    def sample_all(self, times_s: F64) -> tuple[F64, F64]:
        """Return poses (N, 55, 3) and translations (N, 3) at `times_s` (N,), each as `sample` gives it."""
        brackets = [bracket(self.times_s, wrapped_time(float(t_s), self.duration_s, self.wrap)) for t_s in times_s]
        i, j = (np.array([neighbours[k] for neighbours in brackets]) for k in (0, 1))
        fraction = np.array([fraction for _, _, fraction in brackets])
        poses = rotvec_from_quat(slerp(self.quats[i], self.quats[j], fraction[:, None]))
        start, end = self.translation[i], self.translation[j]
        return poses, start + (end - start) * fraction[:, None]
