"""Networks for another shape and networks cut in parts, by hand."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest
from onnx import helper, numpy_helper

from support.small_inputs import net, node_of
from trilane.avatars.integer_network import (
    NetworkFile,
)
from trilane.avatars.network_checks import check_network
from trilane.avatars.network_reshape import reshaped
from trilane.avatars.network_split import Cut, cuts, split
from trilane.errors import BadInputError


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
