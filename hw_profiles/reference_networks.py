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

DECODER = (256, 128, 64, 64, 64)
HEADS = (3, 1)
NORMS = ("batch", "instance", "group")
LAYOUTS = ("packed", "split")
GROUPS = 8
CHANNELS_PER_PASS = 4
MAX_SIDE = 4096


class Block(NamedTuple):
    """Inverted residual block: expansion width, output width, kernel, stride, activation, squeeze-and-excitation."""

    expand: int
    out: int
    kernel: int
    stride: int
    act: str
    squeeze: bool = False


def _inverted(stem: int, rows: Iterable[tuple[int, int, int, int, int]]) -> tuple[Block, ...]:
    """Rows (expansion factor, width, repeats, stride, kernel) to blocks; `stem` is the width before the first."""
    blocks: list[Block] = []
    width = stem
    for factor, out, repeats, stride, kernel in rows:
        for index in range(repeats):
            blocks.append(Block(width * factor, out, kernel, stride if index == 0 else 1, "Clip"))
            width = out
    return tuple(blocks)


@dataclass(frozen=True)
class Inverted:
    """An encoder of inverted residual blocks. `tail`: width of a last 1x1 convolution, 0 for none."""

    stem: int
    stem_act: str
    blocks: tuple[Block, ...]
    tail: int


MOBILENET_V2 = Inverted(
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
#: The last layer is that of the trained network (`trilane.training.encoders`): 512 instead of its own 1280.
EFFICIENTNET_LITE0 = Inverted(
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
MOBILENET_V3 = Inverted(
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
INVERTED = {"mobilenetv2": MOBILENET_V2, "mobilenetv3": MOBILENET_V3, "efficientnet-lite0": EFFICIENTNET_LITE0}
ENCODERS = ("resnet18", *INVERTED)


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
        return self.same("GroupNormalization", x, *scales, num_groups=gcd(GROUPS, x.channels))

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
    """Squeeze-and-excitation: mean over the picture, two 1x1 convolutions, gate. Width a quarter, rounded to 8s."""
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


def _inverted_encoder(b: GraphBuilder, x: TensorRef, encoder: Inverted) -> list[TensorRef]:
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
    features = resnet18(b, x) if spec.encoder == "resnet18" else _inverted_encoder(b, x, INVERTED[spec.encoder])
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
