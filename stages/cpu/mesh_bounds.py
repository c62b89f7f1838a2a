"""The screen rectangle of a skinned mesh, exact, at a fraction of the cost of skinning it.

Rule: no part of the mesh that is on the screen lies outside the rectangle; parts behind the near plane or beside the
screen do not widen it.

Spheres that hold patches of the mesh in any pose (`mesh_patches`) tell which patches are off the screen, which ones the
near plane cuts, and which ones can reach the rectangle's sides. Only the last two kinds are looked at in finer patches,
and only their vertices are skinned.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from trilane.arrays import F64, I64, Mask
from trilane.body.body import ShapedBody
from trilane.body.joints import JOINTS
from trilane.body.kinematics import Posed
from trilane.body.skin_weights import branch_sums, joint_distance, largest_weights
from trilane.body.skinning import blend_matrices
from trilane.scene.crop import Rect
from trilane.stages.cpu.mesh_patches import Level, build_levels, join
from trilane.stages.cpu.outermost import W_LEAST, Outermost

#: Margins for rounding, added to every radius (metres) and to every side of the rectangle (NDC).
ROUNDING_M = 1e-4
ROUNDING_NDC = 1e-6


@dataclass
class _Extent:
    """Least and greatest (x, y) of the points added so far, normalised device coordinates."""

    low: F64 = field(default_factory=lambda: np.full(2, np.inf))
    high: F64 = field(default_factory=lambda: np.full(2, -np.inf))

    def add(self, low: F64, high: F64) -> None:
        """Widen by points whose bounds are `low` and `high` (N,2)."""
        if len(low):
            np.minimum(self.low, low.min(axis=0), out=self.low)
            np.maximum(self.high, high.max(axis=0), out=self.high)

    def widened_by(self, low: F64, high: F64) -> Mask:
        """(N,) which of the bounds `low`, `high` (N,2) would move a side that is not yet at the screen's edge."""
        return np.asarray(
            (((low < self.low) & (self.low > -1.0)) | ((high > self.high) & (self.high < 1.0))).any(axis=1)
        )

    def rect(self) -> Rect | None:
        """The rectangle, clipped to the screen; None when it is empty."""
        low, high = np.maximum(self.low - ROUNDING_NDC, -1.0), np.minimum(self.high + ROUNDING_NDC, 1.0)
        if not (low < high).all():
            return None
        return Rect(float(low[0]), float(low[1]), float(high[0]), float(high[1]))


@dataclass(frozen=True)
class _View:
    """One frame: the camera, (4,4) to clip space, with the norms of its rows, and the body's pose.

    `per_joint` (55,16): each joint's matrix from rest to clip space. `turned` (54,): |R - I| of joints 1 to 54.
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
    """Bounds of one shaped body, for any pose and camera."""

    def __init__(
        self, shaped: ShapedBody, weight_count: int | None = None, standoff_m: float = 0.0, pose_blend: bool = True
    ) -> None:
        """Cut the body into patches.

        `shaped`: the body.
        `weight_count`: how many skin weights of a vertex it is drawn with; None for all.
        `standoff_m`: how far clothes and hair reach from the mesh, metres.
        `pose_blend`: whether its pose blend shapes, if any, are drawn.
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
        """Whether the mesh is surely off the screen, in any pose, with its root joint at `root` (3,), world metres.

        The body lies in a sphere about its root joint, which is compared with the six planes of the clip volume.
        """
        camera = np.asarray(clip, np.float64)
        planes = np.concatenate([camera[3] + camera[:3], camera[3] - camera[:3]])
        away = planes[:, :3] @ root + planes[:, 3]
        return bool((away < -self.reach_m * np.linalg.norm(planes[:, :3], axis=1)).any())

    def may_be_seen(self, posed: Posed, clip: ArrayLike) -> bool:
        """Whether the mesh may be on the screen, by its largest patches: no when it surely is not, at little cost."""
        view = _View.of(posed, clip)
        level = self._levels[0]
        touching, cut = self._sort_out(level, np.arange(len(level.centres)), view, _Extent())
        return bool(len(touching) or len(cut))

    def rect(self, posed: Posed, clip: ArrayLike, vertices: NDArray[np.float32] | None = None) -> Rect | None:
        """The mesh's rectangle on the screen, clipped to it; None when nothing is visible.

        `posed`: the frame, of `Skeleton.pose`.
        `clip`: (4,4) projection @ view, of any lens.
        `vertices`: (V,3) the frame's skinned vertices where the caller has them: a body wholly on the screen then needs
        no patches.
        """
        view = _View.of(posed, clip)
        if vertices is not None and (whole := self._rect_of_whole(vertices, view)) is not None:
            return whole
        seen = _Extent()
        rows = np.arange(len(self._levels[0].centres))
        for level in self._levels:
            touching, cut = self._sort_out(level, rows, view, seen)
            rows = join(level.parts, touching if level is self._levels[-1] else np.concatenate([touching, cut]))
        self._add_vertices(rows, view, seen)
        self._add_triangles(join(self._levels[-1].faces, cut), view, seen)
        return seen.rect()

    def _rect_of_whole(self, vertices: NDArray[np.float32], view: _View) -> Rect | None:
        """The rectangle of a body that is wholly on the screen; None when a part of it may be off the screen."""
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
        """Of the patches `rows`: the indices of those that may widen `seen`, and of those the near plane may cut."""
        radius = level.size[rows] + (self._standoff + ROUNDING_M)
        radius += np.einsum("pj,j->p", level.give[rows], view.turned / np.sqrt(2.0))
        if self._blend is not None:
            radius += np.einsum("pj,j->p", level.blend[rows], view.turned)
        centres = self._project(level.centres[rows], view, blend=False)
        front, cut = _against_near(centres, radius, view)
        low, high = _quotients(centres, radius, view)
        front &= ((high >= -1.0) & (low <= 1.0)).all(axis=1)
        # A point of each patch that is surely covered widens the rectangle now, so that fewer patches need refining:
        # the centre, or where blend shapes may have moved the centre, the inner side of its sphere.
        point = _quotients(centres[front], np.full(int(front.sum()), self._standoff), view)
        seen.add(*(point if self._blend is None else (high[front], low[front])))
        return rows[front][seen.widened_by(low[front], high[front])], rows[cut]

    def _project(self, vertices: NDArray[np.integer[Any]], view: _View, blend: bool = True) -> F64:
        """(N,4) clip coordinates of `vertices` (N,); `blend`: apply the pose blend shapes."""
        rest = self._rest[vertices]
        if blend and self._blend is not None:
            rest[:, :3] += np.einsum("naf,f->na", self._blend[vertices], view.posed.feature)
        blended = blend_matrices(self._weights[vertices], view.per_joint).reshape(-1, 4, 4)
        return np.asarray(np.einsum("nab,nb->na", blended, rest))

    def _add_vertices(self, vertices: I64, view: _View, seen: _Extent) -> None:
        points = self._project(vertices, view)
        seen.add(*_quotients(points, np.full(len(points), self._standoff), view))

    def _add_triangles(self, faces: I64, view: _View, seen: _Extent) -> None:
        """Add the triangles that the near plane may cut, clipped to it."""
        corners = self._project(self._faces[faces].ravel(), view).reshape(-1, 3, 4)
        clipped = _clip_near(corners, self._standoff * view.near_norm)
        seen.add(*_quotients(clipped, np.full(len(clipped), self._standoff), view))


