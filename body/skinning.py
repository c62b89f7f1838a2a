"""Linear blend skinning of vertices on the CPU.

Rule: x_world = sum_j w_j (matrix_j @ [x_rest, 1]); the products are small enough that the BLAS starts no threads.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import ArrayLike

from trilane.arrays import F32, F64
from trilane.body.body import ShapedBody
from trilane.body.detail import EVERYTHING, Detail
from trilane.body.joints import JOINTS, POSE_FEATURES
from trilane.body.kinematics import Posed, Skeleton
from trilane.body.skin_weights import largest_weights

#: Vertices of one product. OpenBLAS wakes its other threads for more than 2**18 multiplications, which stalls on shared
#: cores.
_BLOCK_ROWS = 256


def blend_matrices(weights: F64, per_joint: F64) -> F64:
    """(N,M): `weights` (N,55) @ `per_joint` (55,M), in blocks that the BLAS computes on the calling thread."""
    blended = np.empty((len(weights), per_joint.shape[1]))
    whole = len(weights) // _BLOCK_ROWS * _BLOCK_ROWS
    blocks = weights[:whole].reshape(-1, _BLOCK_ROWS, weights.shape[1])
    np.matmul(blocks, per_joint, out=blended[:whole].reshape(-1, _BLOCK_ROWS, per_joint.shape[1]))
    np.matmul(weights[whole:], per_joint, out=blended[whole:])
    return blended


class CpuSkinner:
    """Vertices of one shaped body, frame by frame, in float64 inside.

    `weight_count`: None for all weights, else 4, 8 or 12. `pose_blend`: apply the body's pose blend shapes, if any.
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
    """Vertices of one shaped body in float32, written into the caller's memory: the CPU unit does this each frame.

    Vertices are computed in blocks. Neighbouring vertices depend on few joints, so a block is multiplied only by the
    joints it has weights for; every block uses as many joints as the block with the most. x of all vertices is stored
    in one row, then y, then z.
    """

    def __init__(self, shaped: ShapedBody, detail: Detail = EVERYTHING) -> None:
        """`detail`: how much of the body is modelled."""
        body = shaped.body
        count = len(body.weights)
        blocks = -(-count // _BLOCK_ROWS)
        weights = np.zeros((blocks * _BLOCK_ROWS, JOINTS), np.float32)
        weights[:count] = detail.weights(shaped)
        per_block = weights.reshape(blocks, _BLOCK_ROWS, JOINTS).transpose(0, 2, 1)
        used = (per_block != 0).any(axis=2)
        self._joints = np.argsort(~used, axis=1, kind="stable")[:, : int(used.sum(axis=1).max())]
        self._weights = np.ascontiguousarray(np.take_along_axis(per_block, self._joints[:, :, None], axis=1))
        self._moved = np.empty((blocks, 12, _BLOCK_ROWS), np.float32)
        self._rest = np.zeros((3, blocks * _BLOCK_ROWS), np.float32)
        self._rest[:, :count] = shaped.vertices.T
        self._blended = self._rest.copy()
        posedirs = body.posedirs if detail.pose_blend else None
        self._blend = None if posedirs is None else posedirs.reshape(-1, POSE_FEATURES)
        self._sum = np.empty((blocks, _BLOCK_ROWS), np.float32)
        self._term = np.empty_like(self._sum)

    @property
    def constant_bytes(self) -> int:
        """What every frame reads besides its pose: rest positions, weights, pose blend shapes."""
        kept = (self._rest, self._weights, self._joints, *(() if self._blend is None else (self._blend,)))
        return sum(array.nbytes for array in kept)

    def skin_into(self, posed: Posed, vertices: F32) -> None:
        """Write the skinned vertices of a frame of `Skeleton.pose` into `vertices` (V,3), world metres."""
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
    """Vertices (V,3), metres, for each pose of `poses` (T,165), as `Body.full_pose` returns them.

    `translation`: (3,) metres, the same for all poses. Raises BadInputError when a number is not finite.
    """
    skeleton = Skeleton(shaped.joints, shaped.body.parents)
    skinner = CpuSkinner(shaped)
    for pose in np.atleast_2d(np.asarray(poses, np.float64)):
        yield skinner.vertices(skeleton.pose(pose, translation))
