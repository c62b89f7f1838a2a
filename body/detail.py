"""How much of a body is modelled: a few levels of detail, and how far each of them can move a vertex in a given pose.

Rule: what a level leaves out has a proved bound; the last level leaves nothing out.

Proof. Let w be a vertex's skin weights, w' those of the level, p its rest position, c_b the centre of joint b and t_b
the angle by which b is turned. As in `skin_weights.weight_error_bound`, other weights move the vertex by at most
sum_b |E_b| |y_b - y_parent|, with E_b the sum of w' - w over b and the joints below it, and b's own turn moves p by
|y_b - y_parent| = 2 sin(t_b / 2) dist(p, axis of b) <= 2 sin(t_b / 2) |p - c_b|. Pose blend shapes move p by at most
r = sum_b r_b |R_b - I|, r_b the norm of the vertex's block of them. Left out, they move the skinned vertex by at most
r, because its weights are shares of rigid motions; kept, they make |p - c_b| larger by at most r. |R_b - I|, Frobenius,
is 2 sqrt(2) sin(t_b / 2). Vertices are taken in groups, with the largest of each term in the group.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from trilane.arrays import F32, F64
from trilane.body.body import Body, ShapedBody
from trilane.body.joints import JOINT_INDEX, JOINT_NAMES, JOINTS
from trilane.body.kinematics import Posed
from trilane.body.skin_weights import branch_sums, joint_distance, largest_weights
from trilane.cache import Arrays, cached_arrays

#: Joints of the hands and the face, to the joint that carries them.
CARRIED_BY = {
    name: JOINT_INDEX["head" if name in ("jaw", "left_eye", "right_eye") else f"{name.partition('_')[0]}_wrist"]
    for name in JOINT_NAMES[JOINT_INDEX["jaw"] :]
}
VERSION = "detail bounds 1"  # to be raised when the same body gives other bounds
#: What float32 may add: the weights' and the skinned vertices' rounding, metres.
ROUNDING_M = 5e-6


@dataclass(frozen=True)
class Detail:
    """A level. `weight_count`: skin weights of a vertex, None for all. `hands_and_face`: whether their joints count,
    else they are carried by wrist and head. `pose_blend`: whether pose blend shapes are applied, where there are any.
    """

    name: str
    weight_count: int | None
    hands_and_face: bool
    pose_blend: bool

    def weights(self, shaped: ShapedBody) -> F32:
        """(V,55) skin weights of this level; rows sum to 1."""
        weights = shaped.body.weights
        if not self.hands_and_face:
            weights = carried(weights)
        count = self.weight_count
        if count is None or np.count_nonzero(weights, axis=1).max() <= count:
            return weights
        return largest_weights(weights, count).dense()


def left_out(detail: Detail, body: Body) -> list[str]:
    """What `detail` does not model of `body`, in words; empty when that is nothing."""
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


#: From the least work to all of it.
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
    """`weights` (V,55) with those of the hands' and the face's joints given to wrist and head."""
    given = weights.astype(np.float64)
    for name, carrier in CARRIED_BY.items():
        given[:, carrier] += given[:, JOINT_INDEX[name]]
        given[:, JOINT_INDEX[name]] = 0.0
    return given.astype(np.float32)


class DetailBounds:
    """The bounds of every level of `DETAILS`, for one shaped body.

    `reach` (55,): metres, the furthest from each joint's centre at rest of the vertices that any level moves with it.
    """

    def __init__(self, shaped: ShapedBody) -> None:
        body = shaped.body
        sources: list[NDArray[Any]] = [shaped.vertices, shaped.joints, body.parents, body.weights]
        sources += [body.posedirs] if body.posedirs is not None else []
        arrays = cached_arrays(VERSION, sources, lambda: _terms(shaped))
        self._lever, self._change, self._blend = arrays["lever"], arrays["change"], arrays["blend"]
        self.reach: F64 = arrays["reach"]

    def metres(self, posed: Posed) -> list[float]:
        """For each level of `DETAILS`, the furthest that it moves a vertex in this frame of `Skeleton.pose`."""
        turned = _turned(posed)
        swing = turned / np.sqrt(2.0)
        blend = self._blend @ turned
        lever, change = self._lever @ swing, self._change @ swing
        return [
            0.0 if detail == EVERYTHING else _bound(detail, lever[level], change[level], blend)
            for level, detail in enumerate(DETAILS)
        ]

    def blend_m(self, posed: Posed) -> float:
        """The furthest that pose blend shapes move a vertex in this frame, metres."""
        return float((self._blend @ _turned(posed)).max())


def _turned(posed: Posed) -> F64:
    """(54,) |R - I|, Frobenius, of joints 1 to 54."""
    return np.asarray(np.linalg.norm(posed.feature.reshape(-1, 9).astype(np.float64), axis=1))


def _bound(detail: Detail, lever: F64, change: F64, blend: F64) -> float:
    moved = lever + change * blend if detail.pose_blend else lever + blend
    return float(moved.max()) + ROUNDING_M


def _terms(shaped: ShapedBody) -> Arrays:
    """Of the G groups of vertices the largest |E_b| |p - c_b|, `lever`, and |E_b|, `change`, both (levels,G,54); of the
    blend shapes r_b, `blend` (G,54); and `reach` (55,).
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
        "blend": np.maximum.reduceat(_blend_reach(shaped)[order], starts, axis=0),
        "reach": np.where(used, distance, 0.0).max(axis=0),
    }


def _blend_reach(shaped: ShapedBody) -> F64:
    """(V,54) metres: how far each joint's pose blend shapes can move each vertex at |R - I| = 1."""
    posedirs = shaped.body.posedirs
    if posedirs is None:
        return np.zeros((len(shaped.vertices), JOINTS - 1))
    blocks = posedirs.reshape(-1, 3, JOINTS - 1, 9)
    return np.asarray(np.sqrt(np.einsum("vajk,vajk->vj", blocks, blocks).astype(np.float64)))


def _groups(weights: F32) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Vertices grouped by their two largest joints: where each group begins in the order (V,) that is also returned."""
    two = np.sort(np.argsort(-weights, axis=1, kind="stable")[:, :2], axis=1)
    key = two[:, 0] * JOINTS + two[:, 1]
    order = np.argsort(key, kind="stable")
    starts = np.flatnonzero(np.diff(key[order], prepend=-1))
    return starts, order
