"""Makes the levels of a body's mesh: meshoptimizer simplifies it, then vertices are put back until no point moves far.

meshoptimizer collapses edges onto existing vertices, keeps UV seams, and weighs UV as an attribute. Its error is a mean
over quadrics, so single texels may move far. Therefore the distance between the whole mesh and the level is measured
where it can be largest (`avatars/mesh_levels.py`): at vertices, and where an edge of the mesh crosses an edge of the
level in UV. If the distance is too large, a vertex beside the worst place of each triangle is locked, and the mesh is
simplified again.

At a seam, the level's edge is a chord of the whole mesh's outline in UV. A left-out vertex on a seam or beyond a chord
is paired with the nearest point of a chord.
"""

from __future__ import annotations

import ctypes
from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from trilane.arrays import F64, I64, Mask
from trilane.avatars.mesh_levels import MeshLevel, grouped
from trilane.body.body import ShapedBody
from trilane.body.joints import JOINTS, Skeleton
from trilane.body.skinning import CpuSkinner, blend_reach, branch_sums
from trilane.errors import MissingPartError
from trilane.stages.gpu.skinned_mesh import split_corners
from trilane.training.random_views import random_pose

#: For each level, the largest distance in metres by which it may move a point, at rest and in `POSES` random poses.
TOLERANCES_M = (0.002, 0.005, 0.015, 0.04)
POSES = 6
#: Weight of an error in UV, scaled to metres, relative to an error in position.
UV_WEIGHT = 10.0
MOST_ROUNDS = 25
#: Cells along a side of the grid over the texture in which pairs of triangles are searched.
CELLS = 96
ON_EDGE = 1e-9
CHUNK = 4000


@dataclass(frozen=True)
class Pairs:
    """P pairs of points: a point of the whole mesh, and the point of the level that shows the same texel.

    `corners`: indices (P,5) of corners. The point of the whole mesh lies between the first two, the point of the level
    between the last three.
    `shares`: (P,5), barycentric weight of each corner in its point: negated for the first two corners.
    `uv_error`: as in `MeshLevel`.
    """

    corners: I64
    shares: F64
    uv_error: float


