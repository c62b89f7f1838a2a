"""Network files: what makes one for the pipeline, tensors in files beside it, and each refusal with its sentence."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper, numpy_helper

from support.small_inputs import net, node_of
from trilane.avatars import network_file
from trilane.avatars.network_file import (
    FLOAT_LAYERS_KEY,
    TO_INTEGERS,
    Affine,
    IntegerNetwork,
    check_integer_layers,
    check_network,
    constants_of,
    node_name,
    parse_network,
    read_network,
    reshaped,
)
from trilane.avatars.network_split import split
from trilane.errors import BadInputError

Change = Callable[[onnx.ModelProto], None]


def constant(name: str, value: Any) -> Change:
    def change(model: onnx.ModelProto) -> None:
        tensor = next(tensor for tensor in model.graph.initializer if tensor.name == name)
        tensor.CopyFrom(numpy_helper.from_array(np.asarray(value), name))

    return change


def test_a_network_without_zero_points_has_zeros() -> None:
    model = net()
    del node_of(model, "bytes_in").input[2:]
    node_of(model, "bytes_out").input[2] = ""
    network = check_network(model, "here")
    assert (network.input, network.output) == (Affine(0.5, 0), Affine(0.25, 0))


SIZES: list[tuple[tuple[int, ...], str]] = [
    ((64, 4096, 1, 1), ""),
    ((1, 1, 4096, 64), ""),
    ((65, 8, 8, 1), "input 'bytes' of 65x8x8x1"),
    ((1, 4097, 8, 1), "input 'bytes' of 1x4097x8x1"),
    ((1, 8, 4097, 1), "input 'bytes' of 1x8x4097x1"),
    ((1, 8, 8, 65), "input 'bytes' of 1x8x8x65"),
]


@pytest.mark.parametrize(("shape", "found"), SIZES)
def test_the_largest_inputs(shape: tuple[int, ...], found: str) -> None:
    if not found:
        assert check_network(net(shape), "here").shape == shape
        return
    with pytest.raises(BadInputError) as raised:
        check_network(net(shape), "here")
    expected = "N x H x W x C with sides up to 4096 and 1 to 64 channels last"
    assert str(raised.value) == f"here: found {found}, expected {expected}"


@pytest.mark.parametrize("wrong", [(2, 32, 64, 4), (1, 33, 64, 4), (1, 32, 65, 4), (1, 32, 64, 3)])
def test_the_output_is_rgba_of_the_inputs_size(wrong: tuple[int, ...]) -> None:
    with pytest.raises(BadInputError) as raised:
        check_network(net(out=wrong), "here")
    text = "x".join(map(str, wrong))
    assert str(raised.value) == f"here: found output 'rgba' of {text}, expected 1x32x64x4 (RGBA)"


def input_dims(sizes: list[int | str]) -> Change:
    def change(model: onnx.ModelProto) -> None:
        kind = TensorProto.UINT8
        model.graph.input[0].CopyFrom(helper.make_tensor_value_info("bytes", kind, sizes))

    return change


def no_shape(model: onnx.ModelProto) -> None:
    model.graph.input[0].type.tensor_type.ClearField("shape")


def float_end(which: str) -> Change:
    def change(model: onnx.ModelProto) -> None:
        getattr(model.graph, which)[0].type.tensor_type.elem_type = TensorProto.FLOAT

    return change


def more(which: str) -> Change:
    def change(model: onnx.ModelProto) -> None:
        getattr(model.graph, which).append(helper.make_tensor_value_info("more", TensorProto.UINT8, [1]))

    return change


def inputs_of(name: str, *names: str) -> Change:
    def change(model: onnx.ModelProto) -> None:
        del node_of(model, name).input[:]
        node_of(model, name).input.extend(names)

    return change


def op(name: str, op_type: str, domain: str = "") -> Change:
    def change(model: onnx.ModelProto) -> None:
        node_of(model, name).op_type, node_of(model, name).domain = op_type, domain

    return change


def nameless(name: str, op_type: str) -> Change:
    def change(model: onnx.ModelProto) -> None:
        node = node_of(model, name)
        node.op_type = op_type
        node.name = ""

    return change


def zero_of(kind: int, value: int) -> Change:
    """The zero point of bytes_in as raw numbers of a type, as a damaged file may have them."""

    def change(model: onnx.ModelProto) -> None:
        tensor = next(tensor for tensor in model.graph.initializer if tensor.name == "mid_zero")
        tensor.CopyFrom(TensorProto(name="mid_zero", data_type=kind, int32_data=[value]))

    return change


def cut_scale(model: onnx.ModelProto) -> None:
    tensor = next(tensor for tensor in model.graph.initializer if tensor.name == "mid_scale")
    tensor.raw_data = tensor.raw_data[:2]


def scale_of_no_type(model: onnx.ModelProto) -> None:
    next(tensor for tensor in model.graph.initializer if tensor.name == "mid_scale").data_type = 50


def input_of_no_type(model: onnx.ModelProto) -> None:
    model.graph.input[0].type.tensor_type.elem_type = 50


def read_twice(model: onnx.ModelProto) -> None:
    model.graph.node.append(helper.make_node("Relu", ["bytes"], ["spare"], "second"))


def made_by_nothing(model: onnx.ModelProto) -> None:
    node_of(model, "to_nhwc").input[0] = "nowhere"


def own_input(model: onnx.ModelProto) -> None:
    model.graph.node.insert(3, helper.make_node("Transpose", ["turned"], ["turned"], "round"))
    node_of(model, "conv1").input[0] = "turned"


def made_twice(model: onnx.ModelProto) -> None:
    model.graph.node.insert(2, helper.make_node("Transpose", ["nchw"], ["real"], "back"))


def nothing_made(model: onnx.ModelProto) -> None:
    model.graph.node.insert(0, helper.make_node("Constant", [], [], value=numpy_helper.from_array(np.float32(3))))


ORDER = "made or read before, expected nodes in the order of the work, each with new names"
RANGE = "expected a number from 1e-30 to 1e+30"


REFUSED: dict[str, tuple[Change, str]] = {
    "operator": (op("conv1", "Einsum"), "operator Einsum in node 'conv1', expected operators a DSP has"),
    "domain": (op("conv1", "Conv", "x.y"), "operator x.y:Conv in node 'conv1', expected operators a DSP has"),
    "no name": (nameless("conv1", "If"), "operator If in node 'If that makes conv1', expected operators a DSP has"),
    "two inputs": (more("input"), "2 inputs, expected one input, N x H x W x C uint8"),
    "two outputs": (more("output"), "2 outputs, expected one output, N x H x W x 4 uint8"),
    "float in": (float_end("input"), f"'bytes' of type FLOAT, expected uint8; {TO_INTEGERS}"),
    "float out": (float_end("output"), f"'rgba' of type FLOAT, expected uint8; {TO_INTEGERS}"),
    "dynamic": (input_dims([1, "h", 64, 3]), "'bytes' of shape 1x?x64x3, expected four fixed sizes, N x H x W x C"),
    "zero side": (input_dims([1, 32, 0, 3]), "'bytes' of shape 1x32x?x3, expected four fixed sizes, N x H x W x C"),
    "three": (input_dims([32, 64, 3]), "'bytes' of shape 32x64x3, expected four fixed sizes, N x H x W x C"),
    "no shape": (no_shape, "'bytes' of shape unknown, expected four fixed sizes, N x H x W x C"),
    "no scale": (inputs_of("mid_in", "mid_q", "x"), "no scale for node 'mid_in', expected a constant scale"),
    "one input": (inputs_of("mid_in", "mid_q"), "no scale for node 'mid_in', expected a constant scale"),
    "scale 0": (constant("mid_scale", np.float32(0)), f"scale 0 in node 'mid_out', {RANGE}"),
    "small": (constant("mid_scale", np.float32(9e-31)), f"scale 9e-31 in node 'mid_out', {RANGE}"),
    "large": (constant("mid_scale", np.float32(1.1e30)), f"scale 1.1e+30 in node 'mid_out', {RANGE}"),
    "nan": (constant("mid_scale", np.float32(np.nan)), f"scale nan in node 'mid_out', {RANGE}"),
    "one of two": (constant("mid_scale", np.float32([1, -2])), f"scale -2 in node 'mid_out', {RANGE}"),
    "none": (constant("mid_scale", np.zeros(0, np.float32)), f"scale nothing in node 'mid_out', {RANGE}"),
    "not constant": (
        inputs_of("mid_in", "mid_q", "mid_scale", "conv1"),
        "zero point of node 'mid_in' no integer, expected a constant integer",
    ),
    "float zero": (
        constant("mid_zero", np.float32(3)),
        "zero point of node 'mid_out' no integer, expected a constant integer",
    ),
    "cut": (cut_scale, "tensor 'mid_scale' that does not decode"),
    "no type": (scale_of_no_type, "tensor 'mid_scale' of type 50, expected a type that ONNX has"),
    "no type of the input": (input_of_no_type, "'bytes' of type 50, expected uint8"),
    "a scale in words": (
        constant("mid_scale", np.array(["a"], object)),
        "tensor 'mid_scale' of object, expected numbers",
    ),
    "two scales at the end": (
        constant("in_scale", np.float32([1, 2])),
        "node 'bytes_in' of type uint8, expected one scale and one uint8 zero point",
    ),
    "two zeros at the end": (
        constant("in_zero", np.uint8([1, 2])),
        "node 'bytes_in' of type uint8, expected one scale and one uint8 zero point",
    ),
    "int8 at the end": (
        constant("out_zero", np.int8(1)),
        "node 'bytes_out' of type int8, expected one scale and one uint8 zero point",
    ),
    "read twice": (read_twice, "input used by ['bytes_in', 'second'], expected a DequantizeLinear of the bytes"),
    "not read": (
        inputs_of("bytes_in", "w1", "in_scale", "in_zero"),
        "input used by [], expected a DequantizeLinear of the bytes",
    ),
    "read by another": (op("bytes_in", "Relu"), "input used by ['bytes_in'], expected a DequantizeLinear of the bytes"),
    "made by another": (op("to_nhwc", "Relu"), "output made by node 'to_nhwc', expected a QuantizeLinear to bytes"),
    "a node that reads itself": (own_input, f"'turned', made by node 'round' and {ORDER}"),
    "a tensor made twice": (made_twice, f"'real', made by node 'back' and {ORDER}"),
    "no input": (inputs_of("to_nhwc"), "node 'to_nhwc' without inputs or outputs, expected at least one of each"),
    "no output": (nothing_made, "node 'Constant that makes nothing' without inputs or outputs, expected"),
    "made by nothing": (made_by_nothing, "nothing that makes 'nowhere', expected a QuantizeLinear"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_a_wrong_network_is_refused_in_one_sentence(case: str) -> None:
    change, sentence = REFUSED[case]
    model = net()
    change(model)
    with pytest.raises(BadInputError, match=re.escape(f"here: found {sentence}")):
        check_network(model, "here")


@pytest.mark.parametrize("scale", [1.01e-30, 0.99e30])
def test_scales_at_the_ends_of_their_range(scale: float) -> None:
    assert check_network(net(scales=(scale, 0.25)), "here").input.scale == pytest.approx(scale)


@pytest.mark.parametrize(
    ("kind", "low", "high"),
    [
        (TensorProto.UINT8, 0, 255),
        (TensorProto.INT8, -128, 127),
        (TensorProto.UINT16, 0, 65535),
        (TensorProto.INT16, -32768, 32767),
    ],
)
def test_zero_points_of_every_type(kind: int, low: int, high: int) -> None:
    for value in (low, high):
        model = net()
        zero_of(kind, value)(model)
        check_network(model, "here")
    for value in (low - 1, high + 1):
        model = net()
        zero_of(kind, value)(model)
        with pytest.raises(BadInputError) as raised:
            check_network(model, "here")
        assert str(raised.value) == f"here: found zero point {value} in node 'mid_out', expected {low} to {high}"
    assert network_file.ZERO_POINT_TYPES[TensorProto.INT32] == (-2147483648, 2147483647)


def test_several_transposes_may_lie_before_the_ends() -> None:
    model = net()
    twice = helper.make_node("Transpose", ["bytes"], ["turned"], "once", perm=[0, 2, 1, 3])
    back = helper.make_node("Transpose", ["turned"], ["back"], "again", perm=[0, 2, 1, 3])
    node_of(model, "bytes_in").input[0] = "back"
    nodes = [twice, back, *model.graph.node]
    del model.graph.node[:]
    model.graph.node.extend(nodes)
    assert check_network(model, "here").input == Affine(0.5, 7)


def test_initializers_may_be_listed_as_inputs_too() -> None:
    model = net((1, 32, 32, 3))
    for tensor in model.graph.initializer:
        model.graph.input.insert(0, helper.make_tensor_value_info(tensor.name, tensor.data_type, tensor.dims))
    model.ir_version = 3  # in which each initializer must be an input
    network = check_network(model, "here")
    assert reshaped(network, 64, 32).shape == (1, 64, 32, 3)
    assert split(network, ["mid_q"])[0].inputs == {"bytes": (1, 32, 32, 3)}


def test_layers_in_float_are_named() -> None:
    model = net()
    network = IntegerNetwork("here", model)
    check_integer_layers(network)
    node_of(model, "conv2").input[0] = "conv1"
    node_of(model, "conv1").input[1] = "w1"
    with pytest.raises(BadInputError) as raised:
        check_integer_layers(network)
    assert str(raised.value) == (
        "here: found layers left in float: conv1, conv2, expected integer layers; quantise them"
    )
    node_of(model, "conv1").input.append("in_scale")  # a bias may be in float
    model.metadata_props.add(key="other", value="[")
    model.metadata_props.add(key="trilane.float_layers", value='["conv2"]')
    assert FLOAT_LAYERS_KEY == "trilane.float_layers"
    assert network.float_layers == {"conv2"}
    with pytest.raises(BadInputError, match="layers left in float: conv1, expected"):
        check_integer_layers(network)
    for op_type, counts in (("ConvTranspose", True), ("Gemm", True), ("Add", False)):
        node_of(model, "conv1").op_type = op_type
        if counts:
            with pytest.raises(BadInputError, match="layers left in float: conv1"):
                check_integer_layers(network)
        else:
            check_integer_layers(network)
    for value in ("3", '"abc"', '{"conv2": 1}', "["):
        model.metadata_props[-1].value = value
        with pytest.raises(BadInputError) as raised:
            _ = network.float_layers
        assert str(raised.value) == f"here: found trilane.float_layers {[value]}, expected a JSON list of names"


def test_names_and_constants_of_a_graph() -> None:
    assert node_name(helper.make_node("Add", ["a"], ["b"], "sum")) == "sum"
    assert node_name(helper.make_node("Add", ["a"], ["b"])) == "Add that makes b"
    assert node_name(helper.make_node("Add", ["a"], [])) == "Add that makes nothing"
    model = net()
    value = numpy_helper.from_array(np.float32(3))
    model.graph.node.append(helper.make_node("Constant", [], ["made"], value=value))
    constants = constants_of(model)
    assert {"in_scale", "w2", "made"} <= set(constants) and "conv1" not in constants
    assert numpy_helper.to_array(constants["made"]) == 3


# Network files by value: read, refused in whole sentences, and with tensors in files beside them.


def test_a_network_file_is_read_or_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert network_file.MAX_BYTES == 536_870_912
    path = tmp_path / "network.onnx"
    data = net().SerializeToString()
    path.write_bytes(data)
    assert read_network(path).where == str(path)
    monkeypatch.setattr(network_file, "MAX_BYTES", len(data))
    assert parse_network(path) == net()
    monkeypatch.setattr(network_file, "MAX_BYTES", len(data) - 1)
    cut_short = "; copy it again: it may be cut short"
    for content, sentence in (
        (data, f"found a file of {len(data)} bytes, expected an ONNX network of 1 to {len(data) - 1} bytes"),
        (b"", "found an empty file, expected an ONNX network"),
        (b"glTF" + bytes(60), "found a binary glTF file (GLB, VRM), expected an ONNX network"),
        (b"not a network", f"found bytes that do not parse, expected an ONNX file{cut_short}"),
        (b"\x08\x08", f"found no nodes or no operator set, expected an ONNX network{cut_short}"),
    ):
        path.write_bytes(content)
        with pytest.raises(BadInputError) as raised:
            parse_network(path)
        assert str(raised.value) == f"{path}: {sentence}"
    path.unlink()
    with pytest.raises(BadInputError) as raised:
        parse_network(path)
    assert str(raised.value) == f"{path}: found no such file, expected an ONNX network"


@pytest.mark.parametrize(("domain", "fine"), [("", True), ("ai.onnx", True), ("com.acme", False)])
def test_a_network_names_the_operators_of_onnx(tmp_path: Path, domain: str, fine: bool) -> None:
    model = net()
    model.opset_import[0].domain = domain
    (tmp_path / "a.onnx").write_bytes(model.SerializeToString())
    if fine:
        parse_network(tmp_path / "a.onnx")
    else:
        with pytest.raises(BadInputError, match="no nodes or no operator set"):
            parse_network(tmp_path / "a.onnx")


def kept_outside(location: str, constant_node: bool = False) -> onnx.ModelProto:
    """`w1` kept in another file: as an initializer, or as the value of a Constant node."""
    model = net()
    tensor = next(tensor for tensor in model.graph.initializer if tensor.name == "w1")
    if constant_node:
        model.graph.node.insert(0, helper.make_node("Constant", [], ["w1"], "w1_here", value=tensor))
        model.graph.initializer.remove(tensor)
        tensor = model.graph.node[0].attribute[0].t
    tensor.ClearField("raw_data")
    tensor.data_location = TensorProto.EXTERNAL
    tensor.external_data.add(key="location", value=location)
    return model


@pytest.mark.parametrize("constant_node", [False, True])
def test_data_in_a_file_beside_is_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, constant_node: bool) -> None:
    raw = next(tensor.raw_data for tensor in net().graph.initializer if tensor.name == "w1")
    (tmp_path / "w.bin").write_bytes(raw)
    path = tmp_path / "a.onnx"
    path.write_bytes(kept_outside("w.bin", constant_node).SerializeToString())
    model = parse_network(path)
    tensor = constants_of(model)["w1"]
    assert (tensor.raw_data, tensor.data_location, len(tensor.external_data)) == (raw, TensorProto.DEFAULT, 0)
    size = path.stat().st_size
    (tmp_path / "w.bin").write_bytes(raw + bytes(size - len(raw) + 1))
    monkeypatch.setattr(network_file, "MAX_BYTES", size)
    with pytest.raises(BadInputError) as raised:
        parse_network(path)
    assert str(raised.value) == (
        f"{path}: found tensor 'w1' kept in {tmp_path}/w.bin, expected a file of the network's folder"
    )


@pytest.mark.parametrize(
    ("location", "sentence"),
    [
        ("../w.bin", "found tensor 'w1' kept in {above}/w.bin, expected data inside {folder}; move it there"),
        ("no.bin", "found tensor 'w1' kept in {folder}/no.bin, expected a file of the network's folder"),
        ("/etc/hostname", "found tensor 'w1' kept in /etc/hostname, expected data inside {folder}; move it there"),
        (".", "found tensor 'w1' kept in "),
        ("", "found tensor 'w1'"),
        ("short.bin", "found tensor 'w1' in {folder}/short.bin: "),
    ],
)
def test_data_elsewhere_is_not_read(tmp_path: Path, location: str, sentence: str) -> None:
    folder = tmp_path / "b"
    folder.mkdir()
    (tmp_path / "w.bin").write_bytes(bytes(100))
    (folder / "short.bin").write_bytes(b"")
    model = kept_outside(location)
    next(t for t in model.graph.initializer if t.name == "w1").external_data.add(key="offset", value="9")
    (folder / "a.onnx").write_bytes(model.SerializeToString())
    with pytest.raises(BadInputError, match=re.escape(sentence.format(above=tmp_path, folder=folder))):
        read_network(folder / "a.onnx")
