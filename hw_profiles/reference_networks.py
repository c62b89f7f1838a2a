"""The U-Nets of the reference application: their ONNX graphs, their work, and CSV tables that list many of them.

All U-Nets have the same decoder, heads and channel counts (`trilane.unet_tables`). They differ in encoder,
normalisation, size and layout of the input. Batch normalisation is folded and leaves no operator. A weight is a graph
input with a shape and without data, so that a network of any size is cheap to describe. A bad cell of a table raises a
`BadInputError` that names file, line and column.
"""

from __future__ import annotations

import csv
from dataclasses import dataclass
from functools import lru_cache
from math import gcd, inf
from pathlib import Path
from typing import Any, NamedTuple

from onnx import TensorProto, helper

from trilane.arrays import check_side, parse_shape
from trilane.errors import BadInputError
from trilane.hw_profiles.network_work import Network, Work, count_work
from trilane.unet_tables import (
    DECODER,
    ENCODERS,
    HEADS,
    MOBILE_ENCODERS,
    NORM_GROUPS,
    NORMS,
    RESNET18_STAGES,
    RESNET18_STEM,
    MobileBlock,
    MobileEncoder,
    squeeze_channels,
)
from trilane.unexpected_value import UnexpectedValue
from trilane.units import MAX_CHANNELS

LAYOUTS = ("packed", "split")
CHANNELS_PER_PASS = 4

KEYS = ("encoder", "norm", "size", "channels", "layout")
MAX_BYTES, MAX_ROWS = 32_000_000, 100_000

#: ONNX operators of the tables' activations.
ACTIVATIONS = {"relu": "Relu", "relu6": "Clip", "hardswish": "HardSwish"}


@dataclass(frozen=True)
class NetworkSpec:
    """One reference network.

    `encoder`: one of ENCODERS.
    `norm`: one of NORMS.
    `height`, `width`: size of the input in pixels, which `check_side` accepts.
    `channels`: channels of the rasterised texture, 1 to MAX_CHANNELS.
    `layout`: one of LAYOUTS.

    Raises BadInputError for another value.
    """

    encoder: str
    norm: str
    height: int
    width: int
    channels: int
    layout: str = "packed"

    def __post_init__(self) -> None:
        for key, known in (("encoder", ENCODERS), ("norm", NORMS), ("layout", LAYOUTS)):
            if (value := getattr(self, key)) not in known:
                raise BadInputError(key, repr(value), "one of " + ", ".join(known))
        try:
            check_side(self.height, "height")
            check_side(self.width, "width")
        except UnexpectedValue as error:
            raise BadInputError.at("size", error) from None
        if not 1 <= self.channels <= MAX_CHANNELS:
            raise BadInputError("channels", str(self.channels), f"1 to {MAX_CHANNELS}")

    @property
    def pixels(self) -> int:
        return self.height * self.width


def reference_network(spec: NetworkSpec) -> Network:
    """Return the network of `spec`, with its work and its facts for reports."""
    facts = {"encoder": spec.encoder, "norm": spec.norm}
    return Network(facts, spec.height, spec.width, spec.channels, spec.layout, network_work(spec))


@lru_cache(maxsize=4096)
def network_work(spec: NetworkSpec) -> Work:
    """Return the work of the network of `spec`."""
    return count_work(build_network(spec))


def build_network(spec: NetworkSpec) -> Any:
    """Return the network as an `onnx.ModelProto` (opset 21, NCHW, batch 1) whose weights are inputs named `w<n>`."""
    b = GraphBuilder(spec.norm)
    x = _network_input(b, spec)
    body = _decoder(b, encode(b, x, spec.encoder))
    heads = [b.conv(b.unit(body, DECODER[-1], 3), width, 3, bias=True) for width in HEADS]
    joined = b.op("Concat", [head.name for head in heads], (sum(HEADS), *body[2:]), axis=1)
    return b.model(f"unet-{spec.encoder}-{spec.norm}", [b.same("Sigmoid", joined)])