@dataclass
class Corners:
    """The N corners of a body's mesh, one for each distinct pair of vertex and texture coordinate.

    `shaped`: the body.
    `vertex`, `uv_row`: indices (N,) of the body's vertices and of its texture coordinates.
    `triangles`, `edges`: indices (F,3) and (E,2) of corners.
    `uv`: texture coordinates (N,2).
    `rest`: positions (N,3) at rest, in metres.
    `places`: positions (1 + POSES,N,3) at rest and in random poses, in metres.
    `border`: indices of the corners at UV seams.
    `chart`: number (N,) of each corner's UV chart, a connected part of the mesh in UV.
    """

    shaped: ShapedBody
    vertex: I64 = field(init=False)
    uv_row: I64 = field(init=False)
    triangles: I64 = field(init=False)

    def __post_init__(self) -> None:
        body = self.shaped.body
        self.vertex, self.uv_row, triangles = split_corners(body.faces, body.uv_faces)
        self.triangles = triangles.astype(np.int64)
        self.uv: F64 = body.uv[self.uv_row].astype(np.float64)
        self.rest: F64 = self.shaped.vertices[self.vertex].astype(np.float64)
        self.edges, uses = _edges(self.triangles)
        self.border: I64 = np.unique(self.edges[uses == 1])
        graph = coo_array((np.ones(len(self.edges)), self.edges.T), shape=(len(self.uv), len(self.uv)))
        self.chart: I64 = connected_components(graph, directed=False)[1].astype(np.int64)
        self.places: F64 = np.stack(list(self._places()))

    def _places(self) -> Iterator[F64]:
        skeleton = Skeleton(self.shaped.joints, self.shaped.body.parents)
        skinner = CpuSkinner(self.shaped)
        yield self.rest
        for seed in range(POSES):
            yield skinner.vertices(skeleton.pose(random_pose(np.random.default_rng(seed))))[self.vertex]

    @property
    def extent(self) -> float:
        """Longest side of the body's bounding box at rest, in metres."""
        return float(np.ptp(self.rest, axis=0).max())

    def simplified(self, tolerance_m: float, locked: Mask) -> I64:
        """Return the triangles (G,3), indices of corners, to which meshoptimizer simplifies the mesh.

        `tolerance_m`: target error in metres. `locked`: (N,), whether a corner must stay.
        """
        import meshoptimizer

        triangles = np.ascontiguousarray(self.triangles.ravel(), np.uint32)
        positions = np.ascontiguousarray(self.rest, np.float32)
        metres = np.sqrt(_area(self.rest[self.triangles]) / _area(self.uv[self.triangles]))
        attributes = np.ascontiguousarray(self.uv * metres, np.float32)
        left = np.zeros_like(triangles)
        # The package passes these numbers to C without types, so they need C types.
        size = ctypes.c_size_t
        count = meshoptimizer.simplify_with_attributes(
            left,
            triangles,
            positions,
            attributes,
            np.full(2, UV_WEIGHT / self.extent, np.float32),
            index_count=size(len(triangles)),
            vertex_count=size(len(positions)),
            vertex_positions_stride=size(positions.strides[0]),
            vertex_attributes_stride=size(attributes.strides[0]),
            attribute_count=size(2),
            vertex_lock=locked.astype(np.uint8),
            target_index_count=size(0),
            target_error=ctypes.c_float(tolerance_m / self.extent),
            options=ctypes.c_uint(0),
        )
        return left[:count].reshape(-1, 3).astype(np.int64)

    def pairs(self, level: I64) -> Pairs:
        """Return the pairs at which the distance between the whole mesh and a level may be largest.

        `level`: triangles (G,3) of the level, indices of corners.
        """
        # Kept corners are included: if a level folds over itself in UV, one may lie in a triangle of other corners.
        inside, is_inside = self._in_triangles(np.unique(self.triangles), level)
        left_out = np.setdiff1d(self.triangles, level)
        edges, uses = _edges(level)
        beside = np.union1d(np.setdiff1d(left_out, is_inside), np.intersect1d(self.border, left_out))
        seams, apart = self._at_seams(beside, edges[uses == 1])
        corners, shares = zip(inside, self._crossings(edges), seams, strict=True)
        return Pairs(np.concatenate(corners), np.concatenate(shares), float(apart.max(initial=0.0)))

    def _in_triangles(self, corners: I64, level: I64) -> tuple[tuple[I64, F64], I64]:
        """Return (pairs, corners (K,) that are in a pair).

        A pair consists of one of `corners` (M,) and a point that shows the same texel. The point lies in a triangle of
        `level` (G,3) that does not have this corner. Pairs are (`corners`, `shares`) as in `Pairs`.
        """
        point, (a, b, c) = self.uv[corners], (self.uv[level[:, k]] for k in range(3))
        box = np.stack([a, b, c])
        row, number = _neighbours((point, point), (box.min(axis=0), box.max(axis=0)))
        p, a, b, c = point[row], a[number], b[number], c[number]
        area = _cross(b - a, c - a)
        with np.errstate(divide="ignore", invalid="ignore"):
            shares = (
                np.stack([_cross(b - p, c - p), _cross(c - p, a - p), _cross(a - p, b - p)], axis=1) / area[:, None]
            )
        holds = (shares >= -ON_EDGE).all(axis=1) & (level[number] != corners[row][:, None]).all(axis=1)
        row, number, shares = row[holds], number[holds], shares[holds]
        own = corners[row][:, None]
        ones = np.ones((len(row), 1))
        return (np.hstack([own, own, level[number]]), np.hstack([-ones, 0 * ones, shares])), np.unique(own)

    def _crossings(self, edges: I64) -> tuple[I64, F64]:
        """Return one pair for each point of UV where an edge of the whole mesh crosses an edge of a level.

        Pairs are (`corners`, `shares`) as in `Pairs`. Edges that cross at an end of one of them have no pair here.
        """
        a, b, c, d = (self.uv[ends] for ends in (*self.edges.T, *edges.T))
        row, number = _neighbours((np.minimum(a, b), np.maximum(a, b)), (np.minimum(c, d), np.maximum(c, d)))
        a, b, c, d = a[row], b[row], c[number], d[number]
        turn = _cross(b - a, d - c)
        with np.errstate(divide="ignore", invalid="ignore"):
            t, s = _cross(c - a, d - c) / turn, _cross(c - a, b - a) / turn
        # A crossing at an end is a vertex, which is kept or has its own pair. Parallel edges give NaN or infinity.
        hit = (np.minimum(t, s) > ON_EDGE) & (np.maximum(t, s) < 1 - ON_EDGE)
        t, s, own, other = t[hit], s[hit], self.edges[row[hit]], edges[number[hit]]
        return np.hstack([own, other, other[:, :1]]), np.stack([t - 1, -t, 1 - s, s, 0 * s], axis=1)

    def _at_seams(self, corners: I64, chords: I64) -> tuple[tuple[I64, F64], F64]:
        """Pair each of the M `corners` with the nearest point of a chord in UV; return (pairs, distances (M,) in UV).

        Only chords in the same UV chart count. The pairs have the form of `Pairs`.
        """
        if not len(corners):
            return (np.zeros((0, 5), np.int64), np.zeros((0, 5))), np.zeros(0)
        point, start = self.uv[corners][:, None], self.uv[chords[:, 0]]
        along = self.uv[chords[:, 1]] - start
        length = np.maximum((along * along).sum(axis=1), 1e-30)
        share = np.clip(((point - start) * along).sum(axis=2) / length, 0.0, 1.0)
        apart = np.linalg.norm(point - start - share[..., None] * along, axis=2)
        apart += np.where(self.chart[corners][:, None] == self.chart[chords[:, 0]], 0.0, 1e3)
        nearest = apart.argmin(axis=1)
        rows = np.arange(len(corners))
        s, own, other = share[rows, nearest], corners[:, None], chords[nearest]
        shares = np.stack([-np.ones(len(s)), 0 * s, 1 - s, s, 0 * s], axis=1)
        return (np.hstack([own, own, other, other[:, :1]]), shares), np.minimum(apart[rows, nearest], 1.0)

    def moved_m(self, pairs: Pairs) -> F64:
        """Return the distance (P,) in metres between the points of each pair: the largest over rest and all poses."""
        square = np.zeros(len(pairs.corners))
        for places in self.places:
            apart = np.einsum("pk,pka->pa", pairs.shares, places[pairs.corners])
            np.maximum(square, np.einsum("pa,pa->p", apart, apart), out=square)
        return np.asarray(np.sqrt(square))

    def to_lock(self, pairs: Pairs, level: I64, moved: F64, tolerance_m: float, locked: Mask) -> Mask:
        """Return which corners (N,) to lock next: all in `locked`, and corners of pairs whose points are too far apart.

        `pairs`, `level`: pairs and triangles (G,3) of the level.
        `moved`: distance (P,) between the points of each pair, in metres.
        `tolerance_m`: largest distance in metres that is allowed.
        `locked`: (N,), whether a corner is locked already.
        """
        bad = np.flatnonzero(moved > tolerance_m)
        bad = bad[np.argsort(-moved[bad])]
        element = pairs.corners[bad, 2] << 32 | pairs.corners[bad, 3]
        worst = bad[np.unique(element, return_index=True)[1]]
        kept = np.zeros(len(self.uv), bool)
        kept[level] = True
        own = pairs.corners[worst, :2]
        best = np.where(kept[own], 1.0, pairs.shares[worst, :2]).argmin(axis=1)
        picked = own[np.arange(len(own)), best]
        # If both ends of an edge are kept but a point of it moves too far, all corners around the pair are put back.
        stuck = pairs.corners[worst[kept[picked]]]
        around = self.edges[np.isin(self.edges, stuck).any(axis=1)].ravel()
        wanted = np.union1d(picked, around)
        gone = np.setdiff1d(self.chart[wanted], self.chart[np.flatnonzero(kept)])
        wanted = np.union1d(
            wanted, np.flatnonzero(np.isin(self.chart, gone) & np.isin(np.arange(len(kept)), self.border))
        )
        if locked[wanted].all():
            wanted = self.edges[np.isin(self.edges, pairs.corners[worst]).any(axis=1)].ravel()
        return locked | np.isin(self.vertex, self.vertex[wanted])

    def terms(self, pairs: Pairs) -> tuple[F64, F64, F64]:
        """Return the terms of the bound for P pairs, as in `MeshLevel`: (rest (P,), swing (P,54), blend (P,54))."""
        body = self.shaped.body
        weights = branch_sums(body.parents, body.weights.astype(np.float64))[self.vertex]
        lever = weights[:, 1:, None] * (self.rest[:, None] - self.shaped.joints[None, 1:])
        reach = blend_reach(self.shaped)[self.vertex]
        below = branch_sums(body.parents, np.eye(JOINTS))[:, 1:]  # (55,54): whether joint k is joint b or below it
        rest, swing, blend = [], [], []
        for start in range(0, len(pairs.corners), CHUNK):
            corners, shares = pairs.corners[start : start + CHUNK], pairs.shares[start : start + CHUNK]
            apart = np.einsum("pk,pka->pa", shares, self.rest[corners])
            y = np.einsum("pk,pkba->pba", shares, lever[corners])
            outside = np.linalg.norm(y, axis=2)
            inside = np.linalg.norm(apart[:, None] - y, axis=2)
            seen_from = (outside @ (1 - below).T + inside @ below.T).argmin(axis=1)
            rest.append(np.linalg.norm(apart, axis=1))
            swing.append(np.where(below[seen_from] > 0, inside, outside))
            blend.append(np.einsum("pk,pkb->pb", np.abs(shares), reach[corners]))
        return np.concatenate(rest), np.concatenate(swing), np.concatenate(blend)

    def level(self, triangles: I64, pairs: Pairs) -> MeshLevel:
        """Return the level with `triangles` (G,3), indices of corners. `pairs`: its pairs with the whole mesh."""
        faces, uv_faces = (rows[triangles].astype(np.int32) for rows in (self.vertex, self.uv_row))
        rest, swing, blend = self.terms(pairs)
        return MeshLevel(faces, uv_faces, *grouped(rest, swing, blend), pairs.uv_error)


