"""The noise model: closed forms of two layers, clipping, what rounds nothing, the bound, and networks that break it."""

from __future__ import annotations

import copy
import math
from types import SimpleNamespace

import numpy as np
import onnx
import onnxruntime
import pytest
from onnx import TensorProto, helper, numpy_helper

from trilane.errors import BadInputError
from trilane.training.quantising.noise_model import (
    DRAWS,
    STUDENT_T,
    NoiseModel,
    float_picture,
    float_ranges,
    ideal_noise_model,
    noise_model,
    predicted_bound,
)

#: Of the two-layer network: its weights, the steps of weights, of the tensor between and of the output, and its input.
W1, W2 = 0.7, -0.9
STEP1, STEP2, STEP_BETWEEN, STEP_OUT = 0.05, 0.07, 0.04, 0.03
X = 0.6
DRAWN = 6000


def layers(weights, steps, stored_steps, zero=128, between=(), exact=False):
    """Convolutions 1x1 of one channel in a row; `between` are operators after the first stored tensor.

    With `exact` the weights are plain floats, which have no error.
    """
    constants, nodes = {"in_scale": np.float32(0.1), "in_zero": np.uint8(0), "zero": np.uint8(zero)}, []
    nodes.append(helper.make_node("DequantizeLinear", ["bytes", "in_scale", "in_zero"], ["x0"]))
    for i, (weight, step, stored) in enumerate(zip(weights, steps, stored_steps, strict=True), 1):
        constants[f"w{i}_quantized"] = np.full((1, 1, 1, 1), round(weight / step), np.int8)
        constants |= {f"ws{i}": np.array([step], np.float32), f"wz{i}": np.zeros(1, np.int8)}
        constants[f"s{i}"] = np.float32(stored)
        nodes += [
            *(
                []
                if exact
                else [helper.make_node("DequantizeLinear", [f"w{i}_quantized", f"ws{i}", f"wz{i}"], [f"w{i}"], axis=0)]
            ),
            helper.make_node("Conv", [f"x{i - 1}", f"w{i}"], [f"y{i}"]),
            helper.make_node("QuantizeLinear", [f"y{i}", f"s{i}", "zero"], [f"q{i}"]),
            helper.make_node("DequantizeLinear", [f"q{i}", f"s{i}", "zero"], [f"x{i}"]),
        ]
        if exact:
            constants[f"w{i}"] = np.full((1, 1, 1, 1), weight, np.float32)
        if i == 1:
            nodes += between
    nodes[-1] = helper.make_node("Transpose", [f"q{len(weights)}"], ["picture"], perm=[0, 2, 3, 1])
    tensors = [numpy_helper.from_array(np.asarray(value), name) for name, value in constants.items()]
    source = helper.make_tensor_value_info("bytes", TensorProto.UINT8, [1, 1, 1, 1])
    target = helper.make_tensor_value_info("picture", TensorProto.UINT8, None)
    model = helper.make_model(helper.make_graph(nodes, "layers", [source], [target], tensors))
    floats = {f"w{i}": np.full((1, 1, 1, 1), weight, np.float32) for i, weight in enumerate(weights, 1)}
    return SimpleNamespace(network=SimpleNamespace(model=model), float_constants=floats, facts={"rounds_alike": False})


def drawn(quantised, byte, draws):
    """What the output's real number is in each draw."""
    tensor = np.full((1, 1, 1, 1), byte, np.uint8)
    return np.array([picture.item() / 255 for picture in noise_model(quantised).pictures(tensor, draws, seed=1)])


@pytest.mark.parametrize("multiples", [1, 2])
def test_two_layers_have_the_variance_of_the_closed_form(multiples):
    """y = (w2 + d2) ((w1 + d1) x + e1) + e2, all four errors uniform over +-half a step, independent, of mean 0:

    E[(y - w1 w2 x)²] = (w2² + D2) (x² D1 + E1) + D2 w1² x² + E2, where each capital is step²/12. No term is less than a
    tenth of the sum, and a step of twice the size, as rounding alike has for weights, changes D1 and D2 fourfold.
    """
    quantised = layers((W1, W2), (STEP1, STEP2), (STEP_BETWEEN, STEP_OUT))
    quantised.facts["rounds_alike"] = multiples == 2
    d1, d2 = ((multiples * step) ** 2 / 12 for step in (STEP1, STEP2))
    e1, e2 = (step**2 / 12 for step in (STEP_BETWEEN, STEP_OUT))
    terms = (W2**2 + d2) * X**2 * d1, (W2**2 + d2) * e1, d2 * W1**2 * X**2, e2
    assert min(terms) > 0.05 * sum(terms)
    error = drawn(quantised, 6, DRAWN) - W1 * W2 * X
    assert np.square(error).mean() == pytest.approx(sum(terms), rel=0.06)
    assert error.mean() == pytest.approx(0, abs=4 * math.sqrt(sum(terms) / DRAWN))


