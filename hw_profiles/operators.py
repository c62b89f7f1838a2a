"""ONNX operators: the class of each, the counts of products, and the layers that a tensor engine makes from a graph.

If no table names an operator, its time follows from the elements that it moves, and reports name the operator. The
count of a product follows only from shapes and attributes; `network_work.py` counts convolutions.

A term is a kind of work with its own cost (`TERMS`); this file knows no chip. Channels are rounded up to the Hexagon's
blocks: a convolution's inputs to 16, its outputs to 32, all other activations to 8. The runtime folds a ReLU and a clip
into the layer before them, and a batch normalisation into the convolution before it. It folds a sum of two tensors into
the convolution that makes one of them. A permutation between channels first and channels last costs nothing, because
the engine always has channels last.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from itertools import chain
from math import prod
from typing import Any, Literal, NamedTuple, get_args

import numpy as np
from numpy.typing import NDArray

ARITHMETIC = ("convolution", "pointwise", "depthwise")
TRAFFIC = ("normalisation", "resize", "elementwise", "permute")
CLASSES = ARITHMETIC + TRAFFIC

#: Operators that cost nothing: a runtime folds them into the convolution before them, or they only rename a tensor. A
#: batch normalisation that follows no convolution has a cost.
FOLDED = frozenset(
    ("Relu", "Clip", "Sigmoid", "BatchNormalization", "QuantizeLinear", "DequantizeLinear", "Identity")
) | frozenset(("Reshape", "Flatten", "Squeeze", "Unsqueeze", "Constant", "Dropout"))
#: Operators whose result depends only on shapes; a runtime folds them, and all operators that depend only on them.
OF_SHAPES = frozenset(["Shape", "Size"])
#: Index of the second factor among the inputs, for convolutions and for other products of two tensors.
CONVOLUTIONS = {"Conv": 1, "ConvTranspose": 1, "ConvInteger": 1, "DeformConv": 1, "FusedConv": 1, "QLinearConv": 3}
PRODUCTS = {"Gemm": 1, "MatMul": 1, "MatMulInteger": 1, "QLinearMatMul": 3, "FusedMatMul": 1, "Einsum": 1}
#: Recurrent layers. Their inputs 1 and 2 are weights, which multiply the vector of every step.
RECURRENT = frozenset(["LSTM", "GRU", "RNN"])
#: Normalisations that read their input twice: for its mean and variance, and to apply them.
STATISTICS = frozenset(
    (
        *("InstanceNormalization", "GroupNormalization", "LayerNormalization", "MeanVarianceNormalization"),
        *("SkipLayerNormalization", "SimplifiedLayerNormalization", "RMSNormalization", "LpNormalization"),
        *("Softmax", "LogSoftmax", "Hardmax"),
    )
)

_BY_CLASS = {
    "normalisation": (
        *STATISTICS,
        *("GlobalAveragePool", "GlobalMaxPool", "GlobalLpPool", "LRN", "ArgMax", "ArgMin"),
        *("ReduceMean", "ReduceSum", "ReduceMax", "ReduceMin", "ReduceProd", "ReduceL1", "ReduceL2"),
        *("ReduceLogSum", "ReduceLogSumExp", "ReduceSumSquare", "QLinearGlobalAveragePool"),
    ),
    "resize": (
        *("Resize", "Upsample", "Concat", "MaxPool", "AveragePool", "LpPool", "Slice", "Split", "Pad"),
        *("DepthToSpace", "SpaceToDepth", "Expand", "Tile", "Gather", "GatherElements", "GatherND"),
        *("ScatterElements", "ScatterND", "Scatter", "GridSample", "RoiAlign", "MaxRoiPool", "MaxUnpool", "Col2Im"),
        *("CenterCropPad", "ReverseSequence", "TopK", "OneHot", "Compress", "QLinearConcat", "QLinearAveragePool"),
    ),
    "permute": ("Transpose",),
    "elementwise": (
        *("Add", "Sub", "Mul", "Div", "Pow", "Mod", "Min", "Max", "Sum", "Mean", "PRelu", "Where", "CumSum"),
        *("ConstantOfShape", "Range", "RandomNormalLike", "RandomUniformLike", "NonMaxSuppression"),
        *("And", "Or", "Not", "Xor", "Equal", "Greater", "GreaterOrEqual", "Less", "LessOrEqual", "IsNaN", "IsInf"),
        *("BitwiseAnd", "BitwiseOr", "BitwiseNot", "BitwiseXor", "BitShift", "Trilu", "EyeLike"),
        *(
            "Abs",
            "Neg",
            "Sign",
            "Sqrt",
            "Exp",
            "Log",
            "Reciprocal",
            "Erf",
            "Floor",
            "Ceil",
            "Round",
            "Cast",
            "CastLike",
        ),
        *("Sin", "Cos", "Tan", "Asin", "Acos", "Atan", "Sinh", "Cosh", "Asinh", "Acosh", "Atanh"),
        *("HardSwish", "HardSigmoid", "Tanh", "LeakyRelu", "Elu", "Celu", "Selu", "Gelu", "Mish", "Swish", "Softplus"),
        *("Softsign", "ThresholdedRelu", "Shrink", "QuickGelu", "FastGelu", "BiasGelu", "DynamicQuantizeLinear"),
        *("QLinearAdd", "QLinearMul", "QLinearSigmoid", "QLinearLeakyRelu", "QLinearSoftmax"),
    ),
}
#: Class of each ONNX operator that is no product.
KIND_OF = {operator: kind for kind, operators in _BY_CLASS.items() for operator in operators}
#: Operators whose constant inputs are weights. Constant inputs of other operators are axes, sizes and indices.
WEIGHTED = frozenset(
    [*CONVOLUTIONS, *PRODUCTS, *RECURRENT, *STATISTICS, *_BY_CLASS["elementwise"], "BatchNormalization", "Gather"]
)
#: Permutations between channels first and channels last. They cost nothing: the units always work with channels last,
#: and a file has these operators only because it has channels first.
LAYOUT_CHANGES = ((0, 3, 1, 2), (0, 2, 3, 1))
#: Domains whose operators the tables contain: ONNX itself and ONNX Runtime.
DOMAINS = ("", "ai.onnx", "com.microsoft")
#: Operators that contain a network compiled for a chip; the file does not say what it computes.
COMPILED = frozenset(["EPContext"])
#: Class of an operator without a rule: it reads its inputs and writes its results.
UNKNOWN = "elementwise"

_KNOWN = frozenset([*FOLDED, *OF_SHAPES, *CONVOLUTIONS, *PRODUCTS, *RECURRENT, *KIND_OF])

Shape = tuple[int, ...]


def has_rule(op_type: str, domain: str = "") -> bool:
    """Return whether the tables know the ONNX operator `op_type` of `domain`."""
    return domain in DOMAINS and op_type in _KNOWN


class Product(NamedTuple):
    """The counts of a product of tensors.

    `macs`: multiply-accumulates.
    `c_in`: number of products that each element of the result sums.
    `c_out`: number of elements of the result that use the same element of the first factor.
    """

    macs: int
    c_in: int
    c_out: int


def product_of(node: Any, shapes: list[Shape], out: Shape) -> Product | None:
    """Return the counts of the product that `node` computes; None if its shapes do not say.

    `node`: operator of PRODUCTS or RECURRENT.
    `shapes`: shape of each input.
    `out`: shape of its first result.
    """
    if node.op_type in RECURRENT:
        # X (steps, sequences, size), W and R (directions, gates, size): each step of each sequence takes all weights.
        if [len(shape) for shape in shapes[:3]] != [3, 3, 3]:
            return None
        source, weights, recurrence = shapes[:3]
        return Product(prod(source[:2]) * (prod(weights) + prod(recurrence)), source[2], weights[1])
    if node.op_type == "Einsum":
        return _einsum(node, shapes)
    at = PRODUCTS[node.op_type]
    if len(shapes) <= at or not shapes[0] or not shapes[at]:
        return None
    first, second = shapes[0], shapes[at]
    turned = {a.name: a.i for a in node.attribute if a.name in ("transA", "transB")}
    depth = first[-2] if turned.get("transA") else first[-1]
    width = 1 if len(second) == 1 else second[-2] if turned.get("transB") else second[-1]
    return Product(prod(out) * depth, depth, width)


def _einsum(node: Any, shapes: list[Shape]) -> Product | None:
    """Return the counts of an Einsum; None for an equation with an ellipsis or one that does not fit the shapes."""
    equation = next((a.s.decode() for a in node.attribute if a.name == "equation"), "").replace(" ", "")
    sources, _, result = equation.partition("->")
    terms = sources.split(",")
    if "." in equation or [*map(len, terms)] != [*map(len, shapes)]:
        return None
    sizes = dict(zip("".join(terms), chain.from_iterable(shapes), strict=True))
    summed = set(sizes) - set(result)
    c_in, c_out = (prod(sizes[index] for index in of) for of in (summed, set(terms[-1]) - summed))
    return Product(prod(sizes.values()), c_in, c_out)


RateName = Literal["arithmetic", "activation", "spill", "weight", "operator", "job"]
RATES: tuple[RateName, ...] = get_args(RateName)

#: The rate by which the amount of each term is divided. Amounts of `arithmetic` are products. Amounts of `activation`,
#: `spill` and `weight` are elements, and amounts of `operator` and `job` are counts.
TERMS: dict[str, RateName] = {
    "convolution": "arithmetic",
    "grouped": "arithmetic",
    "first": "arithmetic",
    "depthwise": "arithmetic",
    "stride": "arithmetic",
    "depthwise_stride": "arithmetic",
    "dilation": "arithmetic",
    "moved": "activation",
    "moved_depthwise": "activation",
    "pool": "activation",
    "reduction": "activation",
    "bilinear": "activation",
    "nearest": "activation",
    "concat": "activation",
    "constant": "activation",
    "divide": "activation",
    "elementwise": "activation",
    "batch_norm": "activation",
    "normalisation": "activation",
    "shuffle": "activation",
    "depth_to_space": "activation",
    "activation": "activation",
    "leaky": "activation",
    "swish": "activation",
    "clip": "activation",
    "pad": "activation",
    "other": "activation",
    "input": "activation",
    "output": "activation",
    "spill": "spill",
    "weights": "weight",
    "operator": "operator",
    "job": "job",
}
NAMES = tuple(TERMS)
INDEX = {name: index for index, name in enumerate(NAMES)}

#: Operators that only rename their input.
RENAMES = frozenset(
    ("Identity", "Reshape", "Flatten", "Squeeze", "Unsqueeze", "Dropout", "Cast", "QuantizeLinear", "DequantizeLinear")
)
#: Activations that a runtime folds into the layer before them.
FOLDED_ACTIVATIONS = frozenset(["Relu", "Clip"])
NORMALISATIONS = ("BatchNormalization", "InstanceNormalization", "GroupNormalization", "LayerNormalization")
#: Layers into which such an activation is folded.
TAKES = frozenset(
    ("Conv", "ConvTranspose", "Gemm", "MatMul", "Add", "Mul", "Concat", "MaxPool", "Resize", *NORMALISATIONS)
)
PLAIN_PRODUCTS = frozenset(["Conv", "ConvTranspose", "Gemm", "MatMul"])
WITH_PRODUCTS = frozenset([*CONVOLUTIONS, *PRODUCTS, *RECURRENT])
#: The float operator that does the same work, for integer operators and for operators fused with others.
PLAIN = {
    **{"QLinearConv": "Conv", "ConvInteger": "Conv", "FusedConv": "Conv", "DeformConv": "Conv"},
    **{"QLinearMatMul": "MatMul", "MatMulInteger": "MatMul", "FusedMatMul": "MatMul"},
    **{"QLinearAdd": "Add", "QLinearMul": "Mul", "QLinearConcat": "Concat", "QLinearAveragePool": "AveragePool"},
    **{"QLinearGlobalAveragePool": "GlobalAveragePool", "QLinearSigmoid": "Sigmoid", "QLinearSoftmax": "Softmax"},
    "QLinearLeakyRelu": "LeakyRelu",
}
ARITHMETIC_OF_TWO = frozenset(["Add", "Sub", "Mul", "Div"])
_BY_TERM = {
    "pool": ("MaxPool", "AveragePool", "LpPool"),
    "reduction": ("GlobalAveragePool", "GlobalMaxPool", "ReduceMean", "ReduceSum", "ReduceMax", "ReduceMin", "ArgMax"),
    "concat": ("Concat",),
    "batch_norm": ("BatchNormalization",),
    "normalisation": NORMALISATIONS[1:],
    "shuffle": ("Slice", "Split", "Transpose", "Gather", "Expand", "Tile"),
    "depth_to_space": ("DepthToSpace", "SpaceToDepth"),
    "activation": ("Relu", "Clip", "Sigmoid", "HardSwish", "HardSigmoid", "Tanh", "Gelu", "Erf", "Elu", "Softmax"),
    "leaky": ("LeakyRelu", "PRelu"),
    "swish": ("Swish",),
    "pad": ("Pad",),
}
TERM_OF = {operator: term for term, operators in _BY_TERM.items() for operator in operators}
INPUT_BLOCK, OUTPUT_BLOCK, ACTIVATION_BLOCK = 16, 32, 8
#: Most input channels of a convolution that reads a picture.
PICTURE_CHANNELS = 4


class EngineLayer(NamedTuple):
    """One layer of a tensor engine.

    `amounts`: amount of each term.
    `reads`: names of the tensors that it reads, without weights.
    `writes`: name of its result.
    `more`: further results that other layers read, such as the parts of a split.
    """

    name: str
    op_type: str
    amounts: Mapping[str, float]
    reads: tuple[str, ...]
    writes: str
    more: tuple[str, ...] = ()

    @property
    def kind(self) -> str:
        """The type of the float operator that does the same work."""
        return PLAIN.get(self.op_type, self.op_type)


@dataclass(frozen=True, eq=False)
class Layers:
    """The layers of a network, in order. Two objects are never equal, even with equal content.

    `sizes`: elements of each tensor, by name.
    `input`, `output`: elements of the network's inputs and of its outputs.
    """

    layers: tuple[EngineLayer, ...]
    sizes: Mapping[str, int]
    input: int
    output: int

    @cached_property
    def table(self) -> NDArray[np.float64]:
        """The amount of each term in each layer (layers, terms)."""
        table = np.zeros((len(self.layers), len(NAMES)))
        for row, layer in zip(table, self.layers, strict=True):
            for term, amount in layer.amounts.items():
                row[INDEX[term]] = amount
        return table

    def since(self, name: str, crossing: int) -> Layers:
        """Return the layers from the layer `name` on. `crossing`: elements that they read from earlier layers."""
        first = next((i for i, layer in enumerate(self.layers) if layer.name == name), len(self.layers))
        return Layers(self.layers[first:], self.sizes, crossing, self.output)

    def named(self, before: str) -> Layers:
        """Return the same layers with the text `before` in front of the names of all layers and tensors."""

        def renamed(names: tuple[str, ...]) -> tuple[str, ...]:
            return tuple(before + name for name in names)

        layers = tuple(
            layer._replace(
                name=before + layer.name,
                reads=renamed(layer.reads),
                writes=before + layer.writes,
                more=renamed(layer.more),
            )
            for layer in self.layers
        )
        return Layers(layers, {before + name: size for name, size in self.sizes.items()}, self.input, self.output)


NO_LAYERS = Layers((), {}, 0, 0)

Shapes = Mapping[str, Shape]


class _Graph:
    """A graph without operators that only rename a tensor. `reads`: number of readers of each tensor."""

    def __init__(self, graph: Any, shapes: Shapes, constants: set[str]) -> None:
        self.shapes, self.constants = shapes, constants
        self.nodes = [n for n in graph.node if not all(name in constants for name in n.output if name)]
        self._renamed: dict[str, str] = {}
        for node in self.nodes:
            if _renames(node) and node.input:
                self.rename(node.output[0], node.input[0])
        self.reads = Counter(self.name_of(name) for n in self.nodes if not _renames(n) for name in n.input)
        self._ends = {self.name_of(output.name) for output in graph.output}

    def rename(self, name: str, original: str) -> None:
        """Treat the tensor `name` as another name of the tensor `original` from now on."""
        self._renamed[name] = original

    def name_of(self, name: str) -> str:
        """Return the original name of the tensor `name`."""
        while name in self._renamed:
            name = self._renamed[name]
        return name

    def given(self, node: Any) -> tuple[str, ...]:
        """Return the tensors that `node` reads, without its weights."""
        return tuple(self.name_of(name) for name in node.input if name and name not in self.constants)

    def more(self, node: Any) -> tuple[str, ...]:
        """Return the results of `node`, except the first, that are read or are outputs of the graph."""
        others = (name for name in node.output if name and name != first_result(node))
        return tuple(name for name in others if self.reads[name] or name in self._ends)


def first_result(node: Any) -> str:
    """Return the first named output of `node`. A recurrent layer may leave its first outputs without a name."""
    name: str = next(name for name in node.output if name)
    return name


def _kind(node: Any) -> str:
    """Return the type of the float operator that does the same work as `node`; empty for an unknown domain."""
    return PLAIN.get(node.op_type, node.op_type) if node.domain in DOMAINS else ""


def _renames(node: Any) -> bool:
    """Return whether `node` only renames its input, and moves no data."""
    kind = _kind(node)
    return kind in RENAMES or (kind == "Transpose" and any(tuple(a.ints) in LAYOUT_CHANGES for a in node.attribute))


def layers_of(graph: Any, shapes: Shapes, constants: set[str]) -> Layers:
    """Return the layers of an ONNX graph.

    `graph`: ONNX graph of a model.
    `shapes`: shape of each tensor, by name.
    `constants`: names of tensors that do not depend on the input.
    """
    names = _Graph(graph, shapes, constants)
    layers: dict[str, EngineLayer] = {}
    activated: set[str] = set()  # results of layers that have taken up an activation
    for node in names.nodes:
        if _renames(node) or not names.given(node):
            continue
        kind = _kind(node)
        before = [layers[name] for name in names.given(node) if name in layers]
        sigmoid = next((layer for layer in before if _is_swish(node, layer, names)), None)
        # A layer whose result nothing else reads can take up what follows it.
        taker = before[0].kind if before and names.reads[before[0].writes] == 1 else ""
        if kind in FOLDED_ACTIVATIONS and taker in TAKES:
            layers[before[0].writes] = before[0]._replace(amounts={**before[0].amounts, **_clip(node, shapes)})
            names.rename(node.output[0], before[0].writes)
            activated.add(before[0].writes)
        elif node.op_type == "BatchNormalization" and taker in PLAIN_PRODUCTS and before[0].writes not in activated:
            names.rename(node.output[0], before[0].writes)
        elif sigmoid is not None:
            del layers[sigmoid.writes]
            layers[first_result(node)] = _layer(node, names, "Swish", sigmoid.reads)
        elif kind == "Add" and any(layer.kind in PLAIN_PRODUCTS for layer in before):
            result = node.output[0]
            layers[result] = EngineLayer(node.name or result, "Add", {}, names.given(node), result)
        else:
            layers[first_result(node)] = _layer(node, names, kind, names.given(node))
    sizes = {name: _padded(shape) for name, shape in shapes.items() if name not in constants}
    ends = ([i.name for i in graph.input if i.name not in constants], [o.name for o in graph.output])
    whole = tuple(layers.values())
    return Layers(whole, sizes, *(sum(prod(shapes[name]) for name in end) for end in ends))


def _clip(node: Any, shapes: Shapes) -> dict[str, float]:
    return {"clip": 2.0 * _padded(shapes[node.output[0]])} if node.op_type == "Clip" else {}


def _is_swish(node: Any, before: EngineLayer, names: _Graph) -> bool:
    """Return whether `node` multiplies a tensor with its own sigmoid, which the layer `before` makes for it alone."""
    if _kind(node) != "Mul" or before.kind != "Sigmoid":
        return False
    return set(names.given(node)) == {*before.reads, before.writes} and names.reads[before.writes] == 1


def _layer(node: Any, names: _Graph, kind: str, reads: tuple[str, ...]) -> EngineLayer:
    writes, more = first_result(node), names.more(node)
    amounts: Counter[str] = Counter(dict(_products(node, names.shapes)) if kind else {})
    if amounts:
        amounts["weights"] = sum(prod(names.shapes.get(n, ())) for n in node.input if n and n in names.constants)
    else:
        moved = [names.shapes[n] for n in node.input if n and n not in names.constants]
        moved += [names.shapes[n] for n in (writes, *more)]
        amounts.update(dict(_movement(node, kind, sum(_padded(s) for s in moved), names)))
    amounts["operator"] = 1
    counted = {t: float(a) for t, a in amounts.items() if a}
    return EngineLayer(node.name or writes, node.op_type, counted, reads, writes, more)


def _movement(node: Any, kind: str, moved: int, names: _Graph) -> Iterator[tuple[str, float]]:
    """Yield (term, amount) of a layer without products. `kind`: its type. `moved`: elements read and written."""
    if kind == "Resize":
        mode = next((a.s for a in node.attribute if a.name == "mode"), b"nearest")
        yield "nearest" if mode == b"nearest" else "bilinear", moved
    elif kind in ARITHMETIC_OF_TWO:
        with_constant = len(names.given(node)) < 2
        yield "divide" if kind == "Div" else "constant" if with_constant else "elementwise", moved
    else:
        yield TERM_OF.get(kind, "other"), moved


def _padded(shape: tuple[int, ...]) -> int:
    """Return the elements of a tensor of `shape`; with four axes, axis 1 (channels) is rounded up to whole blocks."""
    if len(shape) != 4:
        return prod(shape)
    return shape[0] * _up(shape[1], ACTIVATION_BLOCK) * shape[2] * shape[3]


def _up(count: int, block: int) -> int:
    return -(-count // block) * block


def _products(node: Any, shapes: Shapes) -> Iterator[tuple[str, float]]:
    """Yield (term, amount) of an operator's products and of the elements moved for them; nothing without products."""
    if node.op_type not in WITH_PRODUCTS:
        return
    source, out = shapes[node.input[0]], shapes[first_result(node)]
    moved = _padded(source) + _padded(out)
    if node.op_type in CONVOLUTIONS:
        yield from _convolution(node, source, shapes[node.input[CONVOLUTIONS[node.op_type]]], out, moved)
        return
    product = product_of(node, [shapes.get(name, ()) for name in node.input], out)
    if product is None or len(source) < 2:
        return
    yield "moved", moved
    yield "convolution", product.macs * _padding(product.c_in, INPUT_BLOCK) * _padding(product.c_out, OUTPUT_BLOCK)


