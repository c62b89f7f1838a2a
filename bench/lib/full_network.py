"""The FP32 network of an avatar: what the plan `full` paints with.

Rule: a picture's source is said. The network that the avatar was quantised from is taken where it is known, by the
digest that the avatar's manifest has of it. Else the integer network is run with its weights in float32 and without
rounding between its layers: what quantising the weights cost is then in `full` too.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
import onnx
import onnxruntime
from onnx import helper, numpy_helper

from trilane import machine
from trilane.arrays import F32, F64
from trilane.avatars.bundle import Bundle
from trilane.avatars.manifest import sha256_of
from trilane.avatars.network_file import NetworkFile, constants_of, reshaped
from trilane.errors import MissingPartError
from trilane.shapes import Shape

#: Where Trilane keeps the weights of float networks.
WEIGHTS = Path(__file__).resolve().parents[2] / "training"
IN, OUT = "real_tensor", "real_rgba"
#: (h,w,C) float64, real numbers, to (h,w,4) float32: straight colour (sRGB) and alpha in 0..1.
Paint = Callable[[F64], F32]


def float_network(bundle: Bundle) -> tuple[Paint, str]:
    """The FP32 network of `bundle`, and what it is, for people. Raises BadInputError, MissingPartError."""
    weights = require_float_network(bundle)
    if weights is None:
        return dequantised(
            bundle.read_network()
        ), "the integer network's weights in FP32, nothing rounded between layers"
    return trained(bundle, weights), f"the FP32 network it was quantised from, {weights.name}"


def require_float_network(bundle: Bundle) -> Path | None:
    """Its `float_weights`. Raises MissingPartError when they cannot be run here: found out before long work."""
    weights = float_weights(bundle)
    if weights is not None and not machine.here.has_package("torch"):
        raise MissingPartError("the FP32 network needs torch", extra="train")
    return weights


def float_weights(bundle: Bundle) -> Path | None:
    """The file of the network that `bundle` was quantised from; None when its manifest names none that is here.

    A manifest names it by file and digest, as `avatar validate --float-network` writes it, or with how the network was
    quantised.
    """
    validation = bundle.manifest.validation
    validated = ((validation.model_extra or {}) if validation is not None else {}).get("float", {}).get("network", "")
    said = validated or bundle.manifest.quantisation.get("float_network", "")
    name, _, digest = str(said).partition(", sha256 ")
    path = WEIGHTS / Path(name).name
    return path if path.is_file() and sha256_of([path]) == digest else None


def weights_name(weights: Path) -> str:
    """The file of a float network as a manifest names it."""
    return f"{weights.name}, sha256 {sha256_of([weights])}"


def trained(bundle: Bundle, weights: Path) -> Paint:
    """The network of a file that training saved. Raises BadInputError, ImportError without PyTorch."""
    import torch

    from trilane.training.network import UNet
    from trilane.training.trainable_avatar import load_network

    entry = bundle.manifest.network
    untrained = UNet(entry.encoder, entry.norm, entry.width, entry.channels, input_skip=True)
    network = load_network(untrained, weights).eval()

    def paint(tensor: F64) -> F32:
        planes = torch.from_numpy(np.ascontiguousarray(tensor.transpose(2, 0, 1), np.float32))[None]
        with torch.no_grad():
            rgba: F32 = network(planes)[0].permute(1, 2, 0).numpy()
        return rgba

    return paint


def dequantised(network: NetworkFile) -> Paint:
    """`network` in FP32 by ONNX Runtime: see `unrounded`."""
    sessions: dict[Shape, onnxruntime.InferenceSession] = {}

    def paint(tensor: F64) -> F32:
        shape = (tensor.shape[0], tensor.shape[1])
        if shape not in sessions:
            model = unrounded(reshaped(network, *shape))
            sessions[shape] = onnxruntime.InferenceSession(
                model.SerializeToString(), providers=["CPUExecutionProvider"]
            )
        rgba: F32 = sessions[shape].run([OUT], {IN: tensor.astype(np.float32)[None]})[0][0]
        return rgba

    return paint


def as_written(network: NetworkFile) -> Paint:
    """The integer network as its file says it, every rounding to bytes and nothing else: what runtimes are to compute.

    ONNX Runtime runs node by node, in FP32, with no optimisation. Its input is real numbers, which need not be of
    bytes.
    """
    settings = onnxruntime.SessionOptions()
    settings.graph_optimization_level = onnxruntime.GraphOptimizationLevel.ORT_DISABLE_ALL
    settings.intra_op_num_threads = 1
    sessions: dict[Shape, onnxruntime.InferenceSession] = {}

    def paint(tensor: F64) -> F32:
        shape = (tensor.shape[0], tensor.shape[1])
        if shape not in sessions:
            model = from_real(reshaped(network, *shape)).SerializeToString()
            sessions[shape] = onnxruntime.InferenceSession(model, settings, providers=["CPUExecutionProvider"])
        (picture,) = sessions[shape].run(None, {IN: tensor.astype(np.float32)[None]})
        return np.asarray(picture[0] / np.float32(255))

    return paint


def from_real(network: NetworkFile) -> onnx.ModelProto:
    """`network` with an input `IN` of real numbers, (N,H,W,C) float32, in place of its bytes. Else it is unchanged."""
    model = onnx.ModelProto()
    model.CopyFrom(network.model)
    graph = model.graph
    (entry,) = graph.input
    for node in graph.node:
        if entry.name in node.input:
            node.CopyFrom(helper.make_node("Identity", [IN], node.output, name=node.name))
    entry.name = IN
    entry.type.tensor_type.elem_type = onnx.TensorProto.FLOAT
    _keep_what_is_read(graph)
    return model


def unrounded(network: NetworkFile) -> onnx.ModelProto:
    """`network` between real numbers: input `IN` (N,H,W,C), output `OUT` (N,H,W,4), both float32.

    Every tensor that was rounded to bytes keeps the range of those bytes, because a range that begins at 0 stands for
    a rectifier; only the rounding goes. Weights and biases are what the integers stand for.
    """
    model = onnx.ModelProto()
    model.CopyFrom(network.model)
    graph = model.graph
    constants = constants_of(model)
    rounded = {node.output[0]: node for node in graph.node if node.op_type == "QuantizeLinear"}
    nodes, ends = [], {graph.input[0].name: IN, graph.output[0].name: OUT}
    for node in graph.node:
        if node.op_type == "QuantizeLinear":
            low, high = _range(node, constants)
            limits = [numpy_helper.from_array(np.float32(x), f"{node.output[0]} {x}") for x in (low, high)]
            graph.initializer.extend(limits)
            nodes.append(helper.make_node("Clip", [node.input[0], *(x.name for x in limits)], node.output))
        elif node.op_type == "DequantizeLinear" and (node.input[0] in rounded or node.input[0] == graph.input[0].name):
            nodes.append(helper.make_node("Identity", node.input[:1], node.output))
        else:
            nodes.append(node)
    for node in nodes:
        node.input[:] = [ends.get(name, name) for name in node.input]
        node.output[:] = [ends.get(name, name) for name in node.output]
    del graph.node[:], graph.value_info[:]
    graph.node.extend(nodes)
    _keep_what_is_read(graph)
    for value in (graph.input[0], graph.output[0]):
        value.name = ends[value.name]
        value.type.tensor_type.elem_type = onnx.TensorProto.FLOAT
    return model


def _keep_what_is_read(graph: onnx.GraphProto) -> None:
    """Leave out the constants that no node of `graph` reads."""
    read = {name for node in graph.node for name in node.input}
    kept = [tensor for tensor in graph.initializer if tensor.name in read]
    del graph.initializer[:]
    graph.initializer.extend(kept)


def _range(node: onnx.NodeProto, constants: Mapping[str, onnx.TensorProto]) -> tuple[float, float]:
    """The least and the largest real number that the bytes of a QuantizeLinear stand for."""
    scale = float(numpy_helper.to_array(constants[node.input[1]]).item())
    zero = numpy_helper.to_array(constants[node.input[2]])
    limits = np.iinfo(zero.dtype)
    return (limits.min - int(zero.item())) * scale, (limits.max - int(zero.item())) * scale
