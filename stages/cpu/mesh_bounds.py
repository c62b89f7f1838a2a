"""Computes the exact screen rectangle of a skinned mesh, at a fraction of the cost of skinning it.

The rectangle contains all parts of the mesh that are on the screen; parts behind the near plane or outside the screen
do not widen it. In any pose, each patch of the mesh lies in a sphere. The spheres show which patches are off the
screen, which ones the near plane cuts, and which ones can reach the rectangle's sides. Only the last two kinds are
divided into finer patches, and only their vertices are skinned.

**Patches** are neighbouring triangles with similar skinning weights. A patch's radius is a proven bound. Let c be the
rest position of the patch's centre, a vertex with weights u, and p another vertex of the patch with weights w. G_j is
the rigid motion of joint j. The distance vector in a pose is

    x_p - x_c = sum_j w_j (G_j p - G_j c) + sum_j (w_j - u_j) G_j c.

The first sum is at most |p - c|. The second sum is a change of weights at c as in `skinning.weight_error_bound`.
Therefore it is at most sum_b |E_b| |G_b c - G_parent c|, where E_b is the sum of w_j - u_j over b and the joints below
it. Joint b turns about its centre c_b by its own angle t_b, so |G_b c - G_parent c| <= 2 sin(t_b / 2) |c - c_b|.

**Skinned bodies** are projected in float32, in memory that is allocated once. All vertices within twice the rounding
error of the outermost one are projected again in float64, which finds the truly outermost vertex.

The rounding error follows from u = 2**-24. A clip coordinate c = r . v + d is a sum of three products of rounded
factors and d. Its error is at most 6 u (sum |r_k| |v_k| + |d|). The bound e_c is 8 u times this sum plus the
sphere's reach; the larger factor covers the rounding of the reach. A quotient q = c / w, with w >= w_least, has an
error of at most (e_c + |q| e_w) / w_least + 4 u |q|, where |q| is at most 1 on the screen.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from trilane.arrays import F32, F64, I64, Mask
from trilane.body.body import ShapedBody
from trilane.body.joints import JOINTS, Posed
from trilane.body.skinning import blend_matrices, blend_reach, branch_sums, joint_distance, largest_weights
from trilane.cache import Arrays, cached_arrays
from trilane.scene.crop import Rect

#: Half the distance from 1 to the next float32: the largest relative error of a rounding.
U = 2.0**-24
W_LEAST = 1e-9


class Outermost:
    """Finds the outermost vertices of bodies with `count` vertices."""

    def __init__(self, count: int) -> None:
        self.count = count
        self._flat = np.empty((4, count), np.float32)
        self._scratch = np.empty((3, count), np.float32)
        self._is_far = np.empty(count, np.bool_)

    def of(self, vertices: F32, camera: F64, radius: float) -> I64 | None:
        """Return the indices (N,) of the vertices that may be outermost on the screen.

        The result is None if a vertex's sphere may reach over the screen's edge or a clip plane.

        `vertices`: (V,3), metres, world space.
        `camera`: matrix (4,4) to clip space.
        `radius`: radius of the sphere about each vertex, metres.
        """
        reach = radius * np.linalg.norm(camera[:, :3], axis=1)
        error = self._project(vertices, camera, reach)
        x, y, z, w = self._flat
        near, far = (radius * float(np.linalg.norm(camera[3, :3] + sign * camera[2, :3])) for sign in (1, -1))
        scratch, least, most = self._scratch
        if not np.add(w, z, out=scratch).min() > near + error[2] + error[3]:
            return None
        if not np.subtract(w, z, out=scratch).min() > far + error[2] + error[3]:
            return None
        w_least = float(np.subtract(w, np.float32(reach[3]), out=least).min()) - error[3]
        if not w_least > W_LEAST:
            return None
        np.reciprocal(least, out=least)
        np.reciprocal(np.add(w, np.float32(reach[3]), out=most), out=most)
        slack = 2 * ((error + error[3]) / w_least + 4 * U)
        sides = [self._side(row, reach[k], sign, float(slack[k])) for k, row in enumerate((x, y)) for sign in (1, -1)]
        found = [side for side in sides if side is not None]
        return np.concatenate(found) if len(found) == len(sides) else None

    def _project(self, vertices: F32, camera: F64, reach: F64) -> F64:
        """Compute the clip coordinates of `vertices`, and return the error bound of each coordinate (4,)."""
        np.matmul(camera[:, :3].astype(np.float32), vertices.T, out=self._flat)
        self._flat += camera[:, 3:].astype(np.float32)
        furthest = max(float(vertices.max()), -float(vertices.min()))
        return np.asarray(8 * U * (np.abs(camera[:, :3]).sum(axis=1) * furthest + np.abs(camera[:, 3]) + reach))

    def _side(self, row: F32, reach: float, sign: int, slack: float) -> I64 | None:
        """Return the indices of the vertices that may be outermost on one side; None if one may be off the screen.

        `sign`: 1 for the lowest coordinates, -1 for the highest. `slack`: twice the largest error of a quotient.
        """
        scratch, least, most = self._scratch
        place = np.subtract(row, np.float32(reach), out=scratch) if sign > 0 else np.negative(row, out=scratch)
        if sign < 0:
            place -= np.float32(reach)
        place *= least if place.min() <= 0 else most
        lowest = float(place.min())
        if not lowest > slack - 1.0:
            return None
        return np.flatnonzero(np.less_equal(place, np.float32(lowest + slack + U), out=self._is_far))


#: Largest distance between the middles of a patch's triangles, metres, for coarse and for fine patches.
EXTENTS_M = (0.08, 0.02)
LEAST_FACES = 4
#: Joint angle, radians, for which patches are formed: triangles that move apart at this angle are in different patches.
TYPICAL_TURN = 0.5
VERSION = "patches 1"  # raise it when the same body gives other patches


@dataclass(frozen=True)
class Level:
    """The P patches of one level of patches, the coarse or the fine one.

    `centres`: index of each patch's centre, a vertex (P,).
    `size`, `give`: (P,) and (P,54), metres. Without blend shapes, the sphere about a patch's posed centre has a radius
    of size + sum_b give_b 2 sin(t_b / 2), where t_b is the angle of joint b = 1..54.
    `blend`: largest distance by which the pose blend shapes of each joint move a vertex (P,54), metres per unit of
    |R - I|.
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
    """Return the indices in the groups that `chosen` lists, as one array."""
    return np.concatenate([groups[patch] for patch in chosen]) if len(chosen) else np.zeros(0, np.int64)