def _network_input(b: GraphBuilder, spec: NetworkSpec) -> TensorRef:
    """Return the network's input in the layout of `spec`.

    With `packed` it is one tensor. With `split` the graph has one input per raster pass, which are joined and permuted.
    """
    shape = (spec.height, spec.width)
    if spec.layout == "packed":
        return b.input("input", spec.channels, *shape)
    counts = [min(CHANNELS_PER_PASS, spec.channels - c) for c in range(0, spec.channels, CHANNELS_PER_PASS)]
    passes = [b.input(f"pass{i}", count, *shape) for i, count in enumerate(counts)]
    joined = b.op("Concat", [p.name for p in passes], (spec.channels, *shape), axis=1)
    return b.same("Transpose", joined, perm=[0, 1, 2, 3])


def _decoder(b: GraphBuilder, features: list[TensorRef]) -> TensorRef:
    """Return the decoder's result at full size. `features`: features of the encoder, from stride 2 to stride 32."""
    x, skips = features[-1], [*reversed(features[:-1]), None]
    for width, skip in zip(DECODER, skips, strict=True):
        shape = (x.channels, 2 * x.height, 2 * x.width)
        x = b.op("Resize", [x.name, "", b.twice.name], shape, mode="nearest")
        if skip is not None:
            x = b.op("Concat", [x.name, skip.name], (x.channels + skip.channels, x.height, x.width), axis=1)
        x = b.unit(b.unit(x, width, 3), width, 3)
    return x


@dataclass(frozen=True)
class ConfigurationRow:
    """One row of a table of configurations.

    `place`: file and line, for messages.
    `cells`: text of its cells by column.
    """

    place: str
    cells: dict[str, str]
    spec: NetworkSpec

    def number(self, column: str) -> float | None:
        """Return the measured value in `column`; None if the cell is blank or the column is missing.

        Raises BadInputError for a text that is no number above 0.
        """
        text = self.cells.get(column, "")
        if not text:
            return None
        try:
            value = float(text)
        except ValueError:
            value = 0.0
        if not 0 < value < inf:
            raise BadInputError(f"{self.place}: {column}", repr(text), "a number above 0, or nothing")
        return value

    def range(self, column: str) -> tuple[float, float] | None:
        """Return (value of `column`_min, value of `column`_max); None if a value is blank. Raises BadInputError."""
        low, high = self.number(f"{column}_min"), self.number(f"{column}_max")
        if low is None or high is None:
            return None
        if low > high:
            raise BadInputError(f"{self.place}: {column}_min", f"{low:g}", f"at most {column}_max, which is {high:g}")
        return low, high


def read_table(path: Path) -> list[ConfigurationRow]:
    """Return the rows of `path`; lines that begin with `#` are comments.

    Raises BadInputError if the file is unreadable or too large, lacks rows or a column of KEYS, or has a wrong cell.
    """
    try:
        if path.stat().st_size > MAX_BYTES:
            raise BadInputError(path, f"{path.stat().st_size} bytes", f"at most {MAX_BYTES}")
        text = path.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError as error:
        raise BadInputError(path, str(error), "text in UTF-8") from None
    except OSError as error:
        raise BadInputError.of_os_error(path, error, "a file that can be read") from None
    lines = numbered_lines(text)
    if len(lines) < 2:
        raise BadInputError(path, "no rows", "a header and at least one row")
    if len(lines) > MAX_ROWS:
        raise BadInputError(path, f"{len(lines)} rows", f"at most {MAX_ROWS}")
    header = header_of(path, *lines[0])
    missing = [key for key in KEYS if key not in header]
    if missing:
        raise BadInputError(f"{path}: line {lines[0][0]}", f"no column {', '.join(missing)}", ", ".join(KEYS))
    return [_row(f"{path}: line {n}", header, next(csv.reader([line]))) for n, line in lines[1:]]


def numbered_lines(text: str) -> list[tuple[int, str]]:
    """Return pairs (number, line) of the lines of a table that are neither blank nor comments; numbers begin at 1."""
    return [(n, line) for n, line in enumerate(text.splitlines(), 1) if line.strip() and not line.startswith("#")]


