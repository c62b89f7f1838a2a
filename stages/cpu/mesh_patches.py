"""Patches of a mesh: neighbouring triangles with similar skin weights, each with a sphere that holds it in every pose.

Rule: a patch's radius is proved, not sampled.

Let c be the rest position of the patch's centre, a vertex with weights u, and p another of its vertices with weights w;
G_j is the rigid motion of joint j. Then

    x_p - x_c = sum_j w_j (G_j p - G_j c) + sum_j (w_j - u_j) G_j c.

The first sum is at most |p - c|. The second is a change of weights at c as in `skin_weights.weight_error_bound`, so it
is at most sum_b |E_b| |G_b c - G_parent c|, where E_b is the sum of w_j - u_j over b and the joints below it; and as b
turns about its centre c_b by its own angle t_b, |G_b c - G_parent c| <= 2 sin(t_b / 2) |c - c_b|.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from trilane.arrays import F64, I64
from trilane.body.body import ShapedBody
from trilane.body.skin_weights import branch_sums, joint_distance
from trilane.cache import Arrays, cached_arrays

#: Largest distance between the middles of a patch's triangles, metres: of coarse patches, and of fine ones.
EXTENTS_M = (0.08, 0.02)
LEAST_FACES = 4
#: Joint angle, radians, that patches are cut for: triangles that move apart at this angle are put into other patches.
TYPICAL_TURN = 0.5
VERSION = "patches 1"  # to be raised when the same body gives other patches


@dataclass(frozen=True)
class Level:
    """P patches of one level of detail.

    `centres`: (P,) vertex indices.
    `size`, `give`: (P,) and (P,54). The sphere about a patch's posed centre has the radius
    size + sum_b give_b 2 sin(t_b / 2), metres, where t_b is the angle of joint b = 1..54.
    `blend`: (P,54) the furthest that the pose blend shapes of a joint move a vertex, metres per unit of |R - I|.
    `parts`: for each patch, the indices of its patches in the next level; in the last level, of its vertices.
    `faces`: for each patch, the indices of its triangles.
    """

    centres: I64
    size: F64
    give: F64
    blend: F64
    parts: list[I64]
    faces: list[I64]


def join(groups: list[I64], chosen: I64) -> I64:
    """The indices of the groups that `chosen` lists, in one array."""
    return np.concatenate([groups[patch] for patch in chosen]) if len(chosen) else np.zeros(0, np.int64)


def build_levels(shaped: ShapedBody, weights: F64) -> list[Level]:
    """Coarse and fine patches of all triangles of the body, skinned with `weights` (V,55); cached."""
    body = shaped.body
    sources: list[NDArray[Any]] = [shaped.vertices, shaped.joints, body.parents, body.faces, weights]
    sources += [body.posedirs] if body.posedirs is not None else []
    stored = cached_arrays(VERSION, sources, lambda: _levels_to_arrays(_build_levels(shaped, weights)))
    return _levels_from_arrays(stored)


def _levels_to_arrays(levels: list[Level]) -> dict[str, NDArray[Any]]:
    arrays: dict[str, NDArray[Any]] = {}
    for number, level in enumerate(levels):
        arrays |= {f"{name}{number}": getattr(level, name) for name in ("centres", "size", "give", "blend")}
        for name in ("parts", "faces"):
            groups: list[I64] = getattr(level, name)
            arrays[f"{name}{number}"] = np.concatenate(groups)
            arrays[f"{name}{number}_ends"] = np.cumsum([len(group) for group in groups])
    return arrays


def _levels_from_arrays(arrays: Arrays) -> list[Level]:
    levels = []
    for number in range(len(EXTENTS_M)):
        parts, faces = (
            np.split(arrays[f"{name}{number}"], arrays[f"{name}{number}_ends"][:-1]) for name in ("parts", "faces")
        )
        own = {name: arrays[f"{name}{number}"] for name in ("centres", "size", "give", "blend")}
        levels.append(Level(**own, parts=parts, faces=faces))
    return levels


def _build_levels(shaped: ShapedBody, weights: F64) -> list[Level]:
    branches = branch_sums(shaped.body.parents, weights)
    swing = branches * joint_distance(shaped)
    features = np.concatenate([shaped.vertices.astype(np.float64), TYPICAL_TURN * swing[:, 1:]], axis=1)
    faces = shaped.body.faces
    middles = features[faces].mean(axis=1)
    coarse = _bisect(middles, np.arange(len(faces)), EXTENTS_M[0])
    nested = [_bisect(middles, group, EXTENTS_M[1]) for group in coarse]
    ends = np.cumsum([len(groups) for groups in nested])
    children = [np.arange(end - len(groups), end) for groups, end in zip(nested, ends, strict=True)]
    fine = [group for groups in nested for group in groups]
    blend = _blend_reach(shaped.body.posedirs, len(weights))
    return [
        _level(shaped, features, branches, blend, coarse, children),
        _level(shaped, features, branches, blend, fine, None),
    ]


def _level(
    shaped: ShapedBody, features: F64, branches: F64, blend: F64, groups: list[I64], parts: list[I64] | None
) -> Level:
    members = [np.unique(shaped.body.faces[group]).astype(np.int64) for group in groups]
    centres = np.array([rows[_nearest_to_middle(features[rows])] for rows in members])
    rest = shaped.vertices.astype(np.float64)
    flat, starts = np.concatenate(members), np.cumsum([0, *map(len, members)])[:-1]
    own = np.repeat(centres, [len(rows) for rows in members])
    size = np.maximum.reduceat(np.linalg.norm(rest[flat] - rest[own], axis=1), starts)
    change = np.maximum.reduceat(np.abs(branches[flat] - branches[own]), starts, axis=0)
    give = change * np.linalg.norm(rest[centres][:, None] - shaped.joints, axis=2)
    reach = np.maximum.reduceat(blend[flat], starts, axis=0)
    return Level(centres, size, give[:, 1:], reach, members if parts is None else parts, groups)


def _blend_reach(posedirs: NDArray[np.float32] | None, count: int) -> F64:
    """(V,54) metres: how far each joint's pose blend shapes can move each vertex at |R - I| = 1."""
    if posedirs is None:
        return np.zeros((count, 54))
    blocks = posedirs.reshape(count, 3, 54, 9)
    return np.asarray(np.sqrt(np.einsum("vajk,vajk->vj", blocks, blocks).astype(np.float64)))


def _bisect(features: F64, rows: I64, extent: float) -> list[I64]:
    """`rows` in groups: halved along the longest axis of their `features` until no axis is longer than `extent`."""
    here = features[rows]
    low, high = here.min(axis=0), here.max(axis=0)
    axis = int((high - low).argmax())
    if len(rows) <= LEAST_FACES or high[axis] - low[axis] <= extent:
        return [rows]
    left = here[:, axis] < (low[axis] + high[axis]) / 2.0
    return _bisect(features, rows[left], extent) + _bisect(features, rows[~left], extent)


def _nearest_to_middle(points: F64) -> int:
    middle = (points.min(axis=0) + points.max(axis=0)) / 2.0
    return int(np.linalg.norm(points - middle, axis=1).argmin())
