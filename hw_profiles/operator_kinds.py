"""Tables of ONNX operators: the kind of work of each operator, and the products of those that multiply tensors.

An operator that no table names is priced by the elements that it moves, and reports name it. The count of a product
follows from shapes and attributes alone; `network_work.py` counts convolutions.
"""

from __future__ import annotations

from math import prod
from typing import Any, NamedTuple

ARITHMETIC = ("convolution", "pointwise", "depthwise")
TRAFFIC = ("normalisation", "resize", "elementwise", "permute")
CLASSES = ARITHMETIC + TRAFFIC

#: Operators that cost nothing: a runtime folds them into the convolution before them, or they only rename a tensor. A
#: batch normalisation that stands behind no convolution does cost something.
FOLDED = frozenset(
    ("Relu", "Clip", "Sigmoid", "BatchNormalization", "QuantizeLinear", "DequantizeLinear", "Identity")
) | frozenset(("Reshape", "Flatten", "Squeeze", "Unsqueeze", "Constant", "Dropout"))
#: Operators whose result is known once the shapes are: a runtime folds them with all that follows from them alone.
OF_SHAPES = frozenset(["Shape", "Size"])
#: Convolutions, and other products of two tensors. Each -> where its second factor is among its inputs.
CONVOLUTIONS = {"Conv": 1, "ConvTranspose": 1, "ConvInteger": 1, "DeformConv": 1, "FusedConv": 1, "QLinearConv": 3}
PRODUCTS = {"Gemm": 1, "MatMul": 1, "MatMulInteger": 1, "QLinearMatMul": 3, "FusedMatMul": 1, "Einsum": 1}
#: Recurrent layers: their inputs 1 and 2 are weights, with each of which every step's vector is multiplied.
RECURRENT = frozenset(["LSTM", "GRU", "RNN"])
#: Normalisations that read their input twice: once for its mean and variance and once to apply them.
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
#: ONNX operator -> its class, for all but products.
KIND_OF = {operator: kind for kind, operators in _BY_CLASS.items() for operator in operators}
#: Operators whose constant inputs are weights. The others' say where and how much: axes, sizes, indices.
WEIGHTED = frozenset(
    [*CONVOLUTIONS, *PRODUCTS, *RECURRENT, *STATISTICS, *_BY_CLASS["elementwise"], "BatchNormalization", "Gather"]
)
#: Permutations between channels first and channels last. They cost nothing: the units work with channels last, and
#: these operators are in the file only because its order is the other one.
LAYOUT_CHANGES = ((0, 3, 1, 2), (0, 2, 3, 1))
#: Where operators are defined whose names mean what the tables say: ONNX itself and ONNX Runtime.
DOMAINS = ("", "ai.onnx", "com.microsoft")
#: Operators that hold a network which was compiled for a chip: what it computes is not in the file.
COMPILED = frozenset(["EPContext"])
#: What an operator without a rule is priced as: it reads its inputs and writes its results.
UNKNOWN = "elementwise"

_KNOWN = frozenset([*FOLDED, *OF_SHAPES, *CONVOLUTIONS, *PRODUCTS, *RECURRENT, *KIND_OF])

Shape = tuple[int, ...]


def has_rule(op_type: str, domain: str = "") -> bool:
    """Return whether the tables know the ONNX operator `op_type` of `domain`."""
    return domain in DOMAINS and op_type in _KNOWN


class Product(NamedTuple):
    """Counts of a product.

    `macs`: multiply-accumulates. `c_in`: how many of them each result sums. `c_out`: how many results share a factor.
    """

    macs: int
    c_in: int
    c_out: int


def product_of(node: Any, shapes: list[Shape], out: Shape) -> Product | None:
    """Return what `node` multiplies; None where its shapes do not tell.

    `node`: operator of PRODUCTS or RECURRENT.
    `shapes`: shape of each input.
    `out`: shape of its first result.
    """
    if node.op_type in RECURRENT:
        return _recurrent(shapes) if [len(shape) for shape in shapes[:3]] == [3, 3, 3] else None
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


def _recurrent(shapes: list[Shape]) -> Product:
    """Count every step of every sequence times all weights.

    Shapes: X (steps, sequences, size), W and R (directions, gates, size).
    """
    steps, weights, recurrence = shapes[0], shapes[1], shapes[2]
    macs = prod(steps[:2]) * (prod(weights) + prod(recurrence))
    return Product(macs, steps[2], weights[1])


def _einsum(node: Any, shapes: list[Shape]) -> Product | None:
    """Count one product for every combination of all indices.

    An equation with an ellipsis is not looked into.
    """
    equation = next((a.s.decode() for a in node.attribute if a.name == "equation"), "").replace(" ", "")
    sources, _, result = equation.partition("->")
    terms = sources.split(",")
    if (
        "." in equation
        or len(terms) != len(shapes)
        or any(len(t) != len(s) for t, s in zip(terms, shapes, strict=True))
    ):
        return None
    sizes = {
        index: size for term, shape in zip(terms, shapes, strict=True) for index, size in zip(term, shape, strict=True)
    }
    summed = set(sizes) - set(result)
    return Product(
        prod(sizes.values()),
        prod(sizes[index] for index in summed),
        prod(sizes[index] for index in set(terms[-1]) - summed),
    )