def header_of(path: Path, number: int, line: str) -> list[str]:
    """Return the columns that the header `line` of `path` names. Raises BadInputError for a column that comes twice."""
    header = [cell.strip() for cell in next(csv.reader([line]))]
    if repeated := [key for key in header if header.count(key) > 1]:
        raise BadInputError(f"{path}: line {number}", f"column {repeated[0]!r} twice", "every column once")
    return header


def _row(place: str, header: list[str], cells: list[str]) -> ConfigurationRow:
    if len(cells) != len(header):
        raise BadInputError(place, f"{len(cells)} cells", f"{len(header)} as in the header")
    named = {key: cell.strip() for key, cell in zip(header, cells, strict=True)}
    return ConfigurationRow(place, named, spec_of(named, place))


def spec_of(cells: dict[str, str], place: str) -> NetworkSpec:
    """Return the network that the cells of the columns KEYS describe; `size` is one side or HEIGHTxWIDTH.

    `place`: file and line, for messages. Raises BadInputError.
    """
    size = cells["size"]
    try:
        height, width = parse_shape(size if "x" in size else f"{size}x{size}")
    except UnexpectedValue:
        raise BadInputError(f"{place}: size", repr(size), "a side such as 512, or HEIGHTxWIDTH") from None
    channels = cells["channels"]
    if not channels.isdecimal() or len(channels) > 4:
        raise BadInputError(f"{place}: channels", repr(channels), f"1 to {MAX_CHANNELS}")
    try:
        return NetworkSpec(cells["encoder"], cells["norm"], height, width, int(channels), cells["layout"])
    except BadInputError as error:
        raise BadInputError(f"{place}: {error.where}", error.found, error.expected) from None


def encode(b: GraphBuilder, x: TensorRef, encoder: str) -> list[TensorRef]:
    """Append `encoder`, one of ENCODERS, to the graph of `b`. Return features of `x` at strides 2, 4, 8, 16 and 32."""
    return resnet18(b, x) if encoder == "resnet18" else _inverted_encoder(b, x, MOBILE_ENCODERS[encoder])


def resnet18(b: GraphBuilder, x: TensorRef) -> list[TensorRef]:
    """Append ResNet18 to the graph of `b`. Return features of `x` at strides 2, 4, 8, 16 and 32."""
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
    """Append squeeze-and-excitation of `x`: mean over the picture, two 1x1 convolutions, gate. Return the result."""
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
    """Return the features of `x` at strides 2, 4, 8, 16 and 32: the last ones before each halving, and the result."""
    x = b.unit(x, encoder.stem, 3, ACTIVATIONS[encoder.activation], stride=2)
    features: list[TensorRef] = []
    for row in encoder.rows:
        if row.stride == 2:
            features.append(x)
        x = _inverted_block(b, x, row)
    return [*features, b.unit(x, encoder.last, 1, ACTIVATIONS[encoder.activation])]


class TensorRef(NamedTuple):
    """A tensor of the graph: its name and its size without the batch axis."""

    name: str
    channels: int
    height: int
    width: int


