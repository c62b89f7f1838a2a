"""Networks that round alike: scales are powers of two, no sum is half way, nothing is lost where tensors are joined."""

from __future__ import annotations

import copy

import numpy as np
import onnx
import pytest
from hypothesis import given
from hypothesis import strategies as st
from onnx import helper, numpy_helper

from trilane.avatars.dyadic import dyadic_weights, rounds_alike
from trilane.avatars.quantise import quantise
from trilane.errors import BadInputError

FIRST, SECOND = "tensor", "made"


class Range:
    """What ONNX Runtime keeps of a tensor."""

    def __init__(self, low, high):
        self.lowest, self.highest = np.float32(low), np.float32(high)


def parts(model):
    values = {tensor.name: numpy_helper.to_array(tensor) for tensor in model.graph.initializer}
    makers = {out: node for node in model.graph.node for out in node.output}
    return values, makers


def is_power_of_two(values):
    return (np.frexp(values)[0] == 0.5).all()


def test_every_scale_but_the_pictures_is_a_power_of_two(tiny_quantised):
    values, _ = parts(tiny_quantised.network.model)
    nodes = [node for node in tiny_quantised.network.model.graph.node if node.op_type.endswith("eLinear")]
    scales = {node.input[1]: values[node.input[1]] for node in nodes} | {"": np.float32(1)}
    scales.pop("picture_scale")
    assert len(scales) > 10 and all(is_power_of_two(scale) for scale in scales.values())


def test_weights_are_even_and_biases_odd(tiny_quantised):
    values, makers = parts(tiny_quantised.network.model)
    layers = [node for node in tiny_quantised.network.model.graph.node if node.op_type == "Conv"]
    for layer in layers:
        weights, bias = (values[makers[name].input[0]].astype(int) for name in layer.input[1:])
        assert not (weights % 2).any() and (bias % 2).all() and np.abs(weights).max() <= 64
    assert layers


def test_tensors_that_are_added_have_one_step(tiny_quantised):
    model = tiny_quantised.network.model
    values, makers = parts(model)
    add = next(node for node in model.graph.node if node.op_type == "Add")
    after = next(node for node in model.graph.node if add.output[0] in node.input)
    assert len({float(values[node.input[1]]) for node in (*(makers[name] for name in add.input), after)}) == 1


def test_a_layer_without_a_bias_gets_one(tiny_float, tiny_frames):
    model = copy.deepcopy(tiny_float)
    layer = next(node for node in model.graph.node if node.name == "deep")
    del layer.input[2]
    network = quantise(model, tiny_frames).network
    values, makers = parts(network.model)
    assert all(
        (values[makers[node.input[2]].input[0]] % 2).all()
        for node in network.model.graph.node
        if node.op_type == "Conv"
    )


def test_other_networks_keep_their_measured_scales(tiny_float, tiny_frames):
    model = copy.deepcopy(tiny_float)
    next(node for node in model.graph.node if node.op_type == "Relu").op_type = "HardSwish"
    result = quantise(model, tiny_frames)
    assert not rounds_alike(model) and not result.facts["rounds_alike"] and result.facts["weight_bits"] == 7


@pytest.mark.parametrize("reduce_range", [True, False])
@given(seed=st.integers(0, 2**32 - 1), size=st.sampled_from([1e-6, 0.01, 1.0, 100.0]))
def test_no_sum_is_half_way_between_two_bytes(reduce_range, seed, size):
    """The three ways to round a half give the same bytes, in float32 as in integers."""
    rng = np.random.default_rng(seed)
    weights = [
        numpy_helper.from_array((size * rng.normal(size=(3, 4, 1, 1))).astype(np.float32), "w"),
        numpy_helper.from_array((size * rng.normal(size=3)).astype(np.float32), "b"),
    ]
    node = helper.make_node("Conv", [FIRST, "w", "b"], [SECOND], "layer")
    model = helper.make_model(helper.make_graph([node], "g", [], [], weights))
    step, reach = 2.0**-5, 2.0 ** np.ceil(np.log2(10 * size))
    known = {FIRST: Range(0, 255 * step), SECOND: Range(-127 * reach / 128, 128 * reach / 128)}
    scales = np.array([row["scale"] for row in dyadic_weights(model, known, reduce_range)["w"]], np.float64)
    kernel, bias = (numpy_helper.to_array(tensor).astype(np.float64) for tensor in model.graph.initializer)
    integers, offset = np.rint(kernel[..., 0, 0] / scales[:, None]), np.rint(bias / (scales * step))
    assert not (integers % 2).any() and (offset % 2 == 1).all()
    sums = rng.integers(0, 256, (100, 4)) @ integers.T + offset
    value = sums * (scales * step / (reach / 128))
    assert (np.rint(value) == np.floor(value + 0.5)).all()
    assert (np.rint(value.astype(np.float32)) == np.rint(value)).all()


@pytest.mark.parametrize("size", [1e4, 1e6])
def test_a_huge_bias_stays_exact_in_float32(tiny_float, tiny_frames, size):
    model = copy.deepcopy(tiny_float)
    bias = next(tensor for tensor in model.graph.initializer if tensor.name == "deep.b")
    bias.CopyFrom(numpy_helper.from_array(numpy_helper.to_array(bias) * np.float32(size), "deep.b"))
    values, makers = parts(quantise(model, tiny_frames).network.model)
    biases = [values[makers[node.input[2]].input[0]] for node in makers.values() if node.op_type == "Conv"]
    assert all(np.abs(bias.astype(np.int64)).max() < 2**23 and (bias % 2).all() for bias in biases)


@pytest.mark.parametrize(("factor", "named"), [("nan", "deep.w"), ("1e38", "calibration")])
def test_a_network_that_is_not_finite_is_refused(tiny_float, tiny_frames, factor, named):
    model = copy.deepcopy(tiny_float)
    kernel = next(tensor for tensor in model.graph.initializer if tensor.name == "deep.w")
    kernel.CopyFrom(numpy_helper.from_array(numpy_helper.to_array(kernel) * np.float32(factor), "deep.w"))
    with pytest.raises(BadInputError, match=named):
        quantise(model, tiny_frames)


def test_a_network_with_a_float_layer_keeps_its_measured_scales(tiny_float, tiny_frames):
    assert not quantise(tiny_float, tiny_frames, keep_float=["stem"]).facts["rounds_alike"]


def test_what_rounds_alike(tiny_float):
    assert rounds_alike(tiny_float)
    other = onnx.ModelProto()
    other.CopyFrom(tiny_float)
    other.graph.node[0].op_type = "InstanceNormalization"
    assert not rounds_alike(other)
