"""Roundings while training, beside the quantiser's own numbers and the integer network that it makes."""

from __future__ import annotations

from typing import Any

import numpy as np
import onnxruntime
import pytest
from onnx import numpy_helper

torch = pytest.importorskip("torch")
pytest.importorskip("scipy")
pytest.importorskip("skimage")

from trilane.training import make_bundle  # noqa: E402
from trilane.training.network import UNet, export_onnx  # noqa: E402
from trilane.training.quantising.calibration import _round_weights  # noqa: E402
from trilane.training.quantising.quantise import ByteRanges, byte_ranges, quantise  # noqa: E402
from trilane.training.trainable_avatar import ByteGrid, NeuralTexture, TrainableAvatar, rounded_weights  # noqa: E402

SHAPE, CHANNELS = (64, 32), 5


torch.set_num_threads(1)


def network() -> UNet:
    """With statistics, scales and shifts that are not those of a new one."""
    torch.manual_seed(3)
    made = UNet(width=4, channels=CHANNELS, input_skip=True)
    with torch.no_grad():
        for value in made.parameters():
            if value.ndim == 1:
                value += 0.3 * torch.randn_like(value)
        for _ in range(20):
            made.train()(0.5 * torch.randn(2, CHANNELS, *SHAPE))
    return made.eval()


def frames(count: int = 3) -> list[Any]:
    """Whole multiples of 1/64, which bytes of every power of two from there on hold exactly."""
    rng = np.random.default_rng(0)
    return [(np.round(rng.uniform(-0.9, 0.9, (*SHAPE, CHANNELS)) * 64) / 64).astype(np.float32) for _ in range(count)]


def grid_of(made: UNet) -> ByteGrid:
    grid = ByteGrid(made)
    assert not grid.measured
    grid.measure(byte_ranges(export_onnx(made, *SHAPE), frames()))
    assert grid.measured
    return grid


def picture(made: UNet, grid: ByteGrid | None, frame: Any) -> Any:
    x = torch.from_numpy(frame.transpose(2, 0, 1).copy())[None]
    with torch.no_grad():
        output = made(x) if grid is None else grid.painted(made, x)
    return 255 * output[0].permute(1, 2, 0).numpy()


def test_what_is_painted_is_what_the_integer_network_paints() -> None:
    """But for biases, whose steps are at most a quarter of those of their layer's output. Of the squares of what the
    float network is off, a twelfth is of the output's own rounding, so a tenth of all leaves no room for another place.
    """
    made = network()
    floats = [np.round(picture(made, None, frame)) for frame in frames()]
    grid = grid_of(made)
    assert all((np.round(picture(made, None, frame)) == one).all() for frame, one in zip(frames(), floats, strict=True))
    grid.active = True
    rounded = [np.round(picture(made, grid, frame)) for frame in frames()]
    quantised = quantise(export_onnx(network(), *SHAPE), frames())
    assert quantised.facts["rounds_alike"] and bool(grid.alike)
    integers = [painted_in_integers(quantised.network, frame) for frame in frames()]
    off = np.mean([np.square(one - other).mean() for one, other in zip(integers, rounded, strict=True)])
    assert off < 0.1 * np.mean([np.square(one - other).mean() for one, other in zip(integers, floats, strict=True)])


def painted_in_integers(network_file: Any, frame: Any) -> Any:
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    model = network_file.model.SerializeToString()
    session = onnxruntime.InferenceSession(model, options, providers=["CPUExecutionProvider"])
    ends = network_file.input
    data = np.round(frame / ends.scale + ends.zero_point).astype(np.uint8)[None]
    return session.run(None, {session.get_inputs()[0].name: data})[0][0].astype(float)


def test_weights_are_the_quantisers() -> None:
    """Where they round alike; else whole multiples of a 64th of a channel's largest, as ONNX Runtime has them."""
    values = np.random.default_rng(1).normal(0, 0.2, (6, 3, 3, 3)).astype(np.float32)
    values[0, 0, 0, 0], values[1] = 65 / 64, values[1] / 1000
    kernel = numpy_helper.from_array(values, "kernel")
    _round_weights(kernel, np.zeros(6), 64)
    np.testing.assert_array_equal(rounded_weights(torch.from_numpy(values), alike=True), numpy_helper.to_array(kernel))
    units = np.abs(values).reshape(6, -1).max(axis=1)[:, None, None, None] / 64
    wanted = np.round(values / units) * units
    np.testing.assert_allclose(rounded_weights(torch.from_numpy(values), alike=False), wanted, atol=1e-7)


