"""The UV image of a skinned mesh: u and v of every pixel, as float32 or as bytes, before any texture is read.

Rule: same vertices, same rasterisation and same pixel centres as the packed pass; no antialiasing.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from trilane.arrays import F32, Floats
from trilane.stages.gpu.mesh_draw import MeshDraw
from trilane.stages.gpu.skinned_mesh import BodyPose, SkinnedMesh


class UvRaster:
    """Draws `mesh` into UV images. Targets are kept by shape."""

    def __init__(self, ctx: Any, mesh: SkinnedMesh) -> None:
        self._ctx, self._mesh = ctx, mesh
        self._draw = MeshDraw(ctx, mesh, "uv.frag")
        self._targets: dict[tuple[int, int], Any] = {}

    def render(
        self, joints: F32, view: Floats, projection: Floats, shape: tuple[int, int], feature: F32 | None = None
    ) -> F32:
        """UV image (h,w,3) float32 of u, v, coverage (1 on the mesh, 0 elsewhere with u = v = 0), row 0 on top.

        `joints` (55,3,4): skinning matrices. `projection`: of the crop, when there is one. `feature` (486,): only for
        a mesh with pose blend shapes.
        """
        target = self._target(shape)
        target.use()
        self._mesh.prepare(self._ctx)
        target.clear(0.0, 0.0, 0.0, 0.0, depth=1.0)
        self._draw.draw(BodyPose(joints, feature), view, projection)
        pixels = np.empty((*shape, 4), np.float32)
        target.read_into(pixels, components=4, dtype="f4", alignment=1)
        return pixels[..., :3]

    def _target(self, shape: tuple[int, int]) -> Any:
        if shape not in self._targets:
            size = (shape[1], shape[0])
            colour = self._ctx.texture(size, 4, dtype="f4")
            self._targets[shape] = self._ctx.framebuffer([colour], self._ctx.depth_renderbuffer(size))
        return self._targets[shape]


class UvBytes:
    """Draws `mesh` into images of two bytes a pixel, for networks that read UV coordinates instead of a texture."""

    def __init__(self, ctx: Any, mesh: SkinnedMesh) -> None:
        self._ctx, self._mesh = ctx, mesh
        self._draw = MeshDraw(ctx, mesh, "uv_only.frag")
        self._targets: dict[tuple[int, int], Any] = {}

    def render_into(
        self,
        tensor: NDArray[np.uint8],
        joints: F32,
        view: Floats,
        projection: Floats,
        shape: tuple[int, int],
        feature: F32 | None = None,
    ) -> None:
        """Write (h, w, 2) uint8 into `tensor`, (h * w * 2,): u and v as round(255 x), row 0 on top, 0 off the mesh.

        Arguments as of `UvRaster.render`.
        """
        if shape not in self._targets:
            size = (shape[1], shape[0])
            colour = self._ctx.texture(size, 2)
            self._targets[shape] = self._ctx.framebuffer([colour], self._ctx.depth_renderbuffer(size))
        target = self._targets[shape]
        target.use()
        self._mesh.prepare(self._ctx)
        target.clear(0.0, 0.0, 0.0, 0.0, depth=1.0)
        self._draw.draw(BodyPose(joints, feature), view, projection)
        target.read_into(tensor, components=2, alignment=1)
