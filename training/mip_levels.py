"""Reads a texture that has smaller levels, as a GPU does: the more texels go by from pixel to pixel, the smaller.

Rule: it is OpenGL's trilinear filter (specification 4.6, section 8.14): the level is the binary logarithm of the texels
that one pixel moves on, at most, and two levels next to it are mixed by it.

A GPU knows a triangle's own derivatives; here the lesser of the differences to the two neighbours stands for them, so
that a seam, where u and v jump, does not count.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor
from torch.nn import functional

from trilane.avatars.bundle import Bundle, split_levels
from trilane.training.neural_texture import read_texture

#: Texels a pixel below which the level is 0 anyway.
LEAST = 1e-3


def read_levels(levels: Sequence[Tensor], uv: Tensor, covered: Tensor) -> Tensor:
    """The network's input (N, C, H, W), as `read_texture` gives it of one level.

    `levels`: (1, C, S, S), (1, C, S/2, S/2), ...; `uv` (N, H, W, 2) in 0..1; `covered` (N, H, W) bool.
    """
    if len(levels) == 1:
        return read_texture(levels[0], uv, covered)
    detail = level_of_detail(uv, covered, levels[0].shape[-1]).clamp(max=len(levels) - 1)[:, None]
    parts = [
        (1 - (detail - number).abs()).clamp(min=0) * read_texture(level, uv, covered)
        for number, level in enumerate(levels)
    ]
    return torch.stack(parts).sum(dim=0)


def levels_of(bundle: Bundle) -> list[Tensor]:
    """The texture of `bundle` and its smaller levels, as `read_levels` takes them. Raises BadInputError."""
    texture = bundle.read_texture()
    levels = [texture, *split_levels(bundle.read_levels(), texture.shape[1])]
    return [torch.from_numpy(level.transpose(2, 0, 1).copy())[None] for level in levels]


def level_of_detail(uv: Tensor, covered: Tensor, side: int) -> Tensor:
    """(N, H, W): 0 where a pixel moves on by a texel of `side` at most, 1 where by two, and so on."""
    texels = torch.maximum(_least_step(uv, covered, 1), _least_step(uv, covered, 2)) * side
    return torch.log2(texels.clamp(min=LEAST)).clamp(min=0)


def _least_step(uv: Tensor, covered: Tensor, axis: int) -> Tensor:
    """(N, H, W): how far `uv` is from that of the nearer neighbour on the body along `axis`; 0 where there is none."""
    size = covered.shape[axis] - 1
    ends = (uv.narrow(axis, 0, size), uv.narrow(axis, 1, size))
    both = covered.narrow(axis, 0, size) & covered.narrow(axis, 1, size)
    step = torch.where(both, (ends[1] - ends[0]).norm(dim=-1), torch.inf)
    before = (1, 0) if axis == 2 else (0, 0, 1, 0)
    after = (0, 1) if axis == 2 else (0, 0, 0, 1)
    least = torch.minimum(functional.pad(step, before, value=torch.inf), functional.pad(step, after, value=torch.inf))
    return torch.where(least.isinf(), 0.0, least)
