"""The clothed body on the GPU: all its layers, each with its paint, drawn together.

Rule: pictures come from the GPU stage's own raster; this file adds only the layers and the uniforms of `paint.frag`.
"""

from __future__ import annotations

from collections.abc import Mapping
from importlib.resources import files
from pathlib import Path
from typing import Any

import moderngl
import numpy as np
from numpy.typing import NDArray

from trilane.arrays import F32, U8, Floats
from trilane.stages.gpu.opengl import build_program, eye_of, set_uniforms
from trilane.stages.gpu.skinned_mesh import BodyPose, MeshDraw, SkinnedMesh, mesh_arrays
from trilane.training.clothing import looks as joint
from trilane.training.clothing.layers import MATERIALS, Layer
from trilane.training.clothing.looks import DEFAULT, Landmarks, Look

WEIGHTS_PER_VERTEX = 8
PAINT = Path(str(files("trilane.training.clothing") / "paint.frag"))


class ClothedBody:
    """Draws the layers of a clothed body."""

    def __init__(self, ctx: Any, layers: list[Layer], landmarks: Landmarks, samples: int, look: Look = DEFAULT) -> None:
        """Put the layers on the GPU.

        `ctx`: OpenGL context.
        `layers`: layers from `clothing_layers`.
        `landmarks`: landmarks of the body at rest.
        `samples`: number of samples along each side of a pixel, even.
        `look`: look of the layers.
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
        """Return the picture (h,w,4) uint8, sRGB, straight alpha.

        `joints`: skinning matrices (55,3,4).
        `view`, `projection`: matrices (4,4) of the camera.
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
    """Return the uniforms of `paint.frag` that say where things are on the body."""
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


# Draws skinned meshes with a fragment shader of the caller, supersampled: the ground truth pictures.
#
# Rule: shaders write linear light; samples are averaged in linear light, then written as sRGB with straight alpha.


class ShadedMesh:
    """One mesh with its fragment shader and textures.

    The mesh must have `normal` and `colour`. The shader reads `v_position`, `v_normal` (world, not normalised),
    `v_rest`, `v_uv`, `v_colour`, `gl_FrontFacing` and the uniforms `view` (mat4) and `eye` (vec3). It writes one vec4:
    linear light and alpha, which is 1; `discard` makes holes.
    """

    def __init__(
        self, ctx: Any, mesh: SkinnedMesh, fragment: Path, uniforms: dict[str, Any], definitions: Mapping[str, str]
    ) -> None:
        """Compile the shader.

        `ctx`: OpenGL context.
        `mesh`: mesh to draw.
        `fragment`: file of the shader.
        `uniforms`: uniforms of the shader, which never change.
        `definitions`: preprocessor definitions that it is compiled with.
        Raises TrilaneError when the shader does not compile.
        """
        self._draw = MeshDraw(ctx, mesh, fragment, **definitions)
        self._draw.set(uniforms)

    def draw(self, joints: F32, view: Floats, projection: Floats) -> None:
        """Draw into the target in use.

        `joints`: skinning matrices (55,3,4).
        `view`, `projection`: matrices (4,4) of the camera.
        """
        self._draw.set({"view": tuple(np.asarray(view, np.float64).T.ravel()), "eye": tuple(eye_of(view))})
        self._draw.draw(BodyPose(joints), view, projection)


class ShadedRaster:
    """Draws supersampled pictures of shaded meshes.

    `samples`: number of samples along each side of a pixel (2 is 2x2), even.
    """

    def __init__(self, ctx: Any, samples: int) -> None:
        self._ctx, self._samples = ctx, samples
        self._resolve = build_program(ctx, "whole_screen.vert", "tent_filter.frag", SAMPLES=samples)
        self._screen = ctx.vertex_array(self._resolve, [])
        self._targets: dict[tuple[int, int], tuple[Any, Any, Any]] = {}

    def render(
        self, meshes: list[ShadedMesh], joints: F32, view: Floats, projection: Floats, shape: tuple[int, int]
    ) -> U8:
        """Return the picture (h,w,4) uint8, sRGB, straight alpha, row 0 on top.

        Pixels that no mesh covers are 0, 0, 0, 0.

        `meshes`: meshes to draw, depth tested.
        `joints`: skinning matrices (55,3,4) of all meshes.
        `view`, `projection`: matrices (4,4) of the camera.
        `shape`: (height, width) of the picture.
        """
        large, samples, small = self._target(shape)
        large.use()
        self._ctx.enable_only(moderngl.DEPTH_TEST)
        self._ctx.depth_func = "<"
        large.clear(0.0, 0.0, 0.0, 0.0, depth=1.0)
        for mesh in meshes:
            mesh.draw(joints, view, projection)
        small.use()
        self._ctx.enable_only(moderngl.NOTHING)
        samples.use(0)
        set_uniforms(self._resolve, {"samples": 0})
        self._screen.render(vertices=3)
        pixels = np.empty((*shape, 4), np.uint8)
        small.read_into(pixels, components=4, alignment=1)
        return pixels

    def _target(self, shape: tuple[int, int]) -> tuple[Any, Any, Any]:
        if shape not in self._targets:
            size = (shape[1] * self._samples, shape[0] * self._samples)
            samples = self._ctx.texture(size, 4, dtype="f2")
            large = self._ctx.framebuffer([samples], self._ctx.depth_renderbuffer(size))
            small = self._ctx.framebuffer([self._ctx.texture(shape[::-1], 4)])
            self._targets[shape] = (large, samples, small)
        return self._targets[shape]
