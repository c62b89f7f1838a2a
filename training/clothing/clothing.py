"""The dressed body on the GPU: every layer with its paint, drawn together.

Rule: pictures come from the GPU stage's own raster; here are only the layers and what the paint must be told.
"""

from __future__ import annotations

from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from trilane.stages.gpu.mesh import SkinnedMesh, mesh_arrays
from trilane.training.clothing import landmarks as marks
from trilane.training.clothing.landmarks import Landmarks
from trilane.training.clothing.layers import MATERIALS, Layer
from trilane.training.clothing.shaded import ShadedMesh, ShadedRaster

WEIGHTS_PER_VERTEX = 8
PAINT = Path(str(files("trilane.training.clothing") / "paint.frag"))


class Wardrobe:
    """Draws `layers`. `samples`: samples along each side of a pixel."""

    def __init__(self, ctx: Any, layers: list[Layer], found: Landmarks, samples: int) -> None:
        placed = _places(found)
        self._meshes = [
            ShadedMesh(ctx, _mesh(ctx, layer), PAINT, uniforms=placed | {"material": MATERIALS.index(layer.material)})
            for layer in layers
        ]
        self._raster = ShadedRaster(ctx, samples)

    def render(
        self, joints: NDArray[np.float32], view: Any, projection: Any, shape: tuple[int, int]
    ) -> NDArray[np.uint8]:
        """Picture (h,w,4) uint8, sRGB, straight alpha. `joints` (55,3,4): skinning matrices."""
        return self._raster.render(self._meshes, joints, view, projection, shape)


def _mesh(ctx: Any, layer: Layer) -> SkinnedMesh:
    order = np.argsort(-layer.weights, axis=1)[:, :WEIGHTS_PER_VERTEX]
    weight = np.take_along_axis(layer.weights, order, axis=1)
    weight /= weight.sum(axis=1, keepdims=True)
    colour = np.zeros((len(layer.vertices), 4))
    colour[:, 0], colour[:, 1] = layer.light, layer.mark
    no_uv = np.zeros((1, 2))
    return SkinnedMesh(
        ctx,
        mesh_arrays(
            layer.vertices, layer.faces, no_uv, np.zeros_like(layer.faces), order, weight, layer.normal, colour
        ),
    )


def _places(found: Landmarks) -> dict[str, Any]:
    joints = found.joints
    named = {
        "pelvis": joints[marks.PELVIS],
        "hip": joints[marks.HIP],
        "neck": joints[marks.NECK],
        "shoulder": joints[marks.SHOULDER],
        "elbow": joints[marks.ELBOW],
        "ankle": joints[marks.ANKLE],
        "toes": joints[marks.FOOT],
        "eyeball": found.eye,
        "ear": found.ear,
    }
    return {name: tuple(float(x) for x in point) for name, point in named.items()} | {
        "eyeball_radius": found.eye_radius
    }
