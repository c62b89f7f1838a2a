"""The mesh that the GPU draws for a body. Rule: as many weights as the body needs, worked out once and then cached."""

from __future__ import annotations

from dataclasses import fields
from typing import Any

import numpy as np

from trilane.body.body import Body, ShapedBody
from trilane.body.skin_weights import WEIGHT_COUNTS, largest_weights
from trilane.cache import Arrays, cached_arrays
from trilane.stages.gpu.mesh_arrays import MeshArrays, mesh_arrays

LARGEST_LOSS = 1e-3  # of a vertex's weight
VERSION = "avatar mesh 1"  # to be raised when the same body gives other arrays


def avatar_mesh(shaped: ShapedBody) -> MeshArrays:
    """Vertices, triangles and weights of `shaped`, in the order in which they are drawn."""
    body = shaped.body
    sources = (shaped.vertices, body.faces, body.uv, body.uv_faces, body.weights)
    arrays: dict[str, Any] = dict(cached_arrays(VERSION, sources, lambda: _arrays(shaped)))
    closed = bool(arrays.pop("closed"))
    return MeshArrays(**arrays, closed=closed)


def _arrays(shaped: ShapedBody) -> Arrays:
    body = shaped.body
    top = largest_weights(body.weights, enough_weights(body))
    mesh = mesh_arrays(shaped.vertices, body.faces, body.uv, body.uv_faces, top.joints, top.weights)
    return {field.name: np.asarray(getattr(mesh, field.name)) for field in fields(mesh) if field.name != "surface"}


def enough_weights(body: Body) -> int:
    """The smallest K of 4, 8, 12 whose K largest weights hold all but LARGEST_LOSS of every vertex; else 12."""
    left = -np.sort(-body.weights, axis=1)
    lost = {k: float(left[:, k:].sum(axis=1).max(initial=0.0)) for k in WEIGHT_COUNTS}
    return next((k for k in WEIGHT_COUNTS if lost[k] <= LARGEST_LOSS), WEIGHT_COUNTS[-1])
