"""The avatar's network: an encoder, a decoder of five levels with skips, a colour head and a mask head.

Rule: this is the only definition of the network that computes; every runtime runs a file exported from it.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Self

import torch
from torch import Tensor, nn
from torch.nn import functional

from trilane.errors import BadInputError
from trilane.training.encoders import ENCODERS
from trilane.unet_tables import DECODER, HEADS, NORM_GROUPS

FULL_WIDTH = 64
CHANNEL_STEP = 4


class GroupNorm(nn.GroupNorm):
    """`nn.GroupNorm` in operators that quantise: an instance norm over groups, then a depthwise 1x1 convolution."""

    def forward(self, x: Tensor) -> Tensor:
        n, c, h, w = x.shape
        grouped = x.reshape(n, self.num_groups, c // self.num_groups * h, w)
        x = functional.instance_norm(grouped, eps=self.eps).reshape(n, c, h, w)
        return functional.conv2d(x, self.weight.view(c, 1, 1, 1), self.bias, groups=c)


class NoNorm(nn.BatchNorm2d):
    """A learnt scale and shift of each channel, and no statistics: a batch norm that never measures.

    It is exported, and folded into the convolution before it, as a batch norm is.
    """

    def train(self, mode: bool = True) -> Self:
        """Stays in evaluation mode, in which the mean is 0 and the variance 1; `mode` changes nothing."""
        del mode
        super().train(False)
        return self


NORMS: dict[str, Callable[[int], nn.Module]] = {
    "batch": nn.BatchNorm2d,
    "instance": lambda channels: nn.InstanceNorm2d(channels, affine=True),
    "group": lambda channels: GroupNorm(math.gcd(channels, NORM_GROUPS), channels),
    "none": lambda channels: NoNorm(channels).eval(),
}


class UNet(nn.Module):
    """(N, channels, H, W) float32 to (N, 4, H, W): straight colour and mask, each in 0..1. H, W: multiples of 32."""

    def __init__(
        self,
        encoder: str = "resnet18",
        norm: str = "batch",
        width: int = FULL_WIDTH,
        channels: int = 16,
        input_skip: bool = False,
    ) -> None:
        """Build the network, untrained.

        `encoder`: a name of `ENCODERS`.
        `norm`: a name of `NORMS`.
        `width`: 64 is the full network; every channel count is scaled by `width` / 64 and rounded to a multiple of 4.
        `channels`: of the input.
        `input_skip`: the last level also reads the input, the only tensor of full resolution; the paper's does not.
        Raises BadInputError for an unknown encoder or norm, or a width or channel count out of range.
        """
        super().__init__()
        _check(encoder, norm, width, channels)

        def scale(count: int) -> int:
            return max(CHANNEL_STEP, round(count * width / FULL_WIDTH / CHANNEL_STEP) * CHANNEL_STEP)

        make_norm = NORMS[norm]
        self.norm, self.input_skip = norm, input_skip
        self.encoder = ENCODERS[encoder](channels, scale, make_norm)
        *skips, deepest = self.encoder.channels
        self.levels = nn.ModuleList()
        c_in = deepest
        for count, skip in zip(DECODER, (*reversed(skips), channels if input_skip else 0), strict=True):
            c_out = scale(count)
            self.levels.append(
                nn.Sequential(*_convolution(c_in + skip, c_out, make_norm), *_convolution(c_out, c_out, make_norm))
            )
            c_in = c_out
        self.colour = nn.Sequential(*_convolution(c_in, c_in, make_norm), nn.Conv2d(c_in, HEADS[0], 3, 1, 1))
        self.mask = nn.Sequential(*_convolution(c_in, c_in, make_norm), nn.Conv2d(c_in, HEADS[1], 3, 1, 1))

    def forward(self, x: Tensor) -> Tensor:
        x = self.features(x)
        return torch.sigmoid(torch.cat((self.colour(x), self.mask(x)), dim=1))

    def features(self, x: Tensor) -> Tensor:
        """The features (N, width, H, W) that both heads read."""
        whole = x if self.input_skip else None
        *skips, x = self.encoder(x)
        for level, skip in zip(self.levels, (*reversed(skips), whole), strict=True):
            x = functional.interpolate(x, scale_factor=2.0, mode="nearest")
            x = level(x if skip is None else torch.cat((x, skip), dim=1))
        return x


def _convolution(c_in: int, c_out: int, norm: Callable[[int], nn.Module]) -> tuple[nn.Module, ...]:
    return nn.Conv2d(c_in, c_out, 3, 1, 1, bias=False), norm(c_out), nn.ReLU(inplace=True)


def _check(encoder: str, norm: str, width: int, channels: int) -> None:
    for name, value, known in (("encoder", encoder, ENCODERS), ("norm", norm, NORMS)):
        if value not in known:
            raise BadInputError("network", f"{name} {value!r}", f"one of {', '.join(known)}")
    for name, number, top in (("width", width, 256), ("channels", channels, 64)):
        if not 1 <= number <= top:
            raise BadInputError("network", f"{name} {number}", f"a number from 1 to {top}")
