"""Avatars by value: each refusal with its sentence, each limit on both sides, parts and reshaped networks by hand."""

from __future__ import annotations

import copy
import dataclasses
import hashlib
import importlib
import json
import pkgutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper, numpy_helper

import trilane.avatars
import trilane.body
import trilane.scene
from trilane.avatars import network_checks, network_file
from trilane.avatars.bundle import Bundle, bundle_folder, load_bundle, write_bundle
from trilane.avatars.integer_network import (
    FLOAT_LAYERS_KEY,
    Affine,
    IntegerNetwork,
    NetworkFile,
    check_integer_layers,
    constants_of,
    node_name,
)
from trilane.avatars.manifest import BANDS, Manifest, NetworkEntry, network_entry, parse_manifest
from trilane.avatars.network_checks import check_network
from trilane.avatars.network_file import parse_network, read_network
from trilane.avatars.network_reshape import reshaped
from trilane.avatars.network_split import Cut, cuts, split
from trilane.errors import BadInputError
from trilane.testing.byte_network import net, node_of

Change = Callable[[onnx.ModelProto], None]


def constant(name: str, value: Any) -> Change:
    def change(model: onnx.ModelProto) -> None:
        tensor = next(tensor for tensor in model.graph.initializer if tensor.name == name)
        tensor.CopyFrom(numpy_helper.from_array(np.asarray(value), name))

    return change


def test_a_good_network_says_what_its_bytes_mean() -> None:
    network = check_network(net(), "here")
    assert (network.where, network.shape, network.channels) == ("here", (1, 32, 64, 3), 3)
    assert (network.input, network.output) == (Affine(0.5, 7), Affine(0.25, 11))
    assert network.digest == hashlib.sha256(network.model.SerializeToString(deterministic=True)).hexdigest()


def test_a_network_without_zero_points_has_zeros() -> None:
    model = net()
    del node_of(model, "bytes_in").input[2:]
    node_of(model, "bytes_out").input[2] = ""
    network = check_network(model, "here")
    assert (network.input, network.output) == (Affine(0.5, 0), Affine(0.25, 0))


# --- sizes ---

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


def read_twice(model: onnx.ModelProto) -> None:
    model.graph.node.append(helper.make_node("Relu", ["bytes"], ["spare"], "second"))


def made_by_nothing(model: onnx.ModelProto) -> None:
    node_of(model, "to_nhwc").input[0] = "nowhere"