def test_one_rounding_has_a_mean_error_of_a_quarter_step_and_at_most_a_half():
    error = np.abs(drawn(layers((1.0,), (STEP1,), (STEP_OUT,), zero=0, exact=True), 6, 4000) - X)
    assert error.mean() == pytest.approx(STEP_OUT / 4, rel=0.05)
    assert error.max() == pytest.approx(STEP_OUT / 2, rel=0.01)


def test_beyond_its_range_a_tensor_is_at_the_ranges_end_and_rounds_nothing():
    """Bytes reach from -1.28 to 1.27; 0.1 of 255 is 25.5."""
    assert drawn(layers((1.0,), (STEP1,), (0.01,), exact=True), 255, 5) == pytest.approx([1.27] * 5)
    assert drawn(layers((-1.0,), (STEP1,), (0.01,), exact=True), 255, 5) == pytest.approx([-1.28] * 5)


def test_zero_is_stored_exactly():
    assert (drawn(layers((W1, W2), (STEP1, STEP2), (STEP_BETWEEN, STEP_OUT)), 0, 5) == 0).all()


@pytest.mark.parametrize(("step", "rounds"), [(STEP_BETWEEN, False), (STEP_OUT, True)])
def test_a_tensor_that_is_only_moved_is_not_rounded_again(step, rounds):
    between = [
        helper.make_node("MaxPool", ["x1"], ["pool"], kernel_shape=[1, 1]),
        helper.make_node("Relu", ["pool"], ["relu"]),
        helper.make_node("QuantizeLinear", ["relu", "moved_step", "zero"], ["moved"]),
        helper.make_node("DequantizeLinear", ["moved", "moved_step", "zero"], ["x1_moved"]),
    ]
    quantised = layers((W1, W2), (STEP1, STEP2), (STEP_BETWEEN, STEP_OUT), between=between)
    graph = quantised.network.model.graph
    graph.initializer.append(numpy_helper.from_array(np.asarray(step, np.float32), "moved_step"))
    next(node for node in graph.node if "x1" in node.input and node.op_type == "Conv").input[0] = "x1_moved"
    assert ("moved.offset" in noise_model(quantised).offsets) is rounds


def test_a_constant_without_its_float_value_is_named():
    quantised = layers((W1, W2), (STEP1, STEP2), (STEP_BETWEEN, STEP_OUT))
    quantised.float_constants["w2"] = np.zeros(3, np.float32)
    with pytest.raises(BadInputError, match="w2"):
        noise_model(quantised)


@pytest.mark.parametrize(("stored", "half"), [(0, 0.0), (1, math.sqrt(3) * STEP1), (-1, math.sqrt(3) * STEP1)])
def test_a_constant_of_0_is_exact_or_a_whole_step_off_where_only_odd_multiples_are_used(stored, half):
    """An error of always one step has the variance step², a uniform one within +-h the variance h²/3."""
    quantised = layers((stored * STEP1,), (STEP1,), (STEP_OUT,))
    quantised.facts["rounds_alike"] = True
    quantised.float_constants["w1"] = np.zeros((1, 1, 1, 1), np.float32)
    assert noise_model(quantised).constants["w1"][1].item() == pytest.approx(half)


def test_copies_of_a_constant_have_its_value():
    """ONNX Runtime calls the second copy of bias `w` `w1`; where there is a `w1`, it is that, and `w1x` is another."""
    quantised = layers((W1,), (STEP1,), (STEP_OUT,))
    value = quantised.float_constants.pop("w1")
    quantised.float_constants["w"] = value
    assert noise_model(quantised).constants["w1"][0] == value
    quantised.float_constants = {"w1": value, "w": 2 * value}
    assert noise_model(quantised).constants["w1"][0] == value
    quantised.float_constants = {"w1x": value}
    with pytest.raises(BadInputError, match="w1"):
        noise_model(quantised)


def test_the_bound_is_the_prediction_interval(monkeypatch):
    """16 draws with errors 1 to 16 have mean 8.5 and deviation sqrt(68/3)."""
    pictures = [np.full((1, 2, 2, 4), float(error)) for error in range(1, DRAWS + 1)]
    monkeypatch.setattr(NoiseModel, "pictures", lambda *_: iter(pictures))
    mean, bound = predicted_bound(NoiseModel(None, {}, ()), np.zeros((1, 2, 2, 4)), np.zeros(1))
    assert mean == 8.5
    assert bound == pytest.approx(8.5 + STUDENT_T * math.sqrt(68 / 3) * math.sqrt(17 / 16))


def test_student_t_is_exceeded_with_the_stated_risk():
    """The density of Student's t, integrated from `STUDENT_T` on with x = t + u / (1 - u)."""
    degrees = DRAWS - 1
    factor = math.gamma((degrees + 1) / 2) / math.gamma(degrees / 2) / math.sqrt(degrees * math.pi)
    u = (np.arange(100000) + 0.5) / 100000
    x = STUDENT_T + u / (1 - u)
    density = factor * (1 + x**2 / degrees) ** (-(degrees + 1) / 2) / (1 - u) ** 2
    assert density.mean() == pytest.approx(0.001, rel=1e-3)


