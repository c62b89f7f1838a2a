"""Cuts a quantised network in two at a quantised tensor. Rule: only bytes cross a cut, so that the parts one after the
other give the bytes of the whole.

What crosses beside the tensor itself (the skips of a U-Net, its input) crosses too; a Dequantize whose bytes cross,
and a Transpose behind it, go to the second part.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import onnx
from onnx import TensorProto, helper

from trilane.avatars.network_file import NetworkFile
from trilane.errors import BadInputError

QUANTIZE = "QuantizeLinear"
#: Nodes of one input that the second part can do again from the bytes that cross.
MOVABLE = ("DequantizeLinear", "Transpose")


@dataclass(frozen=True)
class Cut:
    """A place to cut. `crossing`: tensor (all uint8) to shape; `at` is one of them. `nodes`: how many come before."""

    at: str
    crossing: dict[str, tuple[int, ...]]
    nodes: int

    @property
    def bytes(self) -> int:
        return sum(int(np.prod(shape)) for shape in self.crossing.values())


def cuts(network: NetworkFile) -> Iterator[Cut]:
    """Every place where `network` can be cut, in the order of its work."""
    graph = onnx.shape_inference.infer_shapes(network.model).graph
    for number, node in enumerate(graph.node, 1):
        if node.op_type == QUANTIZE and node.output[0] != graph.output[0].name:
            crossing = _crossing(graph, number)
            if crossing is not None and node.output[0] in crossing:
                yield Cut(node.output[0], crossing, number)


def split(network: NetworkFile, at: str) -> tuple[onnx.ModelProto, onnx.ModelProto]:
    """The part up to the quantised tensor `at`, and the rest. Raises BadInputError when it cannot be cut there."""
    for cut in cuts(network):
        if cut.at == at:
            return _part(network, cut, head=True), _part(network, cut, head=False)
    raise BadInputError(f"{network.where}, --at", repr(at), "a quantised tensor; without --at they are listed")


def _crossing(graph: onnx.GraphProto, nodes: int) -> dict[str, tuple[int, ...]] | None:
    """What the nodes from number `nodes` on read of those before; None when it is not bytes alone."""
    makers = {name: node for node in graph.node[:nodes] for name in node.output}
    shapes = _shapes(graph)
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
    return {name: shapes[name] for name in distinct}


def _part(network: NetworkFile, cut: Cut, *, head: bool) -> onnx.ModelProto:
    graph = network.model.graph
    values = [helper.make_tensor_value_info(name, TensorProto.UINT8, shape) for name, shape in cut.crossing.items()]
    if head:
        nodes = list(graph.node[: cut.nodes])
        inputs, outputs = list(graph.input), [value for value in values if value.name != graph.input[0].name]
        nodes = _needed(nodes, [value.name for value in outputs])
    else:
        nodes, inputs, outputs = _tail_nodes(graph, cut), values, list(graph.output)
    used = {name for node in nodes for name in node.input}
    part = helper.make_graph(
        nodes,
        f"{graph.name} {'head' if head else 'tail'}",
        inputs,
        outputs,
        [t for t in graph.initializer if t.name in used],
    )
    model = helper.make_model(part, opset_imports=network.model.opset_import, ir_version=network.model.ir_version)
    onnx.checker.check_model(model)
    return model


def _tail_nodes(graph: onnx.GraphProto, cut: Cut) -> list[onnx.NodeProto]:
    """The nodes behind the cut, after those that lead from what crosses to what they read."""
    movable = [node for node in graph.node[: cut.nodes] if node.op_type in MOVABLE]
    read = [name for node in graph.node[cut.nodes :] for name in node.input]
    return [*_needed(movable, read), *graph.node[cut.nodes :]]


def _needed(nodes: Sequence[onnx.NodeProto], outputs: Sequence[str]) -> list[onnx.NodeProto]:
    wanted, kept = set(outputs), []
    for node in reversed(nodes):
        if wanted.intersection(node.output):
            wanted.update(node.input)
            kept.append(node)
    return kept[::-1]


def _shapes(graph: Any) -> dict[str, tuple[int, ...]]:
    values = (*graph.value_info, *graph.input, *graph.output)
    return {value.name: tuple(dim.dim_value for dim in value.type.tensor_type.shape.dim) for value in values}
