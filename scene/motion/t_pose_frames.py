"""Tells frames of a T pose that a recording begins with and that are no part of its motion.

Rule: such frames stand still with arms to the sides and straight legs, and the next frame is elsewhere; a motion that
begins in a T pose and moves on from it keeps it.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from trilane.arrays import F64
from trilane.scene.motion.tracks import SIDES, Tracks, angle_between

#: How far arms may be from the line of the hips, and legs from that of the trunk; how far a still bone turns; radians.
IN_T, STILL = np.radians(20.0), np.radians(2.0)
#: A bone that turns by more between two frames jumps, radians.
JUMP = np.radians(20.0)
CHAINS = (("shoulder", "elbow"), ("elbow", "wrist"), ("hip", "knee"), ("knee", "ankle"))


def leading_t_pose(tracks: Tracks, trunk: F64) -> tuple[int, tuple[str, ...]]:
    """How many frames at the beginning are a T pose from which the motion jumps away, and a note on a T pose there.

    `trunk`: its line (T, 3).
    """
    pairs = [(f"{side}_{start}", f"{side}_{end}") for start, end in CHAINS for side in SIDES]
    if tracks.frames < 2 or not all(tracks.has(*pair) for pair in pairs):
        return 0, ()
    bones = np.array([tracks.bone(*pair) for pair in pairs])
    moved = np.flatnonzero(angle_between(bones, bones[:, :1]).max(axis=0) > STILL)
    if not len(moved) or not _in_t(tracks, trunk, bones)[0]:
        return 0, ()
    first = int(moved[0])
    if angle_between(bones[:, first], bones[:, first - 1]).max() < JUMP:
        return 0, ("begins in a T pose and moves on from it; `start_s` leaves it out",)
    return first, (f"a T pose before the motion, which jumps away from it: left out, {first} of the frames",)


def _in_t(tracks: Tracks, trunk: F64, bones: F64) -> NDArray[np.bool_]:
    """Whether the bones (8, T, 3) of CHAINS are in a T pose, per frame (T,)."""
    left = tracks.across("hip")
    expected = np.array([left, -left, left, -left, -trunk, -trunk, -trunk, -trunk])
    return np.asarray((angle_between(bones, expected) < IN_T).all(axis=0))
