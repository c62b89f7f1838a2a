"""Quantisation: bytes at both ends, real zero exact, small error, weights that cannot overflow, named errors."""

from __future__ import annotations

import copy

import numpy as np
import onnx
import onnxruntime
import pytest
from onnx import numpy_helper

from trilane.avatars.network_reshape import reshaped
from trilane.errors import BadInputError
from trilane.training.quantising.calibration import METHODS
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
