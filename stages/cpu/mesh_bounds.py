"""The screen rectangle of a skinned mesh, exact, at a fraction of the cost of skinning it.

Rule: nothing of the mesh that is on the screen lies outside the rectangle; what is behind the near plane or beside the
screen does not widen it.

Spheres that hold patches of the mesh in any pose (`patches`) say which patches are off the screen, which are cut by the
near plane, and which can touch the rectangle's sides; only those are looked at more closely, and at last skinned.
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
from trilane.body.skinning import blend_matrices, largest_weights
from trilane.stages.cpu.crop import Rect
from trilane.stages.cpu.patches import Level, build_levels, join

#: Added to every radius, metres, and to every side of the rectangle, NDC, against rounding.
ROUNDING_M = 1e-4
ROUNDING_NDC = 1e-6
_W_LEAST = 1e-9


@dataclass
class _Extent:
    """Least and greatest (x, y) seen so far, normalised device coordinates."""

    low: F64 = field(default_factory=lambda: np.full(2, np.inf))
    high: F64 = field(default_factory=lambda: np.full(2, -np.inf))

    def add(self, low: F64, high: F64) -> None:
        """Widen by points whose bounds are `low` and `high` (N,2)."""
        if len(low):
            np.minimum(self.low, low.min(axis=0), out=self.low)
            np.maximum(self.high, high.max(axis=0), out=self.high)

    def widened_by(self, low: F64, high: F64) -> Mask:
        """(N,): which bounds (N,2) reach over a side that is not yet at the screen's edge."""
        return np.asarray(
            (((low < self.low) & (self.low > -1.0)) | ((high > self.high) & (self.high < 1.0))).any(axis=1)
        )

    def rect(self) -> Rect | None:
        low, high = np.maximum(self.low - ROUNDING_NDC, -1.0), np.minimum(self.high + ROUNDING_NDC, 1.0)
        if not (low < high).all():
            return None
        return Rect(float(low[0]), float(low[1]), float(high[0]), float(high[1]))


