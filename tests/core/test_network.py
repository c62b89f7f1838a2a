"""The network's published size, its output shape and range."""

from __future__ import annotations

import pytest

torch = pytest.importorskip("torch")

from trilane.avatars.training.network import UNet  # noqa: E402
from trilane.errors import BadInputError  # noqa: E402


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


def test_output_is_rgba_of_the_input_size():
    with torch.no_grad():
        out = UNet(width=8, channels=5).eval()(torch.randn(2, 5, 96, 64))
    assert out.shape == (2, 4, 96, 64)
    assert 0 <= float(out.min()) <= float(out.max()) <= 1


@pytest.mark.parametrize("bad", [{"encoder": "vgg"}, {"norm": "layer"}, {"width": 0}, {"channels": 0}])
def test_wrong_settings_are_named(bad):
    with pytest.raises(BadInputError, match=str(next(iter(bad)))):
        UNet(**bad)