def _padding(count: int, block: int) -> float:
    """Return `count` channels rounded up to whole blocks, divided by `count`."""
    return _up(count, block) / count


def _convolution(node: Any, source: Shape, weight: Shape, out: Shape, moved: int) -> Iterator[tuple[str, float]]:
    """Yield (term of `TERMS`, amount) of a convolution: moved elements, and multiplications.

    The multiplications count channels rounded up to whole blocks.

    `source`, `out`: shapes (N, C, ...). `weight`: shape with the kernel's sides from axis 2 on.
    `moved`: elements read and written, with channels in whole blocks.
    """
    attributes = {a.name: a for a in node.attribute}
    groups = attributes["group"].i if "group" in attributes else 1
    yield "moved_depthwise" if groups == source[1] > 1 else "moved", moved
    stride, dilation = (max(attributes[k].ints) if k in attributes else 1 for k in ("strides", "dilations"))
    places = source[0] * prod(source[2:] if node.op_type == "ConvTranspose" else out[2:]) * prod(weight[2:])
    if groups > 1:
        yield from _grouped(places, source[1], out[1], groups, stride)
        return
    macs = places * _up(source[1], INPUT_BLOCK) * _up(out[1], OUTPUT_BLOCK)
    picture = source[1] <= PICTURE_CHANNELS
    yield "first" if picture else "convolution", macs
    if stride > 1 and not picture and _kind(node) == "Conv":
        yield "stride", macs
    if dilation > 1:
        yield "dilation", macs


def _grouped(places: int, c_in: int, c_out: int, groups: int, stride: int) -> Iterator[tuple[str, float]]:
    """Yield (term, amount) of a convolution in groups.

    `places`: number of output positions times number of kernel positions.
    """
    if c_in > groups:
        yield "grouped", places * _up(c_in // groups, INPUT_BLOCK) * _up(c_out, OUTPUT_BLOCK)
        return
    yield "depthwise", places * _up(c_out, OUTPUT_BLOCK)
    if stride > 1:
        yield "depthwise_stride", places * _up(c_out, OUTPUT_BLOCK)
