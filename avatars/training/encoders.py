"""The encoders: each is a table, and turns (N, C, H, W) into features at strides 2, 4, 8, 16 and 32.

Rule: an encoder is rows of numbers; the only code is what one row means.
Sources: He et al. 2015 (ResNet18).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

from torch import Tensor, nn

Norm = Callable[[int], nn.Module]
Scale = Callable[[int], int]

#: ResNet18: (channels, stride) of the two blocks of each stage.
RESNET18 = ((64, 1), (128, 2), (256, 2), (512, 2))


class Encoder(Protocol):
    """`channels`: of the five features, from stride 2 to stride 32."""

    channels: tuple[int, ...]

    def __call__(self, x: Tensor) -> list[Tensor]:
        """(N, C, H, W), sides multiples of 32 -> five features, finest first."""


class ResidualBlock(nn.Module):
    """Two 3x3 convolutions beside a shortcut, which is a strided 1x1 convolution where the shape changes."""

    def __init__(self, c_in: int, c_out: int, stride: int, norm: Norm) -> None:
        super().__init__()
        self.body = nn.Sequential(
            nn.Conv2d(c_in, c_out, 3, stride, 1, bias=False),
            norm(c_out),
            nn.ReLU(inplace=True),
            nn.Conv2d(c_out, c_out, 3, 1, 1, bias=False),
            norm(c_out),
        )
        same = stride == 1 and c_in == c_out
        self.shortcut = (
            nn.Identity() if same else nn.Sequential(nn.Conv2d(c_in, c_out, 1, stride, bias=False), norm(c_out))
        )
        self.relu = nn.ReLU(inplace=True)

    def forward(self, x: Tensor) -> Tensor:
        out: Tensor = self.relu(self.body(x) + self.shortcut(x))
        return out


class ResNet18(nn.Module):
    """7x7 stride-2 stem, 3x3 stride-2 max pool, four stages of two residual blocks."""

    def __init__(self, c_in: int, scale: Scale, norm: Norm) -> None:
        super().__init__()
        stem = scale(RESNET18[0][0])
        self.stem = nn.Sequential(nn.Conv2d(c_in, stem, 7, 2, 3, bias=False), norm(stem), nn.ReLU(inplace=True))
        self.pool = nn.MaxPool2d(3, 2, 1)
        self.stages = nn.ModuleList()
        before = stem
        for count, stride in RESNET18:
            c = scale(count)
            self.stages.append(nn.Sequential(ResidualBlock(before, c, stride, norm), ResidualBlock(c, c, 1, norm)))
            before = c
        self.channels = (stem, *(scale(count) for count, _ in RESNET18))

    def forward(self, x: Tensor) -> list[Tensor]:
        features = [self.stem(x)]
        x = self.pool(features[0])
        for stage in self.stages:
            x = stage(x)
            features.append(x)
        return features


ENCODERS: dict[str, Callable[[int, Scale, Norm], nn.Module]] = {"resnet18": ResNet18}
