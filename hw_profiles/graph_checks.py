"""Checks the parts of an ONNX graph from a stranger's file: the data of its tensors, and how its operators connect.

A tensor's data must be as long as its shape claims. Only small data is kept (sizes, axes and the like, from which
shapes follow), and data outside the file is never opened. Every tensor must be made once, before an operator reads it,
and the operators must form no circle. Shapes come later, in `graph_shapes.py`.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from graphlib import CycleError, TopologicalSorter
from math import prod
from pathlib import Path

import onnx
from onnx import AttributeProto, TensorProto

from trilane.unexpected_value import UnexpectedValue

MAX_TENSOR_BYTES = 1 << 30
#: Elements up to which a tensor keeps its data.
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
    """Return the name of an element type, as ONNX writes it in small letters."""
    return str(TensorProto.DataType.Name(kind)).lower() if kind in TensorProto.DataType.values() else f"type {kind}"


def bytes_of(shape: tuple[int, ...], kind: int) -> int:
    """Return bytes of a tensor. Raises UnexpectedValue when its elements are no numbers."""
    if kind not in _BITS:
        remedy = "leave the part of the graph that handles text to the program"
        raise UnexpectedValue(f"elements of type {type_name(kind)}", "numbers", remedy)
    return -(-prod(shape) * _BITS[kind] // 8)


def is_ordinary(shape: tuple[int, ...], kind: int) -> bool:
    """Return whether `check_size` would let a tensor pass: its elements are numbers and it is not too large."""
    return prod(shape) * _BITS.get(kind, 8 * MAX_TENSOR_BYTES + 1) <= 8 * MAX_TENSOR_BYTES


def check_size(shape: tuple[int, ...], kind: int, what: str) -> None:
    """Raise UnexpectedValue when a tensor is too large or its elements are no numbers.

    `shape`: shape of the tensor.
    `kind`: its ONNX element type.
    `what`: what the message calls it.
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
    """Check a tensor of a file, and drop its data unless it is small.

    `tensor`: tensor of the file; it is changed in place.
    `folder`: folder of the file.
    Raises UnexpectedValue when the data is not as long as the shape claims, or is kept outside the folder.
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
        claimed = _entries(tensor, claimed)
    if held != claimed:
        raise UnexpectedValue(f"{what} with {held} {unit}", f"the {claimed} that its shape claims", CUT_SHORT)


def _entries(tensor: TensorProto, size: int) -> int:
    """Return the numbers in the lists of a tensor of `size` bytes: half-bytes share one, complex numbers have two."""
    bits = _BITS[tensor.data_type]
    pairs = tensor.data_type in (TensorProto.COMPLEX64, TensorProto.COMPLEX128)
    return size if bits < 8 else prod(tensor.dims) * (2 if pairs else 1)


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
    """Leave only name, type and shape."""
    bare = TensorProto(name=tensor.name, data_type=tensor.data_type, dims=tensor.dims)
    tensor.CopyFrom(bare)


def called(node: onnx.NodeProto) -> str:
    """Return what messages call an operator."""
    kind = f"{node.domain}:{node.op_type}" if node.domain not in ("", "ai.onnx") else node.op_type
    return f"{kind} {node.name!r}" if node.name else f"{kind} that makes {next(iter(node.output), '')!r}"


def check_structure(graph: onnx.GraphProto) -> None:
    """Raise UnexpectedValue for operators that hold graphs, and for tensors that nobody makes or that several make."""
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
    """Return the names of all tensors, each as often as it is made. A weight may be declared as an input too."""
    weights = [tensor.name for tensor in graph.initializer]
    yield from weights
    yield from (value.name for value in graph.input if value.name not in set(weights))
    yield from (name for node in graph.node for name in node.output if name)


def in_order(graph: onnx.GraphProto) -> None:
    """Sort the operators so that each comes after those that it reads from, and drop those that nobody needs.

    `graph`: graph that is changed in place; operators that are in order stay where they are.
    Raises UnexpectedValue for a circle.
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
