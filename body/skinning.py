"""Linear blend skinning on the CPU: skinning weights, levels of detail of a body, and the vertices of a pose.

x_world = sum_j w_j (matrix_j @ [x_rest, 1]). Matrix products are kept so small that the BLAS starts no threads. A level
of detail may keep only the K largest weights of a vertex, scaled to sum to 1. The error of each level has a proved
bound. The last level leaves nothing out.

Proof. Let w be a vertex's weights, w' its weights at the level, and p its rest position. Let c_b be the centre of joint
b, and t_b the angle by which b is turned. Let y_b be the position to which joint b alone moves p. Let E_b be the sum of
w' - w over b and the joints below b. As in `weight_error_bound`, the change of weights moves the vertex by at most
sum_b |E_b| |y_b - y_parent|. The turn of b moves p by |y_b - y_parent| = 2 sin(t_b / 2) dist(p, axis of b) <= 2 sin(t_b
/ 2) |p - c_b|.

Let r_b be the norm of the vertex's block of pose blend shapes of joint b. All these shapes move p by at most
r = sum_b r_b |R_b - I|. If they are left out, the skinned vertex moves by at most r, because skinning averages rigid
motions. If they are kept, |p - c_b| grows by at most r. The Frobenius norm |R_b - I| is 2 sqrt(2) sin(t_b / 2).
Vertices are bounded in groups: each term takes its largest value in the group.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from trilane.arrays import F32, F64
from trilane.body.body import Body, ShapedBody
from trilane.body.joints import JOINT_INDEX, JOINT_NAMES, JOINTS, POSE_FEATURES, Posed, Skeleton
from trilane.cache import Arrays, cached_arrays
from trilane.errors import BadInputError

WEIGHT_COUNTS = (4, 8, 12)


@dataclass(frozen=True)
class TopWeights:
    """The largest skinning weights of each vertex.

    `joints` (V,K) int32: joint indices. `weights` (V,K) float32: their weights, largest first. Rows sum to 1; unused
    columns have weight 0.
    """

    joints: NDArray[np.int32]
    weights: F32

    def dense(self) -> F32:
        """Return the weights as (V,55) float32, one column per joint."""
        full = np.zeros((len(self.weights), JOINTS), np.float32)
        np.put_along_axis(full, self.joints, self.weights, axis=1)
        return full


def largest_weights(weights: F32, k: int) -> TopWeights:
    """Return the `k` largest weights of each row of `weights` (V,55), scaled to sum to 1.

    Raises BadInputError if `k` is not 4, 8 or 12.
    """
    if k not in WEIGHT_COUNTS:
        raise BadInputError("skin weights", str(k), "4, 8 or 12")
    order = np.argsort(-weights, axis=1, kind="stable")[:, :k]
    largest = np.take_along_axis(weights, order, axis=1).astype(np.float64)
    return TopWeights(order.astype(np.int32), (largest / largest.sum(axis=1, keepdims=True)).astype(np.float32))


def weight_error_bound(shaped: ShapedBody, weight_count: int) -> F64:
    """Return a bound (V,), metres, on each vertex's error, in any pose, with only its `weight_count` largest weights.

    The bound holds without pose blend shapes. Raises BadInputError as `largest_weights` does.

    Proof. Let joint j alone move the rest vertex p to y_j, and let e_j be the change of its weight; the e_j sum to 0.
    Joint b and its parent both move p rigidly, and both move the centre c_b of b to the same point. Therefore y_b and
    y_parent lie on one sphere about that point: |y_b - y_parent| <= 2 |p - c_b|. If each y_j is written as the root's y
    plus the steps down the chain to j,

        sum_j e_j y_j = sum_b E_b (y_b - y_parent),   E_b the sum of e_j over b and the joints below it,

    and the vertex moves by at most sum_b |E_b| 2 |p - c_b|. With pose blend shapes, p would be the vertex after them.
    """
    largest = largest_weights(shaped.body.weights, weight_count).dense()
    change = branch_sums(shaped.body.parents, largest.astype(np.float64) - shaped.body.weights)
    return np.asarray((np.abs(change[:, 1:]) * 2.0 * joint_distance(shaped)[:, 1:]).sum(axis=1))


def joint_distance(shaped: ShapedBody) -> F64:
    """Return the distance (V,55), metres, of each rest vertex from each rest joint."""
    return np.asarray(np.linalg.norm(shaped.vertices[:, None, :] - shaped.joints[None], axis=2))


def branch_sums(parents: NDArray[np.int32], values: F64) -> F64:
    """Return sums of `values` (..., 55): for each joint, the sum over that joint and all joints below it (..., 55).

    `parents` (55,): index of each joint's parent, -1 at the root.
    """
    above = np.eye(len(parents))
    for joint in range(len(parents)):
        at = int(parents[joint])
        while at >= 0:
            above[joint, at] = 1.0
            at = int(parents[at])
    return np.asarray(values @ above)


#: For each joint of the hands and the face: the index of the joint that takes over its weights, a wrist or the head.
CARRIED_BY = {
    name: JOINT_INDEX["head" if name in ("jaw", "left_eye", "right_eye") else f"{name.partition('_')[0]}_wrist"]
    for name in JOINT_NAMES[JOINT_INDEX["jaw"] :]
}
VERSION = "detail bounds 1"  # part of the cache key; raise it when the same body gets other bounds
#: Error, metres, that float32 may add by rounding weights and skinned vertices.
ROUNDING_M = 5e-6


@dataclass(frozen=True)
class Detail:
    """A level of detail.

    `name`: description for people.
    `weight_count`: number of skinning weights per vertex; None for all.
    `hands_and_face`: whether joints of hands and face move the mesh; otherwise wrists and head take over their weights.
    `pose_blend`: whether pose blend shapes are applied, if the body has them.
    """

    name: str
    weight_count: int | None
    hands_and_face: bool
    pose_blend: bool

    def weights(self, shaped: ShapedBody) -> F32:
        """Return the skinning weights (V,55) of this level; rows sum to 1."""
        weights = shaped.body.weights
        if not self.hands_and_face:
            weights = carried(weights)
        count = self.weight_count
        if count is None or np.count_nonzero(weights, axis=1).max() <= count:
            return weights
        return largest_weights(weights, count).dense()


def left_out(detail: Detail, body: Body) -> list[str]:
    """Return, in words, each part of `body` that `detail` leaves out; an empty list when nothing is left out."""
    found = []
    weights = body.weights
    if not detail.hands_and_face:
        found.append("turns of fingers, jaw and eyes")
        weights = carried(weights)
    count = detail.weight_count
    cut = 0 if count is None else int((np.count_nonzero(weights, axis=1) > count).sum())
    if cut:
        found.append(f"all but the {count} largest skin weights of {cut} of {len(weights)} vertices")
    if not detail.pose_blend and body.posedirs is not None:
        found.append("pose blend shapes")
    return found


#: Levels of detail, from the least work to the most.
DETAILS = (
    Detail("4 weights, hands and face at rest, no pose blend shapes", 4, hands_and_face=False, pose_blend=False),
    Detail("4 weights, no pose blend shapes", 4, hands_and_face=True, pose_blend=False),
    Detail("8 weights, no pose blend shapes", 8, hands_and_face=True, pose_blend=False),
    Detail("8 weights", 8, hands_and_face=True, pose_blend=True),
    Detail("12 weights", 12, hands_and_face=True, pose_blend=True),
    Detail("everything", None, hands_and_face=True, pose_blend=True),
)
EVERYTHING = DETAILS[-1]


def carried(weights: F32) -> F32:
    """Return `weights` (V,55) after wrists and head take over the weights of the joints of hands and face."""
    given = weights.astype(np.float64)
    for name, carrier in CARRIED_BY.items():
        given[:, carrier] += given[:, JOINT_INDEX[name]]
        given[:, JOINT_INDEX[name]] = 0.0
    return given.astype(np.float32)


class DetailBounds:
    """Error bounds of every level of `DETAILS`, for one shaped body.

    `reach` (55,): largest distance, metres, from each joint's centre at rest to a rest vertex that the joint moves at
    any level.
    """

    def __init__(self, shaped: ShapedBody) -> None:
        body = shaped.body
        sources: list[NDArray[Any]] = [shaped.vertices, shaped.joints, body.parents, body.weights]
        sources += [body.posedirs] if body.posedirs is not None else []
        arrays = cached_arrays(VERSION, sources, lambda: _terms(shaped))
        self._lever, self._change, self._blend = arrays["lever"], arrays["change"], arrays["blend"]
        self.reach: F64 = arrays["reach"]

    def metres(self, posed: Posed) -> list[float]:
        """Return a bound, metres, on the error of any vertex in this pose, for each level of `DETAILS`.

        `posed`: result of `Skeleton.pose`.
        """
        turned = _turned(posed)
        swing = turned / np.sqrt(2.0)
        blend = self._blend @ turned
        lever, change = self._lever @ swing, self._change @ swing
        return [
            0.0 if detail == EVERYTHING else _bound(detail, lever[level], change[level], blend)
            for level, detail in enumerate(DETAILS)
        ]

    def blend_m(self, posed: Posed) -> float:
        """Return a bound, metres, on how far pose blend shapes move any vertex in this pose."""
        return float((self._blend @ _turned(posed)).max())


def _turned(posed: Posed) -> F64:
    """Return the Frobenius norms |R - I| (54,) of joints 1 to 54."""
    return np.asarray(np.linalg.norm(posed.feature.reshape(-1, 9).astype(np.float64), axis=1))


def _bound(detail: Detail, lever: F64, change: F64, blend: F64) -> float:
    moved = lever + change * blend if detail.pose_blend else lever + blend
    return float(moved.max()) + ROUNDING_M


def _terms(shaped: ShapedBody) -> Arrays:
    """Return the terms of the bounds, each the largest in a group of vertices, in the symbols of the module's proof.

    `lever`, `change` (levels,G,54): |E_b| |p - c_b| and |E_b|, for each of G groups. `blend` (G,54): r_b.
    `reach` (55,): as in `DetailBounds`.
    """
    starts, order = _groups(shaped.body.weights)
    distance = joint_distance(shaped)
    exact = shaped.body.weights.astype(np.float64)
    lever, change, used = [], [], exact > 0
    for detail in DETAILS:
        weights = detail.weights(shaped)
        used = used | (weights > 0)
        moved = np.abs(branch_sums(shaped.body.parents, weights - exact)[:, 1:])
        change.append(np.maximum.reduceat(moved[order], starts, axis=0))
        lever.append(np.maximum.reduceat((moved * distance[:, 1:])[order], starts, axis=0))
    return {
        "lever": np.array(lever),
        "change": np.array(change),
        "blend": np.maximum.reduceat(blend_reach(shaped)[order], starts, axis=0),
        "reach": np.where(used, distance, 0.0).max(axis=0),
    }


def blend_reach(shaped: ShapedBody) -> F64:
    """Return a bound (V,54), metres, on how far each joint's pose blend shapes move each vertex at |R - I| = 1."""
    posedirs = shaped.body.posedirs
    if posedirs is None:
        return np.zeros((len(shaped.vertices), JOINTS - 1))
    blocks = posedirs.reshape(-1, 3, JOINTS - 1, 9)
    return np.asarray(np.sqrt(np.einsum("vajk,vajk->vj", blocks, blocks).astype(np.float64)))


