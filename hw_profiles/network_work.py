"""The work of a network: its ONNX operators, each with its multiply-accumulates and the elements that it moves.

This file knows no hardware; `unit_times.py` turns the counts into times.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from math import prod
from typing import Any, NamedTuple

import numpy as np
import onnx
from numpy.typing import NDArray

from trilane.errors import BadInputError
from trilane.hw_profiles.operators import (
    CLASSES,
    CONVOLUTIONS,
    DOMAINS,
    FOLDED,
    KIND_OF,
    LAYOUT_CHANGES,
    NO_LAYERS,
    OF_SHAPES,
    PRODUCTS,
    RECURRENT,
    RENAMES,
    STATISTICS,
    UNKNOWN,
    WEIGHTED,
    Layers,
    Shapes,
    first_result,
    has_rule,
    layers_of,
    product_of,
)

#: Name of a weight in a graph without weights, in which each weight is an input.
WEIGHT_INPUT = re.compile(r"w\d+")
#: Number of inputs of a batch normalisation that count: data, scale, shift. The others are folded into these.
SCALE_AND_SHIFT = 3
#: Least number of axes of a tensor that is convolved: batch, channels, one side.
CONVOLVED = 3


class Operator(NamedTuple):
    """One operator of a network and its counts.

    `op_type`: its ONNX type.
    `kind`: one of CLASSES.
    `macs`: multiply-accumulates.
    `moved`: activation elements that it reads and writes.
    `weights`: elements of its weights.
    `c_in`, `c_out`: input and output channels per group; 0 for an operator without products.
    `out`: elements of its result.
    `live`: elements that exist after it because later operators read them.
    `ruled`: whether `operators.py` knows the operator; an unknown operator counts only the movement of its elements.
    """

    name: str
    op_type: str
    kind: str
    macs: int
    moved: int
    weights: int
    c_in: int
    c_out: int
    out: int
    live: int = 0
    ruled: bool = True


@dataclass(frozen=True)
class Work:
    """The work of a network.

    `operators`: operators in order.
    `input_elements`, `output_elements`: elements of its inputs and of its outputs.
    `input_tensors`: number of tensors that together are its picture, joined by the first operator; 1 for other inputs.
    `layers`: the same work as layers of a tensor engine.
    """

    operators: tuple[Operator, ...]
    input_elements: int
    input_tensors: int
    output_elements: int
    layers: Layers = field(default=NO_LAYERS, compare=False)

    @cached_property
    def table(self) -> NDArray[np.float64]:
        """The counts of the operators (operators, 5), with the columns macs, moved, c_in, c_out, out."""
        rows = [(o.macs, o.moved, o.c_in, o.c_out, o.out) for o in self.operators]
        return np.array(rows, dtype=np.float64).reshape(-1, 5)

    @cached_property
    def classes(self) -> NDArray[np.int64]:
        """The index into `CLASSES` of each operator (operators,)."""
        return np.array([CLASSES.index(o.kind) for o in self.operators], dtype=np.int64)

    @cached_property
    def macs(self) -> int:
        """The multiply-accumulates of the whole network."""
        return sum(o.macs for o in self.operators)

    @cached_property
    def weights(self) -> int:
        """The weight elements of the whole network."""
        return sum(o.weights for o in self.operators)


def one_after_the_other(works: Sequence[Work]) -> Work:
    """Return the work of a job that runs one or more networks, each on its own input."""
    if len(works) == 1:
        return works[0]
    parts = [work.layers.named(f"{number}/") for number, work in enumerate(works)]
    return Work(
        operators=tuple(operator for work in works for operator in work.operators),
        input_elements=sum(work.input_elements for work in works),
        input_tensors=max(work.input_tensors for work in works),
        output_elements=sum(work.output_elements for work in works),
        layers=Layers(
            tuple(layer for part in parts for layer in part.layers),
            {name: size for part in parts for name, size in part.sizes.items()},
            sum(part.input for part in parts),
            sum(part.output for part in parts),
        ),
    )


class Network(NamedTuple):
    """A network with the input that the raster stage draws for it.

    `facts`: keys that identify the network in reports.
    `height`, `width`, `channels`: size of its input.
    `layout`: `packed` (one tensor) or `split` (one tensor per raster pass).
    `work`: work of one frame.
    """

    facts: Mapping[str, str]
    height: int
    width: int
    channels: int
    layout: str
    work: Work

    @property
    def pixels(self) -> int:
        return self.height * self.width


def count_work(model: Any) -> Work:
    """Return the work of `model`, an `onnx.ModelProto` with static shapes, NCHW, in floats or quantised with QDQ.

    An operator whose results depend only on constants and shapes costs nothing. An operator without a rule counts only
    the movement of its elements, and has `ruled` False.

    Raises BadInputError for a tensor without a static shape, shapes that contradict each other, or a convolution whose
    tensors do not fit.
    """
    shapes = _shapes(model)
    graph = model.graph
    constants = constant_tensors(graph)
    live_counts = _live_counts(graph, shapes, constants)
    read = {name for node in graph.node for name in node.input} | {output.name for output in graph.output}
    lone = _lone_normalisations(graph)
    operators = tuple(
        _operator(n, shapes, constants, read)._replace(live=live)
        for n, live in zip(graph.node, live_counts, strict=True)
        if n.output[0] in lone or not _costs_nothing(n, constants)
    )
    inputs = [i.name for i in graph.input if i.name not in constants]
    return Work(
        operators,
        sum(_size(shapes, name) for name in inputs),
        _picture_tensors(graph, inputs),
        sum(_size(shapes, o.name) for o in graph.output),
        layers_of(graph, shapes, constants),
    )


def _picture_tensors(graph: Any, inputs: list[str]) -> int:
    """Return the number of inputs that form one picture: all if only one concatenation reads them, otherwise 1."""
    given, readers = set(inputs), []
    for node in graph.node:
        if given.intersection(node.input):
            if node.op_type in RENAMES:
                given.update(node.output)
            else:
                readers.append(node.op_type)
    return len(inputs) if readers == ["Concat"] else 1


def graph_facts(model: Any) -> dict[str, Any]:
    """Return the facts of a network for reports. Raises as `count_work` does.

    `parameters` is the number of weight elements, and `gmac` the number of multiply-accumulates in 1e9.
    """
    work = count_work(model)
    return {"parameters": work.weights, "gmac": work.macs / 1e9}


def constant_tensors(graph: Any) -> set[str]:
    """Return the names of the tensors that depend only on weights and shapes.

    An input of the graph counts as a weight if its name is `w<n>`, unless all inputs have such names. It also counts as
    a weight if a convolution or normalisation reads it after its first input.
    """
    names = {i.name for i in graph.initializer} | _weight_inputs(graph) | {""}  # "" is an input that is left out
    for node in graph.node:
        if names.issuperset(node.input) or node.op_type in OF_SHAPES:
            names.update(node.output)
    return names - {""}


def _shapes(model: Any) -> dict[str, tuple[int, ...]]:
    shapes = {i.name: tuple(i.dims) for i in model.graph.initializer}
    known = {v.name for v in model.graph.value_info}
    if any(name not in known for node in model.graph.node[:-1] for name in node.output[:1]):
        try:
            model = onnx.shape_inference.infer_shapes(model)
        except onnx.shape_inference.InferenceError as error:
            wrong = str(error).splitlines()[0]
            raise BadInputError("its shapes", wrong, "shapes that follow from each other", "export it again") from None
    for info in (*model.graph.input, *model.graph.value_info, *model.graph.output):
        shapes[info.name] = tuple(d.dim_value for d in info.type.tensor_type.shape.dim)
    return shapes


def _weight_inputs(graph: Any) -> set[str]:
    names = {i.name for i in graph.input}
    kinds = ("Conv", "ConvTranspose", "InstanceNormalization", "GroupNormalization")
    after_first = {name for node in graph.node if node.op_type in kinds for name in node.input[1:] if name in names}
    numbered = {name for name in names if WEIGHT_INPUT.fullmatch(name)}
    return after_first | (numbered if numbered != names else set())


def _size(shapes: Shapes, name: str) -> int:
    if name not in shapes or min(shapes[name], default=1) <= 0:
        raise BadInputError(f"tensor {name}", "no static shape", "a network exported with fixed sizes")
    return prod(shapes[name])


def _lone_normalisations(graph: Any) -> set[str]:
    """Return the names of the results of batch normalisations that cannot be folded into a product before them."""
    maker = {name: node.op_type for node in graph.node for name in node.output}
    reads = Counter(name for node in graph.node for name in node.input)
    return {
        node.output[0]
        for node in graph.node
        if node.op_type == "BatchNormalization"
        and (maker.get(node.input[0]) not in (*CONVOLUTIONS, *PRODUCTS) or reads[node.input[0]] > 1)
    }


def _costs_nothing(node: Any, constants: set[str]) -> bool:
    return (
        (node.op_type in FOLDED and node.domain in DOMAINS)
        or (node.op_type == "Transpose" and any(tuple(a.ints) in LAYOUT_CHANGES for a in node.attribute))
        or all(name in constants for name in node.output if name)
    )


def _live_counts(graph: Any, shapes: Shapes, constants: set[str]) -> list[int]:
    """Return for each node how many elements exist after it, because later nodes read them or they are outputs."""
    last_use = {name: index for index, node in enumerate(graph.node) for name in node.input if name not in constants}
    last_use |= {output.name: len(graph.node) for output in graph.output}
    freed: dict[int, int] = {}
    live, counts = 0, []
    for index, node in enumerate(graph.node):
        for name in node.output:
            size = prod(shapes.get(name, (0,)))
            if last_use.get(name, index) > index:
                live += size
                freed[last_use[name]] = freed.get(last_use[name], 0) + size
        live -= freed.pop(index, 0)
        counts.append(live)
    return counts


def _operator(node: Any, shapes: Shapes, constants: set[str], read: set[str]) -> Operator:
    """Return the counts of `node`. `read`: names of the tensors that any node reads, and of the graph's outputs."""
    known = has_rule(node.op_type, node.domain)
    weighted = node.op_type in WEIGHTED and known
    own = node.input[:SCALE_AND_SHIFT] if node.op_type == "BatchNormalization" else node.input
    weights = sum(_size(shapes, name) for name in own if name in constants) if weighted else 0
    moved_in = [_size(shapes, name) for name in node.input if name and name not in constants]
    out = sum(_size(shapes, name) for name in node.output if name and (name in read or name == first_result(node)))
    moved = sum(moved_in) * (2 if node.op_type in STATISTICS else 1) + out
    name, kind = node.name or first_result(node), KIND_OF.get(node.op_type, UNKNOWN)
    plain = Operator(name, node.op_type, kind, 0, moved, weights, 0, 0, out)
    if known and node.op_type in CONVOLUTIONS:
        return _convolution(node, shapes, plain)
    if known and (node.op_type in PRODUCTS or node.op_type in RECURRENT):
        product = product_of(node, [shapes.get(name, ()) for name in node.input], shapes[first_result(node)])
        return plain if product is None else plain._replace(kind="pointwise", **product._asdict())
    return plain if known else plain._replace(kind=UNKNOWN, ruled=False)


def _convolution(node: Any, shapes: Shapes, plain: Operator) -> Operator:
    """Return the counts of the convolution `node`. `plain`: its counts without products."""
    groups = next((a.i for a in node.attribute if a.name == "group"), 1)
    names = node.input[CONVOLUTIONS[node.op_type]], node.input[0], node.output[0]
    weight, source, result = (shapes[name] for name in names)
    if min(len(weight), len(source), len(result)) < CONVOLVED or not 0 < groups <= min(source[1], result[1]):
        found = f"tensors of {len(source)}, {len(weight)} and {len(result)} dimensions in {groups} groups"
        raise BadInputError(f"operator {plain.name}", found, "a convolution of pictures", "export it again")
    c_in, c_out = source[1] // groups, result[1] // groups
    kernel = prod(weight[2:])
    positions = prod(source) // source[1] if node.op_type == "ConvTranspose" else prod(result) // (c_out * groups)
    kind = "depthwise" if groups > 1 and c_in == 1 else "pointwise" if kernel == 1 else "convolution"
    macs = positions * kernel * c_in * c_out * groups
    return plain._replace(kind=kind, macs=macs, c_in=c_in, c_out=c_out)
