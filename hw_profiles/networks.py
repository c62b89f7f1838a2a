"""The U-Nets of the reference application as ONNX graphs without weights: shapes and operators only.

Rule: no tensor data is ever made here, so any size is cheap to describe; weights are graph inputs with a shape.
The decoder, heads and channel counts are those of DESIGN section 5. Encoders follow their papers: ResNet
(He 2015), MobileNetV2 (Sandler 2018), MobileNetV3 large (Howard 2019), EfficientNet-Lite0 (Tan 2019, the
mobile variant without squeeze-and-excitation). Batch normalisation is folded and leaves no operator.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from math import gcd
from typing import Any, NamedTuple

import onnx
from onnx import TensorProto, helper

from trilane.errors import BadInputError
from trilane.unet_tables import (
    DECODER,
    ENCODERS,
    HEADS,
    MOBILE_ENCODERS,
    NORM_GROUPS,
    NORMS,
    RESNET18_STAGES,
    RESNET18_STEM,
    MobileEncoder,
    Row,
    squeeze_channels,
)

LAYOUTS = ("packed", "split")
CHANNELS_PER_PASS = 4
MAX_SIDE = 4096


#: ONNX operators of the tables' activations.
ACTIVATIONS = {"relu": "Relu", "relu6": "Clip", "hardswish": "HardSwish"}


@dataclass(frozen=True)
class NetworkSpec:
    """One network. `height`, `width` in pixels, multiples of 32; `channels` of the rasterised texture, 4 to 16.

    Raises BadInputError when made with a value outside its range.
    """

    encoder: str
    norm: str
    height: int
    width: int
    channels: int
    layout: str = "packed"

    def __post_init__(self) -> None:
        _one_of("encoder", self.encoder, ENCODERS)
        _one_of("norm", self.norm, NORMS)
        _one_of("layout", self.layout, LAYOUTS)
        for name, side in (("height", self.height), ("width", self.width)):
            if side % 32 or not 32 <= side <= MAX_SIDE:
                raise BadInputError("size", f"{name} {side}", f"a multiple of 32 from 32 to {MAX_SIDE}")
        if not 1 <= self.channels <= 16:
            raise BadInputError("channels", str(self.channels), "1 to 16")

    @property
    def pixels(self) -> int:
        return self.height * self.width


def _one_of(key: str, found: str, known: tuple[str, ...]) -> None:
    if found not in known:
        raise BadInputError(key, repr(found), "one of " + ", ".join(known))


class TensorRef(NamedTuple):
    name: str
    channels: int
    height: int
    width: int


class GraphBuilder:
    """Collects nodes and shapes. All tensors are NCHW of batch 1, FLOAT by name only: the cost model sets bytes."""

    def __init__(self, norm: str) -> None:
        self.norm = norm
        self.nodes: list[Any] = []
        self.inputs: list[Any] = []
        self.infos: list[Any] = []
        self.twice = helper.make_tensor("twice", TensorProto.FLOAT, (4,), (1, 1, 2, 2))

    def input(self, name: str, channels: int, height: int, width: int) -> TensorRef:
        self.inputs.append(value_info(name, (1, channels, height, width)))
        return TensorRef(name, channels, height, width)

    def weight(self, shape: tuple[int, ...]) -> str:
        name = f"w{len(self.inputs)}"
        self.inputs.append(value_info(name, shape))
        return name

    def op(self, kind: str, sources: list[str], shape: tuple[int, int, int], **attributes: Any) -> TensorRef:
        out = TensorRef(f"{kind}_{len(self.nodes)}", *shape)
        self.nodes.append(helper.make_node(kind, sources, [out.name], name=out.name, **attributes))
        self.infos.append(value_info(out.name, (1, *shape)))
        return out

    def conv(
        self, x: TensorRef, out: int, kernel: int, stride: int = 1, groups: int = 1, bias: bool = False
    ) -> TensorRef:
        weight = self.weight((out, x.channels // groups, kernel, kernel))
        sources = [x.name, weight] + ([self.weight((out,))] if bias else [])
        shape = (out, -(-x.height // stride), -(-x.width // stride))
        return self.op(
            "Conv",
            sources,
            shape,
            kernel_shape=[kernel] * 2,
            strides=[stride] * 2,
            pads=[kernel // 2] * 4,
            group=groups,
        )

    def same(self, kind: str, x: TensorRef, *more: str, **attributes: Any) -> TensorRef:
        return self.op(kind, [x.name, *more], x[1:], **attributes)

    def normed(self, x: TensorRef) -> TensorRef:
        if self.norm == "batch":
            return x
        scales = [self.weight((x.channels,)), self.weight((x.channels,))]
        if self.norm == "instance":
            return self.same("InstanceNormalization", x, *scales)
        return self.same("GroupNormalization", x, *scales, num_groups=gcd(NORM_GROUPS, x.channels))

    def unit(
        self, x: TensorRef, out: int, kernel: int, act: str | None = "Relu", stride: int = 1, groups: int = 1
    ) -> TensorRef:
        """Convolution, normalisation, activation."""
        y = self.normed(self.conv(x, out, kernel, stride, groups, bias=self.norm == "batch"))
        return y if act is None else self.same(act, y)

    def upsampled(self, x: TensorRef) -> TensorRef:
        """Nearest neighbour, twice the size."""
        shape = (x.channels, 2 * x.height, 2 * x.width)
        return self.op("Resize", [x.name, "", self.twice.name], shape, mode="nearest")

    def model(self, name: str, outputs: list[TensorRef]) -> Any:
        """Everything so far as an `onnx.ModelProto`, opset 21."""
        results = [value_info(out.name, (1, *out[1:])) for out in outputs]
        graph = helper.make_graph(self.nodes, name, self.inputs, results, [self.twice], value_info=self.infos)
        return helper.make_model(graph, opset_imports=[helper.make_opsetid("", 21)])

    def add(self, x: TensorRef, y: TensorRef) -> TensorRef:
        return self.op("Add", [x.name, y.name], x[1:])


def value_info(name: str, shape: tuple[int, ...]) -> Any:
    return helper.make_tensor_value_info(name, TensorProto.FLOAT, shape)


def _network_input(b: GraphBuilder, spec: NetworkSpec) -> TensorRef:
    """Packed: one tensor. Split: one tensor per raster pass, joined and permuted before the first convolution."""
    shape = (spec.height, spec.width)
    if spec.layout == "packed":
        return b.input("input", spec.channels, *shape)
    counts = [min(CHANNELS_PER_PASS, spec.channels - c) for c in range(0, spec.channels, CHANNELS_PER_PASS)]
    passes = [b.input(f"pass{i}", count, *shape) for i, count in enumerate(counts)]
    joined = b.op("Concat", [p.name for p in passes], (spec.channels, *shape), axis=1)
    return b.same("Transpose", joined, perm=[0, 1, 2, 3])


def resnet18(b: GraphBuilder, x: TensorRef) -> list[TensorRef]:
    """Features at strides 2, 4, 8, 16, 32."""
    x = b.unit(x, RESNET18_STEM, 7, stride=2)
    features = [x]
    x = b.op(
        "MaxPool",
        [x.name],
        (RESNET18_STEM, x.height // 2, x.width // 2),
        kernel_shape=[3, 3],
        strides=[2, 2],
        pads=[1] * 4,
    )
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
    """Squeeze-and-excitation: mean over the picture, two 1x1 convolutions, gate. Width a quarter, rounded to 8s."""
    inner = squeeze_channels(x.channels)
    pooled = b.op("GlobalAveragePool", [x.name], (x.channels, 1, 1))
    hidden = b.same("Relu", b.conv(pooled, inner, 1, bias=True))
    gate = b.same("HardSigmoid", b.conv(hidden, x.channels, 1, bias=True))
    return b.op("Mul", [x.name, gate.name], x[1:])


def _inverted_block(b: GraphBuilder, x: TensorRef, row: Row) -> TensorRef:
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


def _decoder(b: GraphBuilder, features: list[TensorRef]) -> TensorRef:
    x, skips = features[-1], [*reversed(features[:-1]), None]
    for width, skip in zip(DECODER, skips, strict=True):
        x = b.upsampled(x)
        if skip is not None:
            x = b.op("Concat", [x.name, skip.name], (x.channels + skip.channels, x.height, x.width), axis=1)
        x = b.unit(b.unit(x, width, 3), width, 3)
    return x


def build_network(spec: NetworkSpec) -> Any:
    """The network as an `onnx.ModelProto` (opset 21, NCHW, batch 1) whose weights are inputs named `w<n>`."""
    b = GraphBuilder(spec.norm)
    x = _network_input(b, spec)
    features = resnet18(b, x) if spec.encoder == "resnet18" else _inverted_encoder(b, x, MOBILE_ENCODERS[spec.encoder])
    body = _decoder(b, features)
    heads = [b.conv(b.unit(body, DECODER[-1], 3), width, 3, bias=True) for width in HEADS]
    joined = b.op("Concat", [head.name for head in heads], (sum(HEADS), *body[2:]), axis=1)
    return b.model(f"unet-{spec.encoder}-{spec.norm}", [b.same("Sigmoid", joined)])


def parameters(model: Any) -> int:
    """Number of weights and biases of a model made by `build_network`."""
    shapes = [_shape(info) for info in model.graph.input if info.name.startswith("w")]
    return sum(_product(shape) for shape in shapes)


def _shape(info: onnx.ValueInfoProto) -> list[int]:
    return [d.dim_value for d in info.type.tensor_type.shape.dim]


def _product(values: Iterable[int]) -> int:
    result = 1
    for value in values:
        result *= value
    return result
