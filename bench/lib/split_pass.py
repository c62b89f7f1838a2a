"""The baseline that the packed pass is measured against: a pass for every four channels, then a permute on the CPU.

Rule: it writes the same bytes as the packed pass and shares its mesh, its texture and its triangles.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from trilane.arrays import U8, Floats
from trilane.stages.gpu.packed_pass import Placement, Quantisation, check_texture, texture_array
from trilane.stages.gpu.skinned_mesh import MeshDraw, SkinnedMesh


class SplitPass:
    """Draws one avatar into tensors, RGBA8 by RGBA8.

    `ctx`: the OpenGL context.
    `mesh`: of the avatar.
    `texture`: (H,W,C) floats, C a multiple of 4.
    `quantisation`: of the tensor.
    `shape`: (height, width) of the tensor in pixels.
    """

    def __init__(
        self,
        ctx: Any,
        mesh: SkinnedMesh,
        texture: NDArray[np.floating[Any]],
        quantisation: Quantisation,
        shape: tuple[int, int],
    ) -> None:
        check_texture(texture, texture.shape[2])
        self._ctx, self._mesh, self._shape = ctx, mesh, shape
        self._draw = MeshDraw(ctx, mesh, "split.frag")
        self._texture = texture_array(ctx, texture)
        zero_point = float(quantisation.zero_point)
        self._draw.set({"neural": 0, "scale": quantisation.scale, "zero_point": zero_point})
        self._background = (zero_point / 255,) * 4
        size = shape[::-1]
        depth = ctx.depth_renderbuffer(size)
        self._targets = [ctx.framebuffer([ctx.texture(size, 4)], depth) for _ in range(texture.shape[2] // 4)]
        self._planes = np.empty((len(self._targets), *shape, 4), np.uint8)

    def draw(self, view: Floats, placement: Placement) -> None:
        """Draw every pass. The avatar fills the tensor; `placement.rect` is not read."""
        self._texture.use(0)
        self._mesh.prepare(self._ctx)
        for layer, target in enumerate(self._targets):
            target.use()
            target.clear(*self._background)
            self._draw.set({"layer": layer})
            self._draw.draw(placement.pose, view, placement.clip_projection)

    def read_into(self, tensor: U8) -> None:
        """Read every pass and interleave them into `tensor`, (h * w * C,) uint8."""
        image = tensor.reshape(*self._shape, 4 * len(self._targets))
        for layer, target in enumerate(self._targets):
            target.read_into(self._planes[layer], components=4)
            image[..., 4 * layer : 4 * layer + 4] = self._planes[layer]
