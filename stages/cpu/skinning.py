"""Linear blend skinning on the CPU: the K largest weights, the bound on what leaving out the rest costs, the vertices.

Rule: a saving comes with its proved bound. Weights that are left out are never lost: the kept ones are renormalised.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from trilane.errors import BadInputError
from trilane.stages.contracts import JOINTS, POSE_FEATURES
from trilane.stages.cpu.body import ShapedBody
from trilane.stages.cpu.kinematics import Posed, Skeleton

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]

WEIGHT_COUNTS = (4, 8, 12)


@dataclass(frozen=True)
class TopWeights:
    """`joints` (V,K) int32 and `weights` (V,K) float32, largest first, rows sum to 1; unused places hold weight 0."""

    joints: NDArray[np.int32]
    weights: F32

    def dense(self) -> F32:
        """(V,55) float32."""
        full = np.zeros((len(self.weights), JOINTS), np.float32)
        np.put_along_axis(full, self.joints, self.weights, axis=1)
        return full


def largest_weights(weights: F32, k: int) -> TopWeights:
    """The `k` largest of each row of `weights` (V,55), renormalised. Raises BadInputError unless `k` is 4, 8 or 12."""
    if k not in WEIGHT_COUNTS:
        raise BadInputError("skin weights", str(k), "4, 8 or 12")
    order = np.argsort(-weights, axis=1, kind="stable")[:, :k]
    kept = np.take_along_axis(weights, order, axis=1).astype(np.float64)
    return TopWeights(order.astype(np.int32), (kept / kept.sum(axis=1, keepdims=True)).astype(np.float32))


def weight_error_bound(shaped: ShapedBody, k: int) -> F64:
    """(V,) metres: no pose moves a vertex further than this by keeping only its `k` largest weights.

    Let y_j be where joint j alone takes the rest vertex p, S the kept joints of total weight m, D the others. The
    exact vertex is x = sum w_j y_j, the approximate one x' = sum_S (w_i / m) y_i. As x = m x' + sum_D w_j y_j and
    m + sum_D w_j = 1,

        x - x' = sum_D w_j (y_j - x') = sum_D sum_S w_j (w_i / m) (y_j - y_i).

    A joint b and its parent both carry p rigidly and agree on where the centre c_b of joint b goes, so their images of
    p lie on one sphere about it: |y_b - y_parent| <= 2 |p - c_b|. Summed over the path from i to j in the joint
    tree this bounds |y_j - y_i| by d(i, j), and |x - x'| <= sum_D sum_S w_j (w_i / m) d(i, j). Pose blend shapes that
    move p by e add at most 2 e per joint on the path.
    """
    body = shaped.body
    reach = path_reach(shaped)
    common = _common_ancestors(body.parents)
    order = np.argsort(-body.weights, axis=1, kind="stable")
    sorted_weights = np.take_along_axis(body.weights, order, axis=1).astype(np.float64)
    bound = np.zeros(len(order))
    rows = np.flatnonzero(sorted_weights[:, k] > 0.0)
    if not len(rows):
        return bound
    kept, share = order[rows, :k], sorted_weights[rows, :k]
    share = share / share.sum(axis=1, keepdims=True)
    here = np.arange(len(rows))[:, None]
    near = reach[rows]
    for column in range(k, JOINTS):
        weight = sorted_weights[rows, column]
        if not weight.any():
            break
        left_out = order[rows, column][:, None]
        distance = near[here, kept] + near[here, left_out] - 2.0 * near[here, common[kept, left_out]]
        bound[rows] += weight * (share * distance).sum(axis=1)
    return bound


def path_reach(shaped: ShapedBody) -> F64:
    """(V,55): sum of 2 |p - c_b| over the joints b from below the root down to each joint, metres."""
    steps = 2.0 * np.linalg.norm(shaped.vertices[:, None, :] - shaped.joints[None], axis=2)
    steps[:, 0] = 0.0
    return np.asarray(steps @ _on_path(shaped.body.parents).T.astype(np.float64))


def _on_path(parents: NDArray[np.int32]) -> NDArray[np.bool_]:
    """(55,55) [joint, ancestor]: is it the joint itself or above it."""
    above = np.eye(len(parents), dtype=bool)
    for joint in range(len(parents)):
        at = int(parents[joint])
        while at >= 0:
            above[joint, at] = True
            at = int(parents[at])
    return above


def _common_ancestors(parents: NDArray[np.int32]) -> NDArray[np.int64]:
    """(55,55): the deepest joint that is above or equal to both."""
    above = _on_path(parents)
    depth = above.sum(axis=1)
    shared = above[:, None, :] & above[None, :, :]
    return np.where(shared, depth, -1).argmax(axis=2)


class CpuSkinner:
    """Vertices of one shaped body, frame by frame, in float64 inside.

    `weight_count`: None for all weights, else 4, 8 or 12. `pose_blend`: apply the pose blend shapes, if it has any.
    """

    def __init__(self, shaped: ShapedBody, weight_count: int | None = None, pose_blend: bool = True) -> None:
        body = shaped.body
        weights = body.weights if weight_count is None else largest_weights(body.weights, weight_count).dense()
        self._weights = weights.astype(np.float64)
        self._rest = shaped.vertices.astype(np.float64)
        self._blend = body.posedirs.reshape(-1, POSE_FEATURES) if pose_blend and body.posedirs is not None else None

    def vertices(self, posed: Posed) -> F64:
        """(V,3) world metres of a frame of `Skeleton.pose`."""
        rest = self._rest
        if self._blend is not None:
            rest = rest + (self._blend @ posed.feature).reshape(-1, 3)
        moved = (self._weights @ posed.matrices.reshape(JOINTS, 12).astype(np.float64)).reshape(-1, 3, 4)
        return np.asarray(np.einsum("vab,vb->va", moved[:, :, :3], rest) + moved[:, :, 3])


def posed_vertices(shaped: ShapedBody, poses: ArrayLike, translation: ArrayLike | None = None) -> F32:
    """(T,V,3) float32 vertices of poses (T,165) as `Body.full_pose` gives them. Raises BadInputError."""
    frames = np.atleast_2d(np.asarray(poses, np.float64))
    skeleton = Skeleton(shaped.joints, shaped.body.parents)
    skinner = CpuSkinner(shaped)
    out = np.empty((len(frames), len(shaped.vertices), 3), np.float32)
    for frame, pose in enumerate(frames):
        out[frame] = skinner.vertices(skeleton.pose(pose, translation))
    return out
