"""What the GPU needs of an avatar's bundle.

Rule: read once, when the unit starts; no stage opens a file later.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from trilane.avatars.bundle import load_bundle
from trilane.body.body import Body, load_body
from trilane.body.skin_weights import WEIGHT_COUNTS, largest_weights
from trilane.stages.gpu.mesh_arrays import MeshArrays, mesh_arrays
from trilane.stages.gpu.packed_pass import Quantisation

LARGEST_LOSS = 1e-3  # of a vertex's weight


@dataclass(frozen=True)
class AvatarAssets:
    """`rest` (55,3) float64: rest joints, metres. `posedirs` (V,3,486) or None. `texture` (H,W,C) float32."""

    arrays: MeshArrays
    posedirs: NDArray[np.float32] | None
    rest: NDArray[np.float64]
    texture: NDArray[np.float32]
    quantisation: Quantisation


def load_assets(folder: Path) -> AvatarAssets:
    """Read the bundle in `folder`. Raises BadInputError."""
    bundle = load_bundle(folder)
    body = load_body(bundle.body_path)
    shaped = body.shape(bundle.manifest.betas, bundle.manifest.expression)
    top = largest_weights(body.weights, enough_weights(body))
    return AvatarAssets(
        arrays=mesh_arrays(shaped.vertices, body.faces, body.uv, body.uv_faces, top.joints, top.weights),
        posedirs=body.posedirs,
        rest=shaped.joints,
        texture=bundle.read_texture(),
        quantisation=Quantisation(bundle.manifest.network.input.scale, bundle.manifest.network.input.zero_point),
    )


def enough_weights(body: Body) -> int:
    """The smallest K of 4, 8, 12 whose K largest weights hold all but LARGEST_LOSS of every vertex; else 12."""
    left = -np.sort(-body.weights, axis=1)
    lost = {k: float(left[:, k:].sum(axis=1).max(initial=0.0)) for k in WEIGHT_COUNTS}
    return next((k for k in WEIGHT_COUNTS if lost[k] <= LARGEST_LOSS), WEIGHT_COUNTS[-1])
