"""Checks a network: operators, shapes of its ends, scales and zero points.

Rule: a network that passes is a static integer network from NHWC bytes to RGBA bytes, so a runtime need not check it
again; a network that does not pass is refused by the name of the node that is wrong.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import onnx
from numpy.typing import NDArray
from onnx import TensorProto, numpy_helper

from trilane.avatars.integer_network import (
    MAX_BATCH,
    MAX_CHANNELS,
    MAX_SIDE,
    Affine,
    NetworkFile,
    constants_of,
    node_name,
)
from trilane.errors import BadInputError

RGBA = 4
#: What to do with a network of floats.
TO_INTEGERS = "make it one of integers: trilane avatar quantise FLOAT.onnx --frames FRAMES.npy --out NETWORK.onnx"
#: Smallest and largest plausible scale; others come from an empty calibration or a damaged file.
SCALE_RANGE = (1e-30, 1e30)
#: The operators a network may have: layers that quantise, activations, norms, and operators that move data.
OPERATORS = {
    *("Conv", "ConvTranspose", "Gemm", "Add", "Sub", "Mul", "Div", "Sqrt", "ReduceMean", "Constant", "Identity"),
    *("Relu", "LeakyRelu", "Clip", "Sigmoid", "HardSigmoid", "HardSwish", "Tanh"),
    *("BatchNormalization", "InstanceNormalization", "GroupNormalization"),
    *("AveragePool", "GlobalAveragePool", "MaxPool", "Resize", "DepthToSpace", "SpaceToDepth"),
    *("Concat", "Pad", "Reshape", "Slice", "Split", "Transpose", "QuantizeLinear", "DequantizeLinear"),
}
ZERO_POINT_TYPES = {
    TensorProto.UINT8: (0, 255),
    TensorProto.INT8: (-128, 127),
    TensorProto.UINT16: (0, 65535),
    TensorProto.INT16: (-32768, 32767),
    TensorProto.INT32: (-(2**31), 2**31 - 1),
}


def check_network(model: onnx.ModelProto, where: str) -> NetworkFile:
    """The checked network of `model`, which came from `where`. Raises BadInputError that names the node at fault."""
    _check_operators(model, where)
    shape = _check_input(model, where)
    _check_output(model, where, shape)
    graph = model.graph
    constants = constants_of(model)
    for node in graph.node:
        if node.op_type in ("QuantizeLinear", "DequantizeLinear"):
            _check_affine(node, constants, where)
    first = _reader_of(graph, graph.input[0].name, "DequantizeLinear", where)
    last = _maker_of(graph, graph.output[0].name, "QuantizeLinear", where)
    return NetworkFile(where, model, shape, _affine(first, constants, where), _affine(last, constants, where))


def _check_operators(model: onnx.ModelProto, where: str) -> None:
    for node in model.graph.node:
        if node.domain not in ("", "ai.onnx") or node.op_type not in OPERATORS:
            name = f"{node.domain}:{node.op_type}" if node.domain else node.op_type
            raise BadInputError(where, f"operator {name} in node {node_name(node)!r}", "operators a DSP has")


def _check_input(model: onnx.ModelProto, where: str) -> tuple[int, int, int, int]:
    constants = {tensor.name for tensor in model.graph.initializer}
    inputs = [value for value in model.graph.input if value.name not in constants]
    if len(inputs) != 1:
        raise BadInputError(where, f"{len(inputs)} inputs", "one input, N x H x W x C uint8")
    n, h, w, c = _static_shape(inputs[0], where)
    if n > MAX_BATCH or max(h, w) > MAX_SIDE or c > MAX_CHANNELS:
        raise BadInputError(
            where,
            f"input {inputs[0].name!r} of {n}x{h}x{w}x{c}",
            f"N x H x W x C with sides up to {MAX_SIDE} and 1 to {MAX_CHANNELS} channels last",
        )
    return n, h, w, c


def _check_output(model: onnx.ModelProto, where: str, shape: tuple[int, int, int, int]) -> None:
    if len(model.graph.output) != 1:
        raise BadInputError(where, f"{len(model.graph.output)} outputs", "one output, N x H x W x 4 uint8")
    output_shape = _static_shape(model.graph.output[0], where)
    if output_shape != (*shape[:3], RGBA):
        text = "x".join(map(str, output_shape))
        raise BadInputError(
            where,
            f"output {model.graph.output[0].name!r} of {text}",
            f"{'x'.join(map(str, (*shape[:3], RGBA)))} (RGBA)",
        )


def _static_shape(value: onnx.ValueInfoProto, where: str) -> tuple[int, int, int, int]:
    kind = value.type.tensor_type
    if kind.elem_type != TensorProto.UINT8:
        known = kind.elem_type in TensorProto.DataType.values()
        name = TensorProto.DataType.Name(kind.elem_type) if known else str(kind.elem_type)
        raise BadInputError(where, f"{value.name!r} of type {name}", "uint8", TO_INTEGERS)
    dims = [dim.dim_value if dim.HasField("dim_value") else -1 for dim in kind.shape.dim]
    if len(dims) != 4 or min(dims) < 1:
        text = "x".join("?" if d < 1 else str(d) for d in dims)
        raise BadInputError(where, f"{value.name!r} of shape {text or 'unknown'}", "four fixed sizes, N x H x W x C")
    return dims[0], dims[1], dims[2], dims[3]


def _check_affine(node: onnx.NodeProto, constants: Mapping[str, TensorProto], where: str) -> None:
    scale = constants.get(node.input[1]) if len(node.input) > 1 else None
    if scale is None:
        raise BadInputError(where, f"no scale for node {node_name(node)!r}", "a constant scale")
    values = _array(scale, where).astype(np.float64)
    low, high = SCALE_RANGE
    wrong = values[~((values >= low) & (values <= high))]
    if not values.size or wrong.size:
        text = f"{float(wrong.flat[0]):g}" if wrong.size else "nothing"
        raise BadInputError(where, f"scale {text} in node {node_name(node)!r}", f"a number from {low:g} to {high:g}")
    if len(node.input) > 2 and node.input[2]:
        _check_zero_point(node, constants.get(node.input[2]), where)


def _check_zero_point(node: onnx.NodeProto, tensor: TensorProto | None, where: str) -> None:
    if tensor is None or tensor.data_type not in ZERO_POINT_TYPES:
        raise BadInputError(where, f"zero point of node {node_name(node)!r} no integer", "a constant integer")
    low, high = ZERO_POINT_TYPES[tensor.data_type]
    raw = list(tensor.int32_data) if tensor.int32_data else _array(tensor, where).ravel().tolist()
    wrong = [value for value in raw if not low <= value <= high]
    if wrong:
        raise BadInputError(where, f"zero point {wrong[0]} in node {node_name(node)!r}", f"{low} to {high}")


def _array(tensor: TensorProto, where: str) -> NDArray[np.generic]:
    try:
        array: NDArray[np.generic] = numpy_helper.to_array(tensor)
    except KeyError:
        found = f"tensor {tensor.name!r} of type {tensor.data_type}"
        raise BadInputError(where, found, "a type that ONNX has") from None
    except (ValueError, TypeError, OverflowError) as error:
        raise BadInputError(
            where, f"tensor {tensor.name!r} that does not decode ({error})", "as much data as its shape"
        ) from error
    if array.dtype.kind not in "fiub":
        raise BadInputError(where, f"tensor {tensor.name!r} of {array.dtype}", "numbers")
    return array


def _reader_of(graph: onnx.GraphProto, name: str, op_type: str, where: str) -> onnx.NodeProto:
    """The node of `op_type` that reads tensor `name`, with only Transposes between them."""
    for _ in graph.node:
        users = [node for node in graph.node if name in node.input]
        if users and all(node.op_type == op_type for node in users):
            return users[0]
        if len(users) != 1 or users[0].op_type != "Transpose":
            break
        name = users[0].output[0]
    raise BadInputError(where, f"input used by {[node_name(n) for n in users]}", f"a {op_type} of the bytes")


def _maker_of(graph: onnx.GraphProto, name: str, op_type: str, where: str) -> onnx.NodeProto:
    """The node of `op_type` that makes tensor `name`, with only Transposes between them."""
    makers = {out: node for node in graph.node for out in node.output}
    for _ in graph.node:
        node = makers.get(name)
        if node is None:
            raise BadInputError(where, f"nothing that makes {name!r}", f"a {op_type}")
        if node.op_type == op_type:
            return node
        if node.op_type != "Transpose":
            break
        name = node.input[0]
    raise BadInputError(where, f"output made by node {node_name(node)!r}", f"a {op_type} to bytes")


def _affine(node: onnx.NodeProto, constants: Mapping[str, TensorProto], where: str) -> Affine:
    scale = _array(constants[node.input[1]], where)
    zero = _array(constants[node.input[2]], where) if len(node.input) > 2 and node.input[2] else np.zeros((), np.uint8)
    if scale.size != 1 or zero.size != 1 or zero.dtype != np.uint8:
        raise BadInputError(
            where, f"node {node_name(node)!r} of type {zero.dtype}", "one scale and one uint8 zero point"
        )
    return Affine(float(scale.astype(np.float64).item()), int(zero.item()))
