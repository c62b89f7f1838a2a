"""The outermost vertices of a body: enough to know where it touches the floor and what part of the picture it takes.

Rule: heights and extents come from these vertices, not from joints; pose blend shapes are left out.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from trilane.arrays import F32, F64
from trilane.body.body import ShapedBody
from trilane.body.joints import JOINT_INDEX

#: How many of a vertex's skin weights are used: the largest ones.
WEIGHTS = 4
#: Frames whose heights are computed together: so few that the arrays stay in the processor's cache.
FRAMES_AT_ONCE = 16
FEET = ("left_ankle", "right_ankle", "left_foot", "right_foot")
#: Directions in which the outermost vertices of each joint are taken: the axes and the diagonals of a cube.
_SIGNS = [(x, y, z) for x in (-1, 0, 1) for y in (-1, 0, 1) for z in (-1, 0, 1) if abs(x) + abs(y) + abs(z) in (1, 3)]
DIRECTIONS: F64 = np.array(_SIGNS, dtype=np.float64) / np.linalg.norm(_SIGNS, axis=1, keepdims=True)


@dataclass(frozen=True)
class Outline:
    """The K outermost vertices of a body.

    `points` (K, 4): at rest, metres, with a 1 appended. `joints` and `weights` (K, W): the joints that move each of
    them, and how much.
    """

    points: F64
    joints: NDArray[np.intp]
    weights: F64

    def posed(self, matrices: F32) -> F64:
        """World positions (K, 3) under skinning matrices (55, 3, 4)."""
        blend = np.einsum("kw,kwc->kc", self.weights, matrices.reshape(-1, 12)[self.joints])
        return np.asarray(np.einsum("kab,kb->ka", blend.reshape(-1, 3, 4), self.points))

    def lowest(self, height_rows: F32) -> F64:
        """The least height (T,) that `posed` gives, of `height_rows` (T, 55, 4): row 1 of the skinning matrices."""
        parts = np.split(height_rows, range(FRAMES_AT_ONCE, len(height_rows), FRAMES_AT_ONCE))
        return np.concatenate([self._heights(rows).min(axis=1) for rows in parts])

    def _heights(self, rows: F32) -> F64:
        columns = range(self.weights.shape[1])
        blend = np.asarray(sum(self.weights[:, w, None] * rows[:, self.joints[:, w]] for w in columns))
        return np.asarray(np.einsum("tkb,kb->tk", blend, self.points))


def outline(body: ShapedBody) -> Outline:
    """For each joint, of the vertices that it moves most, those that lie furthest along each of DIRECTIONS."""
    weights, rest = body.body.weights, body.vertices.astype(np.float64)
    owner = weights.argmax(axis=1)
    picked: set[int] = set()
    for joint in np.unique(owner):
        own = np.flatnonzero(owner == joint)
        picked.update(own[(rest[own] @ DIRECTIONS.T).argmax(axis=0)].tolist())
    index = np.array(sorted(picked))
    return _of(body, index)


def feet(body: ShapedBody) -> Outline:
    """All vertices that ankles and toes move most: those that stand on the floor to the millimetre."""
    return _of(body, np.flatnonzero(np.isin(body.body.weights.argmax(axis=1), [JOINT_INDEX[name] for name in FEET])))


def _of(body: ShapedBody, index: NDArray[np.intp]) -> Outline:
    """The Outline of the vertices `index`."""
    weights, rest = body.body.weights[index], body.vertices[index].astype(np.float64)
    points = np.concatenate([rest, np.ones((len(index), 1))], axis=1)
    top = np.argsort(-weights, axis=1)[:, :WEIGHTS]
    largest = np.take_along_axis(weights, top, axis=1).astype(np.float64)
    return Outline(points, top, largest / largest.sum(axis=1, keepdims=True))
