"""Conversions of rotations: quaternions `w, x, y, z`, axis-angle vectors in radians, 3x3 matrices for column vectors.

Rule: unless a shape is fixed, every function accepts any leading axes. All functions compute in float64 and are exact
at angles of 0 and pi.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from trilane.arrays import F64

#: Rotation matrix from a Z-up world to a Y-up world; x stays the same.
Y_UP_FROM_Z_UP: F64 = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])


def quat_from_rotvec(rotvec: ArrayLike) -> F64:
    """Convert axis-angle (..., 3) to unit quaternions (..., 4); w is negative for angles between pi and 3 pi."""
    vectors = np.asarray(rotvec, dtype=np.float64)
    half = np.sqrt((vectors * vectors).sum(axis=-1, keepdims=True)) / 2
    return np.concatenate([np.cos(half), np.sinc(half / np.pi) * vectors / 2], axis=-1)


def rotvec_from_quat(quat: ArrayLike) -> F64:
    """Convert unit quaternions (..., 4) to the shortest axis-angle (..., 3), with angles in [0, pi]."""
    q = np.asarray(quat, dtype=np.float64)
    sine = np.sqrt((q[..., 1:] * q[..., 1:]).sum(axis=-1))
    flip = np.where(q[..., 0] < 0, -1.0, 1.0)
    angle = 2 * np.arctan2(sine, q[..., 0] * flip)
    small = sine < 1e-12
    factor = np.where(small, 2.0, angle / np.where(small, 1.0, sine)) * flip
    return np.asarray(q[..., 1:] * factor[..., None])


def _products_to_matrix() -> F64:
    """Return the matrix (16, 9) from the outer product q q^T to the rotation matrix, both flattened by rows.

    q is the unit quaternion (w, x, y, z).
    """
    table = np.zeros((4, 4, 3, 3))
    table[0, 0] = np.eye(3)
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        table[1 + i, 1 + i, [i, j, k], [i, j, k]] = 1.0, -1.0, -1.0
        table[1 + i, 1 + j, [i, j], [j, i]] = 2.0
        table[0, 1 + i, [k, j], [j, k]] = 2.0, -2.0
    return table.reshape(16, 9)


_MATRIX = _products_to_matrix()


def matrix_from_quat(quat: ArrayLike) -> F64:
    """Convert unit quaternions (..., 4) to rotation matrices (..., 3, 3)."""
    q = np.asarray(quat, dtype=np.float64)
    products = q[..., :, None] * q[..., None, :]
    return np.asarray((products.reshape(*q.shape[:-1], 16) @ _MATRIX).reshape(*q.shape[:-1], 3, 3))


def quat_from_matrix(matrix: ArrayLike) -> F64:
    """Convert rotation matrices (..., 3, 3) to unit quaternions (..., 4), computed from the largest component.

    Shepperd, "Quaternion from rotation matrix", J. Guidance and Control 1(3), 1978.
    """
    m = np.asarray(matrix, dtype=np.float64)
    xx, yy, zz = m[..., 0, 0], m[..., 1, 1], m[..., 2, 2]
    a, b, c = m[..., 2, 1] - m[..., 1, 2], m[..., 0, 2] - m[..., 2, 0], m[..., 1, 0] - m[..., 0, 1]
    d, e, f = m[..., 1, 0] + m[..., 0, 1], m[..., 0, 2] + m[..., 2, 0], m[..., 2, 1] + m[..., 1, 2]
    outer = np.stack(
        [
            np.stack([1 + xx + yy + zz, a, b, c], axis=-1),
            np.stack([a, 1 + xx - yy - zz, d, e], axis=-1),
            np.stack([b, d, 1 - xx + yy - zz, f], axis=-1),
            np.stack([c, e, f, 1 - xx - yy + zz], axis=-1),
        ],
        axis=-2,
    )
    best = np.argmax(np.diagonal(outer, axis1=-2, axis2=-1), axis=-1)
    row = np.take_along_axis(outer, best[..., None, None], axis=-2)[..., 0, :]
    return normalised(row)


def matrix_from_rotvec(rotvec: ArrayLike) -> F64:
    """Convert axis-angle (..., 3) to rotation matrices (..., 3, 3)."""
    return matrix_from_quat(quat_from_rotvec(rotvec))


def rotvec_from_matrix(matrix: ArrayLike) -> F64:
    """Convert rotation matrices (..., 3, 3) to the shortest axis-angle (..., 3)."""
    return rotvec_from_quat(quat_from_matrix(matrix))


def about(axis: int, angle_rad: ArrayLike) -> F64:
    """Return rotation matrices (..., 3, 3) about coordinate axis 0, 1 or 2 by the angles `angle_rad` (...)."""
    angle = np.asarray(angle_rad, dtype=np.float64)
    unit = np.zeros(3)
    unit[axis] = 1.0
    return matrix_from_rotvec(angle[..., None] * unit)


def quat_multiply(left: ArrayLike, right: ArrayLike) -> F64:
    """Return the Hamilton product (..., 4): the rotation by `right`, followed by `left`."""
    aw, ax, ay, az = np.moveaxis(np.asarray(left, dtype=np.float64), -1, 0)
    bw, bx, by, bz = np.moveaxis(np.asarray(right, dtype=np.float64), -1, 0)
    return np.stack(
        [
            aw * bw - ax * bx - ay * by - az * bz,
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
        ],
        axis=-1,
    )


def slerp(start: ArrayLike, end: ArrayLike, fraction: ArrayLike) -> F64:
    """Interpolate unit quaternions (..., 4) on the great circle, along the shorter arc; `fraction` (...) in [0, 1].

    Between nearly equal quaternions, the interpolation is linear. Shoemake, "Animating rotation with quaternion
    curves", SIGGRAPH 1985.
    """
    a, b = np.asarray(start, dtype=np.float64), np.asarray(end, dtype=np.float64)
    s = np.asarray(fraction, dtype=np.float64)
    dot = (a * b).sum(axis=-1)
    sign = np.where(dot < 0, -1.0, 1.0)
    angle = np.arccos(np.minimum(dot * sign, 1.0))
    near = angle < 1e-6
    sine = np.where(near, 1.0, np.sin(angle))
    left = np.where(near, 1 - s, np.sin((1 - s) * angle) / sine)
    right = np.where(near, s, np.sin(s * angle) / sine) * sign
    return normalised(left[..., None] * a + right[..., None] * b)


def normalised(vectors: ArrayLike) -> F64:
    """Scale vectors (..., n) to unit length. A vector whose squared length is 0 becomes NaN or infinity."""
    v = np.asarray(vectors, dtype=np.float64)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray(v / np.sqrt((v * v).sum(axis=-1, keepdims=True)))


def shortest_turn(source: ArrayLike, target: ArrayLike, fallback: ArrayLike = (1.0, 0.0, 0.0)) -> F64:
    """Return the rotation (3, 3) of the smallest angle that takes direction `source` (3,) to direction `target` (3,).

    `fallback` (3,): preferred axis between opposite directions, made perpendicular to them.
    """
    a, b = normalised(source), normalised(target)
    axis = np.cross(a, b)
    sine = float(np.linalg.norm(axis))
    if sine < 1e-9:
        axis = np.asarray(fallback, dtype=np.float64)
        axis = axis - (axis @ a) * a
        if np.linalg.norm(axis) <= 1e-6:
            axis = np.cross(a, np.eye(3)[np.abs(a).argmin()])
    return matrix_from_rotvec(normalised(axis) * np.arctan2(sine, a @ b))