def make_mesh_levels(shaped: ShapedBody) -> Iterator[MeshLevel]:
    """Yield the levels of the mesh of `shaped`, finest first, one for each of `TOLERANCES_M`.

    If `MOST_ROUNDS` rounds are not enough, a level exceeds its tolerance; its bound is still correct.

    Raises MissingPartError without meshoptimizer.
    """
    try:
        import meshoptimizer  # noqa: F401
    except ImportError:
        raise MissingPartError("levels of the mesh need meshoptimizer", extra="levels") from None
    mesh = Corners(shaped)
    for tolerance_m in TOLERANCES_M:
        triangles, pairs = simplify_within(mesh, tolerance_m)
        yield mesh.level(triangles, pairs)


def simplify_within(mesh: Corners, tolerance_m: float) -> tuple[I64, Pairs]:
    """Simplify `mesh`; return (triangles (G,3) of the level, pairs of the level with the whole mesh).

    The points of a pair are at most `tolerance_m` apart. If none of MOST_ROUNDS rounds achieves this, the round whose
    largest distance is the smallest gives the result.
    """
    locked = np.zeros(len(mesh.uv), bool)
    best: tuple[float, I64, Pairs] | None = None
    for _ in range(MOST_ROUNDS):
        triangles = mesh.simplified(tolerance_m, locked)
        pairs = mesh.pairs(triangles)
        moved = mesh.moved_m(pairs)
        furthest = float(moved.max(initial=0.0))
        if best is None or furthest < best[0]:
            best = furthest, triangles, pairs
        if furthest <= tolerance_m:
            break
        more = mesh.to_lock(pairs, triangles, moved, tolerance_m, locked)
        if (more == locked).all():
            break
        locked = more
    assert best is not None
    return best[1], best[2]


