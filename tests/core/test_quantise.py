"""Quantisation: bytes at both ends, real zero exact, small error, weights that cannot overflow, named errors."""

from __future__ import annotations

import copy

import numpy as np
import onnx
import onnxruntime
import pytest
from onnx import TensorProto, helper, numpy_helper

from trilane.avatars.network_file import reshaped
from trilane.errors import BadInputError
from trilane.training.quantising.calibration import METHODS, saturated
from trilane.training.quantising.quantise import quantise


def run(model, feed):
    onnxruntime.set_default_logger_severity(3)
    session = onnxruntime.InferenceSession(model.SerializeToString(), providers=["CPUExecutionProvider"])
    return session.run(None, {session.get_inputs()[0].name: feed})[0]


def test_bytes_are_the_picture(tiny_float, tiny_frames, tiny_quantised):
    network = tiny_quantised.network
    frame = tiny_frames[0]
    tensor = np.clip(np.round(frame / network.input.scale) + network.input.zero_point, 0, 255).astype(np.uint8)
    wanted = run(tiny_float, frame.transpose(2, 0, 1)[None])[0].transpose(1, 2, 0)
    picture = run(network.model, tensor[None])[0]
    assert picture.dtype == np.uint8 and picture.shape == (64, 64, 4)
    assert np.abs(picture / 255 - wanted).mean() < 2.5 / 255  # weights of 6 bits
    assert network.output.scale == pytest.approx(1 / 255) and network.output.zero_point == 0


def test_saturated_frames_have_all_values_at_the_ends_of_their_common_range():
    frames = [np.array([-1, 0, 0.5], np.float32), np.array([0.1, -3, 4], np.float32)]
    assert [frame.tolist() for frame in saturated(frames)] == [[-3, 0, 4], [4, -3, 4]]
    assert saturated([np.array([1, 2], np.float32)])[0].tolist() == [2, 2]


@pytest.mark.parametrize("norm", ["InstanceNormalization", "Relu"])
def test_what_a_norm_reads_is_not_cut_off_at_the_strongest_contrast(norm):
    """Inputs are -1 to 1 but mostly +-0.1, and the sum of two of them is at most 0.3 where both are small.

    Saturated, the sum is -2 to 2, which a norm's input holds; without a norm 3/4 of the frames' range.
    """
    frame = np.full((8, 8, 2), 0.1, np.float32)
    frame[::2] = -0.1
    frame[0, 0], frame[7, 7] = (-1, 0.7), (1, -0.7)
    model = summing_network(norm)
    quantised = quantise(model, [frame]).network.model
    known = {tensor.name: numpy_helper.to_array(tensor) for tensor in quantised.graph.initializer}
    store = next(n for n in quantised.graph.node if n.op_type == "QuantizeLinear" and n.input[0] in ("sum", "read"))
    scale, zero = (float(known[name]) for name in store.input[1:])
    low, high = -zero * scale, (255 - zero) * scale
    if norm == "Relu":
        assert low == 0 and 0.2 <= high <= 0.4
    else:
        assert low == pytest.approx(-2, abs=0.02) and high == pytest.approx(2, abs=0.02)


def summing_network(norm):
    """The sum of two channels, `norm` and a last sigmoid."""
    kernels = {"w1": np.ones((1, 2, 1, 1)), "w2": np.ones((4, 1, 1, 1)), "gain": np.ones(1), "offset": np.zeros(1)}
    nodes = [
        helper.make_node("Conv", ["tensor", "w1"], ["sum"], "first"),
        helper.make_node(norm, ["sum", "gain", "offset"] if norm != "Relu" else ["sum"], ["read"], "norm"),
        helper.make_node("Conv", ["read", "w2"], ["logits"], "second"),
        helper.make_node("Sigmoid", ["logits"], ["rgba"], "last"),
    ]
    weights = [numpy_helper.from_array(value.astype(np.float32), name) for name, value in kernels.items()]
    ends = [("tensor", 2), ("rgba", 4)]
    source, target = (helper.make_tensor_value_info(n, TensorProto.FLOAT, [1, c, 8, 8]) for n, c in ends)
    graph = helper.make_graph(nodes, "sum", [source], [target], weights)
    return helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)