@pytest.fixture(scope="module")
def predicted(tiny_float, tiny_quantised, tiny_frames):
    """(bytes, float picture, bound) of the tiny network on a frame."""
    encoding = tiny_quantised.network.input
    steps = np.round(tiny_frames[5] / encoding.scale) + encoding.zero_point
    tensor = np.clip(steps, 0, 255).astype(np.uint8)[None]
    wanted = float_picture(tiny_float, tiny_quantised, tensor)
    return tensor, wanted, predicted_bound(noise_model(tiny_quantised), wanted, tensor)[1]


def error_in_integers(model, tensor, wanted):
    session = onnxruntime.InferenceSession(model.SerializeToString(), providers=["CPUExecutionProvider"])
    return float(np.abs(session.run(None, {"tensor": tensor})[0] - wanted).mean())


def test_the_integer_network_keeps_the_bound_and_wrong_pictures_do_not(tiny_quantised, predicted):
    tensor, wanted, bound = predicted
    assert error_in_integers(tiny_quantised.network.model, tensor, wanted) <= bound
    assert np.abs(wanted - np.median(wanted, axis=(1, 2))).mean() > bound
    assert np.abs(wanted[..., [2, 1, 0, 3]] - wanted).mean() > bound


@pytest.mark.parametrize("layer", ["stem", "level", "head"])
def test_a_layer_that_is_half_too_large_breaks_the_bound(tiny_quantised, predicted, layer):
    tensor, wanted, bound = predicted
    model = copy.deepcopy(tiny_quantised.network.model)
    scale = next(t for t in model.graph.initializer if t.name == f"{layer}.w_scale")
    scale.CopyFrom(numpy_helper.from_array(1.5 * numpy_helper.to_array(scale), scale.name))
    assert error_in_integers(onnx.ModelProto.FromString(model.SerializeToString()), tensor, wanted) > bound


def plain_network(*rectified):
    """A float network of which only the names of its rectifiers' outputs count."""
    nodes = [helper.make_node("Relu", ["x"], [name]) for name in rectified]
    return helper.make_model(helper.make_graph(nodes, "float", [], []))


def test_ideal_ranges_are_those_of_the_float_network_with_its_rectifiers():
    """0.6 * 0.7 = 0.42, times -0.9 is -0.378, which a rectifier makes 0; ranges include 0."""
    tensor = np.full((1, 1, 1, 1), 6, np.uint8)
    quantised = layers((W1, W2), (STEP1, STEP2), (STEP_BETWEEN, STEP_OUT))
    ranges = float_ranges(plain_network(), quantised, tensor)
    assert ranges["q1"] == pytest.approx((0, 0.42)) and ranges["q2"] == pytest.approx((-0.378, 0))
    assert float_ranges(plain_network("y2"), quantised, tensor)["q2"] == (0, 0)


@pytest.mark.parametrize("factor", [0.5, 4.0])
def test_ideal_noise_does_not_depend_on_the_quantisers_steps(factor):
    """The same draws give the same pictures, whatever the steps of weights and of the tensor between are."""
    tensor = np.full((1, 1, 1, 1), 6, np.uint8)

    def pictures(times):
        quantised = layers((W1, -W2), (times * STEP1, times * STEP2), (times * STEP_BETWEEN, times * STEP_OUT))
        return np.array(list(ideal_noise_model(plain_network(), quantised, tensor).pictures(tensor, 50, seed=1)))

    assert (pictures(factor) == pictures(1.0)).all()
    assert np.ptp(pictures(1.0)) > 0


@pytest.mark.parametrize(("alike", "widened"), [(False, 1), (True, 2)])
def test_ideal_weights_have_64_steps_to_either_side_and_powers_of_two_at_most_twice_as_wide_ones(alike, widened):
    """64 is the greatest w with 2 * 255 * w < 2**15, by which two products fit 16 bits: 32640; 33150 does not."""
    quantised = layers((W1, W2), (STEP1, STEP2), (STEP_BETWEEN, STEP_OUT))
    quantised.facts["rounds_alike"] = alike
    model = ideal_noise_model(plain_network(), quantised, np.full((1, 1, 1, 1), 6, np.uint8))
    halves = [half.item() for _, half in model.constants.values()]
    assert halves == pytest.approx([widened * 0.7 / 64 / 2, widened * 0.9 / 64 / 2])
    limits = {
        t.name: numpy_helper.to_array(t).item() for t in model.model.graph.initializer if t.name.endswith(".step")
    }
    assert limits == pytest.approx({"q1.step": widened * 0.42 / 255, "q2.step": 1 / 255})
