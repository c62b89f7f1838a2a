"""Poses of arms and hands for the built-in motions: hanging, waving, relaxed fingers.

Rule: `side` is +1 for left and -1 for right; turns are local to the parent joint, from the T pose: +X left, +Y up, +Z
ahead.
"""

from __future__ import annotations

import numpy as np

from trilane.arrays import F64
from trilane.scene.rotations import about, normalised

#: Angle of a hanging arm below the T pose, radians, without the collar's part.
HANG = 1.27
ELBOW_EASE = 0.22
#: Directions of the right arm raised to wave: upper arm and forearm at the middle of the wave.
UPPER_ARM = (-0.80, -0.38, 0.30)
FOREARM = (-0.22, 0.95, 0.22)
WAVE_REACH = 0.42
#: Curl of a relaxed finger's three joints, radians.
CURL = {
    "index": (0.22, 0.32, 0.18),
    "middle": (0.30, 0.38, 0.22),
    "pinky": (0.38, 0.42, 0.25),
    "ring": (0.34, 0.40, 0.24),
}


def hanging_arm(side: int, swing: F64) -> tuple[F64, F64, F64]:
    """Shoulder, elbow and wrist (T, 3, 3) of an arm at the side, swung back by `swing` (T,) radians."""
    shoulder = about(0, swing + 0.03) @ about(2, np.array(-side * HANG))
    bend = ELBOW_EASE + np.clip(-swing, 0, None) * 0.7 + 0.1 * np.abs(swing)
    elbow = about(1, -side * bend)
    wrist = np.broadcast_to(about(2, np.array(-side * 0.08)), elbow.shape)
    return shoulder, elbow, wrist


def waving_arm(wave: F64) -> tuple[F64, F64, F64]:
    """Shoulder, elbow and wrist (T, 3, 3) of the right arm, palm to the viewer; `wave` (T,) in [-1, 1] is outward."""
    upper = normalised(np.array(UPPER_ARM) + 0.05 * wave[:, None] * np.array([-1.0, 0.5, 0.0]))
    fore = normalised(np.array(FOREARM) + WAVE_REACH * wave[:, None] * np.array([-1.0, 0.0, 0.0]))
    ahead = normalised(fore - (fore * upper).sum(axis=-1, keepdims=True) * upper)
    shoulder = np.stack([-upper, np.cross(ahead, -upper), ahead], axis=-1)
    bend = np.arccos((fore * upper).sum(axis=-1))
    wrist = about(2, -0.25 * wave)
    return shoulder, about(1, bend), about(1, np.full(len(wave), -0.1)) @ wrist


def relaxed_hands(side: int) -> F64:
    """Axis-angle (15, 3) of one hand's fingers, SMPL-X order: index, middle, pinky, ring, thumb."""
    fingers = [[(0.0, 0.0, -side * angle) for angle in CURL[name]] for name in ("index", "middle", "pinky", "ring")]
    thumb = [(0.1, -side * 0.15, 0.0), (0.0, side * 0.1, 0.0), (0.0, side * 0.12, 0.0)]
    return np.array([*fingers, thumb]).reshape(15, 3)
