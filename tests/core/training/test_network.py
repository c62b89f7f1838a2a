"""The network's published size, its output shape and range."""

from __future__ import annotations

import numpy as np
import onnxruntime
import pytest

torch = pytest.importorskip("torch")

from trilane.avatars.bundle import bundle_folder  # noqa: E402
from trilane.avatars.network_file import reshaped  # noqa: E402
from trilane.errors import BadInputError  # noqa: E402
from trilane.training.network import (  # noqa: E402
    ENCODERS,
    NORMS,
    Shortcut,
    UNet,
    export_onnx,
)
from trilane.training.quantising.quantise import quantise  # noqa: E402
from trilane.training.trainable_avatar import NeuralTexture, TrainableAvatar, load_network, save_network  # noqa: E402


def count_macs(network, height, width, channels):
    """Multiply-accumulates of every convolution of one pass."""
    total = 0

    def add(module, _inputs, output):
        nonlocal total
        total += output.shape[2] * output.shape[3] * module.weight.numel()

    hooks = [m.register_forward_hook(add) for m in network.modules() if isinstance(m, torch.nn.Conv2d)]
    with torch.no_grad():
        network.eval()(torch.zeros(1, channels, height, width))
    for hook in hooks:
        hook.remove()
    return total


def test_full_width_has_the_published_size():
    network = UNet()
    assert sum(p.numel() for p in network.parameters()) == pytest.approx(14.58e6, rel=1e-3)
    assert count_macs(network, 128, 128, 16) * 16 == pytest.approx(65.9e9, rel=1e-3)


torch.set_num_threads(1)

RESNETS = [("resnet18", norm) for norm in ("instance", "none")]
PAIRS = [*((encoder, "batch") for encoder in ENCODERS), *RESNETS, ("mobilenetv3", "group")]
#: Published, in millions. Ours within 5 %.
PARAMETERS = {"resnet18": 14.5, "mobilenetv2": 6.6, "mobilenetv3": 6.7, "efficientnet-lite0": 6.1}


@pytest.mark.parametrize("encoder", ENCODERS)
def test_every_encoder_has_its_published_size(encoder):
    count = sum(p.numel() for p in UNet(encoder).parameters())
    assert count / 1e6 == pytest.approx(PARAMETERS[encoder], rel=0.05)


@pytest.mark.parametrize(("encoder", "norm"), PAIRS)
def test_the_exported_network_computes_the_same(encoder, norm):
    """At the exported shape and, where the runtime is given another, at that one."""
    torch.manual_seed(0)
    network = UNet(encoder, norm, width=8, channels=5)
    model = export_onnx(network, 64, 96)
    image = torch.randn(1, 5, 64, 96)
    onnxruntime.set_default_logger_severity(3)
    session = onnxruntime.InferenceSession(model.SerializeToString(), providers=["CPUExecutionProvider"])
    with torch.no_grad():
        wanted = network(image).numpy()
    assert session.run(None, {"tensor": image.numpy()})[0] == pytest.approx(wanted, abs=1e-3)


@pytest.mark.parametrize("norm", NORMS)
def test_a_quantised_network_runs_at_other_shapes(norm):
    torch.manual_seed(0)
    frames = [np.random.default_rng(i).normal(size=(64, 64, 5)).astype(np.float32) for i in range(2)]
    quantised = quantise(export_onnx(UNet(norm=norm, width=4, channels=5), 64, 64), frames)
    assert reshaped(quantised.network, 32, 96).shape == (1, 32, 96, 5)


@pytest.mark.parametrize("bad", [{"encoder": "vgg"}, {"norm": "layer"}, {"width": 0}, {"channels": 0}])
def test_wrong_settings_are_named(bad):
    with pytest.raises(BadInputError, match=str(next(iter(bad)))):
        UNet(**bad)


