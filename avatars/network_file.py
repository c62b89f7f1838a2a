"""Reads an avatar's network file and says what is wrong with it, by the name of the node.

Rule: what passes here is a static integer network from NHWC bytes to RGBA bytes; a runtime need not ask again.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import onnx
from google.protobuf.message import DecodeError
from numpy.typing import NDArray
from onnx import TensorProto, external_data_helper, numpy_helper

from trilane.errors import BadInputError, reason

#: Metadata of a file: a JSON list of the names of layers that were left in float on purpose.
FLOAT_LAYERS_KEY = "trilane.float_layers"
MAX_BYTES = 512 << 20
MAX_SIDE = 4096
MAX_BATCH = 64
MAX_CHANNELS = 64
RGBA = 4
#: Scales outside are no measurement of anything: they come from empty calibration or a damaged file.
SCALE_RANGE = (1e-30, 1e30)

#: What a network may be made of: layers that quantise, their activations, norms, and moving data about.
OPERATORS = {
    *("Conv", "ConvTranspose", "Gemm", "Add", "Sub", "Mul", "Div", "Sqrt", "ReduceMean", "Constant", "Identity"),
    *("Relu", "LeakyRelu", "Clip", "Sigmoid", "HardSigmoid", "HardSwish", "Tanh"),
    *("BatchNormalization", "InstanceNormalization", "GroupNormalization"),
    *("AveragePool", "GlobalAveragePool", "MaxPool", "Resize", "DepthToSpace", "SpaceToDepth"),
    *("Concat", "Pad", "Reshape", "Slice", "Split", "Transpose", "QuantizeLinear", "DequantizeLinear"),
}
#: Where the time goes, and what must run in integers.
LAYERS = ("Conv", "ConvTranspose", "Gemm")
ZERO_POINT_TYPES = {
    TensorProto.UINT8: (0, 255),
    TensorProto.INT8: (-128, 127),
    TensorProto.UINT16: (0, 65535),
    TensorProto.INT16: (-32768, 32767),
    TensorProto.INT32: (-(2**31), 2**31 - 1),
}


@dataclass(frozen=True)
class Affine:
    """`real = (q - zero_point) * scale`, q in 0..255."""

    scale: float
    zero_point: int


@dataclass(frozen=True)
class IntegerNetwork:
    """What a runtime loads: a static integer graph with bytes at its ends, `where` it comes from."""

    where: str
    model: onnx.ModelProto = field(repr=False)

    @property
    def float_layers(self) -> frozenset[str]:
        """Names of the layers that may run in float, because whoever quantised the network said so."""
        texts = [prop.value for prop in self.model.metadata_props if prop.key == FLOAT_LAYERS_KEY]
        try:
            return frozenset(str(name) for text in texts for name in json.loads(text))
        except (ValueError, TypeError, RecursionError) as error:
            raise BadInputError(self.where, f"{FLOAT_LAYERS_KEY} {texts}", "a JSON list of names") from error

    @property
    def digest(self) -> str:
        """SHA-256 of the network, hexadecimal."""
        return hashlib.sha256(self.model.SerializeToString(deterministic=True)).hexdigest()


@dataclass(frozen=True)
class NetworkFile(IntegerNetwork):
    """A checked network. `shape`: N, H, W, C of its input. Output: N, H, W, 4 uint8."""

    shape: tuple[int, int, int, int]
    input: Affine
    output: Affine

    @property
    def channels(self) -> int:
        return self.shape[3]


def read_network(path: Path) -> NetworkFile:
    """Read and check an ONNX file. Raises BadInputError that names the file, the node and how to mend it."""
    return check_network(parse_network(path), str(path))


def check_network(model: onnx.ModelProto, where: str) -> NetworkFile:
    """Check a network in memory. Raises BadInputError, see `read_network`."""
    _check_operators(model, where)
    shape = _check_input(model, where)
    _check_output(model, where, shape)
    graph = model.graph
    constants = constants_of(model)
    for node in graph.node:
        if node.op_type in ("QuantizeLinear", "DequantizeLinear"):
            _check_affine(node, constants, where)
    first = _follow(graph, graph.input[0].name, "DequantizeLinear", where)
    last = _trace(graph, graph.output[0].name, "QuantizeLinear", where)
    return NetworkFile(where, model, shape, _affine(first, constants, where), _affine(last, constants, where))


def node_name(node: onnx.NodeProto) -> str:
    """The node's name, or what it makes when it has none."""
    return node.name or f"{node.op_type} that makes {next(iter(node.output), 'nothing')}"


def constants_of(model: onnx.ModelProto) -> Mapping[str, TensorProto]:
    """Initializers and Constant nodes, by the name of their value."""
    found = {tensor.name: tensor for tensor in model.graph.initializer}
    for node in model.graph.node:
        if node.op_type == "Constant":
            found.update((node.output[0], a.t) for a in node.attribute if a.name == "value")
    return found


def check_integer_layers(network: IntegerNetwork) -> None:
    """Raises BadInputError naming the layers whose inputs are not dequantised integers, but for `float_layers`."""
    makers = {out: node for node in network.model.graph.node for out in node.output}
    left = []
    for node in network.model.graph.node:
        if node.op_type in LAYERS and node_name(node) not in network.float_layers:
            sources = [_beyond_transposes(makers, name) for name in node.input[:2]]
            if any(source is None or source.op_type != "DequantizeLinear" for source in sources):
                left.append(node_name(node))
    if left:
        raise BadInputError(
            network.where, f"layers left in float: {', '.join(left)}", "integer layers", "quantise them"
        )