def _groups(weights: F32) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Group vertices by the two joints with the largest weights.

    Return (first place of each group in the sorted list, sorted list of vertex indices (V,)).
    """
    two = np.sort(np.argsort(-weights, axis=1, kind="stable")[:, :2], axis=1)
    key = two[:, 0] * JOINTS + two[:, 1]
    order = np.argsort(key, kind="stable")
    starts = np.flatnonzero(np.diff(key[order], prepend=-1))
    return starts, order


#: Number of vertices in one matrix product. Beyond 2**18 multiplications OpenBLAS wakes other threads, which stall on
#: shared cores.
_BLOCK_ROWS = 256


def blend_matrices(weights: F64, per_joint: F64) -> F64:
    """Return the product (N,M) of `weights` (N,55) and `per_joint` (55,M), computed in blocks on the calling thread."""
    blended = np.empty((len(weights), per_joint.shape[1]))
    whole = len(weights) // _BLOCK_ROWS * _BLOCK_ROWS
    blocks = weights[:whole].reshape(-1, _BLOCK_ROWS, weights.shape[1])
    np.matmul(blocks, per_joint, out=blended[:whole].reshape(-1, _BLOCK_ROWS, per_joint.shape[1]))
    np.matmul(weights[whole:], per_joint, out=blended[whole:])
    return blended


class CpuSkinner:
    """Computes the vertices of one shaped body, pose by pose, in float64.

    `weight_count`: number of skinning weights per vertex, 4, 8 or 12; None for all.
    `pose_blend`: whether pose blend shapes are applied, if the body has them.
    Raises BadInputError for another `weight_count`.
    """

    def __init__(self, shaped: ShapedBody, weight_count: int | None = None, pose_blend: bool = True) -> None:
        body = shaped.body
        weights = body.weights if weight_count is None else largest_weights(body.weights, weight_count).dense()
        self._weights = weights.astype(np.float64)
        self._rest = shaped.vertices.astype(np.float64)
        self._blend = body.posedirs.reshape(-1, POSE_FEATURES) if pose_blend and body.posedirs is not None else None

    def vertices(self, posed: Posed) -> F64:
        """Return the skinned vertices (V,3), world, metres. `posed`: result of `Skeleton.pose`."""
        rest = self._rest
        if self._blend is not None:
            rest = rest + (self._blend @ posed.feature).reshape(-1, 3)
        moved = blend_matrices(self._weights, posed.matrices.reshape(JOINTS, 12).astype(np.float64)).reshape(-1, 3, 4)
        return np.asarray(np.einsum("vab,vb->va", moved[:, :, :3], rest) + moved[:, :, 3])


class FrameSkinner:
    """Writes the vertices of one shaped body, float32, into the caller's memory; the CPU unit uses it in each frame.

    Vertices are computed in blocks. Neighbouring vertices depend on few joints, so each block is multiplied only by
    joints that move it. All blocks use the same number of joints, the most that any block needs. Positions are stored
    as three rows, of x, y and z, so that NumPy works on contiguous memory.
    """

    def __init__(self, shaped: ShapedBody, detail: Detail = EVERYTHING) -> None:
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
        """Bytes of rest positions, weights, joint indices and pose blend shapes, which every frame reads."""
        kept = (self._rest, self._weights, self._joints, *(() if self._blend is None else (self._blend,)))
        return sum(array.nbytes for array in kept)

    def skin_into(self, posed: Posed, vertices: F32) -> None:
        """Write the skinned vertices into `vertices` (V,3), world, metres. `posed`: result of `Skeleton.pose`."""
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
    """Yield the vertices (V,3), metres, of each pose.

    `poses` (T,165): axis-angle, radians, with absolute hand poses, as `Body.full_pose` returns them.
    `translation` (3,): translation of the root, metres, the same for all poses.
    Raises BadInputError as `Skeleton.pose` does.
    """
    skeleton = Skeleton(shaped.joints, shaped.body.parents)
    skinner = CpuSkinner(shaped)
    for pose in np.atleast_2d(np.asarray(poses, np.float64)):
        yield skinner.vertices(skeleton.pose(pose, translation))
