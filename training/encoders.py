"""The encoders in PyTorch: each turns (N, C, H, W) into features at strides 2, 4, 8, 16 and 32.

Rule: channel counts, kernels and strides come from `trilane.unet_tables`; this file only says what a row means.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

from torch import Tensor, nn
from torch.nn import functional

from trilane.unet_tables import (
    MOBILE_ENCODERS,
    RESNET18_STAGES,
    RESNET18_STEM,
    MobileBlock,
    MobileEncoder,
    squeeze_channels,
)

Norm = Callable[[int], nn.Module]
Scale = Callable[[int], int]

#: A strided 1x1 convolution of as many channels is trained as it is: a whole vector of floats.
SAFE_CHANNELS = 16
ACTIVATIONS: dict[str, Callable[[], nn.Module]] = {"relu": nn.ReLU, "relu6": nn.ReLU6, "hardswish": nn.Hardswish}


class Encoder(Protocol):
    """`channels`: of the five features, from stride 2 to stride 32."""

    channels: tuple[int, ...]

    def __call__(self, x: Tensor) -> list[Tensor]:
        """(N, C, H, W), sides multiples of 32 -> five features, finest first."""


class Shortcut(nn.Conv2d):
    """A strided 1x1 convolution without bias.

    In float32, oneDNN's backward pass of one with 8 channels or fewer, channels last, writes beyond its memory (seen
    with PyTorch 2.13 under AVX-512, from 4 and 8 channels). While training, pixels are therefore left out before it.
    """

    def __init__(self, c_in: int, c_out: int, stride: int) -> None:
        """From `c_in` to `c_out` channels, at every `stride`-th pixel of each axis."""
        super().__init__(c_in, c_out, 1, stride, bias=False)

    def forward(self, x: Tensor) -> Tensor:
        if not self.training or self.in_channels >= SAFE_CHANNELS:
            return super().forward(x)
        down, along = self.stride
        return functional.conv2d(x[:, :, ::down, ::along], self.weight)


class ResidualBlock(nn.Module):
    """Two 3x3 convolutions, added to a shortcut, which is a strided 1x1 convolution where the shape changes."""

    def __init__(self, c_in: int, c_out: int, stride: int, norm: Norm) -> None:
        """A block from `c_in` to `c_out` channels.

        `c_in`, `c_out`: channels of its input and output.
        `stride`: of its first convolution.
        `norm`: makes a normalisation for a number of channels.
        """
        super().__init__()
        self.body = nn.Sequential(
            nn.Conv2d(c_in, c_out, 3, stride, 1, bias=False),
            norm(c_out),
            nn.ReLU(inplace=True),
            nn.Conv2d(c_out, c_out, 3, 1, 1, bias=False),
            norm(c_out),
        )
        same = stride == 1 and c_in == c_out
        self.shortcut = nn.Identity() if same else nn.Sequential(Shortcut(c_in, c_out, stride), norm(c_out))
        self.relu = nn.ReLU(inplace=True)

    def forward(self, x: Tensor) -> Tensor:
        out: Tensor = self.relu(self.body(x) + self.shortcut(x))
        return out


class ResNet18(nn.Module):
    """7x7 stride-2 stem, 3x3 stride-2 max pool, four stages of two residual blocks."""

    def __init__(self, c_in: int, scale: Scale, norm: Norm) -> None:
        super().__init__()
        stem = scale(RESNET18_STEM)
        self.stem = nn.Sequential(nn.Conv2d(c_in, stem, 7, 2, 3, bias=False), norm(stem), nn.ReLU(inplace=True))
        self.pool = nn.MaxPool2d(3, 2, 1)
        self.stages = nn.ModuleList()
        before = stem
        for count, stride in RESNET18_STAGES:
            c = scale(count)
            self.stages.append(nn.Sequential(ResidualBlock(before, c, stride, norm), ResidualBlock(c, c, 1, norm)))
            before = c
        self.channels = (stem, *(scale(count) for count, _ in RESNET18_STAGES))

    def forward(self, x: Tensor) -> list[Tensor]:
        features = [self.stem(x)]
        x = self.pool(features[0])
        for stage in self.stages:
            x = stage(x)
            features.append(x)
        return features


class SqueezeExcite(nn.Module):
    """Squeeze-and-excitation: scales each channel by a factor computed from the channels' means over the picture."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        inner = squeeze_channels(channels)
        self.body = nn.Sequential(
            nn.AdaptiveAvgPool2d(1),
            nn.Conv2d(channels, inner, 1),
            nn.ReLU(inplace=True),
            nn.Conv2d(inner, channels, 1),
            nn.Hardsigmoid(),
        )

    def forward(self, x: Tensor) -> Tensor:
        out: Tensor = x * self.body(x)
        return out


