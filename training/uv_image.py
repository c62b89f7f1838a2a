"""The UV image of a skinned mesh: u and v of every pixel, as float32 or as bytes, before any texture is read.

Rule: same vertices, same rasterisation and same pixel centres as the packed pass; no antialiasing.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from trilane.arrays import F32, Floats
from trilane.stages.gpu.skinned_mesh import BodyPose, MeshDraw, SkinnedMesh


class _MeshTarget:
    """Draws a mesh with one fragment shader into targets of any shape, which are kept by shape."""

    def __init__(self, ctx: Any, mesh: SkinnedMesh, fragment: str, components: int, dtype: str) -> None:
        self._ctx, self._mesh = ctx, mesh
        self._draw = MeshDraw(ctx, mesh, fragment)
        self._components, self._dtype = components, dtype
        self._targets: dict[tuple[int, int], Any] = {}

    def draw(self, pose: BodyPose, view: Floats, projection: Floats, shape: tuple[int, int]) -> Any:
        """The framebuffer of `shape` with the mesh in it; 0 elsewhere."""
        target = self._target(shape)
        target.use()
        self._mesh.prepare(self._ctx)
        target.clear(0.0, 0.0, 0.0, 0.0, depth=1.0)
        self._draw.draw(pose, view, projection)
        return target

    def _target(self, shape: tuple[int, int]) -> Any:
        if shape not in self._targets:
            size = (shape[1], shape[0])
            colour = self._ctx.texture(size, self._components, dtype=self._dtype)
            self._targets[shape] = self._ctx.framebuffer([colour], self._ctx.depth_renderbuffer(size))
        return self._targets[shape]


class UvRaster:
    """Draws a mesh into UV images of float32."""

    def __init__(self, ctx: Any, mesh: SkinnedMesh) -> None:
        self._target = _MeshTarget(ctx, mesh, "uv_and_coverage.frag", 4, "f4")

    def render(
        self, joints: F32, view: Floats, projection: Floats, shape: tuple[int, int], feature: F32 | None = None
    ) -> F32:
        """The UV image (h,w,3) float32 of u, v, coverage, row 0 on top: coverage is 1 on the mesh; 0, 0, 0 elsewhere.

        `joints`: (55,3,4) skinning matrices.
        `view`, `projection`: (4,4) the camera; of a crop, its projection.
        `shape`: (height, width) of the image.
        `feature`: (486,) of a mesh with pose blend shapes.
        """
        pixels = np.empty((*shape, 4), np.float32)
        target = self._target.draw(BodyPose(joints, feature), view, projection, shape)
        target.read_into(pixels, components=4, dtype="f4", alignment=1)
        return pixels[..., :3]


class UvBytes:
    """Draws a mesh into images of two bytes a pixel, for networks that read UV coordinates instead of a texture."""

    def __init__(self, ctx: Any, mesh: SkinnedMesh) -> None:
        self._target = _MeshTarget(ctx, mesh, "uv_only.frag", 2, "f1")

    def render_into(
        self,
        tensor: NDArray[np.uint8],
        joints: F32,
        view: Floats,
        projection: Floats,
        shape: tuple[int, int],
        feature: F32 | None = None,
    ) -> None:
        """Write u and v of every pixel as round(255 x), row 0 on top; 0 off the mesh.

        `tensor`: (h * w * 2,) uint8, written as (h, w, 2).
        `joints`: (55,3,4) skinning matrices.
        `view`, `projection`: (4,4) the camera; of a crop, its projection.
        `shape`: (height, width) of the image.
        `feature`: (486,) of a mesh with pose blend shapes.
        """
        target = self._target.draw(BodyPose(joints, feature), view, projection, shape)
        target.read_into(tensor, components=2, alignment=1)
