"""The work of a network: its ONNX operators, each with its multiply-accumulates and the elements that it moves.

Rule: nothing here knows any hardware; `operator_times.py` turns the counts into time.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from math import prod
from typing import Any, NamedTuple

import numpy as np
import onnx
from numpy.typing import NDArray

from trilane.errors import BadInputError

ARITHMETIC = ("convolution", "pointwise", "depthwise")
TRAFFIC = ("normalisation", "resize", "elementwise", "permute")
CLASSES = ARITHMETIC + TRAFFIC

#: Operators that cost nothing: a runtime folds them into the convolution before them, or they only rename a tensor.
FOLDED = frozenset(
    ("Relu", "Clip", "Sigmoid", "BatchNormalization", "QuantizeLinear", "DequantizeLinear", "Identity")
) | frozenset(("Reshape", "Flatten", "Squeeze", "Unsqueeze", "Constant", "Dropout"))
#: ONNX operator -> its class, for all but convolutions.
KIND_OF = {
    "InstanceNormalization": "normalisation",
    "GroupNormalization": "normalisation",
    "GlobalAveragePool": "normalisation",
    "ReduceMean": "normalisation",
    "Resize": "resize",
    "Upsample": "resize",
    "Concat": "resize",
    "MaxPool": "resize",
    "AveragePool": "resize",
    "Slice": "resize",
    "Split": "resize",
    "Pad": "resize",
    "Transpose": "permute",
    "Add": "elementwise",
    "Mul": "elementwise",
    "Sub": "elementwise",
    "Div": "elementwise",
    "HardSwish": "elementwise",
    "HardSigmoid": "elementwise",
    "Tanh": "elementwise",
    "LeakyRelu": "elementwise",
}
#: Permutations between channels first and channels last. They cost nothing: the units work with channels last, and
#: these operators are in the file only because its order is the other one.
LAYOUT_CHANGES = ((0, 3, 1, 2), (0, 2, 3, 1))
#: Normalisations that read their input twice: once for its mean and variance and once to apply them.
STATISTICS = frozenset(["InstanceNormalization", "GroupNormalization"])


class Operator(NamedTuple):
    """One operator of a network and its counts.

    `op_type`: of ONNX. `kind`: of CLASSES. `macs`: multiply-accumulates. `moved`: activation elements read and written.
    `weights`: elements of its weights. `c_in`, `c_out`: input and output channels per group, 0 for an operator without
    products. `out`: elements of the result. `live`: elements that later operators still need after it. `ruled`: whether
    the tables above know the operator; one that they do not know counts as the movement of its elements.
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
    """The operators of a network, in order, and the sizes of its inputs and outputs in elements."""

    operators: tuple[Operator, ...]
    input_elements: int
    input_tensors: int
    output_elements: int

    @cached_property
    def table(self) -> NDArray[np.float64]:
        """Counts (operators, 5): macs, moved, c_in, c_out, out."""
        rows = [(o.macs, o.moved, o.c_in, o.c_out, o.out) for o in self.operators]
        return np.array(rows, dtype=np.float64).reshape(-1, 5)

    @cached_property
    def classes(self) -> NDArray[np.int64]:
        """Index into `CLASSES` of each operator (operators,)."""
        return np.array([CLASSES.index(o.kind) for o in self.operators], dtype=np.int64)

    @cached_property
    def macs(self) -> int:
        """Multiply-accumulates of the whole network."""
        return sum(o.macs for o in self.operators)

    @cached_property
    def weights(self) -> int:
        """Weight elements of the whole network."""
        return sum(o.weights for o in self.operators)