def _beyond_transposes(makers: Mapping[str, onnx.NodeProto], name: str) -> onnx.NodeProto | None:
    node = makers.get(name)
    while node is not None and node.op_type == "Transpose":
        node = makers.get(node.input[0])
    return node


def parse_network(path: Path) -> onnx.ModelProto:
    """The ONNX file whatever it computes, external data read in. Raises BadInputError when it cannot be read."""
    try:
        size = path.stat().st_size
        if not 0 < size <= MAX_BYTES:
            raise BadInputError(path, f"a file of {size} bytes", f"an ONNX network of 1 to {MAX_BYTES} bytes")
        model = onnx.load_model_from_string(path.read_bytes())
    except OSError as error:
        raise BadInputError.of_os_error(path, error, "a readable ONNX file") from error
    except DecodeError as error:
        raise BadInputError(
            path, "bytes that do not parse", "an ONNX file", "copy it again: it may be cut short"
        ) from error
    if not model.graph.node or not any(entry.domain in ("", "ai.onnx") for entry in model.opset_import):
        raise BadInputError(
            path, "no nodes or no operator set", "an ONNX network", "copy it again: it may be cut short"
        )
    _load_external(model, path)
    return model


def _load_external(model: onnx.ModelProto, path: Path) -> None:
    folder = path.parent.resolve()
    for tensor in _tensors(model):
        if tensor.data_location != TensorProto.EXTERNAL:
            continue
        entry = {pair.key: pair.value for pair in tensor.external_data}
        file = (folder / entry.get("location", "")).resolve()
        if folder not in file.parents:
            raise BadInputError(
                path, f"tensor {tensor.name!r} kept in {file}", f"data inside {folder}", "move it there"
            )
        if not file.is_file() or file.stat().st_size > MAX_BYTES:
            raise BadInputError(path, f"tensor {tensor.name!r} kept in {file}", "a file of the network's folder")
        try:
            external_data_helper.load_external_data_for_tensor(tensor, str(folder))
        except (OSError, ValueError, onnx.checker.ValidationError) as error:
            raise BadInputError(path, f"tensor {tensor.name!r} in {file}: {reason(error)}", "readable data") from error
        tensor.data_location = TensorProto.DEFAULT
        del tensor.external_data[:]


def _tensors(model: onnx.ModelProto) -> Iterator[TensorProto]:
    yield from model.graph.initializer
    for node in model.graph.node:
        for attribute in node.attribute:
            if attribute.HasField("t"):
                yield attribute.t
            yield from attribute.tensors


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
    if not (1 <= n <= MAX_BATCH and 1 <= h <= MAX_SIDE and 1 <= w <= MAX_SIDE and 1 <= c <= MAX_CHANNELS):
        raise BadInputError(
            where,
            f"input {inputs[0].name!r} of {n}x{h}x{w}x{c}",
            f"N x H x W x C with sides up to {MAX_SIDE} and 1 to {MAX_CHANNELS} channels last",
        )
    return n, h, w, c


def _check_output(model: onnx.ModelProto, where: str, shape: tuple[int, int, int, int]) -> None:
    if len(model.graph.output) != 1:
        raise BadInputError(where, f"{len(model.graph.output)} outputs", "one output, N x H x W x 4 uint8")
    found = _static_shape(model.graph.output[0], where)
    if found != (*shape[:3], RGBA):
        text = "x".join(map(str, found))
        raise BadInputError(
            where,
            f"output {model.graph.output[0].name!r} of {text}",
            f"{'x'.join(map(str, (*shape[:3], RGBA)))} (RGBA)",
        )


def _static_shape(value: onnx.ValueInfoProto, where: str) -> tuple[int, int, int, int]:
    kind = value.type.tensor_type
    if kind.elem_type != TensorProto.UINT8:
        name = TensorProto.DataType.Name(kind.elem_type)
        raise BadInputError(where, f"{value.name!r} of type {name}", "uint8", "quantise it: trilane avatar quantize")
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
        found = f"{float(wrong.flat[0]):g}" if wrong.size else "nothing"
        raise BadInputError(where, f"scale {found} in node {node_name(node)!r}", f"a number from {low:g} to {high:g}")
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
    except (ValueError, TypeError, OverflowError) as error:
        raise BadInputError(
            where, f"tensor {tensor.name!r} that does not decode ({error})", "as much data as its shape"
        ) from error
    return array


def _follow(graph: onnx.GraphProto, name: str, op_type: str, where: str) -> onnx.NodeProto:
    """The node of `op_type` that consumes `name`, beyond transposes."""
    for _ in graph.node:
        users = [node for node in graph.node if name in node.input]
        if users and all(node.op_type == op_type for node in users):
            return users[0]
        if len(users) != 1 or users[0].op_type != "Transpose":
            break
        name = users[0].output[0]
    raise BadInputError(where, f"input used by {[node_name(n) for n in users]}", f"a {op_type} of the bytes")


def _trace(graph: onnx.GraphProto, name: str, op_type: str, where: str) -> onnx.NodeProto:
    """The node of `op_type` that makes `name`, beyond transposes."""
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
    found = Affine(float(scale.astype(np.float64).item()), int(zero.item()))
    if not math.isfinite(found.scale):
        raise BadInputError(where, f"scale {found.scale} in node {node_name(node)!r}", "a finite number")
    return found
