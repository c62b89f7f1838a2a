"""Turns over time from directions: frames of two directions, least turns, and constant offsets between two turns.

Rule: every function takes (T, 3) and (T, 3, 3) arrays and gives proper rotations where its input is finite.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from trilane.arrays import F64
from trilane.scene.motion.tracks import unit
from trilane.scene.rotations import matrix_from_quat, normalised

#: Of a direction along another one: the part beside it that is too short to tell a turn.
TOO_SHORT = 1e-6


def transposed(turns: F64) -> F64:
    """The inverse of each turn (T, 3, 3)."""
    return np.swapaxes(turns, -1, -2)


def turned(turns: F64, vectors: F64) -> F64:
    """Vectors (T, 3) or (3,) under turns (T, 3, 3) or (3, 3)."""
    return np.asarray((turns @ vectors[..., None])[..., 0])


def beside(vectors: F64, axis: F64) -> F64:
    """The part of vectors (T, 3) that is perpendicular to unit vectors `axis` (T, 3)."""
    return np.asarray(vectors - (vectors * axis).sum(axis=-1, keepdims=True) * axis)


def frames_along(exact: F64, other: F64, first: str) -> F64:
    """Frames (T, 3, 3) with left, up and forward as columns.

    `first`: `left` when `exact` (T, 3) is the left and `other` (T, 3) is towards up; `up` when it is the other way
    round. Where both are along one line, any perpendicular direction takes the place of `other`.
    """
    a = unit(exact)
    b = beside(unit(other), a)
    along = np.linalg.norm(b, axis=-1, keepdims=True) < TOO_SHORT
    b = unit(np.where(along, np.cross(a, np.eye(3)[np.abs(a).argmin(axis=-1)]), b) if along.any() else b)
    left, up = (a, b) if first == "left" else (b, a)
    return np.stack([left, up, np.cross(left, up)], axis=-1)


def least_turns(source: F64, target: F64) -> F64:
    """The turn (T, 3, 3) of the least angle from each direction `source` (T, 3) to `target` (T, 3).

    As a quaternion it is (1 + cos, cross product), at unit length. Between opposite directions the axis is any
    perpendicular one.
    """
    a, b = unit(source), unit(target)
    a, b = np.broadcast_arrays(a, b)
    axis, cosine = np.cross(a, b), (a * b).sum(axis=-1)
    opposite = cosine < -1 + TOO_SHORT**2
    if opposite.any():
        axis = np.where(opposite[..., None], np.cross(a, np.eye(3)[np.abs(a).argmin(axis=-1)]), axis)
    quats = np.concatenate([np.where(opposite, 0.0, 1 + cosine)[..., None], axis], axis=-1)
    return matrix_from_quat(normalised(quats))


def mean_turn(turns: F64) -> F64:
    """The rotation (3, 3) nearest to the mean of turns (T, 3, 3), in the sense of least squares of their entries.

    Moakher, "Means and averaging in the group of rotations", SIAM J. Matrix Analysis 24(1), 2002.
    """
    u, _, v = np.linalg.svd(turns.mean(axis=0))
    return np.asarray(u @ np.diag([1.0, 1.0, np.linalg.det(u @ v)]) @ v)


def level_with(turns: F64, base: F64, where: NDArray[np.bool_]) -> F64:
    """`turns` (T, 3, 3), with a constant turn before them, so that on average over `where` (T,) they equal `base`."""
    return np.asarray(turns @ mean_turn(transposed(base[where]) @ turns[where]).T)