@pytest.mark.parametrize("channels", [4, 8, 15, 16])
def test_a_narrow_shortcut_is_trained_without_a_strided_convolution(channels, monkeypatch):
    """Values and gradients are those of the strided one in float64, which no runtime of float32 computes."""
    strides, convolve = [], torch.nn.functional.conv2d

    def seen(x, weight, bias=None, stride=1, *rest):
        strides.append(stride)
        return convolve(x, weight, bias, stride, *rest)

    monkeypatch.setattr(torch.nn.functional, "conv2d", seen)
    shortcut = Shortcut(channels, 2 * channels, 2)
    x = torch.rand(2, channels, 10, 6).to(memory_format=torch.channels_last).requires_grad_()
    exact = x.detach().double().requires_grad_()
    weight = shortcut.weight.detach().double().requires_grad_()
    convolve(exact, weight, stride=2).square().sum().backward()
    found = shortcut(x)
    assert strides == ([(2, 2)] if channels == 16 else [1])
    if channels < 16:
        found.square().sum().backward()
        torch.testing.assert_close(x.grad.double(), exact.grad, rtol=1e-5, atol=1e-6)
        torch.testing.assert_close(shortcut.weight.grad.double(), weight.grad, rtol=1e-5, atol=1e-5)
    shortcut.eval()(x)
    assert strides[-1] == strides[0], "an evaluated network has gradients too"
    with torch.no_grad():
        torch.testing.assert_close(shortcut(x), found)
    assert strides[-1] == (2, 2)


# Its weights in a file.

CHANNELS = 4


def avatar():
    torch.manual_seed(0)
    start = np.random.default_rng(1).uniform(-0.5, 0.5, (64, 64, CHANNELS)).astype(np.float32)
    return TrainableAvatar(UNet(width=8, channels=CHANNELS), NeuralTexture(start, sides=(64, 32)))


def test_the_network_alone_comes_back_in_half_precision(tmp_path):
    made, path = avatar(), tmp_path / "network.npz"
    save_network(made, path)
    again = load_network(avatar().network, path)
    for name, value in made.network.state_dict().items():
        if value.is_floating_point():
            assert torch.allclose(again.state_dict()[name], value, atol=1e-3, rtol=1e-3), name


def test_the_kept_network_of_the_default_avatar_loads():
    load_network(
        UNet(width=16, channels=16, input_skip=True),
        bundle_folder("default").parents[1] / "training" / "default-network.npz",
    )


def kept_weights(path, **changes):
    """A file of the network's weights, changed: None takes one out."""
    arrays = {f"network.{name}": value.numpy() for name, value in avatar().network.state_dict().items()} | changes
    np.savez(path, **{name: value for name, value in arrays.items() if value is not None})
    return path


def test_counters_of_batches_may_be_missing(tmp_path):
    path = kept_weights(tmp_path / "a.npz", **{"network.mask.1.num_batches_tracked": None})
    made = load_network(UNet(width=8, channels=CHANNELS), path).state_dict()
    assert all(torch.equal(made[name], value) for name, value in avatar().network.state_dict().items())


@pytest.mark.parametrize("damage", ["empty", "broken", "lone"])
def test_a_damaged_file_of_weights_is_refused(tmp_path, damage):
    path = kept_weights(tmp_path / "b.npz")
    if damage == "lone":
        with path.open("wb") as file:
            np.save(file, np.zeros(3))
    else:
        path.write_bytes(path.read_bytes()[:100] if damage == "broken" else b"")
    with pytest.raises(BadInputError, match=r"expected weights that this network's training saved$"):
        load_network(UNet(width=8, channels=CHANNELS), path)


@pytest.mark.parametrize(
    ("width", "changes", "found"),
    [
        (8, {"network.mask.3.bias": None}, "found no mask.3.bias, expected"),
        (8, {"network.another": np.zeros(1)}, "found also another, expected"),
        (16, {}, "size mismatch"),
        (8, None, "found .*, expected"),
    ],
)
def test_weights_of_another_network_and_what_is_no_archive_are_refused(tmp_path, width, changes, found):
    path = tmp_path / "b.npz"
    path.write_text("no archive") if changes is None else kept_weights(path, **changes)
    said = " weights that this network's training saved$" if "expected" in found else ""
    with pytest.raises(BadInputError, match=f"{found}{said}") as caught:
        load_network(UNet(width=width, channels=CHANNELS), path)
    assert str(caught.value).startswith(f"{path}: ")