def build_levels(shaped: ShapedBody, weights: F64) -> list[Level]:
    """Return the coarse and the fine patches of all triangles of the body. The result is cached.

    `weights`: skinning weights (V,55).
    """
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
    blend = blend_reach(shaped)
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


def _bisect(features: F64, rows: I64, extent: float) -> list[I64]:
    """Return `rows` in groups: halved along the longest axis of `features` until no axis is longer than `extent`."""
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


#: Margins for rounding, added to every radius (metres) and to every side of the rectangle (NDC).
ROUNDING_M = 1e-4
ROUNDING_NDC = 1e-6


@dataclass
class _Extent:
    """The least and the largest (x, y) of the points added so far, in NDC."""

    low: F64 = field(default_factory=lambda: np.full(2, np.inf))
    high: F64 = field(default_factory=lambda: np.full(2, -np.inf))

    def add(self, low: F64, high: F64) -> None:
        """Widen the extent by N points whose (x, y) lie between `low` and `high` (N,2), NDC."""
        if len(low):
            np.minimum(self.low, low.min(axis=0), out=self.low)
            np.maximum(self.high, high.max(axis=0), out=self.high)

    def widened_by(self, low: F64, high: F64) -> Mask:
        """Return a mask (N,) of boxes `low` to `high` (N,2), NDC, that reach beyond a side that is on the screen."""
        return np.asarray(
            (((low < self.low) & (self.low > -1.0)) | ((high > self.high) & (self.high < 1.0))).any(axis=1)
        )

    def rect(self) -> Rect | None:
        """Return the rectangle, clipped to the screen; None if it is empty."""
        low, high = np.maximum(self.low - ROUNDING_NDC, -1.0), np.minimum(self.high + ROUNDING_NDC, 1.0)
        if not (low < high).all():
            return None
        return Rect(float(low[0]), float(low[1]), float(high[0]), float(high[1]))


@dataclass(frozen=True)
class _View:
    """The camera and the body's pose in one frame.

    `camera`: matrix (4,4) to clip space.
    `norms`: norm of the first three columns of each row of `camera` (4,).
    `near_norm`, `far_norm`: largest changes of W + Z and of W - Z, clip coordinates, per metre of movement.
    `per_joint`: matrix of each joint from rest to clip space (55,16).
    `turned`: |R - I| of joints 1 to 54 (54,).
    """

    camera: F64
    norms: F64
    near_norm: float
    far_norm: float
    per_joint: F64
    posed: Posed
    turned: F64

    @classmethod
    def of(cls, posed: Posed, clip: ArrayLike) -> _View:
        camera = np.asarray(clip, np.float64)
        per_joint = np.zeros((JOINTS, 4, 4))
        per_joint[:, :3] = posed.matrices
        per_joint[:, 3, 3] = 1.0
        return cls(
            camera=camera,
            norms=np.linalg.norm(camera[:, :3], axis=1),
            near_norm=float(np.linalg.norm(camera[3, :3] + camera[2, :3])),
            far_norm=float(np.linalg.norm(camera[3, :3] - camera[2, :3])),
            per_joint=(camera @ per_joint).reshape(JOINTS, 16),
            posed=posed,
            turned=np.linalg.norm(posed.feature.reshape(-1, 9).astype(np.float64), axis=1),
        )


