"""Reads any ONNX graph for its operators and shapes: float, quantised, or without weights.

The file may come from a stranger. Sizes are checked before memory is allocated, and the values of weights are dropped
as soon as their shape is known. No other file is opened, because other files have only values of weights.
`image_network` turns a graph whose only input is a picture into the network of the application.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Literal, NamedTuple

import onnx
from google.protobuf.message import DecodeError
from onnx import AttributeProto, TensorProto

from trilane.errors import BadInputError
from trilane.files import HEAD_BYTES, require_file, signature_of_head
from trilane.hw_profiles.graph_tensors import CUT_SHORT, check_structure, forget_data, in_order, with_shapes
from trilane.hw_profiles.network_work import Network, Work, constant_tensors, count_work
from trilane.hw_profiles.operators import CONVOLUTIONS, PRODUCTS, Shape
from trilane.unexpected_value import UnexpectedValue

MAX_BYTES = 512 << 20
MAX_NODES = 50_000
#: Number of checked graphs that are cached, and bytes of the largest such file: it has few weights or none.
REMEMBERED, REMEMBERED_BYTES = 16, 1 << 20
#: In earlier operator sets, operators broadcast only if an attribute says so, which changes shapes.
OLDEST_OPSET = 7
#: Operators that have a tensor among their attributes.
WITH_VALUES = frozenset(["Constant", "ConstantOfShape"])

#: The number format of a file: 8-bit weights and activations, floats, or not said, because it has no weights.
NumberFormat = Literal["w8a8", "float", "not said"]

MOST_CHANNELS = 64


class GraphFile(NamedTuple):
    """A checked graph.

    `model`: graph with a static shape for every tensor, and without the values of weights. Never change it, because
    earlier results of `read_graph` may share it.
    `numbers`: number format of its layers.
    `work`: work of one frame.
    """

    path: Path
    model: onnx.ModelProto
    numbers: NumberFormat
    work: Work


def read_graph(path: Path, input_shapes: Mapping[str, Shape] | None = None) -> GraphFile:
    """Return the checked graph in a file, with static shapes.

    The result for a small file is cached by its bytes.

    `path`: path of an ONNX file.
    `input_shapes`: shapes of inputs by name, in place of the file's shapes.

    Raises BadInputError that says what is wrong and how to fix it.
    """
    data = _bytes(path)
    check = _checked_before if len(data) <= REMEMBERED_BYTES else _checked
    try:
        return GraphFile(path, *check(data, path.parent, tuple(sorted((input_shapes or {}).items()))))
    except UnexpectedValue as error:
        raise BadInputError.at(path, error) from None


def _checked(
    data: bytes, folder: Path, given: Sequence[tuple[str, Shape]]
) -> tuple[onnx.ModelProto, NumberFormat, Work]:
    """Return (graph, number format, work) of `data`, the bytes of a file in `folder`. Raises UnexpectedValue."""
    model = _parse(data)
    _check_version(model)
    _check_names(model)
    check_structure(model.graph)
    for tensor in _tensors(model):
        forget_data(tensor, folder)
    in_order(model.graph)
    model = with_shapes(model, dict(given))
    return model, _numbers(model), count_work(model)


_checked_before = lru_cache(maxsize=REMEMBERED)(_checked)


def _bytes(path: Path) -> bytes:
    try:
        size = require_file(path, _expected(), CUT_SHORT)
        if size > MAX_BYTES:
            remedy = "keep its weights beside it: onnx.save(model, path, save_as_external_data=True)"
            raise BadInputError(path, f"{size >> 20} MiB", _expected(), remedy)
        data = path.read_bytes()
    except OSError as error:
        raise BadInputError.of_os_error(path, error, _expected()) from None
    other = signature_of_head(data[:HEAD_BYTES])
    if other is not None:
        raise BadInputError(path, other.name, _expected(), "export the network as ONNX")
    return data


def _expected() -> str:
    return f"an ONNX file of at most {MAX_BYTES >> 20} MiB"


def _parse(data: bytes) -> onnx.ModelProto:
    try:
        return onnx.load_model_from_string(data)
    except DecodeError:
        raise UnexpectedValue("bytes that do not parse", _expected(), CUT_SHORT) from None


def _check_version(model: onnx.ModelProto) -> None:
    newest = onnx.defs.onnx_opset_version()
    versions = [entry.version for entry in model.opset_import if entry.domain in ("", "ai.onnx")]
    if not model.graph.node:
        raise UnexpectedValue("no operators", "a graph with operators", CUT_SHORT)
    if len(versions) != 1:
        raise UnexpectedValue(f"{len(versions)} operator sets of ONNX", "one in opset_import", CUT_SHORT)
    if not OLDEST_OPSET <= versions[0] <= newest:
        remedy = "convert it: onnx.version_converter.convert_version(model, 17)"
        raise UnexpectedValue(f"operator set {versions[0]}", f"{OLDEST_OPSET} to {newest}", remedy)
    if len(model.graph.node) > MAX_NODES:
        raise UnexpectedValue(f"{len(model.graph.node)} operators", f"at most {MAX_NODES}")
    if model.functions:
        names = ", ".join(function.name for function in model.functions[:3])
        remedy = "put them in place: onnx.inliner.inline_local_functions(model)"
        raise UnexpectedValue(f"functions of its own ({names})", "operators only", remedy)


def _check_names(model: onnx.ModelProto) -> None:
    """Raise UnexpectedValue for a name that is no UTF-8, which protobuf returns as bytes."""
    graph = model.graph
    names = [entry.name for entry in (*graph.input, *graph.output, *graph.initializer)]
    for node in graph.node:
        names += [node.name, node.op_type, node.domain, *node.input, *node.output, *(a.name for a in node.attribute)]
    try:
        "".join(names)
    except TypeError:
        wrong = next(name for name in names if not isinstance(name, str))
        raise UnexpectedValue(f"the name {wrong!r}", "text in UTF-8", CUT_SHORT) from None


def _tensors(model: onnx.ModelProto) -> Iterator[TensorProto]:
    yield from model.graph.initializer
    for node in model.graph.node:
        if node.op_type in WITH_VALUES:
            yield from (attribute.t for attribute in node.attribute if attribute.type == AttributeProto.TENSOR)


def _numbers(model: onnx.ModelProto) -> NumberFormat:
    """Return the graph's number format.

    The format is `w8a8` if a layer is an integer operator or reads dequantised activations, else `float`. It is `not
    said` if the graph lists a float layer's weight as an input, because a caller may replace this weight.
    """
    graph, constants = model.graph, constant_tensors(model.graph)
    dequantised = {
        name
        for node in graph.node
        if node.op_type == "DequantizeLinear" and node.input[0] not in constants
        for name in node.output
    }
    layers = [node for node in graph.node if node.op_type in CONVOLUTIONS or node.op_type in PRODUCTS]
    if any(node.input[0] in dequantised or "Integer" in node.op_type or "QLinear" in node.op_type for node in layers):
        return "w8a8"
    weights = {name for node in layers for name in node.input[1:] if name in constants}
    given = {value.name for value in graph.input}
    return "not said" if weights & given else "float"


def fed_inputs(graph: GraphFile) -> list[onnx.ValueInfoProto]:
    """Return the inputs that a frame feeds: all inputs that do not stand for a weight."""
    weights = constant_tensors(graph.model.graph)
    return [value for value in graph.model.graph.input if value.name not in weights]


def image_network(graph: GraphFile, layout: str) -> Network:
    """Return the graph as the application's network, with its work and the size of its picture.

    The smaller of the second and the last axis counts as channels.

    `graph`: graph of a file.
    `layout`: layout of the raster stage: `packed` or `split`.

    Raises BadInputError if the graph has several inputs, or one that is no picture.
    """
    shapes = [tuple(dim.dim_value for dim in value.type.tensor_type.shape.dim) for value in fed_inputs(graph)]
    if len(shapes) != 1 or len(shapes[0]) != 4 or shapes[0][0] != 1 or min(shapes[0][1], shapes[0][3]) > MOST_CHANNELS:
        found = ", ".join("x".join(map(str, shape)) for shape in shapes)
        expected = f"one picture for the application: 1xCxHxW or 1xHxWxC, C at most {MOST_CHANNELS}"
        raise BadInputError(graph.path, f"inputs {found}", expected, "without --application it is predicted by itself")
    _, first, second, third = shapes[0]
    height, width, channels = (second, third, first) if first <= third else (first, second, third)
    return Network({"network": str(graph.path)}, height, width, channels, layout, graph.work)
