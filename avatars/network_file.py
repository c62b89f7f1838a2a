"""The network file of an avatar: reads and checks it, and rewrites the network for other tensor shapes.

Rule: operators, shapes, scales and zero points are checked once, when a network is read or made. Code that holds a
`NetworkFile` need not check them again. A `NetworkFile` may still have layers in float; `check_integer_layers` refuses
those that its metadata does not list.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import onnx
from google.protobuf.message import DecodeError
from numpy.typing import NDArray
from onnx import TensorProto, external_data_helper, numpy_helper, shape_inference

from trilane.arrays import BUCKET_STEP, MAX_SIDE
from trilane.errors import BadInputError, reason
from trilane.files import require_file, signature_of

# The integer network that an avatar's file holds and a runtime loads.
#
# Rule: the graph has fixed shapes; its input and its output are bytes. Its layers run in integers, except the layers
# that its metadata names.

#: Metadata key of the file: a JSON list of the names of layers that were left in float on purpose.
FLOAT_LAYERS_KEY = "trilane.float_layers"
MAX_BATCH = 64
LEAST_IR = 4  # first version of ONNX in which an initializer need not be an input
MAX_CHANNELS = 64
#: Operators that take most of the time and must run in integers.
LAYERS = ("Conv", "ConvTranspose", "Gemm")


@dataclass(frozen=True)
class Affine:
    """How a tensor's bytes stand for real numbers: `real = (q - zero_point) * scale`, q in 0..255."""

    scale: float
    zero_point: int


@dataclass(frozen=True)
class IntegerNetwork:
    """The network that a runtime loads.

    `where`: source of the network, such as a file, that errors name.
    `model`: integer graph with fixed shapes, whose input and output are bytes.
    """

    where: str
    model: onnx.ModelProto = field(repr=False)

    @property
    def float_layers(self) -> frozenset[str]:
        """Names of the layers that may run in float, as the network's metadata lists them.

        Raises BadInputError when the metadata is not a JSON list.
        """
        texts = [prop.value for prop in self.model.metadata_props if prop.key == FLOAT_LAYERS_KEY]
        try:
            lists = [json.loads(text) for text in texts]
        except (ValueError, RecursionError):
            lists = [None]
        if not all(isinstance(names, list) for names in lists):
            raise BadInputError(self.where, f"{FLOAT_LAYERS_KEY} {texts}", "a JSON list of names")
        return frozenset(str(name) for names in lists for name in names)

    @property
    def digest(self) -> str:
        """SHA-256 of the network, hexadecimal."""
        return hashlib.sha256(self.model.SerializeToString(deterministic=True)).hexdigest()


@dataclass(frozen=True)
class NetworkFile(IntegerNetwork):
    """A checked network.

    `shape`: sizes (N, H, W, C) of the uint8 input. The output is (N, H, W, 4) uint8, RGBA.
    `input`, `output`: scale and zero point of the input and output bytes.
    """

    shape: tuple[int, int, int, int]
    input: Affine
    output: Affine

    @property
    def channels(self) -> int:
        return self.shape[3]


def node_name(node: onnx.NodeProto) -> str:
    """Return the node's name; if it has none, a text of its operator and its first output tensor."""
    return node.name or f"{node.op_type} that makes {next(iter(node.output), 'nothing')}"


def constants_of(model: onnx.ModelProto) -> Mapping[str, TensorProto]:
    """Return the constant tensors of the graph by name: initializers, and outputs of Constant nodes."""
    constants = {tensor.name: tensor for tensor in model.graph.initializer}
    for node in model.graph.node:
        if node.op_type == "Constant":
            constants.update((node.output[0], a.t) for a in node.attribute if a.name == "value")
    return constants


def check_integer_layers(network: IntegerNetwork) -> None:
    """Raise BadInputError if a layer (LAYERS) that `float_layers` does not list has float data or float weights."""
    makers = {out: node for node in network.model.graph.node for out in node.output}
    float_layers = []
    for node in network.model.graph.node:
        if node.op_type in LAYERS and node_name(node) not in network.float_layers:
            sources = [_beyond_transposes(makers, name) for name in node.input[:2]]
            if any(source is None or source.op_type != "DequantizeLinear" for source in sources):
                float_layers.append(node_name(node))
    if float_layers:
        raise BadInputError(
            network.where, f"layers left in float: {', '.join(float_layers)}", "integer layers", "quantise them"
        )


