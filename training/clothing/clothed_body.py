"""The clothed body on the GPU: all its layers, each with its paint, drawn together.

Rule: pictures come from the GPU stage's own raster; this file adds only the layers and the uniforms of `paint.frag`.
"""

from __future__ import annotations

from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from trilane.stages.gpu.skinned_mesh import SkinnedMesh, mesh_arrays
from trilane.training.clothing import landmarks as joint
from trilane.training.clothing.landmarks import Landmarks
from trilane.training.clothing.layers import MATERIALS, Layer
from trilane.training.clothing.looks import DEFAULT, Look
from trilane.training.clothing.shaded_raster import ShadedMesh, ShadedRaster

WEIGHTS_PER_VERTEX = 8
PAINT = Path(str(files("trilane.training.clothing") / "paint.frag"))


class ClothedBody:
    """Draws the layers of a clothed body."""

    def __init__(self, ctx: Any, layers: list[Layer], landmarks: Landmarks, samples: int, look: Look = DEFAULT) -> None:
        """Put the layers on the GPU.

        `ctx`: the OpenGL context.
        `layers`: of `clothing_layers`.
        `landmarks`: of the body at rest.
        `samples`: along each side of a pixel, an even number.
        `look`: of the layers.
        """
        placed, definitions = _places(landmarks), look.definitions(landmarks)
        self._meshes = [
            ShadedMesh(
                ctx, _mesh(ctx, layer), PAINT, placed | {"material": MATERIALS.index(layer.material)}, definitions
            )
            for layer in layers
        ]
        self._raster = ShadedRaster(ctx, samples)

    def render(
        self, joints: NDArray[np.float32], view: Any, projection: Any, shape: tuple[int, int]
    ) -> NDArray[np.uint8]:
        """The picture (h,w,4) uint8, sRGB, straight alpha.

        `joints`: (55,3,4) skinning matrices.
        `view`, `projection`: (4,4) the camera.
        `shape`: (height, width) of the picture.
        """
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


def _places(landmarks: Landmarks) -> dict[str, Any]:
    """The uniforms of `paint.frag` that say where things are on the body."""
    joints = landmarks.joints
    named = {
        "pelvis": joints[joint.PELVIS],
        "hip": joints[joint.HIP],
        "neck": joints[joint.NECK],
        "shoulder": joints[joint.SHOULDER],
        "elbow": joints[joint.ELBOW],
        "ankle": joints[joint.ANKLE],
        "toes": joints[joint.FOOT],
        "eyeball": landmarks.eye,
        "ear": landmarks.ear,
    }
    return {name: tuple(float(x) for x in point) for name, point in named.items()} | {
        "eyeball_radius": landmarks.eye_radius
    }