RANGE = "expected a number from 1e-30 to 1e+30"
REFUSED: dict[str, tuple[Change, str]] = {
    "operator": (op("conv1", "Einsum"), "operator Einsum in node 'conv1', expected operators a DSP has"),
    "domain": (op("conv1", "Conv", "x.y"), "operator x.y:Conv in node 'conv1', expected operators a DSP has"),
    "no name": (nameless("conv1", "If"), "operator If in node 'If that makes conv1', expected operators a DSP has"),
    "two inputs": (more("input"), "2 inputs, expected one input, N x H x W x C uint8"),
    "two outputs": (more("output"), "2 outputs, expected one output, N x H x W x 4 uint8"),
    "float in": (float_end("input"), "'bytes' of type FLOAT, expected uint8; quantise it: trilane avatar quantize"),
    "float out": (float_end("output"), "'rgba' of type FLOAT, expected uint8; quantise it: trilane avatar quantize"),
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
        inputs_of("bytes_in", "mid_q", "in_scale", "in_zero"),
        "input used by [], expected a DequantizeLinear of the bytes",
    ),
    "read by another": (op("bytes_in", "Relu"), "input used by ['bytes_in'], expected a DequantizeLinear of the bytes"),
    "made by another": (op("to_nhwc", "Relu"), "output made by node 'to_nhwc', expected a QuantizeLinear to bytes"),
    "made by nothing": (made_by_nothing, "nothing that makes 'nowhere', expected a QuantizeLinear"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_a_wrong_network_is_refused_in_one_sentence(case: str) -> None:
    change, sentence = REFUSED[case]
    model = net()
    change(model)
    with pytest.raises(BadInputError) as raised:
        check_network(model, "here")
    assert f"here: found {sentence}" in str(raised.value)


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
    assert network_checks.ZERO_POINT_TYPES[TensorProto.INT32] == (-2147483648, 2147483647)


#: By what they do: layers, activations, norms, pooling, moving data, bytes.
ALLOWED = """Conv ConvTranspose Gemm  Add Sub Mul Div Sqrt ReduceMean Constant Identity
Relu LeakyRelu Clip Sigmoid HardSigmoid HardSwish Tanh  BatchNormalization InstanceNormalization GroupNormalization
AveragePool GlobalAveragePool MaxPool  Resize DepthToSpace SpaceToDepth
Concat Pad Reshape Slice Split Transpose  QuantizeLinear DequantizeLinear"""


def test_the_operators_that_a_dsp_has() -> None:
    assert set(ALLOWED.split()) == network_checks.OPERATORS


def test_several_transposes_may_lie_before_the_ends() -> None:
    model = net()
    twice = helper.make_node("Transpose", ["bytes"], ["turned"], "once", perm=[0, 2, 1, 3])
    back = helper.make_node("Transpose", ["turned"], ["back"], "again", perm=[0, 2, 1, 3])
    node_of(model, "bytes_in").input[0] = "back"
    nodes = [twice, back, *model.graph.node]
    del model.graph.node[:]
    model.graph.node.extend(nodes)
    assert check_network(model, "here").input == Affine(0.5, 7)


# --- integer layers ---


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
    model.metadata_props[-1].value = "3"
    with pytest.raises(BadInputError) as raised:
        _ = network.float_layers
    assert str(raised.value) == "here: found trilane.float_layers ['3'], expected a JSON list of names"


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


# --- files ---


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
        (b"", f"found a file of 0 bytes, expected an ONNX network of 1 to {len(data) - 1} bytes"),
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
    assert str(raised.value) == f"{path}: found no such file or directory, expected a readable ONNX file"


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
    with pytest.raises(BadInputError) as raised:
        read_network(folder / "a.onnx")
    assert sentence.format(above=tmp_path, folder=folder) in str(raised.value)


# --- another shape ---


def test_a_network_for_another_shape(tiny_quantised: Any) -> None:
    network: NetworkFile = tiny_quantised.network
    assert network.shape == (1, 64, 64, 5)
    assert reshaped(network, 64, 64) is network
    other = reshaped(network, 32, 96, batch=3)
    assert other.shape == (3, 32, 96, 5) and network.shape == (1, 64, 64, 5)
    sizes = [dim.dim_value for dim in other.model.graph.output[0].type.tensor_type.shape.dim]
    assert sizes == [3, 32, 96, 4]
    assert (other.input, other.output, other.where) == (network.input, network.output, network.where)
    assert list(other.model.graph.initializer) == list(network.model.graph.initializer)
    shapes = {value.name: value.type.tensor_type.shape for value in other.model.graph.value_info}
    assert shapes and {shape.dim[0].dim_value for shape in shapes.values() if len(shape.dim) == 4} >= {3}
    assert reshaped(network, 64, 64, batch=2).shape == (2, 64, 64, 5)
    assert reshaped(other, 32, 96, batch=3) is other
    assert reshaped(other, 96, 32, batch=3).shape == (3, 96, 32, 5)


@pytest.mark.parametrize(
    ("height", "width", "batch"), [(33, 32, 1), (32, 48, 1), (0, 32, 1), (32, 0, 1), (32, 32, 0), (-32, 32, 1)]
)
def test_shapes_that_are_no_multiples_are_refused(tiny_quantised: Any, height: int, width: int, batch: int) -> None:
    network = dataclasses.replace(tiny_quantised.network, where="here")
    with pytest.raises(BadInputError) as raised:
        reshaped(network, height, width, batch)
    assert str(raised.value) == f"here: found shape {batch}x{height}x{width}, expected sides in multiples of 32"


def test_a_graph_that_is_fixed_to_its_shape_is_refused() -> None:
    """A Reshape to fixed sizes in the middle cannot take another input."""
    model = net((1, 32, 32, 3))
    model.graph.initializer.append(numpy_helper.from_array(np.array([1, 4, 32, 32]), "fixed"))
    node_of(model, "mid_out").input[0] = "conv1_fixed"
    model.graph.node.insert(4, helper.make_node("Reshape", ["conv1", "fixed"], ["conv1_fixed"], "fix"))
    network = check_network(model, "here")
    with pytest.raises(BadInputError) as raised:
        reshaped(network, 64, 32)
    assert "here: found a graph fixed to (1, 32, 32, 3): [ShapeInferenceError]" in str(raised.value)
    assert str(raised.value).endswith(", expected one for 64x32") and "\n" not in str(raised.value)


# --- parts ---


def test_the_only_cut_of_a_small_network() -> None:
    network = check_network(net(), "here")
    assert list(cuts(network)) == [
        Cut("mid_q", {"mid_q": (1, 4, 32, 64)}, 5),
        Cut("rgba_q", {"rgba_q": (1, 4, 32, 64)}, 9),
    ]
    assert next(cuts(network)).bytes == 4 * 32 * 64
    head, tail = split(network, ["mid_q"])
    assert (head.inputs, head.outputs) == ({"bytes": (1, 32, 64, 3)}, {"mid_q": (1, 4, 32, 64)})
    assert (tail.inputs, tail.outputs) == ({"mid_q": (1, 4, 32, 64)}, {"rgba": (1, 32, 64, 4)})
    assert (head.crossing_in, head.crossing_out) == (head.inputs, head.outputs)
    assert (tail.crossing_in, tail.crossing_out) == (tail.inputs, tail.outputs)
    assert [node.name for node in head.model.graph.node] == ["bytes_in", "to_nchw", "w1_in", "conv1", "mid_out"]
    assert [node.name for node in tail.model.graph.node] == ["mid_in", "w2_in", "conv2", "bytes_out", "to_nhwc"]
    assert {tensor.name for tensor in head.model.graph.initializer} == {
        "in_scale", "in_zero", "mid_scale", "mid_zero", "w_scale", "w_zero", "w1",
    }  # fmt: skip
    assert (head.model.graph.name, tail.model.graph.name) == (
        "net from the beginning to mid_q",
        "net from mid_q to the end",
    )
    assert head.where == "here" and head.model.ir_version == 8 and head.model.opset_import[0].version == 17


def test_a_skip_crosses_the_cut_beside_it() -> None:
    """The input is read again behind the cut: it crosses too, and its dequantise is repeated there."""
    model = net((1, 32, 64, 4))
    node_of(model, "conv2").input[0] = "both"
    model.graph.node.insert(7, helper.make_node("Add", ["mid", "nchw"], ["both"], "both"))
    model.metadata_props.add(key="k", value="v")
    network = check_network(model, "here")
    first = next(cuts(network))
    assert first == Cut("mid_q", {"mid_q": (1, 4, 32, 64), "bytes": (1, 32, 64, 4)}, 5)
    assert first.bytes == 2 * 4 * 32 * 64
    head, tail = split(network, ["mid_q"])
    assert set(head.outputs) == {"mid_q"} and set(head.crossing_out) == {"mid_q", "bytes"}
    assert set(tail.inputs) == {"mid_q", "bytes"}
    assert [node.name for node in tail.model.graph.node][:2] == ["bytes_in", "to_nchw"]
    assert [(prop.key, prop.value) for prop in tail.model.metadata_props] == [("k", "v")]


def test_a_tensor_in_float_cannot_cross() -> None:
    """Behind the cut a float tensor is read: there is no place to cut there."""
    model = net((1, 32, 64, 4))
    node_of(model, "conv2").input[0] = "both"
    model.graph.node.insert(7, helper.make_node("Add", ["mid", "conv1"], ["both"], "both"))
    assert [cut.at for cut in cuts(check_network(model, "here"))] == ["rgba_q"]


def test_places_that_are_none_and_places_twice() -> None:
    network = check_network(net(), "here")
    for at, sentence in (
        (["x"], "here, cut: found 'x', expected a quantised tensor; `trilane avatar split` without --at lists them"),
        (["rgba_q", "mid_q"], "here, cuts: found rgba_q, mid_q, expected different tensors in the order of the work"),
        (["mid_q", "mid_q"], "here, cuts: found mid_q, mid_q, expected different tensors in the order of the work"),
    ):
        with pytest.raises(BadInputError) as raised:
            split(network, at)
        assert str(raised.value) == sentence


# --- manifests ---

ENTRY = {
    "file": "n.onnx",
    "encoder": "e",
    "norm": "n",
    "width": 8,
    "channels": 3,
    "input": {"scale": 1, "zero_point": 0},
}


def manifest(**changes: Any) -> str:
    entry = {**ENTRY, **changes.pop("network", {})}
    return json.dumps({"name": "a", "network": entry, **changes})


def test_what_a_manifest_leaves_out() -> None:
    read = parse_manifest(manifest(), Path("m"))
    assert (read.schema_version, read.body, read.texture, read.betas, read.expression) == (
        1, "body.npz", "texture.npz", (), (),
    )  # fmt: skip
    assert (read.training_command, read.provenance, read.quantisation, read.validation) == ("", {}, {}, None)
    assert (read.network.output.scale, read.network.output.zero_point) == (1 / 255, 0)


#: Change -> key and beginning of what is expected; "" where the value is fine.
LIMITS: list[tuple[dict[str, Any], str]] = [
    ({"network": {"width": 1}}, ""),
    ({"network": {"width": 256}}, ""),
    ({"network": {"width": 257}}, "network.width: found 257 (Input should be less than or equal to 256)"),
    ({"network": {"width": 0}}, "network.width: found 0 (Input should be greater than or equal to 1)"),
    ({"network": {"channels": 1}}, ""),
    ({"network": {"channels": 64}}, ""),
    ({"network": {"channels": 65}}, "network.channels: found 65 (Input should be less than or equal to 64)"),
    ({"network": {"channels": 0}}, "network.channels: found 0 (Input should be greater"),
    ({"network": {"file": "x" * 200}}, ""),
    ({"network": {"file": "x" * 201}}, "network.file: found "),
    ({"network": {"file": ""}}, 'network.file: found "" ('),
    ({"network": {"input": {"scale": 1e-12, "zero_point": 255}}}, ""),
    ({"network": {"input": {"scale": 1e12, "zero_point": 0}}}, ""),
    ({"network": {"input": {"scale": 0.99e-12, "zero_point": 0}}}, "network.input.scale: found 9.9e-13 ("),
    ({"network": {"input": {"scale": 1.01e12, "zero_point": 0}}}, "network.input.scale: found 1010000000000.0 ("),
    ({"network": {"input": {"scale": 1, "zero_point": 256}}}, "network.input.zero_point: found 256 ("),
    ({"network": {"input": {"scale": 1, "zero_point": -1}}}, "network.input.zero_point: found -1 ("),
    ({"network": {"input": {"scale": 1, "zero_point": 0, "x": 1}}}, "network.input.x: found 1 (Extra inputs"),
    ({"network": {"more": 1}}, "network.more: found 1 ("),
    ({"more": 1}, "more: found 1 (Extra inputs are not permitted), expected a valid manifest"),
    ({"schema_version": 2}, "schema_version: found 2 (Input should be 1)"),
    ({"name": ""}, 'name: found "" ('),
    ({"name": "x" * 100}, ""),
    ({"name": "x" * 101}, f'name: found "{"x" * 56}... ('),
    ({"betas": [100, -100] * 200}, ""),
    ({"betas": [0] * 401}, "betas: found ["),
    ({"betas": [100.1]}, "betas.0: found 100.1 ("),
    ({"betas": [0, -100.1]}, "betas.1: found -100.1 ("),
    ({"expression": [0] * 100}, ""),
    ({"expression": [0] * 101}, "expression: found ["),
    ({"expression": [101]}, "expression.0: found 101 ("),
    ({"body": ""}, 'body: found "" ('),
    ({"texture": 3}, "texture: found 3 ("),
    ({"more": "x" * 58}, f'more: found "{"x" * 58}" ('),
    ({"more": "x" * 59}, f'more: found "{"x" * 56}... ('),
]


@pytest.mark.parametrize("case", range(len(LIMITS)))
def test_limits_of_a_manifest_on_either_side(case: int) -> None:
    changes, sentence = LIMITS[case]
    if not sentence:
        parse_manifest(manifest(**copy.deepcopy(changes)), Path("m"))
        return
    with pytest.raises(BadInputError) as raised:
        parse_manifest(manifest(**copy.deepcopy(changes)), Path("m"))
    assert f"m: {sentence}" in str(raised.value)


def test_bands_go_from_far_to_near() -> None:
    assert BANDS == ("far", "full_body", "upper_body", "face")


def test_a_manifest_that_is_no_json() -> None:
    with pytest.raises(BadInputError, match=r"m: document: found .*, expected a valid manifest"):
        parse_manifest("{", Path("m"))
    with pytest.raises(BadInputError, match=r"m: document: found \[\] \("):
        parse_manifest("[]", Path("m"))


def test_the_entry_of_a_network() -> None:
    network = check_network(net(), "here")
    entry = network_entry(network, "resnet18", "group", 24)
    assert entry == NetworkEntry.model_validate(
        {
            "file": "network.onnx", "encoder": "resnet18", "norm": "group", "width": 24, "channels": 3,
            "input": {"scale": 0.5, "zero_point": 7}, "output": {"scale": 0.25, "zero_point": 11},
        }
    )  # fmt: skip


# --- bundles ---


def bundle(tmp_path: Path, texture: np.ndarray, scale: Any = None, **entry: Any) -> Bundle:
    """A bundle of the small network, with the default avatar's body."""
    network = check_network(net(), "here")
    values = network_entry(network, "resnet18", "batch", 8).model_dump() | entry
    made = Manifest(name="small", network=NetworkEntry.model_validate(values))
    write_bundle(tmp_path / "b", made, bundle_folder("default") / "body.npz", texture, network, scale)
    return load_bundle(tmp_path / "b")


def test_a_bundle_by_its_files(tmp_path: Path) -> None:
    texture = np.arange(4 * 6 * 3).reshape(4, 6, 3).astype(np.float16)
    made = bundle(tmp_path, texture)
    folder = tmp_path / "b"
    assert (made.folder, made.body_path, made.texture_path, made.network_path) == (
        folder, folder / "body.npz", folder / "texture.npz", folder / "network.onnx",
    )  # fmt: skip
    assert {path.name for path in folder.iterdir()} == {"manifest.json", "body.npz", "texture.npz", "network.onnx"}
    np.testing.assert_array_equal(made.read_texture(), texture.astype(np.float32))
    assert made.read_network().shape == (1, 32, 64, 3)
    assert (folder / "manifest.json").read_text().endswith("}\n")
    assert made.body_path.read_bytes() == (bundle_folder("default") / "body.npz").read_bytes()
    assert bundle_folder("default").name == "default" and bundle_folder("x/y") == Path("x/y")


@pytest.mark.parametrize("scale", [np.array([1, 2, 0.5], np.float32), np.float32(2.0)])
def test_a_texture_of_bytes_is_scaled_by_channel(tmp_path: Path, scale: Any) -> None:
    texture = np.arange(-12, 12).reshape(2, 4, 3).astype(np.int8)
    np.testing.assert_allclose(bundle(tmp_path, texture, scale).read_texture(), texture * scale)


SHAPE = "expected (H, W, 3) with sides of 2 to 4096"
SCALE = "an int8 texture without a usable scale, expected array 'scale', finite, shape (3,)"
TEXTURES: dict[str, tuple[dict[str, Any], str]] = {
    "least": ({"texture": np.zeros((2, 2, 3), np.float32)}, ""),
    "most": ({"texture": np.zeros((4096, 2, 3), np.float16)}, ""),
    "one row": ({"texture": np.zeros((1, 2, 3), np.float16)}, f"a texture of shape (1, 2, 3), {SHAPE}"),
    "one column": ({"texture": np.zeros((2, 1, 3), np.float16)}, f"a texture of shape (2, 1, 3), {SHAPE}"),
    "4097": ({"texture": np.zeros((2, 4097, 3), np.float16)}, f"a texture of shape (2, 4097, 3), {SHAPE}"),
    "channels": ({"texture": np.zeros((2, 2, 4), np.float16)}, f"a texture of shape (2, 2, 4), {SHAPE}"),
    "flat": ({"texture": np.zeros((2, 3), np.float16)}, f"a texture of shape (2, 3), {SHAPE}"),
    "double": (
        {"texture": np.zeros((2, 2, 3))},
        "a texture of float64, expected float16, float32, or int8 with a scale",
    ),
    "NaN": (
        {"texture": np.full((2, 2, 3), np.nan, np.float32)},
        "a texture with NaN or infinite texels, expected finite numbers",
    ),
    "no scale": ({"texture": np.zeros((2, 2, 3), np.int8)}, SCALE),
    "integer scale": ({"texture": np.zeros((2, 2, 3), np.int8), "scale": np.ones(3, int)}, SCALE),
    "two scales": ({"texture": np.zeros((2, 2, 3), np.int8), "scale": np.ones(2, np.float32)}, SCALE),
    "infinite scale": ({"texture": np.zeros((2, 2, 3), np.int8), "scale": np.float32([1, np.inf, 1])}, SCALE),
    "no texture": ({"scale": np.ones(3, np.float32)}, "no array 'texture', expected a neural texture"),
}


@pytest.mark.parametrize("case", TEXTURES)
def test_textures_on_either_side_of_their_limits(tmp_path: Path, case: str) -> None:
    made = bundle(tmp_path, np.zeros((2, 2, 3), np.float16))
    arrays, sentence = TEXTURES[case]
    np.savez(made.texture_path, **arrays)
    if not sentence:
        assert made.read_texture().shape == arrays["texture"].shape
        return
    with pytest.raises(BadInputError) as raised:
        made.read_texture()
    assert str(raised.value) == f"{made.texture_path}: found {sentence}"


def test_a_network_that_contradicts_its_manifest(tmp_path: Path) -> None:
    """Scales may differ by 1e-5 of themselves, zero points and channels not at all."""
    made = bundle(tmp_path, np.zeros((2, 2, 3), np.float16))

    def with_entry(**entry: Any) -> Bundle:
        values = made.manifest.network.model_dump() | entry
        manifest = made.manifest.model_copy(update={"network": NetworkEntry.model_validate(values)})
        return dataclasses.replace(made, manifest=manifest)

    with_entry(input={"scale": 0.5 * (1 + 0.9e-5), "zero_point": 7}).read_network()
    path = made.network_path
    has_in, has_out = "found scale 0.5, zero point 7, expected", "found scale 0.25, zero point 11, expected"
    for entry, sentence in (
        ({"input": {"scale": 0.50001, "zero_point": 7}}, f" (input): {has_in} scale 0.50001, zero point 7 by"),
        ({"input": {"scale": 0.5, "zero_point": 8}}, f" (input): {has_in} scale 0.5, zero point 8 by the manifest"),
        ({"output": {"scale": 0.25, "zero_point": 7}}, f" (output): {has_out} scale 0.25, zero point 7 by the manif"),
        ({"channels": 4}, ": found 3 channels, expected 4 by the manifest"),
    ):
        with pytest.raises(BadInputError) as raised:
            with_entry(**entry).read_network()
        assert f"{path}{sentence}" in str(raised.value)


@pytest.mark.parametrize(
    ("key", "value", "sentence"),
    [
        ("body", "../x", ": body: found '../x', outside the bundle, expected a file of the bundle's folder"),
        ("texture", ".", ": texture: found '.', outside the bundle, expected a file of the bundle's folder"),
        ("texture", "no.npz", "b/no.npz: found no such file, expected the file that "),
        ("network", "/etc/hostname", ": network.file: found '/etc/hostname', outside the bundle"),
    ],
)
def test_files_of_a_bundle_lie_in_its_folder(tmp_path: Path, key: str, value: str, sentence: str) -> None:
    bundle(tmp_path, np.zeros((2, 2, 3), np.float16))
    path = tmp_path / "b" / "manifest.json"
    content = json.loads(path.read_text())
    if key == "network":
        content["network"]["file"] = value
    else:
        content[key] = value
    path.write_text(json.dumps(content))
    with pytest.raises(BadInputError) as raised:
        load_bundle(tmp_path / "b")
    assert sentence in str(raised.value)


def test_a_bundle_with_a_wrong_network_is_not_written(tmp_path: Path) -> None:
    with pytest.raises(BadInputError, match=r"\(output\): found scale 0.25"):
        bundle(tmp_path, np.zeros((2, 2, 3), np.float16), output={"scale": 0.5, "zero_point": 11})
    assert not (tmp_path / "b").exists()


# --- what never changes ---

#: Those that a reader fills in step by step.
CHANGING = {"BvhJoint", "_Words", "_Hierarchy"}


@pytest.mark.parametrize("package", [trilane.avatars, trilane.body, trilane.scene])
def test_what_is_loaded_never_changes(package: Any) -> None:
    found = 0
    for info in pkgutil.walk_packages(package.__path__, f"{package.__name__}."):
        for value in vars(importlib.import_module(info.name)).values():
            if isinstance(value, type) and dataclasses.is_dataclass(value) and value.__module__ == info.name:
                assert value.__dataclass_params__.frozen != (value.__name__ in CHANGING), value  # type: ignore[attr-defined]
                found += 1
    assert found >= 4