class MeshBounds:
    """Computes bounds of one shaped body, for any pose and camera."""

    def __init__(
        self, shaped: ShapedBody, weight_count: int | None = None, standoff_m: float = 0.0, pose_blend: bool = True
    ) -> None:
        """Divide the body into patches.

        `shaped`: body.
        `weight_count`: number of skinning weights with which a vertex is drawn; None for all.
        `standoff_m`: how far clothes and hair reach from the mesh, metres.
        `pose_blend`: whether the body's pose blend shapes, if any, are drawn.
        """
        body = shaped.body
        weights = body.weights if weight_count is None else largest_weights(body.weights, weight_count).dense()
        self._weights = weights.astype(np.float64)
        self._rest = np.concatenate([shaped.vertices, np.ones((len(weights), 1))], axis=1)
        self._faces = body.faces
        self._standoff = standoff_m
        self._blend = body.posedirs if pose_blend else None
        self._levels = build_levels(shaped, self._weights)
        self._outermost: Outermost | None = None
        self.reach_m = _reach(shaped, self._weights, self._levels) + standoff_m + ROUNDING_M

    def is_off_screen(self, root: F64, clip: ArrayLike) -> bool:
        """Return whether the mesh is certainly off the screen, whatever its pose.

        The body lies in a sphere about its root joint, which is compared with the six planes of the clip volume.

        `root`: place of the root joint (3,), metres, world space.
        `clip`: projection @ view (4,4).
        """
        camera = np.asarray(clip, np.float64)
        planes = np.concatenate([camera[3] + camera[:3], camera[3] - camera[:3]])
        away = planes[:, :3] @ root + planes[:, 3]
        return bool((away < -self.reach_m * np.linalg.norm(planes[:, :3], axis=1)).any())

    def may_be_seen(self, posed: Posed, clip: ArrayLike) -> bool:
        """Return False if the coarse patches show that no part of the mesh is on the screen, otherwise True.

        `clip`: projection @ view (4,4).
        """
        view = _View.of(posed, clip)
        level = self._levels[0]
        touching, cut = self._sort_out(level, np.arange(len(level.centres)), view, _Extent())
        return bool(len(touching) or len(cut))

    def rect(self, posed: Posed, clip: ArrayLike, vertices: NDArray[np.float32] | None = None) -> Rect | None:
        """Return the mesh's rectangle on the screen, clipped to the screen; None if nothing is visible.

        `posed`: a frame of `Skeleton.pose`.
        `clip`: projection @ view (4,4), of any lens.
        `vertices`: skinned vertices (V,3) of the frame, if the caller has them. With them, a body that is wholly on the
        screen needs no patches.
        """
        view = _View.of(posed, clip)
        if vertices is not None and (whole := self._rect_of_whole(vertices, view)) is not None:
            return whole
        seen = _Extent()
        rows = np.arange(len(self._levels[0].centres))
        for level in self._levels:
            touching, cut = self._sort_out(level, rows, view, seen)
            rows = join(level.parts, touching if level is self._levels[-1] else np.concatenate([touching, cut]))
        corners = self._project(self._faces[join(self._levels[-1].faces, cut)].ravel(), view).reshape(-1, 3, 4)
        for points in (self._project(rows, view), _clip_near(corners, self._standoff * view.near_norm)):
            seen.add(*_quotients(points, np.full(len(points), self._standoff), view))
        return seen.rect()

    def _rect_of_whole(self, vertices: NDArray[np.float32], view: _View) -> Rect | None:
        """Return the rectangle of a body that is wholly on the screen; None if a part of it may be off the screen."""
        radius = self._standoff + ROUNDING_M
        if self._outermost is None or self._outermost.count != len(vertices):
            self._outermost = Outermost(len(vertices))
        rows = self._outermost.of(vertices, view.camera, radius)
        if rows is None:
            return None
        points = vertices[rows].astype(np.float64) @ view.camera[:, :3].T + view.camera[:, 3]
        seen = _Extent()
        seen.add(*_quotients(points, np.full(len(points), radius), view))
        return seen.rect() if (seen.low > -1.0).all() and (seen.high < 1.0).all() else None

    def _sort_out(self, level: Level, rows: I64, view: _View, seen: _Extent) -> tuple[I64, I64]:
        """Return indices of (patches that may widen `seen`, patches that the near plane may cut).

        Each patch that is certainly visible widens `seen` by one point.
        """
        radius = level.size[rows] + (self._standoff + ROUNDING_M)
        radius += np.einsum("pj,j->p", level.give[rows], view.turned / np.sqrt(2.0))
        if self._blend is not None:
            radius += np.einsum("pj,j->p", level.blend[rows], view.turned)
        centres = self._project(level.centres[rows], view, blend=False)
        front, cut = _against_near(centres, radius, view)
        low, high = _quotients(centres, radius, view)
        front &= ((high >= -1.0) & (low <= 1.0)).all(axis=1)
        # A point that each patch certainly covers widens the rectangle now, so that fewer patches need refining. The
        # point is the centre. If blend shapes may have moved the centre, it is the inner side of the sphere.
        point = _quotients(centres[front], np.full(int(front.sum()), self._standoff), view)
        seen.add(*(point if self._blend is None else (high[front], low[front])))
        return rows[front][seen.widened_by(low[front], high[front])], rows[cut]

    def _project(self, vertices: NDArray[np.integer[Any]], view: _View, blend: bool = True) -> F64:
        """Return the clip coordinates (N,4) of vertices."""
        rest = self._rest[vertices]
        if blend and self._blend is not None:
            rest[:, :3] += np.einsum("naf,f->na", self._blend[vertices], view.posed.feature)
        blended = blend_matrices(self._weights[vertices], view.per_joint).reshape(-1, 4, 4)
        return np.asarray(np.einsum("nab,nb->na", blended, rest))


