"""Replaces what follows from constants and known shapes by its values, where ONNX's inference does not see through it.

Rule: only operators that reckon with sizes and axes, and only on few numbers: what they would make is bounded before it
is made. Exporters write such chains for a flattening, a repeat or an attention.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from math import prod

import numpy as np
import onnx
from numpy.typing import NDArray
from onnx import helper, numpy_helper
from onnx.reference import ReferenceEvaluator

from trilane.hw_profiles.graph_tensors import KEPT_ELEMENTS
from trilane.hw_profiles.operator_kinds import OF_SHAPES

Values = dict[str, NDArray[np.generic]]

#: Operators whose results are no larger than their inputs together, or than the product of two of them.
_BOUNDED = frozenset(
    (
        *("Add", "Sub", "Mul", "Div", "Mod", "Min", "Max", "Neg", "Abs", "Floor", "Ceil", "Round", "Sqrt", "Pow"),
        *("Equal", "Greater", "GreaterOrEqual", "Less", "LessOrEqual", "And", "Or", "Not", "Where", "Cast"),
        *("Concat", "Gather", "Slice", "Squeeze", "Unsqueeze", "Reshape", "Transpose", "Identity", "Split"),
        *("ReduceProd", "ReduceSum", "ReduceMax", "ReduceMin"),
    )
)
#: What a damaged chain makes the evaluator raise.
_FAILURES = (ArithmeticError, AttributeError, LookupError, RuntimeError, TypeError, ValueError)


def fold(model: onnx.ModelProto, shapes: Mapping[str, tuple[int, ...]]) -> bool:
    """Put values in the place of operators that only reckon with known numbers. Whether there were such operators.

    `model`: is changed.
    `shapes`: of the tensors whose shape is known.
    """
    graph = model.graph
    known: Values = {}
    for tensor in graph.initializer:
        if prod(tensor.dims) <= KEPT_ELEMENTS:
            _keep(known, [tensor.name], _read(tensor))
    left, folded = list[onnx.NodeProto](), Values()
    for node in graph.node:
        found = _results(node, known, shapes, model.opset_import)
        _keep(known, node.output, found)
        if found and node.op_type != "Constant":
            folded.update(zip(node.output, found, strict=False))
        else:
            left.append(node)
    if folded:
        del graph.node[:]
        graph.node.extend(left)
        graph.initializer.extend(numpy_helper.from_array(value, name) for name, value in folded.items())
    return bool(folded)


def _keep(known: Values, names: Sequence[str], values: Sequence[NDArray[np.generic]]) -> None:
    known.update({name: value for name, value in zip(names, values, strict=False) if value.size <= KEPT_ELEMENTS})


def _read(tensor: onnx.TensorProto) -> list[NDArray[np.generic]]:
    """The values of a small tensor; nothing when they were forgotten, or are kept outside the file."""
    try:
        return [numpy_helper.to_array(tensor)]
    except _FAILURES:
        return []


def _results(
    node: onnx.NodeProto,
    known: Values,
    shapes: Mapping[str, tuple[int, ...]],
    opsets: Sequence[onnx.OperatorSetIdProto],
) -> list[NDArray[np.generic]]:
    """What `node` makes; nothing where it is not to be reckoned."""
    if node.domain not in ("", "ai.onnx"):
        return []
    if node.op_type in OF_SHAPES and node.input and node.input[0] in shapes:
        return _of_shape(node, shapes[node.input[0]])
    inputs = [known.get(name) for name in node.input if name]
    values = [value for value in inputs if value is not None]
    if len(values) < len(inputs) or not _is_small(node, values):
        return []
    feeds = dict(zip((name for name in node.input if name), values, strict=True))
    graph = helper.make_graph([node], "one", [_info(name, value) for name, value in feeds.items()], _ends(node))
    try:
        with np.errstate(all="ignore"):
            found = ReferenceEvaluator(helper.make_model(graph, opset_imports=opsets)).run(None, feeds)
    except _FAILURES:
        return []
    results = [np.asarray(value) for value in found]
    return results if all(value.size <= KEPT_ELEMENTS for value in results) else []


def _of_shape(node: onnx.NodeProto, shape: tuple[int, ...]) -> list[NDArray[np.generic]]:
    bounds = {a.name: a.i for a in node.attribute}
    if node.op_type == "Size":
        return [np.array(prod(shape), np.int64)]
    return [np.array(shape[bounds.get("start", 0) : bounds.get("end", len(shape))], np.int64)]


def _is_small(node: onnx.NodeProto, values: Sequence[NDArray[np.generic]]) -> bool:
    """Whether what `node` makes of `values` is bounded, and small."""
    if node.op_type == "Constant":
        return all(prod(a.t.dims) <= KEPT_ELEMENTS for a in node.attribute if a.name == "value")
    if node.op_type == "Range" and len(values) == 3 and all(value.size == 1 for value in values):
        first, last, step = (float(value.item()) for value in values)
        return step != 0 and abs(last - first) <= KEPT_ELEMENTS * abs(step)
    if node.op_type in ("ConstantOfShape", "Expand") and values:
        sizes = values[-1].astype(np.int64).ravel().tolist()
        return all(size >= 0 for size in sizes) and prod(sizes) * values[0].size <= KEPT_ELEMENTS
    return node.op_type in _BOUNDED and bool(values)


def _info(name: str, value: NDArray[np.generic]) -> onnx.ValueInfoProto:
    return helper.make_tensor_value_info(name, helper.np_dtype_to_tensor_dtype(value.dtype), value.shape)


def _ends(node: onnx.NodeProto) -> list[onnx.ValueInfoProto]:
    return [helper.make_empty_tensor_value_info(name) for name in node.output]