def test_a_weight_is_rounded_with_its_norm_folded_in() -> None:
    made = network()
    grid = grid_of(made)
    norm = made.levels[0][1]
    found = grid.weights(made)["levels.0.0.weight"].detach()
    scale = (norm.weight / torch.sqrt(norm.running_var + norm.eps)).detach()[:, None, None, None]
    folded = made.levels[0][0].weight.detach() * scale
    np.testing.assert_allclose(found * scale, rounded_weights(folded, alike=True), atol=1e-6)
    assert float((found - made.levels[0][0].weight).detach().abs().max()) > 1e-4
    assert len(grid.weights(made)) == len([one for one in made.modules() if isinstance(one, torch.nn.Conv2d)])


def test_gradients_pass_through_roundings_and_end_where_values_are_cut_off() -> None:
    """Bytes of 0.5 from -32 to 95.5 at one place: -40 and 99 are cut off, 0.3 becomes 0.5."""
    made = network()
    grid = ByteGrid(made)
    grid.ends[:] = torch.tensor([-32.0, 95.5])
    grid.active = True
    x = torch.tensor([-40.0, 0.3, 10.2, 99.0], requires_grad=True)
    y = grid._stored(x, 0)
    assert y.tolist() == [-32.0, 0.5, 10.0, 95.5]
    y.sum().backward()
    assert x.grad.tolist() == [0.0, 1.0, 1.0, 0.0]
    grid.weights(made)["colour.0.weight"].sum().backward()
    assert bool((made.colour[0].weight.grad == 1).all())


def test_a_network_without_the_input_at_its_end_has_a_place_less() -> None:
    short = ByteGrid(UNet(width=4, channels=CHANNELS))
    assert set(ByteGrid(network()).places) - set(short.places) == {"levels.4"}


def test_ranges_are_given_for_each_place() -> None:
    """A place without one would be an error; the logits are cut off at 6.5, and what is rectified begins at 0."""
    grid = grid_of(network())
    ends = dict(zip(grid.places, grid.ends.tolist(), strict=True))
    assert ends["colour.3"] == ends["mask.3"] and -6.6 < ends["mask.3"][0] < 0 < ends["mask.3"][1] < 6.6
    assert all(ends[name][0] == 0 for name in ("encoder.stem.2", "levels.3.5", "colour.2"))
    other = ByteGrid(network())
    with pytest.raises(KeyError):
        other.measure(ByteRanges({"tensor": (0.0, 1.0)}, True))


def test_what_was_trained_rounded_keeps_its_rounded_weights(monkeypatch: pytest.MonkeyPatch) -> None:
    """Rounding again changes no weight, so the integer network stays but for ranges that are measured anew, which are
    worth a step; the float network comes nearer to it."""
    monkeypatch.setattr(
        make_bundle, "ranges_of", lambda one, *_: byte_ranges(export_onnx(one.network, *SHAPE), frames())
    )
    made, texture = network(), NeuralTexture(np.zeros((32, 32, CHANNELS), np.float32), (32,))
    make_bundle.keep_rounded_weights(TrainableAvatar(made, texture), [], 1)
    before, after = (quantise(export_onnx(one, *SHAPE), frames()).network for one in (network(), made))
    grid = grid_of(made)
    for name, weight in grid.weights(made).items():
        np.testing.assert_allclose(weight.detach(), made.get_parameter(name).detach(), rtol=1e-5, atol=1e-7)
    assert any((network().get_parameter(name) != weight).any() for name, weight in grid.weights(made).items())
    for frame in frames():
        integers = painted_in_integers(before, frame)
        assert np.abs(painted_in_integers(after, frame).astype(int) - integers).max() <= 1
        off = [np.square(np.round(picture(one, None, frame)) - integers).mean() for one in (network(), made)]
        assert off[1] < off[0]
