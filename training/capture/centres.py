"""Points of the body that close-ups are centred on: joints, or vertices drawn so that all of the surface is alike.

Rule: a vertex is drawn by its share of the surface's area. SMPL-X has about as many vertices in the head as elsewhere;
the thesis (section 3.3) weights joints by the volume about them to make up for that, which areas do exactly.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np

from trilane.arrays import F64
from trilane.body.body import ShapedBody
from trilane.body.joints import JOINT_INDEX, JOINT_NAMES, JOINTS
from trilane.body.kinematics import Posed
from trilane.body.skinning import blend_matrices
from trilane.training.clothing.surface_geometry import vertex_areas
from trilane.training.random_views import ANYWHERE, BANDS


class Centres(Protocol):
    """Draws centres of views."""

    def draw(self, rng: np.random.Generator, band: str, posed: Posed) -> F64:
        """(3,), world metres: a point of the body `posed` for a view of `band`, of `BANDS` or `anywhere`."""


class JointCentres:
    """The joints of a band, each as often as any other."""

    def draw(self, rng: np.random.Generator, band: str, posed: Posed) -> F64:
        """As `Centres.draw`."""
        names = BANDS[band][0] if band in BANDS else ANYWHERE
        return np.array(posed.joints[JOINT_INDEX[names[rng.integers(len(names))]]])


class VertexCentres:
    """Vertices that the joints of a band move more than others do, by their area; `anywhere` is the whole body."""

    def __init__(self, shaped: ShapedBody) -> None:
        self._shaped = shaped
        self._area = vertex_areas(shaped.vertices.astype(np.float64), shaped.body.faces.astype(np.int64))
        self._joint = shaped.body.weights.argmax(axis=1)

    def shares(self, band: str) -> F64:
        """(V,): how probable each vertex is in `band`; they sum to 1."""
        names = BANDS[band][0] if band in BANDS else JOINT_NAMES
        area = self._area * np.isin(self._joint, [JOINT_INDEX[name] for name in names])
        return np.asarray(area / area.sum())

    def draw(self, rng: np.random.Generator, band: str, posed: Posed) -> F64:
        """As `Centres.draw`."""
        vertex = int(rng.choice(len(self._area), p=self.shares(band)))
        weights = self._shaped.body.weights[vertex : vertex + 1].astype(np.float64)
        matrix = blend_matrices(weights, posed.matrices.reshape(JOINTS, 12).astype(np.float64)).reshape(3, 4)
        return np.asarray(matrix[:, :3] @ self._shaped.vertices[vertex] + matrix[:, 3])
