"""Checks the tensors and connections of a graph from a stranger's file, and gives every tensor a static shape.

A tensor's data must have the length that its shape states. Only small data is kept, such as sizes and axes, from which
shapes are inferred. Data outside the file is never opened. Every tensor must be made exactly once, and the operators
must form no circle; they are sorted if a tensor is read before it is made.

A shape is inferred; for an operator that ONNX does not know, the file states it. A shape that stays unknown is an error
that names the first operator whose result has it. Exporters compute sizes and axes by chains of operators, for a
flattening, a repeat or an attention. ONNX's inference cannot follow these chains, so `fold` replaces their operators by
values. `fold` checks the size of a value before it computes the value.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from graphlib import CycleError, TopologicalSorter
from math import prod
from pathlib import Path

import numpy as np
import onnx
from numpy.typing import NDArray
from onnx import AttributeProto, TensorProto, helper, numpy_helper
from onnx.reference import ReferenceEvaluator

from trilane.hw_profiles.network_work import constant_tensors
from trilane.hw_profiles.operators import CONVOLUTIONS, OF_SHAPES, Shape
from trilane.unexpected_value import UnexpectedValue

MAX_TENSOR_BYTES = 1 << 30
#: Largest number of elements with which a tensor keeps its data.
KEPT_ELEMENTS = 1024

_BITS = {
    **dict.fromkeys((TensorProto.FLOAT, TensorProto.INT32, TensorProto.UINT32), 32),
    **dict.fromkeys((TensorProto.UINT8, TensorProto.INT8, TensorProto.BOOL), 8),
    **dict.fromkeys((TensorProto.UINT16, TensorProto.INT16, TensorProto.FLOAT16, TensorProto.BFLOAT16), 16),
    **dict.fromkeys((TensorProto.INT64, TensorProto.UINT64, TensorProto.DOUBLE, TensorProto.COMPLEX64), 64),
    **dict.fromkeys((TensorProto.FLOAT8E4M3FN, TensorProto.FLOAT8E4M3FNUZ, TensorProto.FLOAT8E5M2), 8),
    **dict.fromkeys((TensorProto.FLOAT8E5M2FNUZ,), 8),
    **dict.fromkeys((TensorProto.UINT4, TensorProto.INT4, TensorProto.FLOAT4E2M1), 4),
    TensorProto.COMPLEX128: 128,
}
_FIELDS = ("float_data", "int32_data", "int64_data", "double_data", "uint64_data")

CUT_SHORT = "copy or export it again: it may be cut short"
EXPORT_AGAIN = "export it again, and check it with onnx.checker.check_model"
_KINDS = {"sequence_type": "a sequence", "map_type": "a map", "optional_type": "an optional value"}


def type_name(kind: int) -> str:
    """Return ONNX's name of the element type number `kind` in small letters, such as `float16`."""
    return str(TensorProto.DataType.Name(kind)).lower() if kind in TensorProto.DataType.values() else f"type {kind}"


