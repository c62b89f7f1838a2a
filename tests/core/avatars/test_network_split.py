"""A network in two parts: at every place where it can be cut, the parts give the bytes of the whole."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnxruntime
import pytest
from onnx import helper, numpy_helper
from typer.testing import CliRunner

from support.small_inputs import net, node_of
from trilane.apps.cli.avatar import app
from trilane.avatars.bundle import load_bundle
from trilane.avatars.network_file import NetworkFile, check_network, reshaped
from trilane.avatars.network_split import Cut, cuts, split
from trilane.errors import BadInputError

QUIET = 3


def run(model: onnx.ModelProto, known: dict[str, Any]) -> dict[str, Any]:
    """`known` and what `model` makes of it."""
    settings = onnxruntime.SessionOptions()
    settings.log_severity_level = QUIET
    session = onnxruntime.InferenceSession(model.SerializeToString(), settings, providers=["CPUExecutionProvider"])
    values = session.run(None, {value.name: known[value.name] for value in session.get_inputs()})
    return known | dict(zip([value.name for value in session.get_outputs()], values, strict=True))


@pytest.fixture(scope="module")
def network(tiny_quantised: Any) -> NetworkFile:
    return tiny_quantised.network


def test_parts_give_the_bytes_of_the_whole_wherever_it_is_cut(network: NetworkFile) -> None:
    tensor = np.random.default_rng(0).integers(0, 256, network.shape, dtype=np.uint8)
    inputs = {network.model.graph.input[0].name: tensor}
    output = network.model.graph.output[0].name
    whole = run(network.model, inputs)[output]
    places = list(cuts(network))
    assert len(places) >= 3
    for cut in places:
        head, tail = (part.model for part in split(network, [cut.at]))
        kinds = {value.type.tensor_type.elem_type for value in (*head.graph.output, *tail.graph.input)}
        assert kinds == {onnx.TensorProto.UINT8}
        assert (run(tail, run(head, inputs))[output] == whole).all()
        assert cut.bytes == sum(np.prod(shape) for shape in cut.crossing.values())


def test_the_default_avatar_can_be_cut_at_its_skips() -> None:
    places = list(cuts(load_bundle("default").read_network()))
    assert len(places) > 40
    assert max(len(cut.crossing) for cut in places) >= 6


def test_the_command_lists_places_and_writes_parts(tmp_path: Path, tiny_bundle: Path) -> None:
    listed = CliRunner().invoke(app, ["split", str(tiny_bundle), "--size", "64", "--json"])
    places = [row["at"] for row in json.loads(listed.stdout)["cuts"]]
    written = CliRunner().invoke(
        app, ["split", str(tiny_bundle), "--size", "64", "--at", places[0], "--out", str(tmp_path / "parts"), "--json"]
    )
    assert written.exit_code == 0
    assert {path.name for path in (tmp_path / "parts").iterdir()} == {"part-1.onnx", "part-2.onnx"}


def test_half_of_the_options_is_refused(tiny_bundle: Path) -> None:
    with pytest.raises(BadInputError, match="--at without --out"):
        raise CliRunner().invoke(app, ["split", str(tiny_bundle), "--at", "x"]).exception or AssertionError


def test_many_parts_give_the_bytes_of_the_whole(network: NetworkFile) -> None:
    tensor = np.random.default_rng(1).integers(0, 256, network.shape, dtype=np.uint8)
    known = {network.model.graph.input[0].name: tensor}
    output = network.model.graph.output[0].name
    whole = run(network.model, known)[output]
    parts = split(network, [cut.at for cut in cuts(network)][::2])
    assert len(parts) > 3
    for part in parts:
        assert set(part.inputs) <= set(part.crossing_in) and set(part.outputs) <= set(part.crossing_out)
        assert set(part.crossing_out) - set(part.outputs) <= set(part.crossing_in)
        known = run(part.model, known)
    assert (known[output] == whole).all()


# Networks for another shape and networks cut in parts, by hand.


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