class InvertedResidual(nn.Module):
    """1x1 expansion, depthwise convolution, optional squeeze, linear 1x1 projection, added where shapes agree."""

    def __init__(self, c_in: int, row: MobileBlock, scale: Scale, norm: Norm) -> None:
        """The block of one row of the table.

        `c_in`: channels of its input.
        `row`: its kernel, channels, stride and activation.
        `scale`: scales a channel count by the network's width.
        `norm`: makes a normalisation for a number of channels.
        """
        super().__init__()
        inner, c_out = scale(row.expanded), scale(row.channels)
        activation = ACTIVATIONS[row.activation]
        layers: list[nn.Module] = []
        if inner != c_in:
            layers += [nn.Conv2d(c_in, inner, 1, bias=False), norm(inner), activation()]
        layers += [
            nn.Conv2d(inner, inner, row.kernel, row.stride, row.kernel // 2, groups=inner, bias=False),
            norm(inner),
            activation(),
            *([SqueezeExcite(inner)] if row.squeeze else []),
            nn.Conv2d(inner, c_out, 1, bias=False),
            norm(c_out),
        ]
        self.body = nn.Sequential(*layers)
        self.add = row.stride == 1 and c_in == c_out

    def forward(self, x: Tensor) -> Tensor:
        out: Tensor = self.body(x)
        return x + out if self.add else out


class MobileFeatures(nn.Module):
    """A 3x3 stride-2 stem, inverted residual blocks, a last 1x1 layer.

    Features: the tensors that enter the strided blocks, and the last layer's output.
    """

    def __init__(self, spec: MobileEncoder, c_in: int, scale: Scale, norm: Norm) -> None:
        """The encoder of one table.

        `spec`: the table.
        `c_in`: channels of its input.
        `scale`: scales a channel count by the network's width.
        `norm`: makes a normalisation for a number of channels.
        """
        super().__init__()
        before = scale(spec.stem)
        activation = ACTIVATIONS[spec.activation]
        stages = [[nn.Conv2d(c_in, before, 3, 2, 1, bias=False), norm(before), activation()]]
        channels = []
        for row in spec.rows:
            if row.stride == 2:
                channels.append(before)
                stages.append([])
            stages[-1].append(InvertedResidual(before, row, scale, norm))
            before = scale(row.channels)
        last = scale(spec.last)
        stages[-1] += [nn.Conv2d(before, last, 1, bias=False), norm(last), activation()]
        self.stages = nn.ModuleList(nn.Sequential(*stage) for stage in stages)
        self.channels = (*channels, last)

    def forward(self, x: Tensor) -> list[Tensor]:
        features = []
        for stage in self.stages:
            x = stage(x)
            features.append(x)
        return features


def _mobile(spec: MobileEncoder) -> Callable[[int, Scale, Norm], nn.Module]:
    return lambda c_in, scale, norm: MobileFeatures(spec, c_in, scale, norm)


ENCODERS: dict[str, Callable[[int, Scale, Norm], nn.Module]] = {
    "resnet18": ResNet18,
    **{name: _mobile(spec) for name, spec in MOBILE_ENCODERS.items()},
}
