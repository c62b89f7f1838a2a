"""The encoders of the reference networks as ONNX operators.

Rule: shapes follow the papers: ResNet (He 2015), MobileNetV2 (Sandler 2018), MobileNetV3 large (Howard 2019),
EfficientNet-Lite0 (Tan 2019, the mobile variant without squeeze-and-excitation).
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import NamedTuple

from trilane.hw_profiles.graph_builder import GraphBuilder, TensorRef


class Block(NamedTuple):
    """Inverted residual block.

    `expand`: width after the expansion; `out`: width of the result; `kernel`: side; `act`: ONNX operator of the
    activation; `squeeze`: whether it has squeeze-and-excitation.
    """

    expand: int
    out: int
    kernel: int
    stride: int
    act: str
    squeeze: bool = False


def _inverted(stem: int, rows: Iterable[tuple[int, int, int, int, int]]) -> tuple[Block, ...]:
    """The blocks that `rows` (expansion factor, width, repeats, stride, kernel) stand for.

    `stem`: width before the first of them.
    """
    blocks: list[Block] = []
    width = stem
    for factor, out, repeats, stride, kernel in rows:
        for index in range(repeats):
            blocks.append(Block(width * factor, out, kernel, stride if index == 0 else 1, "Clip"))
            width = out
    return tuple(blocks)


@dataclass(frozen=True)
class InvertedEncoder:
    """An encoder of inverted residual blocks.

    `stem`: width of the first convolution; `stem_act`: its activation; `tail`: width of a last 1x1 convolution, 0 for
    none.
    """

    stem: int
    stem_act: str
    blocks: tuple[Block, ...]
    tail: int


MOBILENET_V2 = InvertedEncoder(
    32,
    "Clip",
    _inverted(
        32,
        [
            (1, 16, 1, 1, 3),
            (6, 24, 2, 2, 3),
            (6, 32, 3, 2, 3),
            (6, 64, 4, 2, 3),
            (6, 96, 3, 1, 3),
            (6, 160, 3, 2, 3),
            (6, 320, 1, 1, 3),
        ],
    ),
    1280,
)
#: Its last layer has 512 channels, as in the trained network (`training/encoders.py`), instead of the paper's 1280.
EFFICIENTNET_LITE0 = InvertedEncoder(
    32,
    "Clip",
    _inverted(
        32,
        [
            (1, 16, 1, 1, 3),
            (6, 24, 2, 2, 3),
            (6, 40, 2, 2, 5),
            (6, 80, 3, 2, 3),
            (6, 112, 3, 1, 5),
            (6, 192, 4, 2, 5),
            (6, 320, 1, 1, 3),
        ],
    ),
    512,
)
MOBILENET_V3 = InvertedEncoder(
    16,
    "HardSwish",
    (
        Block(16, 16, 3, 1, "Relu"),
        Block(64, 24, 3, 2, "Relu"),
        Block(72, 24, 3, 1, "Relu"),
        Block(72, 40, 5, 2, "Relu", True),
        Block(120, 40, 5, 1, "Relu", True),
        Block(120, 40, 5, 1, "Relu", True),
        Block(240, 80, 3, 2, "HardSwish"),
        Block(200, 80, 3, 1, "HardSwish"),
        Block(184, 80, 3, 1, "HardSwish"),
        Block(184, 80, 3, 1, "HardSwish"),
        Block(480, 112, 3, 1, "HardSwish", True),
        Block(672, 112, 3, 1, "HardSwish", True),
        Block(672, 160, 5, 2, "HardSwish", True),
        Block(960, 160, 5, 1, "HardSwish", True),
        Block(960, 160, 5, 1, "HardSwish", True),
    ),
    960,
)
INVERTED_ENCODERS = {"mobilenetv2": MOBILENET_V2, "mobilenetv3": MOBILENET_V3, "efficientnet-lite0": EFFICIENTNET_LITE0}
ENCODERS = ("resnet18", *INVERTED_ENCODERS)


def encode(b: GraphBuilder, x: TensorRef, encoder: str) -> list[TensorRef]:
    """Features of `x` at strides 2, 4, 8, 16 and 32 by `encoder`, one of ENCODERS."""
    return resnet18(b, x) if encoder == "resnet18" else _inverted_encoder(b, x, INVERTED_ENCODERS[encoder])


def resnet18(b: GraphBuilder, x: TensorRef) -> list[TensorRef]:
    """Features at strides 2, 4, 8, 16, 32."""
    x = b.unit(x, 64, 7, stride=2)
    features = [x]
    x = b.op("MaxPool", [x.name], (64, x.height // 2, x.width // 2), kernel_shape=[3, 3], strides=[2, 2], pads=[1] * 4)
    for width, stride in ((64, 1), (128, 2), (256, 2), (512, 2)):
        for index in range(2):
            x = _basic_block(b, x, width, stride if index == 0 else 1)
        features.append(x)
    return features


def _basic_block(b: GraphBuilder, x: TensorRef, width: int, stride: int) -> TensorRef:
    y = b.unit(b.unit(x, width, 3, stride=stride), width, 3, act=None)
    shortcut = x if (stride, x.channels) == (1, width) else b.unit(x, width, 1, act=None, stride=stride)
    return b.same("Relu", b.add(y, shortcut))


def _squeeze(b: GraphBuilder, x: TensorRef) -> TensorRef:
    """Squeeze-and-excitation: mean over the picture, two 1x1 convolutions, gate.

    The inner width is a quarter of the channels, rounded to a multiple of 8.
    """
    inner = max(8, (x.channels // 4 + 4) // 8 * 8)
    pooled = b.op("GlobalAveragePool", [x.name], (x.channels, 1, 1))
    hidden = b.same("Relu", b.conv(pooled, inner, 1, bias=True))
    gate = b.same("HardSigmoid", b.conv(hidden, x.channels, 1, bias=True))
    return b.op("Mul", [x.name, gate.name], x[1:])


def _inverted_block(b: GraphBuilder, x: TensorRef, block: Block) -> TensorRef:
    y = x if block.expand == x.channels else b.unit(x, block.expand, 1, block.act)
    y = b.unit(y, block.expand, block.kernel, block.act, block.stride, groups=block.expand)
    if block.squeeze:
        y = _squeeze(b, y)
    y = b.unit(y, block.out, 1, act=None)
    return b.add(x, y) if block.stride == 1 and x.channels == block.out else y


def _inverted_encoder(b: GraphBuilder, x: TensorRef, encoder: InvertedEncoder) -> list[TensorRef]:
    """Features before each halving and at the end: strides 2, 4, 8, 16, 32."""
    x = b.unit(x, encoder.stem, 3, encoder.stem_act, stride=2)
    features: list[TensorRef] = []
    for block in encoder.blocks:
        if block.stride == 2:
            features.append(x)
        x = _inverted_block(b, x, block)
    if encoder.tail:
        x = b.unit(x, encoder.tail, 1, encoder.blocks[-1].act)
    return [*features, x]
