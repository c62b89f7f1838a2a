"""Networks that round alike: scales are powers of two, no sum is half way, tensors that are joined have one scale."""

from __future__ import annotations

import copy

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from onnx import helper, numpy_helper

from trilane.errors import BadInputError
from trilane.training.quantising.calibration import CannotRoundAlikeError, may_round_alike, power_of_two_weights
from trilane.training.quantising.quantise import quantise

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


def test_biases_of_0_go_up_and_down_in_turn(tiny_float, tiny_frames):
    """One unit up in every channel would move all pictures the same way."""
    model = copy.deepcopy(tiny_float)
    layer = next(node for node in model.graph.node if node.name == "deep")
    del layer.input[2]
    network = quantise(model, tiny_frames).network
    values, makers = parts(network.model)
    stored = next(node for node in network.model.graph.node if node.name == "deep")
    assert values[makers[stored.input[2]].input[0]].tolist() == [1, -1] * 4


def test_other_networks_keep_their_measured_scales(tiny_float, tiny_frames):
    model = copy.deepcopy(tiny_float)
    next(node for node in model.graph.node if node.op_type == "Relu").op_type = "HardSwish"
    result = quantise(model, tiny_frames)
    assert not may_round_alike(model) and not result.facts["rounds_alike"] and result.facts["weight_bits"] == 7


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
    try:
        overrides = power_of_two_weights(model, known, reduce_range)
    except CannotRoundAlikeError:
        return
    scales = np.array([row["scale"] for row in overrides["w"]], np.float64)
    kernel, bias = (numpy_helper.to_array(tensor).astype(np.float64) for tensor in model.graph.initializer)
    integers, offset = np.rint(kernel[..., 0, 0] / scales[:, None]), np.rint(bias / (scales * step))
    assert not (integers % 2).any() and (offset % 2 == 1).all()
    sums = rng.integers(0, 256, (100, 4)) @ integers.T + offset
    value = sums * (scales * step / (reach / 128))
    assert (np.rint(value) == np.floor(value + 0.5)).all()
    assert (np.rint(value.astype(np.float32)) == np.rint(value)).all()


def test_weights_that_would_put_every_sum_half_way_are_left_alone(tiny_float, tiny_frames):
    """A last layer some thousand times larger than its bytes can tell: a unit of its sums is half a step and more."""
    model = copy.deepcopy(tiny_float)
    last = next(node for node in model.graph.node if node.output[0] == model.graph.node[-1].input[0])
    kernel = next(tensor for tensor in model.graph.initializer if tensor.name == last.input[1])
    kernel.CopyFrom(numpy_helper.from_array(numpy_helper.to_array(kernel) * np.float32(5000), kernel.name))
    result = quantise(model, tiny_frames)
    assert not result.facts["rounds_alike"] and result.facts["weight_bits"] == 7


def test_a_unit_of_a_sum_is_a_small_part_of_the_step_that_is_written(tiny_quantised):
    model = tiny_quantised.network.model
    values, makers = parts(model)
    readers = {name: node for node in model.graph.node for name in node.input}
    for node in model.graph.node:
        if node.op_type == "Conv":
            source, after = makers[node.input[0]], readers[node.output[0]]
            source = source if source.op_type == "DequantizeLinear" else makers[source.input[0]]
            after = after if after.op_type == "QuantizeLinear" else readers[after.output[0]]
            unit = values[source.input[1]] * values[makers[node.input[1]].input[1]]
            step = values[after.input[1]]
            assert (unit <= 0.25 * step).all() and (unit >= 2.0**-16 * step).all()


def test_a_huge_bias_stays_exact_in_float32():
    """A bias far beyond the output's range, which the sum takes back: its unit is coarser than the range asks for."""
    weights = [
        numpy_helper.from_array(np.full((1, 1, 1, 1), 1e-3, np.float32), "w"),
        numpy_helper.from_array(np.full(1, 3e4, np.float32), "b"),
    ]
    node = helper.make_node("Conv", [FIRST, "w", "b"], [SECOND], "layer")
    model = helper.make_model(helper.make_graph([node], "g", [], [], weights))
    known = {FIRST: Range(0, 255 / 32), SECOND: Range(0, 255 / 8)}
    (row,) = power_of_two_weights(model, known, True)["w"]
    offset = numpy_helper.to_array(model.graph.initializer[1])[0] * 32 / row["scale"]
    assert offset % 2 == 1 and 2**20 < offset < 2**23


@pytest.mark.parametrize(("factor", "named"), [("nan", "deep.w"), ("1e38", "calibration")])
def test_a_network_that_is_not_finite_is_refused(tiny_float, tiny_frames, factor, named):
    model = copy.deepcopy(tiny_float)
    kernel = next(tensor for tensor in model.graph.initializer if tensor.name == "deep.w")
    kernel.CopyFrom(numpy_helper.from_array(numpy_helper.to_array(kernel) * np.float32(factor), "deep.w"))
    with pytest.raises(BadInputError, match=named):
        quantise(model, tiny_frames)


@pytest.mark.parametrize(
    ("kind", "alike"),
    [
        *((name, True) for name in ("Resize", "MaxPool", "Reshape", "Transpose", "Slice", "Split", "SpaceToDepth")),
        *((name, True) for name in ("Concat", "Add", "Conv", "Relu", "Sigmoid", "Constant", "Identity")),
        *((name, False) for name in ("ReduceMean", "Mul", "Clip", "ConvTranspose", "AveragePool", "Softmax")),
    ],
)
def test_operators_that_round_nothing_or_in_one_way(kind, alike):
    """What moves, joins or adds, and what has one rounding at its end; not what rounds inside."""
    node = helper.make_node(kind, ["x"], ["y"])
    assert may_round_alike(helper.make_model(helper.make_graph([node], "g", [], []))) == alike
