"""Which cameras stand clear of a clothed body: those whose near plane cannot cut it.

Rule: a cut body has no ground truth, because the picture of it shows the inside of clothes and limbs; the bound comes
from the triangles themselves, so that every other near view stays.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from trilane.arrays import F64
from trilane.body.joints import JOINTS
from trilane.body.kinematics import Posed
from trilane.body.skinning import blend_matrices
from trilane.training.clothing.layers import Layer
from trilane.training.random_views import View


class ClothedSurface:
    """The surface of all `layers` of a clothed body, as points that reach over the triangles round them."""

    def __init__(self, layers: Sequence[Layer]) -> None:
        self._rest = np.concatenate([layer.vertices for layer in layers])
        self._weights = np.concatenate([layer.weights for layer in layers]).astype(np.float64)
        self._reach = np.concatenate([vertex_reach(layer.vertices, layer.faces) for layer in layers])

    def posed(self, posed: Posed) -> F64:
        """The points (N,3), world metres, in the pose `posed`."""
        matrices = posed.matrices.reshape(JOINTS, 12).astype(np.float64)
        moved = blend_matrices(self._weights, matrices).reshape(-1, 3, 4)
        return np.asarray(np.einsum("vab,vb->va", moved[:, :, :3], self._rest) + moved[:, :, 3])

    def is_clear_of(self, view: View, points: F64) -> bool:
        """Whether the near plane of `view` cannot cut the surface, whose points of `posed` are `points`."""
        eye = np.linalg.inv(view.view)[:3, 3]
        distance = np.linalg.norm(points - eye, axis=1)
        return bool((distance - self._reach).min() > view.near_reach_m)


def vertex_reach(vertices: F64, faces: NDArray[np.int64]) -> F64:
    """(N,) metres: every point of a triangle is within this distance of that corner of it which is nearest.

    A point of a triangle is at most its longest edge over the root of 3 from the nearest corner, as the middle of an
    equilateral one is. `vertices` (N,3), `faces` (F,3).
    """
    corners = vertices[faces]
    longest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
    reach = np.zeros(len(vertices))
    np.maximum.at(reach, faces.reshape(-1), np.repeat(longest / np.sqrt(3), 3))
    return reach
