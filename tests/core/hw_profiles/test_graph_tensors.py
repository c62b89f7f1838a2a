"""The data that a graph's tensors claim, and the values that replace operators on sizes: each operator by hand."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper, numpy_helper

from trilane.hw_profiles.graph_tensors import bytes_of, check_size, fold, forget_data, is_ordinary, type_name
from trilane.unexpected_value import UnexpectedValue

BITS = {
    4: "UINT4 INT4 FLOAT4E2M1",
    8: "UINT8 INT8 BOOL FLOAT8E4M3FN FLOAT8E4M3FNUZ FLOAT8E5M2 FLOAT8E5M2FNUZ",
    16: "UINT16 INT16 FLOAT16 BFLOAT16",
    32: "FLOAT INT32 UINT32",
    64: "INT64 UINT64 DOUBLE COMPLEX64",
    128: "COMPLEX128",
}


def test_the_bytes_of_every_type() -> None:
    """Fifteen elements; seven of half a byte are four bytes."""
    for bits, names in BITS.items():
        for name in names.split():
            kind = getattr(TensorProto, name)
            assert bytes_of((5, 3), kind) == (15 * bits + 7) // 8, name
            assert type_name(kind) == name.lower()
    assert bytes_of((7,), TensorProto.INT4) == 4
    assert type_name(999) == "type 999"
    with pytest.raises(UnexpectedValue, match="elements of type string"):
        bytes_of((1,), TensorProto.STRING)


def test_a_tensor_may_have_a_gibibyte() -> None:
    side = 1 << 14
    assert is_ordinary((side, side), TensorProto.FLOAT)
    check_size((side, side), TensorProto.FLOAT, "it")
    assert not is_ordinary((side, side + 1), TensorProto.FLOAT)
    with pytest.raises(UnexpectedValue, match=r"it of 16384x16400 float, 1 GiB.*at most 1 GiB, more than any unit"):
        check_size((side, side + 16), TensorProto.FLOAT, "it")
    assert not is_ordinary((1,), TensorProto.STRING)
    assert is_ordinary((0,), TensorProto.STRING)


def test_small_tensors_keep_their_data(tmp_path: Path) -> None:
    for count, kept in ((1024, 4096), (1025, 0)):
        tensor = numpy_helper.from_array(np.zeros(count, np.float32), "t")
        forget_data(tensor, tmp_path)
        assert (len(tensor.raw_data), list(tensor.dims), tensor.name) == (kept, [count], "t")
        assert tensor.data_type == TensorProto.FLOAT


@pytest.mark.parametrize(
    ("kind", "field", "held", "claimed"),
    [
        (TensorProto.FLOAT, "float_data", 6, 6),
        (TensorProto.FLOAT, "float_data", 5, 6),
        (TensorProto.INT8, "int32_data", 6, 6),
        (TensorProto.FLOAT16, "int32_data", 6, 6),
        (TensorProto.INT64, "int64_data", 7, 6),
        (TensorProto.DOUBLE, "double_data", 6, 6),
        (TensorProto.UINT64, "uint64_data", 6, 6),
        (TensorProto.COMPLEX64, "float_data", 12, 12),
        (TensorProto.COMPLEX128, "double_data", 6, 12),
        (TensorProto.INT4, "int32_data", 3, 3),
        (TensorProto.UINT4, "int32_data", 6, 3),
    ],
)
def test_numbers_that_a_shape_claims(kind: int, field: str, held: int, claimed: int, tmp_path: Path) -> None:
    """Six elements: half-bytes share a number, complex ones have two."""
    tensor = TensorProto(name="t", data_type=kind, dims=(2, 3))
    getattr(tensor, field).extend([0] * held)
    if held == claimed:
        forget_data(tensor, tmp_path)
        assert len(getattr(tensor, field)) == held
    else:
        with pytest.raises(UnexpectedValue, match=rf"tensor 't' with {held} numbers, expected the {claimed} that its"):
            forget_data(tensor, tmp_path)


def test_texts_and_data_beside_the_file_are_forgotten(tmp_path: Path) -> None:
    words = helper.make_tensor("words", TensorProto.STRING, (2,), [b"a", b"b"])
    forget_data(words, tmp_path)
    assert (list(words.string_data), list(words.dims)) == ([], [2])
    beside = TensorProto(name="t", data_type=TensorProto.FLOAT, dims=(2,), data_location=TensorProto.EXTERNAL)
    beside.external_data.add(key="offset", value="../..")
    beside.external_data.add(key="location", value="sub/t.bin")
    forget_data(beside, tmp_path)
    assert not beside.external_data and list(beside.dims) == [2]


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


@pytest.mark.parametrize(
    "text", ["Where a b c -> y", "Max a b c -> y", "Min a b c a b c -> y", "Add a b -> y", f"Concat {'a ' * 99}-> y"]
)
def test_the_size_of_a_result_is_known_before_it_is_made(text: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """All inputs are small: 1024 numbers each, along an axis of their own."""
    monkeypatch.setattr("trilane.hw_profiles.graph_tensors.ReferenceEvaluator", lambda *_: pytest.fail("it was made"))
    along = {name: np.ones(np.roll((1, 1, 1024), turn), bool) for turn, name in enumerate("abc")}
    made = node(text, axis=0) if text.startswith("Concat") else node(text)
    assert folded([made], **along) is None


def test_a_tensor_whose_data_was_forgotten_is_not_reckoned_with() -> None:
    made = model([node("Add a a -> y")], a=[1, 2])
    made.graph.initializer[0].raw_data = b""
    assert not fold(made, {})