def _area(corners: F64) -> float:
    """Return the total area of triangles (F,3,2) or (F,3,3)."""
    a, b = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    square = (a * a).sum(axis=1) * (b * b).sum(axis=1) - (a * b).sum(axis=1) ** 2
    return float(np.sqrt(np.maximum(square, 0.0)).sum() / 2)


def _cross(a: F64, b: F64) -> F64:
    return np.asarray(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])


def _edges(triangles: I64) -> tuple[I64, NDArray[np.intp]]:
    """Return (edges (E,2) of `triangles` (F,3), number (E,) of the triangles that have each edge)."""
    ends = np.sort(np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]]), axis=1)
    distinct, uses = np.unique(ends[:, 0] << 32 | ends[:, 1], return_counts=True)
    return np.stack([distinct >> 32, distinct & 0xFFFFFFFF], axis=1), uses


def _neighbours(first: tuple[F64, F64], second: tuple[F64, F64]) -> tuple[I64, I64]:
    """Return the boxes that share a cell of the texture: indices (M,) of `first`, indices (M,) of `second`.

    `first`, `second`: (lowest, highest) u and v, (K,2) each, of K boxes.
    """
    row, cell = _cells(*first)
    other, its_cell = _cells(*second)
    order = np.argsort(its_cell, kind="stable")
    start, end = (np.searchsorted(its_cell[order], cell, side) for side in ("left", "right"))
    count = end - start
    at = np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count) + np.repeat(start, count)
    pair = np.unique(np.repeat(row, count) << 32 | other[order[at]])
    return pair >> 32, pair & 0xFFFFFFFF


def _cells(low: F64, high: F64) -> tuple[I64, I64]:
    first = np.floor(low * CELLS).astype(np.int64)
    size = np.floor(high * CELLS).astype(np.int64) - first + 1
    count = size.prod(axis=1)
    row = np.repeat(np.arange(len(low)), count)
    at = np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count)
    return row, (first[row, 0] + at % size[row, 0]) * (1 << 20) + first[row, 1] + at // size[row, 0]
