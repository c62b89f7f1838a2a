"""The FP32 network of an avatar, with which the plan `full` paints.

Rule: every picture states its source. The network that the avatar was quantised from is taken where it is known, by its
digest in the avatar's manifest. Otherwise the integer network runs with its weights in float32 and without rounding
between its layers. The loss by quantising the weights is then in `full` too.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
import onnx
import onnxruntime
from onnx import helper, numpy_helper

from trilane import machine
from trilane.arrays import F32, F64, Shape
from trilane.avatars.bundle import Bundle
from trilane.avatars.manifest import sha256_of
from trilane.avatars.network_file import NetworkFile, constants_of, reshaped
from trilane.errors import MissingPartError

#: Folder in which Trilane keeps the weights of float networks.
WEIGHTS = Path(__file__).resolve().parents[2] / "training"
IN, OUT = "real_tensor", "real_rgba"
#: A function from real numbers (h,w,C) float64 to (h,w,4) float32: straight colour (sRGB) and alpha in 0..1.
Paint = Callable[[F64], F32]


def float_network(bundle: Bundle) -> tuple[Paint, str]:
    """Return the FP32 network of `bundle`, and its source, for people. Raises BadInputError, MissingPartError."""
    weights = require_float_network(bundle)
    if weights is None:
        return dequantised(
            bundle.read_network()
        ), "the integer network's weights in FP32, nothing rounded between layers"
    return trained(bundle, weights), f"the FP32 network it was quantised from, {weights.name}"


def require_float_network(bundle: Bundle) -> Path | None:
    """Return `float_weights` of `bundle`.

    Raises MissingPartError when they cannot be run here, which is found out before long work.
    """
    weights = float_weights(bundle)
    if weights is not None and not machine.here.has_package("torch"):
        raise MissingPartError("the FP32 network needs torch", extra="train")
    return weights


def float_weights(bundle: Bundle) -> Path | None:
    """Return the file of the network that `bundle` was quantised from; None when its manifest names none here.

    The manifest names file and digest in the entry of `avatar validate --float-network`, or among the facts about
    quantising.
    """
    validation = bundle.manifest.validation
    validated = ((validation.model_extra or {}) if validation is not None else {}).get("float", {}).get("network", "")
    said = validated or bundle.manifest.quantisation.get("float_network", "")
    name, _, digest = str(said).partition(", sha256 ")
    path = WEIGHTS / Path(name).name
    return path if path.is_file() and sha256_of([path]) == digest else None


def weights_name(weights: Path) -> str:
    """Return the name of a float network's file as a manifest has it."""
    return f"{weights.name}, sha256 {sha256_of([weights])}"


def trained(bundle: Bundle, weights: Path) -> Paint:
    """Return the network of a file that training saved. Raises BadInputError, ImportError without PyTorch."""
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
    """Return `network` in FP32 by ONNX Runtime: see `unrounded`."""
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
    """Return the integer network exactly as its file defines it, with every rounding to bytes: the runtimes' reference.

    ONNX Runtime runs node by node, in FP32, with no optimisation. Its input is real numbers, which need not be those of
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
    """Return `network` with an input `IN` of real numbers, (N,H,W,C) float32, in place of its bytes.

    Otherwise it is unchanged.
    """
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
    """Return `network` between real numbers: input `IN` (N,H,W,C), output `OUT` (N,H,W,4), both float32.

    Every tensor that was rounded to bytes keeps the range of those bytes, because a range that begins at 0 stands for a
    rectifier; only the rounding is removed. Weights and biases are the real numbers of the integers.
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
    """Remove the constants that no node of `graph` reads."""
    read = {name for node in graph.node for name in node.input}
    kept = [tensor for tensor in graph.initializer if tensor.name in read]
    del graph.initializer[:]
    graph.initializer.extend(kept)


def _range(node: onnx.NodeProto, constants: Mapping[str, onnx.TensorProto]) -> tuple[float, float]:
    """Return the least and the largest real number that the bytes of a QuantizeLinear stand for."""
    scale = float(numpy_helper.to_array(constants[node.input[1]]).item())
    zero = numpy_helper.to_array(constants[node.input[2]])
    limits = np.iinfo(zero.dtype)
    return (limits.min - int(zero.item())) * scale, (limits.max - int(zero.item())) * scale
