"""What a graph reckons with sizes alone is replaced by its values: each operator by hand, and where nothing is made."""

from __future__ import annotations

from typing import Any

import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper, numpy_helper

from trilane.hw_profiles.graph_shapes import fold

INT64 = TensorProto.INT64


def model(nodes: list[Any], **weights: Any) -> onnx.ModelProto:
    made = [numpy_helper.from_array(np.asarray(value), name) for name, value in weights.items()]
    ends = [helper.make_empty_tensor_value_info("y")]
    graph = helper.make_graph(nodes, "g", [helper.make_tensor_value_info("x", INT64, (2, 3, 4))], ends, made)
    return helper.make_model(graph, opset_imports=[helper.make_opsetid("", 20)])


def node(text: str, **attributes: Any) -> Any:
    """`Op a b -> c d`."""
    left, _, right = text.partition(" -> ")
    op_type, *inputs = left.split()
    return helper.make_node(op_type, inputs, right.split(), **attributes)


def folded(nodes: list[Any], shapes: dict[str, tuple[int, ...]] | None = None, **weights: Any) -> dict[str, Any] | None:
    """The values that came in by name; None when there were none. Operators that stay are `left`."""
    made = model(nodes, **weights)
    if not fold(made, shapes or {}):
        assert [n.op_type for n in made.graph.node] == [n.op_type for n in nodes]
        return None
    values = {t.name: numpy_helper.to_array(t).tolist() for t in made.graph.initializer if t.name not in weights}
    return {**values, "left": [n.op_type for n in made.graph.node]}


@pytest.mark.parametrize(
    ("attributes", "sizes"),
    [({}, [2, 3, 4]), ({"start": 1}, [3, 4]), ({"end": -1}, [2, 3]), ({"start": 1, "end": 2}, [3])],
)
def test_the_shape_of_what_is_known(attributes: dict[str, int], sizes: list[int]) -> None:
    assert folded([node("Shape x -> y", **attributes)], {"x": (2, 3, 4)}) == {"y": sizes, "left": []}


def test_the_size_of_what_is_known_and_nothing_of_what_is_not() -> None:
    assert folded([node("Size x -> y")], {"x": (2, 3, 4)}) == {"y": 24, "left": []}
    assert folded([node("Shape x -> y")], {"other": (1,)}) is None


def test_a_chain_is_reckoned_as_far_as_it_is_known() -> None:
    """Of sizes 2, 3, 4 the last two, their product, and -1 before it; what needs x itself stays."""
    nodes = [
        node("Shape x -> s"),
        node("Slice s one three -> last"),
        node("ReduceProd last -> n"),
        node("Concat minus n -> t", axis=0),
        node("Reshape x t -> r"),
        node("Split s -> a b c", num_outputs=3, axis=0),
        node("Identity r -> y"),
    ]
    found = folded(nodes, {"x": (2, 3, 4)}, one=[1], three=[3], minus=[-1])
    assert found == {
        **{"s": [2, 3, 4], "last": [3, 4], "n": [12], "t": [-1, 12], "a": [2], "b": [3], "c": [4]},
        "left": ["Reshape", "Identity"],
    }


def test_constants_stay_where_they_are_and_are_reckoned_with() -> None:
    given = node("Constant -> c", value=numpy_helper.from_array(np.array([5, 7]), "v"))
    assert folded([given, node("Add c c -> y")]) == {"y": [10, 14], "left": ["Constant"]}
    assert folded([given]) is None


LARGE = np.zeros(1025, np.int64)


@pytest.mark.parametrize(
    ("nodes", "weights", "value"),
    [
        ([node("Range a b c -> y")], {"a": 2, "b": 8, "c": 3}, [2, 5]),
        ([node("Range a b c -> y")], {"a": 0, "b": -1024, "c": -1}, list(range(0, -1024, -1))),
        ([node("Range a b c -> y")], {"a": 0, "b": -1025, "c": -1}, None),
        ([node("Range a b c -> y")], {"a": 0, "b": 5, "c": 0}, None),
        ([node("ConstantOfShape a -> y")], {"a": [2, 2]}, [[0.0, 0.0], [0.0, 0.0]]),
        ([node("ConstantOfShape a -> y")], {"a": [32, 33]}, None),
        ([node("Expand a b -> y")], {"a": [7], "b": [2]}, [7, 7]),
        ([node("Expand a b -> y")], {"a": [7, 8, 9], "b": [512, 1]}, None),
        ([node("Expand a b -> y")], {"a": [7], "b": [-1]}, None),
        ([node("Add a a -> y")], {"a": LARGE[1:]}, LARGE[1:].tolist()),
        ([node("Add a a -> y")], {"a": LARGE}, None),
        ([node("Concat a a -> y", axis=0)], {"a": LARGE[1:]}, None),
        ([node("Sin a -> y")], {"a": [1.0]}, None),
        ([node("Add a a -> y", domain="mine")], {"a": [1]}, None),
        ([node("Div a b -> y")], {"a": [7], "b": [2]}, [3]),
        ([node("Reshape a b -> y")], {"a": [1, 2, 3], "b": [2, 2]}, None),
        ([node("Add a x -> y")], {"a": [1]}, None),
    ],
)
def test_only_little_is_made(nodes: list[Any], weights: dict[str, Any], value: Any) -> None:
    """At most 1024 numbers, by operators that reckon with sizes; what is damaged stays."""
    found = folded(nodes, **weights)
    assert found == (None if value is None else {"y": value, "left": []})


def test_a_tensor_whose_data_was_forgotten_is_not_reckoned_with() -> None:
    made = model([node("Add a a -> y")], a=[1, 2])
    made.graph.initializer[0].raw_data = b""
    assert not fold(made, {})
