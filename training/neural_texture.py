"""The neural texture: one image of C channels, stored as the sum of several scales.

Rule: a coarse scale holds what neighbouring texels have in common, a finer one only the difference to it.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from trilane.arrays import F32

SIDES = (512, 256, 128, 64, 32)
LIMIT = 1.0


class NeuralTexture(nn.Module):
    """A Laplacian pyramid that sums to `start` (S,S,C) before training; S is the greatest of `sides`.

    Each scale holds the difference of `start`, shrunk to its side, and the next coarser scale's image, enlarged. The
    sum is clipped to -1..1, because the network's input has one byte range for all channels.

    `mip_levels`: smaller images, each of half the side, that are learnt on their own from `start`, shrunk.
    """

    def __init__(self, start: F32, sides: tuple[int, ...] = SIDES, mip_levels: int = 0) -> None:
        super().__init__()
        target = torch.from_numpy(np.ascontiguousarray(start.transpose(2, 0, 1)))[None]
        scales: list[Tensor] = []
        coarser = torch.zeros(1, 1, 1, 1)
        for side in sorted(sides):
            shrunk = functional.interpolate(target, size=(side, side), mode="area")
            scales.append(shrunk - _enlarged(coarser, side))
            coarser = shrunk
        self.scales = nn.ParameterList([nn.Parameter(scale) for scale in reversed(scales)])
        smaller = [max(sides) >> (number + 1) for number in range(mip_levels)]
        self.mips = nn.ParameterList(
            [nn.Parameter(functional.interpolate(target, size=(side, side), mode="area")) for side in smaller]
        )

    def image(self) -> Tensor:
        """The texture (1, C, S, S)."""
        *finer, total = list(self.scales)
        for scale in reversed(finer):
            total = scale + _enlarged(total, scale.shape[-1])
        return total.clamp(-LIMIT, LIMIT)

    def levels(self) -> list[Tensor]:
        """The texture and its smaller levels, (1, C, S, S), (1, C, S/2, S/2), ..."""
        return [self.image(), *(level.clamp(-LIMIT, LIMIT) for level in self.mips)]


def _enlarged(scale: Tensor, side: int) -> Tensor:
    return functional.interpolate(scale, size=(side, side), mode="bilinear", align_corners=False)


def read_texture(image: Tensor, uv: Tensor, covered: Tensor) -> Tensor:
    """The network's input (N, C, H, W), channels last in memory: the texture read bilinearly at `uv`.

    `image` (1, C, S, S), `uv` (N, H, W, 2) in 0..1, `covered` (N, H, W) bool. Pixels that are not covered are 0.
    """
    n, h, w = covered.shape
    points = uv[covered] * 2 - 1
    values = functional.grid_sample(
        image, points[None, None], mode="bilinear", align_corners=False, padding_mode="border"
    )
    filled = image.new_zeros((n, h, w, image.shape[1]))
    filled[covered] = values[0, :, 0].T
    return filled.permute(0, 3, 1, 2)