def _beyond_transposes(makers: Mapping[str, onnx.NodeProto], name: str) -> onnx.NodeProto | None:
    node = makers.get(name)
    while node is not None and node.op_type == "Transpose":
        node = makers.get(node.input[0])
    return node


# Checks a network: operators, shapes of its input and output, scales and zero points.
#
# Rule: a network that passes the checks is an integer network with fixed shapes, from NHWC bytes to RGBA bytes, so a
# runtime need not check it again. The error about any other network names the wrong node.

RGBA = 4
#: Remedy for a float network.
TO_INTEGERS = "make it one of integers: trilane avatar quantise FLOAT.onnx --frames FRAMES.npy --out NETWORK.onnx"
#: Smallest and largest plausible scale. A scale outside comes from an empty calibration or a damaged file.
SCALE_RANGE = (1e-30, 1e30)
#: Operators that a network may have: layers, arithmetic, activations, norms, and operators that move or quantise data.
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
    """Return `model` as a checked network. Raises BadInputError, which names `where` and the wrong node.

    Initializers that the graph also lists as inputs are removed from its inputs.
    """
    graph = model.graph
    for node in graph.node:
        if node.domain not in ("", "ai.onnx") or node.op_type not in OPERATORS:
            name = f"{node.domain}:{node.op_type}" if node.domain else node.op_type
            raise BadInputError(where, f"operator {name} in node {node_name(node)!r}", "operators a DSP has")
    _check_order(graph, where)
    constants = constants_of(model)
    inputs = [value for value in graph.input if value.name not in constants]
    del graph.input[:]
    graph.input.extend(inputs)
    model.ir_version = max(model.ir_version, LEAST_IR)
    shape = _check_input(model, where)
    _check_output(model, where, shape)
    for node in graph.node:
        if node.op_type in ("QuantizeLinear", "DequantizeLinear"):
            _check_affine(node, constants, where)
    first = _reader_of(graph, graph.input[0].name, "DequantizeLinear", where)
    last = _maker_of(graph, graph.output[0].name, "QuantizeLinear", where)
    return NetworkFile(where, model, shape, _affine(first, constants, where), _affine(last, constants, where))


def _check_order(graph: onnx.GraphProto, where: str) -> None:
    """Raise BadInputError unless tensors are made once, before they are read, and nodes have inputs and outputs."""
    seen: set[str] = set()
    for node in graph.node:
        if not node.output or not (node.input or node.op_type == "Constant"):
            raise BadInputError(where, f"node {node_name(node)!r} without inputs or outputs", "at least one of each")
        seen.update(node.input)
        if again := (seen & set(node.output)) - {""}:
            found = f"{min(again)!r}, made by node {node_name(node)!r} and made or read before"
            raise BadInputError(where, found, "nodes in the order of the work, each with new names")
        seen.update(node.output)


def _check_input(model: onnx.ModelProto, where: str) -> tuple[int, int, int, int]:
    inputs = model.graph.input
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
    """Return the node of `op_type` that reads tensor `name`, directly or through Transposes. Raises BadInputError."""
    for _ in graph.node:
        users = [node for node in graph.node if name in node.input]
        if users and all(node.op_type == op_type for node in users):
            return users[0]
        if len(users) != 1 or users[0].op_type != "Transpose":
            break
        name = users[0].output[0]
    raise BadInputError(where, f"input used by {[node_name(n) for n in users]}", f"a {op_type} of the bytes")


def _maker_of(graph: onnx.GraphProto, name: str, op_type: str, where: str) -> onnx.NodeProto:
    """Return the node of `op_type` that makes tensor `name`, directly or through Transposes. Raises BadInputError."""
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


# Makes the same network for another tensor shape: rewrites batch, height and width of input and output, and infers all
# shapes between them again.
#
# Rule: the result has fixed shapes and passes `check_network`; weights do not change.