class Network(NamedTuple):
    """A network with the input that the raster stage draws for it.

    `facts`: what reports call it. `height`, `width`, `channels`: of its input. `layout`: `packed` (one tensor) or
    `split` (one tensor per raster pass).
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


Shapes = Mapping[str, tuple[int, ...]]


def count_work(model: Any) -> Work:
    """The work of `model`, an `onnx.ModelProto` with static shapes, NCHW, in floats or quantised with QDQ.

    An operator that is in none of the tables above counts as the movement of its elements, with `ruled` False. Raises
    BadInputError for a tensor without a static shape.
    """
    shapes = _shapes(model)
    graph = model.graph
    weights = {i.name for i in graph.initializer} | _weight_inputs(graph)
    weights |= {n.output[0] for n in graph.node if n.op_type == "DequantizeLinear" and n.input[0] in weights}
    live_counts = _live_counts(graph, shapes, weights)
    operators = tuple(
        _operator(n, shapes, weights)._replace(live=live)
        for n, live in zip(graph.node, live_counts, strict=True)
        if n.op_type not in FOLDED and not _changes_layout(n)
    )
    inputs = [i.name for i in graph.input if i.name not in weights]
    return Work(
        operators,
        sum(_size(shapes, name) for name in inputs),
        len(inputs),
        sum(_size(shapes, o.name) for o in graph.output),
    )


def graph_facts(model: Any) -> dict[str, Any]:
    """`parameters` of the layers as they are in the file, `gmac` of one pass. Raises as `count_work`."""
    work = count_work(model)
    return {"parameters": work.weights, "gmac": work.macs / 1e9}


def _shapes(model: Any) -> dict[str, tuple[int, ...]]:
    shapes = {i.name: tuple(i.dims) for i in model.graph.initializer}
    known = {v.name for v in model.graph.value_info}
    if any(name not in known for node in model.graph.node[:-1] for name in node.output[:1]):
        model = onnx.shape_inference.infer_shapes(model)
    for info in (*model.graph.input, *model.graph.value_info, *model.graph.output):
        shapes[info.name] = tuple(d.dim_value for d in info.type.tensor_type.shape.dim)
    return shapes


def _weight_inputs(graph: Any) -> set[str]:
    """Graph inputs that are weights: those that a convolution or normalisation has as its second or a later input."""
    names = {i.name for i in graph.input}
    kinds = ("Conv", "ConvTranspose", "InstanceNormalization", "GroupNormalization")
    return {name for node in graph.node if node.op_type in kinds for name in node.input[1:] if name in names}


def _size(shapes: Shapes, name: str) -> int:
    size = prod(shapes.get(name, (0,)))
    if size <= 0:
        raise BadInputError(f"tensor {name}", "no static shape", "a network exported with fixed sizes")
    return size


def _changes_layout(node: Any) -> bool:
    return node.op_type == "Transpose" and any(tuple(a.ints) in LAYOUT_CHANGES for a in node.attribute)


def _live_counts(graph: Any, shapes: Shapes, weights: set[str]) -> list[int]:
    """After each node: elements of all results so far that later nodes, or the caller, still need."""
    last_use = {name: index for index, node in enumerate(graph.node) for name in node.input if name not in weights}
    last_use |= {output.name: len(graph.node) for output in graph.output}
    freed: dict[int, int] = {}
    live, counts = 0, []
    for index, node in enumerate(graph.node):
        for name in node.output[:1]:
            size = prod(shapes.get(name, (0,)))
            if last_use.get(name, index) > index:
                live += size
                freed[last_use[name]] = freed.get(last_use[name], 0) + size
        live -= freed.pop(index, 0)
        counts.append(live)
    return counts


def _operator(node: Any, shapes: Shapes, weights: set[str]) -> Operator:
    if node.op_type in ("Conv", "ConvTranspose"):
        return _convolution(node, shapes, weights)
    read = sum(_size(shapes, name) for name in node.input if name and name in shapes and name not in weights)
    out = _size(shapes, node.output[0])
    moved = read * (2 if node.op_type in STATISTICS else 1) + out
    kind, ruled = KIND_OF.get(node.op_type, "elementwise"), node.op_type in KIND_OF
    return Operator(node.name, node.op_type, kind, 0, moved, 0, 0, 0, out, ruled=ruled)


def _convolution(node: Any, shapes: Shapes, weights: set[str]) -> Operator:
    groups = next((a.i for a in node.attribute if a.name == "group"), 1)
    weight = shapes[node.input[1]]
    source, out = _size(shapes, node.input[0]), _size(shapes, node.output[0])
    c_in, c_out = shapes[node.input[0]][1] // groups, shapes[node.output[0]][1] // groups
    kernel = prod(weight[2:])
    positions = source // shapes[node.input[0]][1] if node.op_type == "ConvTranspose" else out // (c_out * groups)
    kind = "depthwise" if groups > 1 and c_in == 1 else "pointwise" if kernel == 1 else "convolution"
    size = sum(prod(shapes[name]) for name in node.input[1:] if name in weights)
    macs = positions * kernel * c_in * c_out * groups
    return Operator(node.name, node.op_type, kind, macs, source + out, size, c_in, c_out, out)
