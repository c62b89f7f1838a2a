"""Multiply-accumulates of the operators that multiply tensors: matrix products, sums over indices, recurrent layers.

Rule: a pure function of an operator's shapes and attributes; convolutions are counted in `network_work.py`.
"""

from __future__ import annotations

from math import prod
from typing import Any, NamedTuple

from trilane.hw_profiles.operator_kinds import PRODUCTS, RECURRENT

Shape = tuple[int, ...]


class Product(NamedTuple):
    """`macs`: multiply-accumulates. `c_in`: how many each result sums, `c_out`: how many results share a factor."""

    macs: int
    c_in: int
    c_out: int


def product_of(node: Any, shapes: list[Shape], out: Shape) -> Product | None:
    """What `node` multiplies; None where it cannot be told from its shapes.

    `node`: one of PRODUCTS or RECURRENT.
    `shapes`: of its inputs.
    `out`: shape of its first result.
    """
    if node.op_type in RECURRENT:
        return _recurrent(shapes) if [len(shape) for shape in shapes[:3]] == [3, 3, 3] else None
    if node.op_type == "Einsum":
        return _einsum(node, shapes)
    at = PRODUCTS[node.op_type]
    if len(shapes) <= at or not shapes[0] or not shapes[at]:
        return None
    first, second = shapes[0], shapes[at]
    turned = {a.name: a.i for a in node.attribute if a.name in ("transA", "transB")}
    depth = first[-2] if turned.get("transA") else first[-1]
    width = 1 if len(second) == 1 else second[-2] if turned.get("transB") else second[-1]
    return Product(prod(out) * depth, depth, width)


def _recurrent(shapes: list[Shape]) -> Product:
    """Every step of every sequence meets all weights: X (steps, sequences, size), W and R (directions, gates, size)."""
    steps, weights, recurrence = shapes[0], shapes[1], shapes[2]
    macs = prod(steps[:2]) * (prod(weights) + prod(recurrence))
    return Product(macs, steps[2], weights[1])


def _einsum(node: Any, shapes: list[Shape]) -> Product | None:
    """One product for every combination of all indices; an equation with an ellipsis is not looked into."""
    equation = next((a.s.decode() for a in node.attribute if a.name == "equation"), "").replace(" ", "")
    sources, _, result = equation.partition("->")
    terms = sources.split(",")
    if (
        "." in equation
        or len(terms) != len(shapes)
        or any(len(t) != len(s) for t, s in zip(terms, shapes, strict=True))
    ):
        return None
    sizes = {
        index: size for term, shape in zip(terms, shapes, strict=True) for index, size in zip(term, shape, strict=True)
    }
    summed = set(sizes) - set(result)
    return Product(
        prod(sizes.values()),
        prod(sizes[index] for index in summed),
        prod(sizes[index] for index in set(terms[-1]) - summed),
    )
