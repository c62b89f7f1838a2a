"""Every wrong network is refused with the name of what is wrong."""

from __future__ import annotations

import copy
from pathlib import Path

import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper, numpy_helper

from support.small_inputs import net
from trilane.avatars import network_file
from trilane.avatars.network_file import check_network, constants_of, parse_network, read_network
from trilane.errors import BadInputError


def initializer(model, name):
    return next(tensor for tensor in model.graph.initializer if tensor.name == name)


def node(model, op_type, name=""):
    return next(n for n in model.graph.node if n.op_type == op_type and name in n.name)


def set_input_scale(value):
    def change(model):
        name = node(model, "DequantizeLinear", "bytes_in").input[1]
        initializer(model, name).CopyFrom(numpy_helper.from_array(np.float32(value), name))

    return change


def float_input(model):
    model.graph.input[0].type.tensor_type.elem_type = TensorProto.FLOAT


def dynamic_height(model):
    model.graph.input[0].type.tensor_type.shape.dim[1].dim_param = "height"


def three_dims(model):
    del model.graph.input[0].type.tensor_type.shape.dim[3]


def channels_first(model):
    for dim, size in zip(model.graph.input[0].type.tensor_type.shape.dim, (1, 5, 64, 4096), strict=True):
        dim.dim_value = size


def rgb_output(model):
    model.graph.output[0].type.tensor_type.shape.dim[3].dim_value = 3


def second_input(model):
    model.graph.input.append(helper.make_tensor_value_info("more", TensorProto.UINT8, [1]))


def no_scale(model):
    node(model, "DequantizeLinear", "bytes_in").input[1] = "nowhere"


def zero_point_300(model):
    name = node(model, "DequantizeLinear", "bytes_in").input[2]
    tensor = initializer(model, name)
    tensor.ClearField("raw_data")
    tensor.int32_data[:] = [300]


def float_zero_point(model):
    name = node(model, "DequantizeLinear", "bytes_in").input[2]
    initializer(model, name).CopyFrom(numpy_helper.from_array(np.float32(3), name))


def unsupported_operator(model):
    node(model, "Concat").op_type = "Einsum"


def foreign_domain(model):
    node(model, "Concat").domain = "com.acme"


def cut_weights(model):
    tensor = initializer(model, node(model, "DequantizeLinear", "bytes_in").input[1])
    tensor.raw_data = tensor.raw_data[:2]


def float_output(model):
    model.graph.node[-1].op_type = "Identity"


WRONG = {
    "float input": (float_input, "FLOAT"),
    "dynamic": (dynamic_height, r"\?"),
    "three dims": (three_dims, "four fixed sizes"),
    "channels first": (channels_first, "channels"),
    "rgb": (rgb_output, "RGBA"),
    "two inputs": (second_input, "2 inputs"),
    "scale 0": (set_input_scale(0), "bytes_in"),
    "scale inf": (set_input_scale(np.inf), "bytes_in"),
    "scale nan": (set_input_scale(np.nan), "bytes_in"),
    "scale 1e-40": (set_input_scale(1e-40), "bytes_in"),
    "scale negative": (set_input_scale(-1), "bytes_in"),
    "no scale": (no_scale, "bytes_in"),
    "zero point 300": (zero_point_300, "300.*bytes_in"),
    "float zero point": (float_zero_point, "bytes_in"),
    "unsupported operator": (unsupported_operator, "Einsum.*joined"),
    "foreign domain": (foreign_domain, "com.acme.*joined"),
    "cut data": (cut_weights, "does not decode"),
    "no quantised output": (float_output, "bytes_out"),
}


@pytest.mark.parametrize("case", WRONG)
def test_wrong_networks_are_named(tiny_quantised, case):
    change, message = WRONG[case]
    model = copy.deepcopy(tiny_quantised.network.model)
    change(model)
    with pytest.raises(BadInputError, match=message):
        check_network(model, "network.onnx")


@pytest.mark.parametrize("content", [b"", b"not a network", b"\x08"])
def test_wrong_files_are_named(tmp_path, content):
    path = tmp_path / "network.onnx"
    path.write_bytes(content)
    with pytest.raises(BadInputError, match=r"network\.onnx"):
        read_network(path)


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(BadInputError, match="no such file"):
        read_network(tmp_path / "network.onnx")


def test_a_truncated_file_is_named(tmp_path, tiny_quantised):
    path = tmp_path / "network.onnx"
    content = tiny_quantised.network.model.SerializeToString()
    path.write_bytes(content[: len(content) // 2])
    with pytest.raises(BadInputError, match=r"network\.onnx"):
        read_network(path)


def external(model, location):
    model = copy.deepcopy(model)
    tensor = initializer(model, "stem.w_quantized")
    tensor.ClearField("raw_data")
    tensor.data_location = TensorProto.EXTERNAL
    tensor.external_data.add(key="location", value=location)
    return model


@pytest.mark.parametrize("location", ["../weights.bin", "/etc/hostname", "missing.bin", "", "."])
def test_external_data_stays_inside_the_folder(tmp_path, tiny_quantised, location):
    folder = tmp_path / "bundle"
    folder.mkdir()
    (tmp_path / "weights.bin").write_bytes(bytes(1000))
    onnx.save(external(tiny_quantised.network.model, location), folder / "network.onnx")
    with pytest.raises(BadInputError, match=r"stem\.w_quantized"):
        read_network(folder / "network.onnx")


def test_external_data_inside_the_folder_is_read(tmp_path, tiny_quantised):
    model = tiny_quantised.network.model
    (tmp_path / "weights.bin").write_bytes(initializer(model, "stem.w_quantized").raw_data)
    (tmp_path / "network.onnx").write_bytes(external(model, "weights.bin").SerializeToString())
    network = read_network(tmp_path / "network.onnx")
    assert initializer(network.model, "stem.w_quantized").raw_data == initializer(model, "stem.w_quantized").raw_data


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
