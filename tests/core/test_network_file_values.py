"""Network files by value: read, refused in whole sentences, and with tensors in files beside them."""

from __future__ import annotations

from pathlib import Path

import onnx
import pytest
from onnx import TensorProto, helper

from support.small_inputs import net
from trilane.avatars import network_file
from trilane.avatars.integer_network import (
    constants_of,
)
from trilane.avatars.network_file import parse_network, read_network
from trilane.errors import BadInputError


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
