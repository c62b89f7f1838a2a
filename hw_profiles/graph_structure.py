"""Whether the operators of a graph fit together: every tensor made once, before it is read, and no circle.

Rule: names alone are looked at; shapes come after.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from graphlib import CycleError, TopologicalSorter

import onnx
from onnx import AttributeProto

from trilane.unexpected_value import UnexpectedValue

EXPORT_AGAIN = "export it again, and check it with onnx.checker.check_model"
_KINDS = {"sequence_type": "a sequence", "map_type": "a map", "optional_type": "an optional value"}


def called(node: onnx.NodeProto) -> str:
    """How messages call an operator."""
    kind = f"{node.domain}:{node.op_type}" if node.domain not in ("", "ai.onnx") else node.op_type
    return f"{kind} {node.name!r}" if node.name else f"{kind} that makes {next(iter(node.output), '')!r}"


def check_structure(graph: onnx.GraphProto) -> None:
    """Raises UnexpectedValue for operators that hold graphs, and for tensors that nobody or several make."""
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
    """Names of all tensors, once for each time that they are made. A weight may be declared as an input too."""
    weights = [tensor.name for tensor in graph.initializer]
    yield from weights
    yield from (value.name for value in graph.input if value.name not in set(weights))
    yield from (name for node in graph.node for name in node.output if name)


def in_order(graph: onnx.GraphProto) -> None:
    """Put the operators into an order in which each comes after those that it reads, and drop those nobody needs.

    `graph`: is changed; its operators stay as they are where they are in order.
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