class GraphBuilder:
    """Builds an ONNX graph. The methods append operators and return their results.

    All activations are NCHW with batch 1. All tensors are declared as FLOAT, but the chip's profile decides how many
    bytes an element takes.

    `norm`: normalisation that `normed` and `unit` append: `batch`, `instance` or `group`. `batch` appends no operator,
    because it is folded into the convolution.
    """

    def __init__(self, norm: str) -> None:
        self.norm = norm
        self.nodes: list[Any] = []
        self.inputs: list[Any] = []
        self.infos: list[Any] = []
        self.twice = helper.make_tensor("twice", TensorProto.FLOAT, (4,), (1, 1, 2, 2))

    def input(self, name: str, channels: int, height: int, width: int) -> TensorRef:
        """Declare an input of the graph.

        `channels`, `height`, `width`: size of the tensor.
        """
        self.inputs.append(value_info(name, (1, channels, height, width)))
        return TensorRef(name, channels, height, width)

    def weight(self, shape: tuple[int, ...]) -> str:
        """Declare a weight as a graph input without data, and return its name."""
        name = f"w{len(self.inputs)}"
        self.inputs.append(value_info(name, shape))
        return name

    def op(self, kind: str, sources: list[str], shape: tuple[int, int, int], **attributes: Any) -> TensorRef:
        """Append an operator.

        `kind`: ONNX type of the operator.
        `sources`: names of its input tensors.
        `shape`: channels, height, width of its result.
        `attributes`: attributes by their ONNX names.
        """
        out = TensorRef(f"{kind}_{len(self.nodes)}", *shape)
        self.nodes.append(helper.make_node(kind, sources, [out.name], name=out.name, **attributes))
        self.infos.append(value_info(out.name, (1, *shape)))
        return out

    def conv(
        self, x: TensorRef, out: int, kernel: int, stride: int = 1, groups: int = 1, bias: bool = False
    ) -> TensorRef:
        """Append a convolution that keeps the size, divided by its stride.

        `x`: input tensor.
        `out`: number of output channels.
        `kernel`: side of the kernel in pixels.
        `stride`: stride along both axes.
        `groups`: number of groups of channels.
        `bias`: whether it has a bias.
        """
        weight = self.weight((out, x.channels // groups, kernel, kernel))
        sources = [x.name, weight] + ([self.weight((out,))] if bias else [])
        shape = (out, -(-x.height // stride), -(-x.width // stride))
        sides = {"kernel_shape": [kernel] * 2, "strides": [stride] * 2, "pads": [kernel // 2] * 4}
        return self.op("Conv", sources, shape, **sides, group=groups)

    def same(self, kind: str, x: TensorRef, *more: str, **attributes: Any) -> TensorRef:
        """Append an operator whose result has the size of `x`.

        `kind`: ONNX type of the operator.
        `x`: first input tensor.
        `more`: names of its other inputs.
        `attributes`: attributes by their ONNX names.
        """
        return self.op(kind, [x.name, *more], x[1:], **attributes)

    def normed(self, x: TensorRef) -> TensorRef:
        """Append the normalisation of `x` that `norm` of the builder names."""
        if self.norm == "batch":
            return x
        scales = [self.weight((x.channels,)), self.weight((x.channels,))]
        if self.norm == "instance":
            return self.same("InstanceNormalization", x, *scales)
        return self.same("GroupNormalization", x, *scales, num_groups=gcd(NORM_GROUPS, x.channels))

    def unit(
        self, x: TensorRef, out: int, kernel: int, act: str | None = "Relu", stride: int = 1, groups: int = 1
    ) -> TensorRef:
        """Append a convolution, its normalisation and its activation.

        `x`, `out`, `kernel`, `stride`, `groups`: as in `conv`.
        `act`: ONNX operator of the activation; None: no activation.
        """
        y = self.normed(self.conv(x, out, kernel, stride, groups, bias=self.norm == "batch"))
        return y if act is None else self.same(act, y)

    def model(self, name: str, outputs: list[TensorRef]) -> Any:
        """Return the graph so far, with the results `outputs`, as an `onnx.ModelProto` of opset 21."""
        results = [value_info(out.name, (1, *out[1:])) for out in outputs]
        graph = helper.make_graph(self.nodes, name, self.inputs, results, [self.twice], value_info=self.infos)
        return helper.make_model(graph, opset_imports=[helper.make_opsetid("", 21)])

    def add(self, x: TensorRef, y: TensorRef) -> TensorRef:
        """Append the sum of `x` and `y`, which have the same size."""
        return self.op("Add", [x.name, y.name], x[1:])


def value_info(name: str, shape: tuple[int, ...]) -> Any:
    """Return the `onnx.ValueInfoProto` of a FLOAT tensor."""
    return helper.make_tensor_value_info(name, TensorProto.FLOAT, shape)
