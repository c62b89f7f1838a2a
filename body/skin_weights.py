"""Skin weights: the K largest of each vertex, and a bound on how far leaving out the others moves a vertex.

Rule: weights that remain are scaled to sum to 1, and what leaving out the others costs has a proved bound.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from trilane.arrays import F32, F64
from trilane.body.body import ShapedBody
from trilane.body.joints import JOINTS
from trilane.errors import BadInputError

WEIGHT_COUNTS = (4, 8, 12)


@dataclass(frozen=True)
class TopWeights:
    """`joints` (V,K) int32 and `weights` (V,K) float32, largest first, rows sum to 1; unused columns have weight 0."""

    joints: NDArray[np.int32]
    weights: F32

    def dense(self) -> F32:
        """The weights as (V,55) float32, one column per joint."""
        full = np.zeros((len(self.weights), JOINTS), np.float32)
        np.put_along_axis(full, self.joints, self.weights, axis=1)
        return full


def largest_weights(weights: F32, k: int) -> TopWeights:
    """The `k` largest of each row of `weights` (V,55), scaled to sum to 1.

    Raises BadInputError unless `k` is 4, 8 or 12.
    """
    if k not in WEIGHT_COUNTS:
        raise BadInputError("skin weights", str(k), "4, 8 or 12")
    order = np.argsort(-weights, axis=1, kind="stable")[:, :k]
    largest = np.take_along_axis(weights, order, axis=1).astype(np.float64)
    return TopWeights(order.astype(np.int32), (largest / largest.sum(axis=1, keepdims=True)).astype(np.float32))


def weight_error_bound(shaped: ShapedBody, weight_count: int) -> F64:
    """(V,) metres: the furthest that any pose moves a vertex when only its `weight_count` largest weights are used.

    Proof. Let joint j alone move the rest vertex p to y_j, and let e_j be the change of its weight; the e_j sum to 0.
    Joint b and its parent both move p rigidly, and both move the centre c_b of b to the same point, so y_b and y_parent
    lie on one sphere about that point: |y_b - y_parent| <= 2 |p - c_b|. With each y_j written as the root's y plus the
    steps down the chain to j,

        sum_j e_j y_j = sum_b E_b (y_b - y_parent),   E_b the sum of e_j over b and the joints below it,

    so the vertex moves by at most sum_b |E_b| 2 |p - c_b|. With pose blend shapes, p is the vertex that they moved.
    """
    largest = largest_weights(shaped.body.weights, weight_count).dense()
    change = branch_sums(shaped.body.parents, largest.astype(np.float64) - shaped.body.weights)
    return np.asarray((np.abs(change[:, 1:]) * 2.0 * joint_distance(shaped)[:, 1:]).sum(axis=1))


def joint_distance(shaped: ShapedBody) -> F64:
    """(V,55) metres from each rest vertex to each joint."""
    return np.asarray(np.linalg.norm(shaped.vertices[:, None, :] - shaped.joints[None], axis=2))


def branch_sums(parents: NDArray[np.int32], values: F64) -> F64:
    """`values` (..., 55) summed over each joint and all joints below it."""
    above = np.eye(len(parents))
    for joint in range(len(parents)):
        at = int(parents[joint])
        while at >= 0:
            above[joint, at] = 1.0
            at = int(parents[at])
    return np.asarray(values @ above)