def _reach(shaped: ShapedBody, weights: F64, levels: list[Level]) -> float:
    """Metres: the furthest that any pose brings a vertex from the root joint.

    A joint is no further from the root than the bones between them are long, a point that it moves no further from it
    than at rest, and a skinned vertex is a mean of such points. |R - I| of a joint is at most 2 sqrt(2).
    """
    parents, joints = shaped.body.parents, shaped.joints
    bones = np.linalg.norm(joints - np.where(parents[:, None] < 0, joints, joints[parents]), axis=1)
    bones[0] = 0.0
    chain = branch_sums(parents, np.eye(JOINTS)) @ bones  # of all joints from the root to each
    furthest = np.where(weights > 0, joint_distance(shaped) + chain, 0.0).max()
    blend = max(float(level.blend.sum(axis=1).max()) for level in levels) * 2.0 * np.sqrt(2.0)
    return float(furthest + blend)


def _against_near(centres: F64, radius: F64, view: _View) -> tuple[Mask, Mask]:
    """(N,) which spheres lie wholly in front of the near plane (and W = 0), and (N,) which cross it.

    A sphere that is neither is not visible.
    """
    near, far = centres[:, 3] + centres[:, 2], centres[:, 3] - centres[:, 2]
    within = far + radius * view.far_norm >= 0.0
    front = (near - radius * view.near_norm > 0.0) & (centres[:, 3] - radius * view.norms[3] > W_LEAST)
    return front & within, (near + radius * view.near_norm > 0.0) & ~front & within


def _quotients(points: F64, radius: F64, view: _View) -> tuple[F64, F64]:
    """Least and greatest (X/W, Y/W), each (N,2), over spheres of `radius` (N,) about clip coordinates `points` (N,4).

    X, Y and W are linear in the point, so over a sphere each varies by the radius times the norm of its matrix row.
    """
    reach = radius[:, None] * view.norms[:2]
    least = np.maximum(points[:, 3] - radius * view.norms[3], W_LEAST)[:, None]
    most = np.maximum(points[:, 3] + radius * view.norms[3], W_LEAST)[:, None]
    low, high = points[:, :2] - reach, points[:, :2] + reach
    return low / np.where(low > 0.0, most, least), high / np.where(high > 0.0, least, most)


def _clip_near(triangles: F64, slack: float) -> F64:
    """(N,4) clip coordinates of the corners in front of the near plane, and of the points where edges cross it.

    `triangles` (F,3,4). `slack`: how far the plane is moved back, in clip coordinates.
    """
    near = triangles[:, :, 2] + triangles[:, :, 3] + slack
    points = [triangles[near > 0.0]]
    for a, b in ((0, 1), (1, 2), (2, 0)):
        crosses = (near[:, a] > 0.0) != (near[:, b] > 0.0)
        start, end = triangles[crosses, a], triangles[crosses, b]
        share = near[crosses, a] / (near[crosses, a] - near[crosses, b])
        points.append(start + share[:, None] * (end - start))
    return np.concatenate(points)
