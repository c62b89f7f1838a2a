"""The encoders of the reference networks as ONNX operators.

Rule: channel counts, kernels and strides are those of `trilane.unet_tables`; only the operators are chosen here.
"""

from __future__ import annotations

from trilane.hw_profiles.graph_builder import GraphBuilder, TensorRef
from trilane.unet_tables import (
    MOBILE_ENCODERS,
    RESNET18_STAGES,
    RESNET18_STEM,
    MobileBlock,
    MobileEncoder,
    squeeze_channels,
)

#: ONNX operators of the tables' activations.
ACTIVATIONS = {"relu": "Relu", "relu6": "Clip", "hardswish": "HardSwish"}


def encode(b: GraphBuilder, x: TensorRef, encoder: str) -> list[TensorRef]:
    """Features of `x` at strides 2, 4, 8, 16 and 32 by `encoder`, one of ENCODERS."""
    return resnet18(b, x) if encoder == "resnet18" else _inverted_encoder(b, x, MOBILE_ENCODERS[encoder])


def resnet18(b: GraphBuilder, x: TensorRef) -> list[TensorRef]:
    """Features at strides 2, 4, 8, 16, 32."""
    x = b.unit(x, RESNET18_STEM, 7, stride=2)
    features = [x]
    pooled = (RESNET18_STEM, x.height // 2, x.width // 2)
    x = b.op("MaxPool", [x.name], pooled, kernel_shape=[3, 3], strides=[2, 2], pads=[1] * 4)
    for width, stride in RESNET18_STAGES:
        for index in range(2):
            x = _basic_block(b, x, width, stride if index == 0 else 1)
        features.append(x)
    return features


def _basic_block(b: GraphBuilder, x: TensorRef, width: int, stride: int) -> TensorRef:
    y = b.unit(b.unit(x, width, 3, stride=stride), width, 3, act=None)
    shortcut = x if (stride, x.channels) == (1, width) else b.unit(x, width, 1, act=None, stride=stride)
    return b.same("Relu", b.add(y, shortcut))


def _squeeze(b: GraphBuilder, x: TensorRef) -> TensorRef:
    """Squeeze-and-excitation: mean over the picture, two 1x1 convolutions, gate."""
    inner = squeeze_channels(x.channels)
    pooled = b.op("GlobalAveragePool", [x.name], (x.channels, 1, 1))
    hidden = b.same("Relu", b.conv(pooled, inner, 1, bias=True))
    gate = b.same("HardSigmoid", b.conv(hidden, x.channels, 1, bias=True))
    return b.op("Mul", [x.name, gate.name], x[1:])


def _inverted_block(b: GraphBuilder, x: TensorRef, row: MobileBlock) -> TensorRef:
    activation = ACTIVATIONS[row.activation]
    y = x if row.expanded == x.channels else b.unit(x, row.expanded, 1, activation)
    y = b.unit(y, row.expanded, row.kernel, activation, row.stride, groups=row.expanded)
    if row.squeeze:
        y = _squeeze(b, y)
    y = b.unit(y, row.channels, 1, act=None)
    return b.add(x, y) if row.stride == 1 and x.channels == row.channels else y


def _inverted_encoder(b: GraphBuilder, x: TensorRef, encoder: MobileEncoder) -> list[TensorRef]:
    """Features before each halving and at the end: strides 2, 4, 8, 16, 32."""
    x = b.unit(x, encoder.stem, 3, ACTIVATIONS[encoder.activation], stride=2)
    features: list[TensorRef] = []
    for row in encoder.rows:
        if row.stride == 2:
            features.append(x)
        x = _inverted_block(b, x, row)
    return [*features, b.unit(x, encoder.last, 1, ACTIVATIONS[encoder.activation])]
