"""What a network asks of a unit: an ONNX graph walked once, as a list of operators with counts.

Rule: nothing here knows any hardware; `roofline.py` turns the counts into time.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from math import prod
from typing import Any, NamedTuple

import numpy as np
import onnx
from numpy.typing import NDArray

from trilane.errors import BadInputError
from trilane.hw_profiles.networks import NetworkSpec, build_network

ARITHMETIC = ("convolution", "pointwise", "depthwise")
TRAFFIC = ("normalisation", "resize", "elementwise", "permute")
CLASSES = ARITHMETIC + TRAFFIC

#: Operators that a runtime folds into the convolution before them, or that only name a tensor anew.
FOLDED = frozenset(
    ("Relu", "Clip", "Sigmoid", "BatchNormalization", "QuantizeLinear", "DequantizeLinear", "Identity")
) | frozenset(("Reshape", "Flatten", "Squeeze", "Unsqueeze", "Constant", "Dropout"))
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
REFERENCE_SIDES = (64, 128)
#: Permutations between channels first and channels last. The units work channels last, so these only tell a file's
#: order from the unit's and cost nothing.
LAYOUT_CHANGES = ((0, 3, 1, 2), (0, 2, 3, 1))
#: A normalisation by statistics reads its input once for them and once to apply them.
STATISTICS = frozenset(["InstanceNormalization", "GroupNormalization"])


class Operator(NamedTuple):
    """One operator. `macs` multiply-accumulates; `moved` activation elements read and written; `weights` elements.
    `c_in`, `c_out`: channels that one product joins and makes (per group), 0 where there is no product.
    `out`: elements of the result. `live`: elements that must be kept after it for later operators.
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


@dataclass(frozen=True)
class Work:
    """A network as work: its operators, and the elements and tensors that enter and leave."""

    operators: tuple[Operator, ...]
    input_elements: int
    input_tensors: int
    output_elements: int

    @cached_property
    def table(self) -> NDArray[np.float64]:
        """(operators, 5): macs, moved, c_in, c_out, out."""
        rows = [(o.macs, o.moved, o.c_in, o.c_out, o.out) for o in self.operators]
        return np.array(rows, dtype=np.float64).reshape(-1, 5)

    @cached_property
    def classes(self) -> NDArray[np.int64]:
        """(operators,): index into `CLASSES`."""
        return np.array([CLASSES.index(o.kind) for o in self.operators], dtype=np.int64)

    @cached_property
    def macs(self) -> int:
        return sum(o.macs for o in self.operators)

    @cached_property
    def weights(self) -> int:
        return sum(o.weights for o in self.operators)


class Network(NamedTuple):
    """What is to be run: the drawn tensor, how it is drawn (`packed` or `split`), and the work that follows on it.

    `facts` says which network it is, for reports.
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


def reference_network(spec: NetworkSpec) -> Network:
    """One of the reference networks."""
    facts = {"encoder": spec.encoder, "norm": spec.norm}
    return Network(facts, spec.height, spec.width, spec.channels, spec.layout, network_work(spec))


Shapes = Mapping[str, tuple[int, ...]]


def walk(model: Any) -> Work:
    """The work of `model` (an `onnx.ModelProto` of static shapes, NCHW or quantised with QDQ).

    Raises BadInputError for a tensor without a static shape and for an operator that the model does not know.
    """
    shapes = _shapes(model)
    graph = model.graph
    weights = {i.name for i in graph.initializer} | _weight_inputs(graph)
    weights |= {n.output[0] for n in graph.node if n.op_type == "DequantizeLinear" and n.input[0] in weights}
    alive = _alive(graph, shapes, weights)
    operators = tuple(
        _operator(n, shapes, weights)._replace(live=live)
        for n, live in zip(graph.node, alive, strict=True)
        if n.op_type not in FOLDED and not _changes_layout(n)
    )
    feeds = [i.name for i in graph.input if i.name not in weights]
    return Work(
        operators,
        sum(_size(shapes, name) for name in feeds),
        len(feeds),
        sum(_size(shapes, o.name) for o in graph.output),
    )


def graph_facts(model: Any) -> dict[str, Any]:
    """`parameters` of the layers as they are in the file, `gmac` of one pass. Raises as `walk`."""
    work = walk(model)
    return {"parameters": work.weights, "gmac": work.macs / 1e9}


@lru_cache(maxsize=4096)
def network_work(spec: NetworkSpec) -> Work:
    """The work of one of the reference networks.

    Their strides divide every side that `NetworkSpec` allows, so every count is a constant and a multiple of the
    number of pixels: graphs of two sizes are walked, and all sizes follow exactly.
    """
    small, large = (_walked(replace(spec, height=side, width=side)) for side in REFERENCE_SIDES)
    first, second = (side * side for side in REFERENCE_SIDES)

    def at(a: int, b: int) -> int:
        return a + (b - a) * (spec.pixels - first) // (second - first)

    operators = tuple(
        s._replace(macs=at(s.macs, b.macs), moved=at(s.moved, b.moved), out=at(s.out, b.out), live=at(s.live, b.live))
        for s, b in zip(small.operators, large.operators, strict=True)
    )
    ends = (at(small.input_elements, large.input_elements), at(small.output_elements, large.output_elements))
    return Work(operators, ends[0], small.input_tensors, ends[1])


@lru_cache(maxsize=512)
def _walked(spec: NetworkSpec) -> Work:
    return walk(build_network(spec))


def _shapes(model: Any) -> dict[str, tuple[int, ...]]:
    shapes = {i.name: tuple(i.dims) for i in model.graph.initializer}
    known = {v.name for v in model.graph.value_info}
    if any(name not in known for node in model.graph.node[:-1] for name in node.output[:1]):
        model = onnx.shape_inference.infer_shapes(model)
    for info in (*model.graph.input, *model.graph.value_info, *model.graph.output):
        shapes[info.name] = tuple(d.dim_value for d in info.type.tensor_type.shape.dim)
    return shapes


def _weight_inputs(graph: Any) -> set[str]:
    """Inputs that stand for weights in a graph without data: every second and later input of a product or norm."""
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


def _alive(graph: Any, shapes: Shapes, weights: set[str]) -> list[int]:
    """Elements that later nodes, or the caller, still need after each node."""
    last = {name: index for index, node in enumerate(graph.node) for name in node.input if name not in weights}
    last |= {output.name: len(graph.node) for output in graph.output}
    ends: dict[int, int] = {}
    alive, counts = 0, []
    for index, node in enumerate(graph.node):
        for name in node.output[:1]:
            size = prod(shapes.get(name, (0,)))
            if last.get(name, index) > index:
                alive += size
                ends[last[name]] = ends.get(last[name], 0) + size
        alive -= ends.pop(index, 0)
        counts.append(alive)
    return counts


def _operator(node: Any, shapes: Shapes, weights: set[str]) -> Operator:
    if node.op_type in ("Conv", "ConvTranspose"):
        return _convolution(node, shapes, weights)
    if node.op_type not in KIND_OF:
        known = ", ".join(sorted({"Conv", "ConvTranspose", *KIND_OF, *FOLDED}))
        raise BadInputError(f"node {node.name}", f"operator {node.op_type}", f"one of {known}")
    read = sum(_size(shapes, name) for name in node.input if name and name in shapes and name not in weights)
    out = _size(shapes, node.output[0])
    moved = read * (2 if node.op_type in STATISTICS else 1) + out
    return Operator(node.name, node.op_type, KIND_OF[node.op_type], 0, moved, 0, 0, 0, out)


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