def bytes_of(shape: tuple[int, ...], kind: int) -> int:
    """Return the size of a tensor in bytes. Raises UnexpectedValue if its elements are no numbers.

    `shape`, `kind`: as in `check_size`.
    """
    if kind not in _BITS:
        remedy = "leave the part of the graph that handles text to the program"
        raise UnexpectedValue(f"elements of type {type_name(kind)}", "numbers", remedy)
    return -(-prod(shape) * _BITS[kind] // 8)


def is_ordinary(shape: tuple[int, ...], kind: int) -> bool:
    """Return whether a tensor of `shape` and element type `kind` passes `check_size`."""
    return prod(shape) * _BITS.get(kind, 8 * MAX_TENSOR_BYTES + 1) <= 8 * MAX_TENSOR_BYTES


def check_size(shape: tuple[int, ...], kind: int, what: str) -> None:
    """Raise UnexpectedValue if a tensor is too large or its elements are no numbers.

    `shape`: shape of the tensor.
    `kind`: ONNX element type of the tensor.
    `what`: name of the tensor in the message.
    """
    try:
        size = bytes_of(shape, kind)
    except UnexpectedValue as error:
        raise UnexpectedValue(f"{what} with {error.found}", error.expected, error.remedy) from None
    if size > MAX_TENSOR_BYTES:
        text = "x".join(map(str, shape))
        expected = f"at most {MAX_TENSOR_BYTES >> 30} GiB, more than any unit of a phone takes"
        raise UnexpectedValue(f"{what} of {text} {type_name(kind)}, {size / 2**30:.3g} GiB", expected)


def forget_data(tensor: TensorProto, folder: Path) -> None:
    """Check a tensor of a file, and drop its data if the tensor has more than KEPT_ELEMENTS elements.

    `tensor`: tensor of the file; it is changed in place.
    `folder`: folder of the file.

    Raises UnexpectedValue for a negative or too large shape, for data of another length than the shape states, or for
    data outside the folder.
    """
    what = f"tensor {tensor.name!r}"
    shape = tuple(tensor.dims)
    if any(size < 0 for size in shape):
        raise UnexpectedValue(f"{what} of {'x'.join(map(str, shape))}", "sizes of 0 and more")
    if tensor.data_type == TensorProto.STRING:
        _forget(tensor)
        return
    check_size(shape, tensor.data_type, what)
    if tensor.data_location == TensorProto.EXTERNAL:
        _check_inside(tensor, folder)
        _forget(tensor)
        return
    _check_length(tensor, bytes_of(shape, tensor.data_type), what)
    if prod(shape) > KEPT_ELEMENTS:
        _forget(tensor)


def _check_length(tensor: TensorProto, claimed: int, what: str) -> None:
    if tensor.HasField("raw_data"):
        held, unit = len(tensor.raw_data), "bytes"
    else:
        held, unit = sum(len(getattr(tensor, field)) for field in _FIELDS), "numbers"
        # Two 4-bit elements share one entry, and a complex number has two.
        pairs = tensor.data_type in (TensorProto.COMPLEX64, TensorProto.COMPLEX128)
        claimed = claimed if _BITS[tensor.data_type] < 8 else prod(tensor.dims) * (2 if pairs else 1)
    if held != claimed:
        raise UnexpectedValue(f"{what} with {held} {unit}", f"the {claimed} that its shape claims", CUT_SHORT)


def _check_inside(tensor: TensorProto, folder: Path) -> None:
    location = next((entry.value for entry in tensor.external_data if entry.key == "location"), "")
    try:
        inside = folder.resolve() in (folder / location).resolve().parents
    except (OSError, ValueError):
        inside = False
    if not inside:
        found = f"tensor {tensor.name!r} kept in {location!r}"
        raise UnexpectedValue(found, "data in the folder of the file", "move it there and save the file again")


def _forget(tensor: TensorProto) -> None:
    """Drop everything of a tensor except name, type and shape."""
    tensor.CopyFrom(TensorProto(name=tensor.name, data_type=tensor.data_type, dims=tensor.dims))


def called(node: onnx.NodeProto) -> str:
    """Return the text by which messages name an operator: its type, and its name or first result."""
    kind = f"{node.domain}:{node.op_type}" if node.domain not in ("", "ai.onnx") else node.op_type
    return f"{kind} {node.name!r}" if node.name else f"{kind} that makes {next(iter(node.output), '')!r}"


def check_structure(graph: onnx.GraphProto) -> None:
    """Raise UnexpectedValue if parts of the graph cannot be predicted.

    Errors are: an operator that contains a graph, sparse weights, no outputs, an input or output that is no tensor, and
    a tensor that is missing or made several times.
    """
    _check_kinds(graph)
    made = Counter(_made(graph))
    twice = [name for name, times in made.items() if times > 1]
    if twice:
        raise UnexpectedValue(f"tensor {twice[0]!r} made {made[twice[0]]} times", "each made once", EXPORT_AGAIN)
    for node in graph.node:
        for name in node.input:
            if name and name not in made:
                raise UnexpectedValue(f"tensor {name!r}, which {called(node)} reads, made nowhere", "it", EXPORT_AGAIN)
    for output in graph.output:
        if output.name not in made:
            raise UnexpectedValue(f"output {output.name!r} made nowhere", "an operator that makes it", EXPORT_AGAIN)


def _check_kinds(graph: onnx.GraphProto) -> None:
    for node in graph.node:
        if any(a.type in (AttributeProto.GRAPH, AttributeProto.GRAPHS) for a in node.attribute):
            remedy = "export what runs in every frame: how often the rest does is not in the file"
            raise UnexpectedValue(f"{called(node)}, which has graphs of its own", "a graph without branches", remedy)
    if graph.sparse_initializer:
        raise UnexpectedValue("sparse weights", "dense ones", "export it without sparse tensors")
    for value in (*graph.input, *graph.output):
        kind = value.type.WhichOneof("value") or ""
        if kind != "tensor_type":
            raise UnexpectedValue(f"{value.name!r}, {_KINDS.get(kind, 'without a type')}", "tensors of numbers")
    if not graph.output:
        raise UnexpectedValue("no outputs", "at least one", EXPORT_AGAIN)


def _made(graph: onnx.GraphProto) -> Iterator[str]:
    """Yield the names of the tensors that `graph` makes, as often as it makes each: weights, inputs and results.

    An input with the name of a weight only declares this weight, and is not yielded.
    """
    weights = [tensor.name for tensor in graph.initializer]
    yield from weights
    yield from (value.name for value in graph.input if value.name not in set(weights))
    yield from (name for node in graph.node for name in node.output if name)


def in_order(graph: onnx.GraphProto) -> None:
    """Sort the operators so that each comes after all that it reads, and drop operators that no output depends on.

    `graph`: graph that is changed in place; if its operators are in order, their order stays.

    Raises UnexpectedValue for a circle, or if no output depends on an operator.
    """
    maker = {name: index for index, node in enumerate(graph.node) for name in node.output if name}
    before = [{maker[name] for name in node.input if name in maker} for node in graph.node]
    order = list(range(len(before)))
    if any(source >= index for index, sources in enumerate(before) for source in sources):
        try:
            order = list(TopologicalSorter(dict(enumerate(before))).static_order())
        except CycleError as error:
            circle = [called(graph.node[index]) for index in error.args[1][:4]]
            raise UnexpectedValue(f"a circle: {' <- '.join(circle)}", "none", EXPORT_AGAIN) from None
    needed = {maker[output.name] for output in graph.output if output.name in maker}
    for index in reversed(order):
        if index in needed:
            needed |= before[index]
    if not needed:
        raise UnexpectedValue("outputs that are inputs or weights", "operators that make them", EXPORT_AGAIN)
    nodes = [graph.node[index] for index in order if index in needed]
    if len(nodes) < len(before) or order != sorted(order):
        del graph.node[:]
        graph.node.extend(nodes)


LONGEST_FOUND = 240
SIZES_INSIDE = "save it with small tensors inside: onnx.save(..., size_threshold=1024)"
#: Operators whose result has the shape of their first input, although ONNX does not infer it. For the inference they
#: are replaced by an operator with the same rule for shapes and types.
STAND_INS = {
    ("", "GroupNormalization"): "Identity",
    ("com.microsoft", "BiasGelu"): "Identity",
    ("com.microsoft", "FastGelu"): "Identity",
    ("com.microsoft", "Gelu"): "Identity",
    ("com.microsoft", "QuickGelu"): "Identity",
    ("com.microsoft", "SkipLayerNormalization"): "Identity",
    ("com.microsoft", "QuantizeLinear"): "QuantizeLinear",
    ("com.microsoft", "DequantizeLinear"): "DequantizeLinear",
}

Values = dict[str, NDArray[np.generic]]

#: Operators whose results have the common shape of all their inputs.
_BROADCAST = frozenset(
    (
        *("Add", "Sub", "Mul", "Div", "Mod", "Min", "Max", "Neg", "Abs", "Floor", "Ceil", "Round", "Sqrt", "Pow"),
        *("Equal", "Greater", "GreaterOrEqual", "Less", "LessOrEqual", "And", "Or", "Not", "Where", "Cast"),
    )
)
#: Operators whose results are no larger than the product of two inputs.
_BOUNDED = frozenset(
    (
        *("Gather", "Slice", "Squeeze", "Unsqueeze", "Reshape", "Transpose", "Identity", "Split"),
        *("ReduceProd", "ReduceSum", "ReduceMax", "ReduceMin"),
    )
)
#: Exceptions that the evaluator raises for a damaged chain of operators.
_FAILURES = (ArithmeticError, AttributeError, LookupError, RuntimeError, TypeError, ValueError)


def with_shapes(model: onnx.ModelProto, given: Mapping[str, Shape]) -> onnx.ModelProto:
    """Return `model` with the shape of every tensor in its value_info.

    `model`: model of the graph; it is changed in place.
    `given`: shapes of inputs by name, in place of the file's shapes.

    Raises UnexpectedValue for a shape that is unknown, contradictory or too large.
    """
    weights = {tensor.name for tensor in model.graph.initializer}
    inputs = [value for value in model.graph.input if value.name not in weights]
    _give(model.graph, inputs, given)
    for value in inputs:
        _check_input(value)
    while True:
        inferred = _inferred(model)
        shapes = _known(model.graph, inputs, inferred)
        is_known = all(name in shapes for node in model.graph.node for name in node.output if name)
        if is_known or not fold(model, shapes):
            break
    _check_all(model.graph, inferred, shapes)
    _check_convolutions(model.graph, shapes)
    del model.graph.value_info[:]
    model.graph.value_info.extend(inferred.values())
    del model.graph.input[:]
    model.graph.input.extend(inputs)
    for output in model.graph.output:
        output.CopyFrom(inferred.get(output.name, output))
    return model


def _known(
    graph: onnx.GraphProto, inputs: Sequence[onnx.ValueInfoProto], inferred: Mapping[str, onnx.ValueInfoProto]
) -> dict[str, Shape]:
    """Return the static shape of each tensor that has one, by name. `inferred`: result of `_inferred`."""
    shapes = {tensor.name: tuple(tensor.dims) for tensor in graph.initializer}
    values = (*inputs, *inferred.values())
    return shapes | {value.name: sizes for value in values if (sizes := _sizes(value, least=0)) is not None}


def _give(graph: onnx.GraphProto, inputs: Sequence[onnx.ValueInfoProto], given: Mapping[str, Shape]) -> None:
    """Set the shapes of `inputs` to `given`, by name, and drop the file's other shapes, which may be wrong now."""
    changed = [value for value in inputs if value.name in given]
    for value in changed:
        kind = value.type.tensor_type
        if kind.HasField("shape") and len(kind.shape.dim) != len(given[value.name]):
            shown = "x".join(map(str, given[value.name]))
            raise UnexpectedValue(f"--input-shape {value.name}={shown}", f"{len(kind.shape.dim)} sizes", _shown(value))
        value.CopyFrom(onnx.helper.make_tensor_value_info(value.name, kind.elem_type, given[value.name]))
    if changed:
        del graph.value_info[:]
        for output in graph.output:
            output.type.tensor_type.ClearField("shape")


def _check_input(value: onnx.ValueInfoProto) -> None:
    kind = value.type.tensor_type
    sizes = _sizes(value)
    if sizes is None:
        known = [str(d.dim_value) if d.dim_value > 0 else "N" for d in kind.shape.dim]
        shape = "x".join(["1", *known[1:]] if known[:1] == ["N"] else known) or "1x3x224x224"
        remedy = f"give it: --input-shape {value.name}={shape}" + (", a number for each N" if "N" in shape else "")
        raise UnexpectedValue(f"input {_shown(value)}", "fixed sizes of 1 and more", remedy)
    check_size(sizes, kind.elem_type, f"input {value.name!r}")


def _inferred(model: onnx.ModelProto) -> dict[str, onnx.ValueInfoProto]:
    """Return the type and shape that ONNX infers for each tensor, by name."""
    looked_at = model
    if any((node.domain, node.op_type) in STAND_INS for node in model.graph.node):
        looked_at = onnx.ModelProto()
        looked_at.CopyFrom(model)
        for node in looked_at.graph.node:
            if stand_in := STAND_INS.get((node.domain, node.op_type)):
                inputs = node.input[:1] if stand_in == "Identity" else node.input
                node.CopyFrom(helper.make_node(stand_in, inputs, node.output[:1], node.name))
    try:
        result = onnx.shape_inference.infer_shapes(looked_at, strict_mode=True, data_prop=True)
    except (onnx.shape_inference.InferenceError, RuntimeError, ValueError) as error:
        found = " ".join(str(error).replace("Inference error(s):", "").split())[:LONGEST_FOUND]
        remedy = SIZES_INSIDE if _keeps_sizes_outside(model.graph) else "export it again"
        raise UnexpectedValue(f"shapes that do not fit: {found}", "operators whose inputs fit", remedy) from None
    return {value.name: value for value in (*result.graph.value_info, *result.graph.output)}


def _check_all(
    graph: onnx.GraphProto, inferred: Mapping[str, onnx.ValueInfoProto], shapes: Mapping[str, Shape]
) -> None:
    """Check that every result has a shape; only a result of constants may be empty."""
    constants = constant_tensors(graph)
    for node in graph.node:
        for name in node.output:
            if not name or (name in constants and name in shapes):
                continue
            sizes = shapes.get(name, (0,))
            if 0 in sizes:
                raise _unknown(graph, node, inferred.get(name), name)
            kind = inferred[name].type.tensor_type.elem_type
            if not is_ordinary(sizes, kind):
                check_size(sizes, kind, f"the result of {called(node)}")


def _check_convolutions(graph: onnx.GraphProto, shapes: Mapping[str, Shape]) -> None:
    """Check that a weight's channels fit the input and the output of its convolution, which ONNX does not check."""
    for node in graph.node:
        if (at := CONVOLUTIONS.get(node.op_type)) is None:
            continue
        if len(node.input) <= at:
            raise UnexpectedValue(f"{called(node)} without a weight", "one", EXPORT_AGAIN)
        source, weight, result = (shapes[name] for name in (node.input[0], node.input[at], node.output[0]))
        groups = next((a.i for a in node.attribute if a.name == "group"), 1)
        if not _channels_fit(node.op_type == "ConvTranspose", source, weight, result, groups):
            sizes = ", ".join("x".join(map(str, shape)) for shape in (source, weight, result))
            found = f"{called(node)} from {sizes.replace(', ', ' by ', 1).replace(', ', ' to ')} in {groups} groups"
            raise UnexpectedValue(found, "channels that fit", EXPORT_AGAIN)


def _channels_fit(transposed: bool, source: Shape, weight: Shape, result: Shape, groups: int) -> bool:
    """Return whether the channels of a convolution fit.

    `source`, `result`: shapes (batch, channels, ...) of its input and its output.
    `weight`: shape (out, in / groups, ...); for a transposed convolution (in, out / groups, ...).
    """
    if not (groups > 0 and len(source) == len(weight) == len(result) > 2):
        return False
    if transposed:
        return weight[0] == source[1] and weight[1] * groups == result[1] and source[1] % groups == 0
    return weight[0] == result[1] and weight[1] * groups == source[1] and result[1] % groups == 0 and min(weight) > 0


def _unknown(
    graph: onnx.GraphProto, node: onnx.NodeProto, value: onnx.ValueInfoProto | None, name: str
) -> UnexpectedValue:
    found = f"no static shape for {_shown(value) if value is not None else repr(name)}, made by {called(node)}"
    if _keeps_sizes_outside(graph):
        remedy = SIZES_INSIDE
    elif not onnx.defs.has(node.op_type, node.domain):
        remedy = "ONNX has no such operator: state the shape of its result in the graph's value_info"
    else:
        remedy = "export it with fixed sizes; a result whose size depends on the picture cannot be priced"
    return UnexpectedValue(found, "fixed sizes of 1 and more", remedy)


def _keeps_sizes_outside(graph: onnx.GraphProto) -> bool:
    """Return whether a small tensor of integers, such as sizes and axes, has its data in another file."""
    return any(
        tensor.data_type == TensorProto.INT64 and 0 < prod(tensor.dims) <= KEPT_ELEMENTS
        for tensor in graph.initializer
        if not tensor.raw_data and not tensor.int64_data
    )


def _sizes(value: onnx.ValueInfoProto, least: int = 1) -> Shape | None:
    """Return the static shape of the tensor `value`; None if it has none, or if a size is below `least`."""
    kind = value.type.tensor_type
    if not kind.HasField("shape"):
        return None
    sizes = tuple([dim.dim_value for dim in kind.shape.dim])  # a size that is not stated is read as 0
    if min(sizes, default=1) < least or (0 in sizes and not all(dim.HasField("dim_value") for dim in kind.shape.dim)):
        return None
    return sizes


def _shown(value: onnx.ValueInfoProto) -> str:
    kind = value.type.tensor_type
    if not kind.HasField("shape"):
        return f"{value.name!r} of unknown shape"
    sizes = (str(d.dim_value) if d.HasField("dim_value") else d.dim_param or "?" for d in kind.shape.dim)
    return f"{value.name!r} of [{', '.join(sizes)}]"


def fold(model: onnx.ModelProto, shapes: Mapping[str, tuple[int, ...]]) -> bool:
    """Replace the operators that can be computed now with their results. Return whether there were any.

    `model`: model of the graph; it is changed in place.
    `shapes`: shape of each tensor that has a known one, by name.
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
    """Return the values of a small tensor as one array; an empty list if they were dropped or are in another file."""
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
    """Return the values that `node` computes; an empty list if an input is unknown, or a result may be too large."""
    if node.domain not in ("", "ai.onnx"):
        return []
    if node.op_type in OF_SHAPES and node.input and node.input[0] in shapes:
        return _of_shape(node, shapes[node.input[0]])
    inputs = [known.get(name) for name in node.input if name]
    values = [value for value in inputs if value is not None]
    if len(values) < len(inputs) or not _is_small(node, values):
        return []
    feeds = dict(zip((name for name in node.input if name), values, strict=True))
    given = [
        helper.make_tensor_value_info(name, helper.np_dtype_to_tensor_dtype(value.dtype), value.shape)
        for name, value in feeds.items()
    ]
    ends = [helper.make_empty_tensor_value_info(name) for name in node.output]
    graph = helper.make_graph([node], "one", given, ends)
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
    """Return whether the result of `node` has a known bound on its size, and is small. `values`: its inputs."""
    if node.op_type == "Constant":
        return all(prod(a.t.dims) <= KEPT_ELEMENTS for a in node.attribute if a.name == "value")
    if node.op_type == "Range" and len(values) == 3 and all(value.size == 1 for value in values):
        first, last, step = (float(value.item()) for value in values)
        return step != 0 and abs(last - first) <= KEPT_ELEMENTS * abs(step)
    if node.op_type in ("ConstantOfShape", "Expand") and values:
        sizes = values[-1].astype(np.int64).ravel().tolist()
        return all(size >= 0 for size in sizes) and prod(sizes) * values[0].size <= KEPT_ELEMENTS
    if node.op_type == "Concat":
        return sum(value.size for value in values) <= KEPT_ELEMENTS
    if node.op_type in _BROADCAST and values:
        try:
            return prod(np.broadcast_shapes(*(value.shape for value in values))) <= KEPT_ELEMENTS
        except ValueError:  # shapes that do not fit, or a result that is too large for NumPy
            return False
    return node.op_type in _BOUNDED and bool(values)