def reshaped(network: NetworkFile, height: int, width: int, batch: int = 1) -> NetworkFile:
    """Return `network` for inputs of another shape; `network` itself if it already has this shape.

    `height`, `width`: size of the input in pixels, multiples of BUCKET_STEP.
    `batch`: number of frames that are inferred together.
    Raises BadInputError for sizes that are no such multiples, and if the graph cannot run at this shape.
    """
    if height % BUCKET_STEP or width % BUCKET_STEP or min(height, width, batch) < 1:
        raise BadInputError(network.where, f"shape {batch}x{height}x{width}", f"sides in multiples of {BUCKET_STEP}")
    if network.shape[:3] == (batch, height, width):
        return network
    model = onnx.ModelProto()
    model.CopyFrom(network.model)
    del model.graph.value_info[:]
    for value in (model.graph.input[0], model.graph.output[0]):
        for dim, size in zip(value.type.tensor_type.shape.dim[:3], (batch, height, width), strict=True):
            dim.dim_value = size
    try:
        inferred = shape_inference.infer_shapes(model, check_type=True, strict_mode=True, data_prop=True)
    except onnx.shape_inference.InferenceError as error:
        reason = str(error).strip().splitlines()[0]
        raise BadInputError(
            network.where, f"a graph fixed to {network.shape}: {reason}", f"one for {height}x{width}"
        ) from error
    return check_network(inferred, network.where)


MAX_BYTES = 512 << 20
EXPECTED = "an ONNX network"


def read_network(path: Path) -> NetworkFile:
    """Return the checked network in an ONNX file. Raises BadInputError, which names the file and the wrong node."""
    return check_network(parse_network(path), str(path))


def parse_network(path: Path) -> onnx.ModelProto:
    """Return the unchecked ONNX model in a file, with its external data. Raises BadInputError if this fails."""
    model = _parse(path)
    for tensor in _external_tensors(model):
        file = _external_file(tensor, path)
        try:
            external_data_helper.load_external_data_for_tensor(tensor, str(path.parent.resolve()))
        except (OSError, ValueError, onnx.checker.ValidationError) as error:
            raise BadInputError(path, f"tensor {tensor.name!r} in {file}: {reason(error)}", "readable data") from error
        tensor.data_location = TensorProto.DEFAULT
        del tensor.external_data[:]
    return model


def network_files(path: Path) -> list[Path]:
    """Return the ONNX file `path`, then the files of its external data, sorted. Raises BadInputError."""
    kept = {_external_file(tensor, path) for tensor in _external_tensors(_parse(path))}
    return [path, *sorted(kept)]


def _parse(path: Path) -> onnx.ModelProto:
    try:
        size = require_file(path, EXPECTED)
        if size > MAX_BYTES:
            raise BadInputError(path, f"a file of {size} bytes", f"an ONNX network of 1 to {MAX_BYTES} bytes")
        if (other := signature_of(path)) is not None:
            raise BadInputError(path, other.name, EXPECTED)
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
    return model


def _external_file(tensor: TensorProto, path: Path) -> Path:
    """Return the file with the external data of `tensor`. `path`: file of the network.

    Raises BadInputError for a file that is missing, too large or outside the network's folder.
    """
    folder = path.parent.resolve()
    entry = {pair.key: pair.value for pair in tensor.external_data}
    file: Path = (folder / entry.get("location", "")).resolve()
    if folder not in file.parents:
        raise BadInputError(path, f"tensor {tensor.name!r} kept in {file}", f"data inside {folder}", "move it there")
    if not file.is_file() or file.stat().st_size > MAX_BYTES:
        raise BadInputError(path, f"tensor {tensor.name!r} kept in {file}", "a file of the network's folder")
    return file


def _external_tensors(model: onnx.ModelProto) -> list[TensorProto]:
    tensors = list(model.graph.initializer)
    for attribute in (one for node in model.graph.node for one in node.attribute):
        tensors += [attribute.t] if attribute.HasField("t") else []
        tensors += attribute.tensors
    return [tensor for tensor in tensors if tensor.data_location == TensorProto.EXTERNAL]
