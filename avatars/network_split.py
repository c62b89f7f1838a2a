"""Cuts a quantised network at quantised tensors.

Rule: only bytes cross a cut, so the parts, run one after the other, give the same bytes as the whole network.

A cut is named after the tensor at which it is made. Every tensor that a later part reads crosses the cut: this tensor,
and others, such as a U-Net's skip connections or the network's input. If a DequantizeLinear or a Transpose reads a
crossing tensor, the later part repeats this node.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import onnx
from onnx import TensorProto, helper

from trilane.avatars.network_file import IntegerNetwork, NetworkFile
from trilane.errors import BadInputError

QUANTIZE = "QuantizeLinear"
#: Operators with one data input that a later part can repeat on crossing bytes.
MOVABLE = ("DequantizeLinear", "Transpose")
Shapes = dict[str, tuple[int, ...]]


@dataclass(frozen=True)
class Cut:
    """A place to cut.

    `at`: name of the tensor after which the cut is named.
    `crossing`: shape of every tensor that crosses the cut, by name; all are uint8, and `at` is one of them.
    `nodes`: number of the graph's nodes before the cut.
    """

    at: str
    crossing: Shapes
    nodes: int

    @property
    def bytes(self) -> int:
        """Number of bytes that cross the cut each time the network runs."""
        return sum(math.prod(shape) for shape in self.crossing.values())


@dataclass(frozen=True)
class NetworkPart(IntegerNetwork):
    """A part of the network that runs by itself. The fields below hold shapes of uint8 tensors by name.

    `inputs`, `outputs`: inputs and outputs of `model`, in the model's order.
    `crossing_in`: tensors that cross the cut before this part.
    `crossing_out`: tensors that cross the cut behind this part. A tensor of `crossing_out` that is not in `outputs` is
    in `crossing_in`, and must be copied unchanged.
    """

    inputs: Shapes
    outputs: Shapes
    crossing_in: Shapes
    crossing_out: Shapes


def cuts(network: NetworkFile) -> Iterator[Cut]:
    """Yield every place where `network` can be cut, in the order of its nodes."""
    graph = onnx.shape_inference.infer_shapes(network.model).graph
    for number, node in enumerate(graph.node, 1):
        if node.op_type == QUANTIZE and node.output[0] != graph.output[0].name:
            crossing = _crossing(graph, number)
            if crossing is not None and node.output[0] in crossing:
                yield Cut(node.output[0], crossing, number)


def split(network: NetworkFile, at: Sequence[str]) -> list[NetworkPart]:
    """Return the parts of `network` between the cuts `at`, in order.

    `at`: names of cuts, in the order of the network's nodes.
    Raises BadInputError for an unknown cut, and for cuts that are repeated or in another order.
    """
    known = {cut.at: cut for cut in cuts(network)} if at else {}
    for name in at:
        if name not in known:
            remedy = "`trilane avatar split` without --at lists them"
            raise BadInputError(f"{network.where}, cut", repr(name), "a quantised tensor", remedy)
    chosen = [known[name] for name in at]
    if any(first.nodes >= second.nodes for first, second in pairwise(chosen)):
        raise BadInputError(f"{network.where}, cuts", ", ".join(at), "different tensors in the order of the work")
    graph = network.model.graph
    begin = Cut("", _declared(graph.input), 0)
    end = Cut("", _declared(graph.output), len(graph.node))
    return [_part(network, *ends) for ends in pairwise([begin, *chosen, end])]


def _crossing(graph: onnx.GraphProto, nodes: int) -> Shapes | None:
    """Return the shape of each tensor that crosses a cut, by name; None if any of these tensors is not uint8."""
    makers = {name: node for node in graph.node[:nodes] for name in node.output}
    names = []
    for node in graph.node[nodes:]:
        for name in node.input:
            origin = name
            while origin in makers and makers[origin].op_type in MOVABLE:
                origin = makers[origin].input[0]
            if origin in makers or origin == graph.input[0].name:
                names.append(origin)
    distinct = list(dict.fromkeys(names))
    kinds = {value.name: value.type.tensor_type.elem_type for value in (*graph.value_info, *graph.input)}
    if any(kinds.get(name) != TensorProto.UINT8 for name in distinct):
        return None
    shapes = _declared((*graph.value_info, *graph.input))
    return {name: shapes[name] for name in distinct}


def _part(network: NetworkFile, before: Cut, after: Cut) -> NetworkPart:
    graph = network.model.graph
    own = graph.node[before.nodes : after.nodes]
    made = {name for node in own for name in node.output}
    outputs = {name: shape for name, shape in after.crossing.items() if name in made}
    repeated = [node for node in graph.node[: before.nodes] if node.op_type in MOVABLE]
    nodes = _needed([*repeated, *own], list(outputs))
    read = {name for node in nodes for name in node.input}
    inputs = {name: shape for name, shape in before.crossing.items() if name in read}
    part = helper.make_graph(
        nodes,
        f"{graph.name} from {before.at or 'the beginning'} to {after.at or 'the end'}",
        _values(inputs),
        _values(outputs),
        [tensor for tensor in graph.initializer if tensor.name in read],
    )
    model = helper.make_model(part, opset_imports=network.model.opset_import, ir_version=network.model.ir_version)
    model.metadata_props.extend(network.model.metadata_props)
    onnx.checker.check_model(model)
    return NetworkPart(network.where, model, inputs, outputs, before.crossing, after.crossing)


def _needed(nodes: Sequence[onnx.NodeProto], outputs: Sequence[str]) -> list[onnx.NodeProto]:
    """Return, in their order, the nodes on which the tensors `outputs` depend."""
    wanted, needed = set(outputs), []
    for node in reversed(nodes):
        if wanted.intersection(node.output):
            wanted.update(node.input)
            needed.append(node)
    return needed[::-1]


def _declared(values: Any) -> Shapes:
    return {value.name: tuple(dim.dim_value for dim in value.type.tensor_type.shape.dim) for value in values}


def _values(shapes: Shapes) -> list[onnx.ValueInfoProto]:
    return [helper.make_tensor_value_info(name, TensorProto.UINT8, shape) for name, shape in shapes.items()]
