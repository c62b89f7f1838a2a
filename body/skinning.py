"""Linear blend skinning on the CPU: the K largest weights, the bound on what leaving out the rest costs, the vertices.

Rule: a saving comes with its proved bound. Weights that are left out are never lost: the kept ones are renormalised.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from trilane.arrays import F32, F64
from trilane.body.body import ShapedBody
from trilane.body.joints import JOINTS, POSE_FEATURES
from trilane.body.kinematics import Posed, Skeleton
from trilane.errors import BadInputError

WEIGHT_COUNTS = (4, 8, 12)
#: OpenBLAS wakes its other threads for products of more than 2**18 multiplications, which stalls on shared cores.
_BLOCK_ROWS = 256


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


def weight_error_bound(shaped: ShapedBody, weight_count: int) -> F64:
    """(V,) metres: no pose moves a vertex further than this by keeping only its `weight_count` largest weights.

    Let y_j be where joint j alone takes the rest vertex p, and e_j the change of its weights; the e_j add up to zero.
    Joint b and its parent carry p rigidly and agree on where the centre c_b of b goes, so their images of p lie on one
    sphere about it: |y_b - y_parent| <= 2 |p - c_b|. Writing each y_j as the root's image plus the steps down to j,

        sum_j e_j y_j = sum_b E_b (y_b - y_parent),   E_b the sum of e_j over b and the joints below it,

    so the vertex moves by at most sum_b |E_b| 2 |p - c_b|. With pose blend shapes p is where they take it.
    """
    kept = largest_weights(shaped.body.weights, weight_count).dense()
    change = branch_sums(shaped.body.parents, kept.astype(np.float64) - shaped.body.weights)
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


def blend_matrices(weights: F64, per_joint: F64) -> F64:
    """(N,M): `weights` (N,55) @ `per_joint` (55,M), in blocks so small that the BLAS keeps them on this thread."""
    blended = np.empty((len(weights), per_joint.shape[1]))
    whole = len(weights) // _BLOCK_ROWS * _BLOCK_ROWS
    blocks = weights[:whole].reshape(-1, _BLOCK_ROWS, weights.shape[1])
    np.matmul(blocks, per_joint, out=blended[:whole].reshape(-1, _BLOCK_ROWS, per_joint.shape[1]))
    np.matmul(weights[whole:], per_joint, out=blended[whole:])
    return blended


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
        moved = blend_matrices(self._weights, posed.matrices.reshape(JOINTS, 12).astype(np.float64)).reshape(-1, 3, 4)
        return np.asarray(np.einsum("vab,vb->va", moved[:, :, :3], rest) + moved[:, :, 3])


class FrameSkinner:
    """Vertices of one shaped body in float32, into memory that the caller owns: what the CPU unit does each frame.

    Vertices come in blocks. Neighbours hang on few joints, so a block is multiplied with its own joints alone, as many
    as the neediest block has. x of all vertices lie in a row, then y, then z.
    """

    def __init__(self, shaped: ShapedBody) -> None:
        body = shaped.body
        count = len(body.weights)
        blocks = -(-count // _BLOCK_ROWS)
        weights = np.zeros((blocks * _BLOCK_ROWS, JOINTS), np.float32)
        weights[:count] = body.weights
        per_block = weights.reshape(blocks, _BLOCK_ROWS, JOINTS).transpose(0, 2, 1)
        used = (per_block != 0).any(axis=2)
        self._joints = np.argsort(~used, axis=1, kind="stable")[:, : int(used.sum(axis=1).max())]
        self._weights = np.ascontiguousarray(np.take_along_axis(per_block, self._joints[:, :, None], axis=1))
        self._moved = np.empty((blocks, 12, _BLOCK_ROWS), np.float32)
        self._rest = np.zeros((3, blocks * _BLOCK_ROWS), np.float32)
        self._rest[:, :count] = shaped.vertices.T
        self._blended = self._rest.copy()
        self._blend = body.posedirs.reshape(-1, POSE_FEATURES) if body.posedirs is not None else None
        self._sum = np.empty((blocks, _BLOCK_ROWS), np.float32)
        self._term = np.empty_like(self._sum)

    def skin_into(self, posed: Posed, vertices: F32) -> None:
        """Write `vertices` (V,3), world metres, of a frame of `Skeleton.pose`."""
        count = len(vertices)
        if self._blend is not None:
            np.add(self._rest[:, :count], (self._blend @ posed.feature).reshape(-1, 3).T, out=self._blended[:, :count])
        rest = self._blended.reshape(3, -1, _BLOCK_ROWS)
        matrices = posed.matrices.reshape(JOINTS, 12)[self._joints]
        np.matmul(np.ascontiguousarray(matrices.transpose(0, 2, 1)), self._weights, out=self._moved)
        for axis in range(3):
            row = self._moved[:, 4 * axis : 4 * axis + 4]
            np.multiply(row[:, 0], rest[0], out=self._sum)
            for column in (1, 2):
                np.multiply(row[:, column], rest[column], out=self._term)
                np.add(self._sum, self._term, out=self._sum)
            np.add(self._sum, row[:, 3], out=self._sum)
            vertices[:, axis] = self._sum.reshape(-1)[:count]


def posed_vertices(shaped: ShapedBody, poses: ArrayLike, translation: ArrayLike | None = None) -> Iterator[F64]:
    """Vertices (V,3), metres, of each of the poses (T,165) that `Body.full_pose` gave. Raises BadInputError."""
    skeleton = Skeleton(shaped.joints, shaped.body.parents)
    skinner = CpuSkinner(shaped)
    for pose in np.atleast_2d(np.asarray(poses, np.float64)):
        yield skinner.vertices(skeleton.pose(pose, translation))
