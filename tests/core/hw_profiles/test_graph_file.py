"""Graphs of strangers: what is read of them, and what each malformed one is told."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper, numpy_helper

from trilane.errors import BadInputError
from trilane.hw_profiles import graph_file, graph_tensors
from trilane.hw_profiles.graph_file import GraphFile, read_graph
from trilane.hw_profiles.network_work import count_work

FLOAT = TensorProto.FLOAT
IMAGE = (1, 3, 8, 8)


def value(name: str, shape: Any = IMAGE, kind: int = FLOAT) -> onnx.ValueInfoProto:
    return helper.make_tensor_value_info(name, kind, shape)


def weight(name: str, *shape: int) -> TensorProto:
    return numpy_helper.from_array(np.ones(shape, np.float32), name)


def integers(name: str, *numbers: int) -> TensorProto:
    return numpy_helper.from_array(np.array(numbers, np.int64), name)


def model(
    nodes: list[Any], inputs: Any = None, outputs: Any = None, weights: Any = (), opset: int = 17, **more: Any
) -> onnx.ModelProto:
    graph = helper.make_graph(
        nodes, "g", [value("image")] if inputs is None else inputs, outputs or [value("y", None)], list(weights), **more
    )
    domains = {node.domain for node in nodes} - {""}
    return helper.make_model(
        graph, opset_imports=[helper.make_opsetid("", opset), *(helper.make_opsetid(d, 1) for d in sorted(domains))]
    )


def node(op: str, inputs: str, outputs: str, **attributes: Any) -> onnx.NodeProto:
    return helper.make_node(op, inputs.split(), outputs.split(), name=f"the {op}", **attributes)


def read(made: onnx.ModelProto, folder: Path, **shapes: tuple[int, ...]) -> GraphFile:
    path = folder / "net.onnx"
    path.write_bytes(made.SerializeToString())
    return read_graph(path, shapes)


def conv(**attributes: Any) -> onnx.NodeProto:
    return node("Conv", "image w", "y", pads=[1] * 4, **attributes)


RELU = node("Relu", "image", "y")


def claimed(*shape: int) -> TensorProto:
    return TensorProto(name="w", data_type=FLOAT, dims=shape, raw_data=b"1234")


def outside(location: str) -> TensorProto:
    tensor = TensorProto(name="w", data_type=FLOAT, dims=(4, 3, 3, 3), data_location=TensorProto.EXTERNAL)
    tensor.external_data.add(key="location", value=location)
    return tensor


def sequence() -> onnx.ModelProto:
    kind = helper.make_sequence_type_proto(helper.make_tensor_type_proto(FLOAT, IMAGE))
    return model([RELU], [value("image"), helper.make_value_info("list", kind)])


def branching() -> onnx.ModelProto:
    branch = helper.make_graph([node("Relu", "image", "z")], "branch", [], [value("z")])
    yes = numpy_helper.from_array(np.array(True), "w")
    return model([node("If", "w", "y", then_branch=branch, else_branch=branch)], weights=[yes])


def looping() -> onnx.ModelProto:
    inside = [value("i", (), TensorProto.INT64), value("go", (), TensorProto.BOOL), value("x")]
    body = helper.make_graph([node("Relu", "x", "z")], "body", inside, [value("go", (), TensorProto.BOOL), value("z")])
    return model([node("Loop", "w go image", "y", body=body)], weights=[integers("w", 3), integers("go", 1)])


def with_function() -> onnx.ModelProto:
    made = model([node("Twice", "image", "y", domain="mine")])
    made.functions.append(helper.make_function("mine", "Twice", ["a"], ["b"], [], made.opset_import))
    return made


def sparse() -> onnx.ModelProto:
    made = model([RELU])
    made.graph.sparse_initializer.add()
    return made


def no_operator_set() -> onnx.ModelProto:
    made = model([RELU])
    del made.opset_import[:]
    return made


#: Name -> (model, words of its message).
MALFORMED: dict[str, tuple[Callable[[], onnx.ModelProto], tuple[str, ...]]] = {
    "circle": (
        lambda: model([node("Add", "image b", "a"), node("Relu", "a", "b"), node("Relu", "b", "y")]),
        ("a circle: ", "Add 'the Add'", "Relu 'the Relu'", "onnx.checker"),
    ),
    "reads itself": (lambda: model([node("Add", "image y", "y")]), ("a circle: Add 'the Add'",)),
    "dynamic axes": (
        lambda: model([RELU], [value("image", ("n", 3, "h", 8))]),
        ("input 'image' of [n, 3, h, 8]", "--input-shape image=1x3xNx8, a number for each N"),
    ),
    "input without a shape": (
        lambda: model([RELU], [value("image", None)]),
        ("input 'image' of unknown shape", "--input-shape image=1x3x224x224"),
    ),
    "size zero": (
        lambda: model([RELU], [value("image", (1, 0, 8, 8))]),
        ("input 'image' of [1, 0, 8, 8]", "1 and more"),
    ),
    "negative size": (lambda: model([RELU], [value("image", (1, -3, 8, 8))]), ("input 'image' of [1, -3, 8, 8]",)),
    "result without size": (
        lambda: model([node("Conv", "image w", "y")], weights=[weight("w", 4, 3, 9, 9)]),
        ("no static shape for 'y' of [1, 4, 0, 0], made by Conv 'the Conv'",),
    ),
    "size by what it sees": (
        lambda: model([node("NonZero", "image", "y")], outputs=[value("y", None, TensorProto.INT64)]),
        ("NonZero 'the NonZero'", "depends on the picture"),
    ),
    "gigabytes claimed": (
        lambda: model([conv()], weights=[claimed(1 << 15, 1 << 14, 1, 1)]),
        ("tensor 'w' of 32768x16384x1x1 float, 2 GiB", "at most 1 GiB"),
    ),
    "gigabytes of a picture": (
        lambda: model([RELU], [value("image", (1, 3, 1 << 15, 1 << 13))]),
        ("input 'image' of 1x3x32768x8192 float, 3 GiB",),
    ),
    "gigabytes of a result": (
        lambda: model(
            [node("Expand", "image w", "y")],
            [value("image", (1, 3, 1, 1))],
            weights=[integers("w", 1, 3, 1 << 20, 1 << 20)],
        ),
        ("the result of Expand 'the Expand' of 1x3x1048576x1048576 float",),
    ),
    "less data than claimed": (
        lambda: model([conv()], weights=[claimed(4, 3, 3, 3)]),
        ("tensor 'w' with 4 bytes", "the 432 that its shape claims", "cut short"),
    ),
    "negative weight": (lambda: model([conv()], weights=[claimed(4, -3)]), ("tensor 'w' of 4x-3",)),
    "data outside the folder": (
        lambda: model([conv()], weights=[outside("../../etc/passwd")]),
        ("tensor 'w' kept in '../../etc/passwd'", "move it there"),
    ),
    "data at an absolute path": (lambda: model([conv()], weights=[outside("/etc/passwd")]), ("'/etc/passwd'",)),
    "data nowhere": (lambda: model([conv()], weights=[outside("a\0b")]), ("kept in",)),
    "custom domain": (
        lambda: model([node("Warp", "image", "a", domain="mine"), node("Relu", "a", "y")]),
        ("mine:Warp 'the Warp'", "no such operator", "value_info"),
    ),
    "unknown operator": (lambda: model([node("Warp", "image", "y")]), ("Warp 'the Warp'", "no such operator")),
    "missing tensor": (
        lambda: model([node("Add", "image nobody", "y")]),
        ("tensor 'nobody', which Add 'the Add' reads, made nowhere",),
    ),
    "missing output": (lambda: model([node("Relu", "image", "z")]), ("output 'y' made nowhere",)),
    "no outputs": (lambda: _without_outputs(), ("no outputs",)),
    "two producers": (lambda: model([RELU, node("Abs", "image", "y")]), ("tensor 'y' made 2 times",)),
    "weight and result": (lambda: model([RELU], weights=[weight("y", 1)]), ("tensor 'y' made 2 times",)),
    "two weights of a name": (
        lambda: model([conv()], weights=[weight("w", 4, 3, 3, 3)] * 2),
        ("tensor 'w' made 2 times",),
    ),
    "operators of 2016": (lambda: model([RELU], opset=6), ("operator set 6", "convert_version")),
    "operators of tomorrow": (lambda: model([RELU], opset=999), ("operator set 999",)),
    "no operator set": (no_operator_set, ("0 operator sets",)),
    "empty": (lambda: model([]), ("no operators",)),
    "nothing to do": (lambda: model([RELU], outputs=[value("image")]), ("outputs that are inputs or weights",)),
    "If": (branching, ("If 'the If', which has graphs of its own",)),
    "Loop": (looping, ("Loop 'the Loop', which has graphs of its own",)),
    "function": (with_function, ("functions of its own (Twice)", "inline_local_functions")),
    "sparse": (sparse, ("sparse weights",)),
    "sequence": (sequence, ("'list', a sequence",)),
    "text": (
        lambda: model([node("Identity", "image", "y")], [value("image", (1, 3), TensorProto.STRING)]),
        ("input 'image' with elements of type string",),
    ),
    "shapes that do not fit": (
        lambda: model([node("Add", "image w", "y")], weights=[weight("w", 5, 7)]),
        ("shapes that do not fit", "the Add", "Incompatible dimensions"),
    ),
    "channels that do not fit": (
        lambda: model([conv()], weights=[weight("w", 4, 5, 3, 3)]),
        ("Conv 'the Conv' from 1x3x8x8 by 4x5x3x3 to 1x4x8x8 in 1 groups", "channels that fit"),
    ),
    "no groups": (lambda: model([conv(group=0)], weights=[weight("w", 4, 3, 3, 3)]), ("in 0 groups",)),
    "no text": (lambda: _not_utf8(), ("the name b'\\xff", "expected text in UTF-8")),
    "a shape that is not so": (
        lambda: model([node("Relu", "image", "a"), node("Relu", "a", "y")], value_info=[value("a", (1, 3, 9, 9))]),
        ("shapes that do not fit", "(8) vs (9)"),
    ),
    "shapes kept outside": (
        lambda: model([node("Reshape", "image w", "y")], weights=[_outside_shape()]),
        ("shapes that do not fit", "size_threshold"),
    ),
}


def _without_outputs() -> onnx.ModelProto:
    made = model([RELU])
    del made.graph.output[:]
    return made


def _not_utf8() -> onnx.ModelProto:
    data = model([RELU]).SerializeToString().replace(b"the Relu", b"\xff" * 8)
    return onnx.load_model_from_string(data)


def _outside_shape() -> TensorProto:
    tensor = TensorProto(name="w", data_type=TensorProto.INT64, dims=(2,), data_location=TensorProto.EXTERNAL)
    tensor.external_data.add(key="location", value="net.data")
    return tensor


@pytest.mark.parametrize("name", MALFORMED)
def test_a_malformed_graph_is_told_what_is_wrong(name: str, tmp_path: Path) -> None:
    make, words = MALFORMED[name]
    with pytest.raises(BadInputError) as error:
        read(make(), tmp_path)
    assert error.value.where == str(tmp_path / "net.onnx")
    for word in words:
        assert word in str(error.value)


def test_too_many_operators(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(graph_file, "MAX_NODES", 1)
    with pytest.raises(BadInputError, match="2 operators, expected at most 1"):
        read(model([node("Relu", "image", "a"), node("Relu", "a", "y")]), tmp_path)


def test_what_is_no_onnx_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    whole = model([conv()], weights=[weight("w", 4, 3, 3, 3)]).SerializeToString()
    files = {
        "cut.onnx": (whole[: len(whole) // 2], "bytes that do not parse"),
        "words.onnx": (b"This is no network at all.", "expected an ONNX file"),
        "picture.onnx": (b"\x89PNG\r\n\x1a\n" + bytes(64), "expected an ONNX file"),
        "nothing.onnx": (b"", "an empty file, expected an ONNX file of at most 512 MiB"),
        "zeros.onnx": (bytes(100), "expected an ONNX file"),
    }
    for name, (data, words) in files.items():
        (tmp_path / name).write_bytes(data)
        with pytest.raises(BadInputError, match=words):
            read_graph(tmp_path / name)
    os.mkfifo(tmp_path / "pipe.onnx")
    (tmp_path / "astray.onnx").symlink_to("nowhere.onnx")
    (tmp_path / "round.onnx").symlink_to("round.onnx")
    (tmp_path / "device.onnx").symlink_to("/dev/zero")
    for path, words in (
        (tmp_path, "a folder"),
        (tmp_path / "pipe.onnx", "a pipe"),
        (tmp_path / "device.onnx", "a device"),
        (tmp_path / "astray.onnx", "nowhere.onnx, which is not there"),
        (tmp_path / "round.onnx", "leads back to itself"),
        (tmp_path / "no\0name", "null"),
    ):
        with pytest.raises(BadInputError, match=words):
            read_graph(path)
    monkeypatch.setattr(graph_file, "MAX_BYTES", 1 << 20)
    with (tmp_path / "large.onnx").open("wb") as file:
        file.truncate((3 << 20) + 1)
    with pytest.raises(
        BadInputError, match="3 MiB, expected an ONNX file of at most 1 MiB; keep its weights beside it"
    ):
        read_graph(tmp_path / "large.onnx")


@pytest.mark.parametrize("share", [0.1, 0.3, 0.6, 0.9, 0.99])
def test_every_part_of_a_file_is_refused_or_read(share: float, tmp_path: Path) -> None:
    """A cut may fall between two messages: then what is left is a graph that lacks something."""
    nodes = [node("Conv", "image w", "a", pads=[1] * 4), node("Relu", "a", "b"), node("Add", "a b", "y")]
    whole = model(nodes, weights=[weight("w", 4, 3, 3, 3)]).SerializeToString()
    (tmp_path / "cut.onnx").write_bytes(whole[: int(share * len(whole))])
    with pytest.raises(BadInputError):
        read_graph(tmp_path / "cut.onnx")


def test_dynamic_axes_get_the_shape_that_is_given(tmp_path: Path) -> None:
    made = model(
        [conv()], [value("image", ("n", 3, "h", "w"))], [value("y", ("n", 4, "h", "w"))], [weight("w", 4, 3, 3, 3)]
    )
    work = count_work(read(made, tmp_path, image=(1, 3, 10, 20)).model)
    assert work.macs == 10 * 20 * 9 * 3 * 4
    with pytest.raises(BadInputError, match="--input-shape image=1x3, expected 4 sizes"):
        read(made, tmp_path, image=(1, 3))


def test_a_given_shape_overrides_stale_ones(tmp_path: Path) -> None:
    made = model(
        [conv(), node("Relu", "y", "z")], outputs=[value("z", (1, 4, 8, 8))], weights=[weight("w", 4, 3, 3, 3)]
    )
    made.graph.value_info.append(value("y", (1, 4, 8, 8)))
    assert count_work(read(made, tmp_path, image=(1, 3, 16, 16)).model).macs == 16 * 16 * 9 * 3 * 4


def test_weights_are_forgotten_and_small_numbers_are_not(tmp_path: Path) -> None:
    nodes = [node("Conv", "image w", "a", pads=[1] * 4), node("Reshape", "a shape", "y")]
    made = read(model(nodes, weights=[weight("w", 64, 3, 3, 3), integers("shape", 1, -1)]), tmp_path).model
    held = {tensor.name: len(tensor.raw_data) for tensor in made.graph.initializer}
    assert graph_tensors.KEPT_ELEMENTS < 64 * 27
    assert held == {"w": 0, "shape": 16}
    assert count_work(made).weights == 64 * 27
    assert count_work(made).output_elements == 64 * 64


def test_data_beside_the_file_is_not_opened(tmp_path: Path) -> None:
    """The file that the graph names is not there."""
    work = count_work(read(model([conv()], weights=[outside("weights.bin")]), tmp_path).model)
    assert (work.macs, work.weights) == (64 * 27 * 4, 27 * 4)


def test_an_operator_of_another_domain_is_counted_where_its_shape_is_stated(tmp_path: Path) -> None:
    nodes = [node("Warp", "image", "a", domain="mine"), node("Relu", "a", "y")]
    work = count_work(read(model(nodes, value_info=[value("a", (1, 3, 4, 4))]), tmp_path).model)
    assert [(o.op_type, o.moved, o.ruled) for o in work.operators] == [("Warp", 3 * 64 + 3 * 16, False)]


def test_operators_nobody_needs_are_dropped_and_the_others_put_in_order(tmp_path: Path) -> None:
    nodes = [node("Tanh", "a", "y"), node("Abs", "image", "dead"), node("Neg", "image", "a")]
    made = read(model(nodes), tmp_path).model
    assert [n.op_type for n in made.graph.node] == ["Neg", "Tanh"]


def test_what_onnx_does_not_infer_but_is_plain(tmp_path: Path) -> None:
    nodes = [
        node("GroupNormalization", "image s s", "a", num_groups=3),
        node("Gelu", "a", "b", domain="com.microsoft"),
        node("Tanh", "b", "y"),
    ]
    work = count_work(read(model(nodes, weights=[weight("s", 3)], opset=21), tmp_path).model)
    assert [(o.op_type, o.out, o.ruled) for o in work.operators] == [
        ("GroupNormalization", 192, True),
        ("Gelu", 192, True),
        ("Tanh", 192, True),
    ]


def quantised(*, floats_at_ends: bool) -> onnx.ModelProto:
    """As ONNX Runtime writes it: int8 weights with a scale for each channel, an int32 bias, floats at both ends."""
    weights = [
        numpy_helper.from_array(np.ones((4, 3, 3, 3), np.int8), "w8"),
        numpy_helper.from_array(np.ones(4, np.float32), "w_scale"),
        numpy_helper.from_array(np.zeros(4, np.int8), "w_zero"),
        numpy_helper.from_array(np.ones(4, np.int32), "b32"),
        numpy_helper.from_array(np.float32(0.1), "s"),
        numpy_helper.from_array(np.uint8(3), "z"),
    ]
    nodes = [
        node("QuantizeLinear", "image s z", "q"),
        node("DequantizeLinear", "q s z", "d"),
        node("DequantizeLinear", "w8 w_scale w_zero", "wd", axis=0),
        node("DequantizeLinear", "b32 w_scale", "bd", axis=0),
        node("Conv", "d wd bd", "c", pads=[1] * 4),
        node("QuantizeLinear", "c s z", "cq"),
        node("DequantizeLinear", "cq s z", "y"),
    ]
    if floats_at_ends:
        return model(nodes, weights=weights)
    return model(nodes[1:-1], [value("q", IMAGE, TensorProto.UINT8)], [value("cq", None, TensorProto.UINT8)], weights)


@pytest.mark.parametrize("floats_at_ends", [True, False])
def test_a_quantised_graph_counts_as_its_float_one(floats_at_ends: bool, tmp_path: Path) -> None:
    graph = read(quantised(floats_at_ends=floats_at_ends), tmp_path)
    work = count_work(graph.model)
    assert graph.numbers == "w8a8"
    assert [(o.op_type, o.macs, o.weights) for o in work.operators] == [("Conv", 64 * 27 * 4, 27 * 4 + 4)]
    assert (work.input_elements, work.output_elements) == (192, 256)


def test_what_a_file_says_of_its_numbers(tmp_path: Path) -> None:
    bare = model([node("Conv", "image w0", "y", pads=[1] * 4)], [value("image"), value("w0", (4, 3, 3, 3))])
    plain = model([conv()], weights=[weight("w", 4, 3, 3, 3)])
    integer_weights = quantised(floats_at_ends=True)
    del integer_weights.graph.node[0:2]
    integer_weights.graph.node[2].input[0] = "image"
    assert [read(made, tmp_path).numbers for made in (bare, plain, integer_weights)] == ["not said", "float", "float"]


def test_channels_last(tmp_path: Path) -> None:
    """The permutation of the input costs nothing: the units work with channels last."""
    nodes = [node("Transpose", "image", "x", perm=[0, 3, 1, 2]), node("Conv", "x w", "y", pads=[1] * 4)]
    graph = read(model(nodes, [value("image", (1, 8, 10, 3))], weights=[weight("w", 4, 3, 3, 3)]), tmp_path)
    assert [(o.op_type, o.macs) for o in count_work(graph.model).operators] == [("Conv", 80 * 27 * 4)]


def test_a_file_of_the_same_bytes_is_read_once_but_for_other_shapes(tmp_path: Path) -> None:
    """The same bytes elsewhere are another folder's; a file that was written anew is read anew."""
    path = tmp_path / "net.onnx"

    def write(channels: int) -> None:
        ends = [onnx.helper.make_tensor_value_info(n, onnx.TensorProto.FLOAT, (1, channels, 4, 4)) for n in "xy"]
        graph = onnx.helper.make_graph([onnx.helper.make_node("Tanh", ["x"], ["y"])], "g", ends[:1], ends[1:])
        model = onnx.helper.make_model(graph, opset_imports=[onnx.helper.make_opsetid("", 17)])
        path.write_bytes(model.SerializeToString())

    write(8)
    first = read_graph(path)
    assert read_graph(path).work is first.work
    assert first.work == count_work(first.model)
    assert read_graph(path, {"x": (1, 16, 4, 4)}).work.input_elements == 256
    write(24)
    assert read_graph(path).work.input_elements == 24 * 16