@dataclass(frozen=True)
class _View:
    """One frame: the camera (4,4) and its rows' norms, each joint's map from rest to clip space (55,16), the pose."""

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
    """Bounds of one shaped body, for any pose and camera.

    `weight_count`: the skin weights that are drawn, None for all. `standoff_m`: what is drawn reaches this far from the
    mesh (clothes, hair). `pose_blend`: pose blend shapes are drawn, if the body has any.
    """

    def __init__(
        self, shaped: ShapedBody, weight_count: int | None = None, standoff_m: float = 0.0, pose_blend: bool = True
    ) -> None:
        body = shaped.body
        weights = body.weights if weight_count is None else largest_weights(body.weights, weight_count).dense()
        self._weights = weights.astype(np.float64)
        self._rest = np.concatenate([shaped.vertices, np.ones((len(weights), 1))], axis=1)
        self._faces = body.faces
        self._standoff = standoff_m
        self._blend = body.posedirs if pose_blend else None
        self._levels = build_levels(shaped, self._weights)

    def rect(self, posed: Posed, clip: ArrayLike, vertices: NDArray[np.float32] | None = None) -> Rect | None:
        """The mesh's rectangle on the screen, clipped to it; None when nothing is visible.

        `posed`: rigid transforms of `Skeleton.pose`. `clip` (4,4): projection @ view, of any kind. `vertices` (V,3):
        the frame's skinned vertices, if there are any: then a body that is wholly on the screen needs no patches.
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
        """The rectangle of a body all of which is on the screen; None when any of it may not be."""
        flat = vertices @ view.camera[:, :3].T.astype(np.float32) + view.camera[:, 3].astype(np.float32)
        points = flat.astype(np.float64)
        radius = self._standoff + ROUNDING_M
        near, far = points[:, 3] + points[:, 2], points[:, 3] - points[:, 2]
        if near.min() <= radius * view.near_norm or far.min() < radius * view.far_norm:
            return None
        if points[:, 3].min() <= radius * view.norms[3] + _W_LEAST:
            return None
        low, high = _quotients(points, np.full(len(points), radius), view)
        seen = _Extent()
        seen.add(low, high)
        return seen.rect() if (seen.low > -1.0).all() and (seen.high < 1.0).all() else None

    def _sort_out(self, level: Level, rows: I64, view: _View, seen: _Extent) -> tuple[I64, I64]:
        """Of these patches, those that may widen what was seen, and those that the near plane may cut."""
        radius = level.size[rows] + (self._standoff + ROUNDING_M)
        radius += np.einsum("pj,j->p", level.give[rows], view.turned / np.sqrt(2.0))
        if self._blend is not None:
            radius += np.einsum("pj,j->p", level.blend[rows], view.turned)
        centres = self._project(level.centres[rows], view, blend=False)
        front, cut = _against_near(centres, radius, view)
        low, high = _quotients(centres, radius, view)
        front &= ((high >= -1.0) & (low <= 1.0)).all(axis=1)
        # Bounds of one vertex of each patch: the centre's own, or what its sphere says when blend shapes move it.
        point = _quotients(centres[front], np.full(int(front.sum()), self._standoff), view)
        seen.add(*(point if self._blend is None else (high[front], low[front])))
        return rows[front][seen.widened_by(low[front], high[front])], rows[cut]

    def _project(self, vertices: NDArray[np.integer[Any]], view: _View, blend: bool = True) -> F64:
        """(N,4) clip coordinates of `vertices` (N,), with or without the pose blend shapes."""
        rest = self._rest[vertices]
        if blend and self._blend is not None:
            rest[:, :3] += np.einsum("naf,f->na", self._blend[vertices], view.posed.feature)
        blended = blend_matrices(self._weights[vertices], view.per_joint).reshape(-1, 4, 4)
        return np.asarray(np.einsum("nab,nb->na", blended, rest))

    def _add_vertices(self, vertices: I64, view: _View, seen: _Extent) -> None:
        points = self._project(vertices, view)
        seen.add(*_quotients(points, np.full(len(points), self._standoff), view))

    def _add_triangles(self, faces: I64, view: _View, seen: _Extent) -> None:
        """Add triangles that the near plane may cut, clipped to it."""
        corners = self._project(self._faces[faces].ravel(), view).reshape(-1, 3, 4)
        kept = _clip_near(corners, self._standoff * view.near_norm)
        seen.add(*_quotients(kept, np.full(len(kept), self._standoff), view))


def _against_near(centres: F64, radius: F64, view: _View) -> tuple[Mask, Mask]:
    """Which spheres lie wholly in front of the near plane (and of W = 0), and which cross it; neither: out of sight."""
    near, far = centres[:, 3] + centres[:, 2], centres[:, 3] - centres[:, 2]
    within = far + radius * view.far_norm >= 0.0
    front = (near - radius * view.near_norm > 0.0) & (centres[:, 3] - radius * view.norms[3] > _W_LEAST)
    return front & within, (near + radius * view.near_norm > 0.0) & ~front & within


def _quotients(points: F64, radius: F64, view: _View) -> tuple[F64, F64]:
    """Bounds of (X/W, Y/W) over spheres: X, Y and W are linear, so each moves by the radius times its row's norm."""
    reach = radius[:, None] * view.norms[:2]
    least = np.maximum(points[:, 3] - radius * view.norms[3], _W_LEAST)[:, None]
    most = np.maximum(points[:, 3] + radius * view.norms[3], _W_LEAST)[:, None]
    low, high = points[:, :2] - reach, points[:, :2] + reach
    return low / np.where(low > 0.0, most, least), high / np.where(high > 0.0, least, most)


def _clip_near(triangles: F64, slack: float) -> F64:
    """(N,4) clip coordinates: corners in front of the near plane, moved back by `slack`, and where edges cross it."""
    near = triangles[:, :, 2] + triangles[:, :, 3] + slack
    kept = [triangles[near > 0.0]]
    for a, b in ((0, 1), (1, 2), (2, 0)):
        crosses = (near[:, a] > 0.0) != (near[:, b] > 0.0)
        start, end = triangles[crosses, a], triangles[crosses, b]
        share = near[crosses, a] / (near[crosses, a] - near[crosses, b])
        kept.append(start + share[:, None] * (end - start))
    return np.concatenate(kept)