def _reach(shaped: ShapedBody, weights: F64, levels: list[Level]) -> float:
    """Return the largest distance in metres that a vertex can have from the root joint in any pose.

    A joint is no further from the root than the sum of the bones between them. A joint keeps its distance from each
    point that it moves, and a skinned vertex is a mean of points that joints move. |R - I| of a joint is at most 2
    sqrt(2).
    """
    parents, joints = shaped.body.parents, shaped.joints
    bones = np.linalg.norm(joints - np.where(parents[:, None] < 0, joints, joints[parents]), axis=1)
    bones[0] = 0.0
    chain = branch_sums(parents, np.eye(JOINTS)) @ bones  # length of the bones from the root to each joint
    furthest = np.where(weights > 0, joint_distance(shaped) + chain, 0.0).max()
    blend = max(float(level.blend.sum(axis=1).max()) for level in levels) * 2.0 * np.sqrt(2.0)
    return float(furthest + blend)


def _against_near(centres: F64, radius: F64, view: _View) -> tuple[Mask, Mask]:
    """Return two masks (N,): spheres wholly in front of the near plane and of W = 0, and spheres that cross it.

    A sphere in neither mask is not visible.
    """
    near, far = centres[:, 3] + centres[:, 2], centres[:, 3] - centres[:, 2]
    within = far + radius * view.far_norm >= 0.0
    front = (near - radius * view.near_norm > 0.0) & (centres[:, 3] - radius * view.norms[3] > W_LEAST)
    return front & within, (near + radius * view.near_norm > 0.0) & ~front & within


def _quotients(points: F64, radius: F64, view: _View) -> tuple[F64, F64]:
    """Return the least and the largest (X/W, Y/W), (N,2) each, over spheres about points in clip coordinates.

    X, Y and W are linear in the point. Therefore each varies over a sphere by the radius times the norm of its matrix
    row.
    """
    reach = radius[:, None] * view.norms[:2]
    least = np.maximum(points[:, 3] - radius * view.norms[3], W_LEAST)[:, None]
    most = np.maximum(points[:, 3] + radius * view.norms[3], W_LEAST)[:, None]
    low, high = points[:, :2] - reach, points[:, :2] + reach
    return low / np.where(low > 0.0, most, least), high / np.where(high > 0.0, least, most)


def _clip_near(triangles: F64, slack: float) -> F64:
    """Return the clip coordinates (N,4) of corners in front of the near plane, and of points where edges cross it.

    `triangles`: (F,3,4). `slack`: how far the near plane is moved towards the camera, clip coordinates.
    """
    near = triangles[:, :, 2] + triangles[:, :, 3] + slack
    points = [triangles[near > 0.0]]
    for a, b in ((0, 1), (1, 2), (2, 0)):
        crosses = (near[:, a] > 0.0) != (near[:, b] > 0.0)
        start, end = triangles[crosses, a], triangles[crosses, b]
        share = near[crosses, a] / (near[crosses, a] - near[crosses, b])
        points.append(start + share[:, None] * (end - start))
    return np.concatenate(points)
