"""The avatar's U-Nets as tables: encoders, decoder, heads and normalisations.

Rule: no other file states these channel counts, kernels and strides. Both the trained network (`training/`) and the
layers from which predictions count work (`hw_profiles/`) are built from these tables.
Sources: He et al. 2015 (ResNet18); Sandler et al. 2018 (MobileNetV2); Howard et al. 2019 (MobileNetV3 large); Tan and
Le 2019 with the changes of TensorFlow's EfficientNet-Lite (no squeeze, ReLU6, stem and head unscaled).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

#: Channels of the decoder's five levels, from stride 16 to stride 1.
DECODER = (256, 128, 64, 64, 64)
#: Channels of the colour head and of the mask head.
HEADS = (3, 1)
NORMS = ("batch", "instance", "group")
#: A group norm of C channels has gcd(C, NORM_GROUPS) groups.
NORM_GROUPS = 8
#: ResNet18: channels of the stem, then (channels, stride) of the four stages, two residual blocks each.
RESNET18_STEM = 64
RESNET18_STAGES = ((64, 1), (128, 2), (256, 2), (512, 2))


@dataclass(frozen=True)
class MobileBlock:
    """One inverted residual block: 1x1 to `expanded` channels, depthwise convolution, 1x1 to `channels`.

    `kernel`, `stride`: side of the depthwise kernel, and its stride.
    `activation`: `relu`, `relu6` or `hardswish`. `squeeze`: whether the block has squeeze-and-excitation.
    """

    kernel: int
    expanded: int
    channels: int
    stride: int
    activation: str = "relu6"
    squeeze: bool = False


@dataclass(frozen=True)
class MobileEncoder:
    """An encoder of inverted residual blocks.

    `stem`: channels of the first 3x3 convolution. `activation`: activation of the stem and of the last layer.
    `rows`: blocks, from first to last. `last`: channels of the last 1x1 convolution.
    """

    stem: int
    activation: str
    rows: tuple[MobileBlock, ...]
    last: int


def squeeze_channels(channels: int) -> int:
    """Return the number of inner channels of a squeeze-and-excitation: `channels` / 4, rounded to a multiple of 8.

    The result is at least 8, and never below 90 % of `channels` / 4, as in the authors' code of MobileNetV3.
    """
    quarter = channels // 4
    rounded = max(8, (quarter + 4) // 8 * 8)
    return rounded if rounded >= 0.9 * quarter else rounded + 8


def _repeated(spec: Sequence[tuple[int, int, int, int, int]], before: int) -> tuple[MobileBlock, ...]:
    """Return the blocks of `spec`, whose rows are (kernel, expansion factor, channels, repeats, stride).

    The first block of a row has the row's stride; its repeats have stride 1. `before`: input channels of the first row.
    """
    rows = []
    for kernel, expansion, channels, repeats, stride in spec:
        for i in range(repeats):
            rows.append(MobileBlock(kernel, before * expansion, channels, stride if i == 0 else 1))
            before = channels
    return tuple(rows)


_MOBILENET_V2 = MobileEncoder(
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
#: EfficientNet-Lite's own last layer of 1280 channels would make the avatar's network larger than the published 6.1 M
#: parameters. With the 512 channels of ResNet18 the network has 6.0 M.
_EFFICIENTNET_LITE0 = MobileEncoder(
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
_MOBILENET_V3 = MobileEncoder(
    stem=16,
    activation="hardswish",
    rows=(
        MobileBlock(3, 16, 16, 1, "relu"),
        MobileBlock(3, 64, 24, 2, "relu"),
        MobileBlock(3, 72, 24, 1, "relu"),
        MobileBlock(5, 72, 40, 2, "relu", squeeze=True),
        *[MobileBlock(5, 120, 40, 1, "relu", squeeze=True)] * 2,
        MobileBlock(3, 240, 80, 2, "hardswish"),
        MobileBlock(3, 200, 80, 1, "hardswish"),
        *[MobileBlock(3, 184, 80, 1, "hardswish")] * 2,
        MobileBlock(3, 480, 112, 1, "hardswish", squeeze=True),
        MobileBlock(3, 672, 112, 1, "hardswish", squeeze=True),
        MobileBlock(5, 672, 160, 2, "hardswish", squeeze=True),
        *[MobileBlock(5, 960, 160, 1, "hardswish", squeeze=True)] * 2,
    ),
    last=960,
)
MOBILE_ENCODERS = {
    "mobilenetv2": _MOBILENET_V2,
    "mobilenetv3": _MOBILENET_V3,
    "efficientnet-lite0": _EFFICIENTNET_LITE0,
}
ENCODERS = ("resnet18", *MOBILE_ENCODERS)