def test_zero_is_exact(tiny_quantised):
    assert 0 <= tiny_quantised.network.input.zero_point <= 255


@pytest.mark.parametrize("method", METHODS)
def test_every_method_calibrates(tiny_float, tiny_frames, method):
    result = quantise(tiny_float, tiny_frames, method)
    assert result.facts["method"] == method and result.facts["calibration_frames"] == len(tiny_frames)


@pytest.mark.parametrize(("reduce_range", "limit"), [(True, 64), (False, 127)])
def test_weights_have_seven_bits_when_reduced(tiny_float, tiny_frames, reduce_range, limit):
    model = quantise(tiny_float, tiny_frames, reduce_range=reduce_range).network.model
    weights = [numpy_helper.to_array(t) for t in model.graph.initializer if t.name.endswith(".w_quantized")]
    assert len(weights) == 4
    assert limit // 2 < max(np.abs(w.astype(int)).max() for w in weights) <= limit


def test_a_layer_can_stay_in_float(tiny_float, tiny_frames):
    result = quantise(tiny_float, tiny_frames, keep_float=["stem"])
    assert result.facts["float_layers"] == ["stem"]
    assert run(result.network.model, np.zeros((1, 64, 64, 5), np.uint8)).shape == (1, 64, 64, 4)


def test_another_shape_computes_the_same(tiny_quantised):
    """A constant picture has the same middle at every size."""
    network = tiny_quantised.network
    wide = reshaped(network, 32, 96, batch=2)
    assert wide.shape == (2, 32, 96, 5) and wide.input == network.input
    tensor = np.full((64, 64, 5), 99, np.uint8)
    picture = run(wide.model, np.broadcast_to(tensor[:1, :1], (2, 32, 96, 5)).copy())
    assert picture.shape == (2, 32, 96, 4)
    assert np.abs(picture[1, 16, 48].astype(int) - run(network.model, tensor[None])[0, 32, 32]).max() <= 1


@pytest.mark.parametrize("shape", [(33, 64), (0, 64)])
def test_wrong_shapes_are_refused(tiny_quantised, shape):
    with pytest.raises(BadInputError, match="multiples of 32"):
        reshaped(tiny_quantised.network, *shape)


@pytest.mark.parametrize(
    ("frames", "message"),
    [([], "0 frames"), ([np.zeros((64, 32, 5), np.float32)], "frame 0"), ([np.full((64, 64, 5), np.nan)], "finite")],
)
def test_wrong_frames_are_named(tiny_float, frames, message):
    with pytest.raises(BadInputError, match=message):
        quantise(tiny_float, frames)


def test_a_network_without_sigmoid_is_refused(tiny_float, tiny_frames):
    model = copy.deepcopy(tiny_float)
    model.graph.node[-1].op_type = "Tanh"
    with pytest.raises(BadInputError, match="Sigmoid"):
        quantise(model, tiny_frames)
    assert isinstance(tiny_float, onnx.ModelProto)


def test_a_concat_moves_bytes(tiny_quantised):
    """Inputs and output of a Concat have one scale, so its bytes do not change, whichever runtime fuses it."""
    model = tiny_quantised.network.model
    values = {tensor.name: numpy_helper.to_array(tensor) for tensor in model.graph.initializer}
    makers = {out: node for node in model.graph.node for out in node.output}
    users = {name: node for node in model.graph.node for name in node.input}
    concat = next(node for node in model.graph.node if node.op_type == "Concat")
    ends = [makers[name] for name in concat.input] + [users[concat.output[0]]]
    assert len({(float(values[end.input[1]]), int(values[end.input[2]])) for end in ends}) == 1


def test_an_unknown_method_is_refused(tiny_float, tiny_frames):
    with pytest.raises(BadInputError, match="median"):
        quantise(tiny_float, tiny_frames, "median")
