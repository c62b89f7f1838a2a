"""Which kind of work each ONNX operator is.

Rule: tables and nothing else. An operator that is in none of them is priced by what it moves, and named.
"""

from __future__ import annotations

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


def has_rule(op_type: str, domain: str = "") -> bool:
    """Whether the tables know the ONNX operator `op_type` of `domain`."""
    return domain in DOMAINS and op_type in _KNOWN
