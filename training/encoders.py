"""The encoders: each is a table, and turns (N, C, H, W) into features at strides 2, 4, 8, 16 and 32.

Rule: an encoder is rows of numbers; the only code is what one row means.
Sources: He et al. 2015 (ResNet18); Sandler et al. 2018 (MobileNetV2); Howard et al. 2019 (MobileNetV3 large);
Tan and Le 2019 with the changes of TensorFlow's EfficientNet-Lite (no squeeze, ReLU6, stem and head unscaled).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

from torch import Tensor, nn

Norm = Callable[[int], nn.Module]
Scale = Callable[[int], int]

#: ResNet18: (channels, stride) of the four stages, two blocks each.
RESNET18 = ((64, 1), (128, 2), (256, 2), (512, 2))

ACTIVATIONS: dict[str, Callable[[], nn.Module]] = {"relu": nn.ReLU, "relu6": nn.ReLU6, "hardswish": nn.Hardswish}
SQUEEZE = 4


@dataclass(frozen=True)
class Row:
    """One inverted residual block. `expanded`: channels inside the block."""

    kernel: int
    expanded: int
    channels: int
    stride: int
    activation: str = "relu6"
    squeeze: bool = False


@dataclass(frozen=True)
class Mobile:
    """An encoder of inverted residuals: `stem` channels, its `activation`, rows, and a last 1x1 layer."""

    stem: int
    activation: str
    rows: tuple[Row, ...]
    last: int


def _repeated(spec: Sequence[tuple[int, int, int, int, int]], before: int) -> tuple[Row, ...]:
    """Rows from (kernel, expansion, channels, count, stride): every block expands what enters it."""
    rows = []
    for kernel, expansion, channels, count, stride in spec:
        for i in range(count):
            rows.append(Row(kernel, before * expansion, channels, stride if i == 0 else 1))
            before = channels
    return tuple(rows)


MOBILENET_V2 = Mobile(
    stem=32,
    activation="relu6",
    rows=_repeated(
        (
            *((3, 1, 16, 1, 1), (3, 6, 24, 2, 2), (3, 6, 32, 3, 2), (3, 6, 64, 4, 2)),
            *((3, 6, 96, 3, 1), (3, 6, 160, 3, 2), (3, 6, 320, 1, 1)),
        ),
        before=32,
    ),
    last=1280,
)
#: Its own head of 1280 would make the network larger than the published 6.1 M; ResNet18's 512 makes it 6.0 M.
EFFICIENTNET_LITE0 = Mobile(
    stem=32,
    activation="relu6",
    rows=_repeated(
        (
            *((3, 1, 16, 1, 1), (3, 6, 24, 2, 2), (5, 6, 40, 2, 2), (3, 6, 80, 3, 2)),
            *((5, 6, 112, 3, 1), (5, 6, 192, 4, 2), (3, 6, 320, 1, 1)),
        ),
        before=32,
    ),
    last=512,
)
MOBILENET_V3 = Mobile(
    stem=16,
    activation="hardswish",
    rows=(
        Row(3, 16, 16, 1, "relu"),
        Row(3, 64, 24, 2, "relu"),
        Row(3, 72, 24, 1, "relu"),
        Row(5, 72, 40, 2, "relu", squeeze=True),
        *[Row(5, 120, 40, 1, "relu", squeeze=True)] * 2,
        Row(3, 240, 80, 2, "hardswish"),
        Row(3, 200, 80, 1, "hardswish"),
        *[Row(3, 184, 80, 1, "hardswish")] * 2,
        Row(3, 480, 112, 1, "hardswish", squeeze=True),
        Row(3, 672, 112, 1, "hardswish", squeeze=True),
        Row(5, 672, 160, 2, "hardswish", squeeze=True),
        *[Row(5, 960, 160, 1, "hardswish", squeeze=True)] * 2,
    ),
    last=960,
)


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


class SqueezeExcite(nn.Module):
    """Scales each channel by what the whole picture says of it."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        inner = max(8, (channels // SQUEEZE + 4) // 8 * 8)
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

    def __init__(self, c_in: int, row: Row, scale: Scale, norm: Norm) -> None:
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


class MobileEncoder(nn.Module):
    """A 3x3 stride-2 stem, inverted residuals, a last 1x1 layer. Features: what enters each later stride; the last."""

    def __init__(self, spec: Mobile, c_in: int, scale: Scale, norm: Norm) -> None:
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


def _mobile(spec: Mobile) -> Callable[[int, Scale, Norm], nn.Module]:
    return lambda c_in, scale, norm: MobileEncoder(spec, c_in, scale, norm)


ENCODERS: dict[str, Callable[[int, Scale, Norm], nn.Module]] = {
    "resnet18": ResNet18,
    "mobilenetv2": _mobile(MOBILENET_V2),
    "mobilenetv3": _mobile(MOBILENET_V3),
    "efficientnet-lite0": _mobile(EFFICIENTNET_LITE0),
}
