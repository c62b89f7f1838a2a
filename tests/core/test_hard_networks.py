"""The hard inputs and networks, number for number: textures, figures, drawn weights and contrast."""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from trilane.apps.experiments import hard_cases
from trilane.apps.experiments.hard_cases import INPUTS, NETWORKS, calibration_frames, case_input, float_network
from trilane.errors import MissingPartError


class Told:
    """In place of a generator of random numbers: those that a test wrote down, one after the other."""

    def __init__(self, *numbers: float) -> None:
        self._numbers = list(numbers)
        self.asked: list[Any] = []

    def normal(self, *, size: tuple[int, ...]) -> Any:
        self.asked.append(size)
        return np.arange(float(np.prod(size))).reshape(size)

    def uniform(self, low: float, high: float, count: int) -> Any:
        self.asked.append((low, high, count))
        return np.array([self._numbers.pop(0) for _ in range(count)])


def test_a_smooth_texture_is_linear_between_its_corners() -> None:
    """9 x 9 corners of 4 values; those of `Told` grow by 36 a row and 4 a column, so the whole texture is a plane."""
    rng: Any = Told()
    texture = hard_cases._smooth(rng)
    assert rng.asked == [(9, 9, 4)]
    row, column, channel = np.mgrid[:64, :64, :4]
    np.testing.assert_allclose(texture, (36 * row + 4 * column) * 8 / 63 + channel, rtol=1e-5)
    assert (texture.dtype, texture.shape) == (np.float32, (64, 64, 4))


def test_a_flat_texture_has_one_value_in_each_cell() -> None:
    rng: Any = Told()
    texture = hard_cases._flat(rng)
    assert rng.asked == [(4, 4, 4)]
    row, column, channel = np.mgrid[:64, :64, :4]
    assert (texture == 16 * (row // 16) + 4 * (column // 16) + channel).all()
    assert texture.dtype == np.float32


@pytest.mark.parametrize(("down", "right", "size"), [(0.0, 0.0, 1.0), (0.1, -0.05, 1.0), (-0.1, 0.1, 0.7)])
def test_a_figure_is_an_ellipse(down: float, right: float, size: float) -> None:
    """Semi-axes of 0.42 and 0.25 of the side, its centre moved down and right; 0 outside."""
    rng: Any = Told(down, right)
    frame = hard_cases._in_figure(rng, lambda given: np.full((64, 64, 4), 3.0 if given is rng else 0, np.float32), size)
    assert rng.asked == [(-0.1, 0.1, 2)]
    for row in range(64):
        for column in range(0, 64, 3):
            y, x = row / 64 - 0.5 - down, column / 64 - 0.5 - right
            inside = (y / 0.42) ** 2 + (x / 0.25) ** 2 < size**2
            assert (frame[row, column] == (3.0 if inside else 0.0)).all()
    assert frame.dtype == np.float32


def test_inputs_are_the_textures_in_their_figures(monkeypatch: pytest.MonkeyPatch) -> None:
    """One generator draws the place of a figure, then its texture; the sizes are 1, but 0.7 of the small one."""
    calls = []

    def in_figure(rng: Any, texture: Any, size: float = 1.0) -> Any:
        calls.append((texture.__name__, size, float(rng.uniform())))
        return np.ones(1, np.float32)

    monkeypatch.setattr(hard_cases, "_in_figure", in_figure)
    first = float(np.random.default_rng(7).uniform())
    values = {name: float(case_input(name)[0]) for name in INPUTS}
    assert values == {"constant patches": 1, "little but background": 1, "saturating": 10, "usual": 1}
    assert calls == [("_flat", 1.0, first), ("_smooth", 0.7, first), ("_smooth", 1.0, first), ("_smooth", 1.0, first)]
    calls.clear()
    assert len(calibration_frames()) == 8
    rng = np.random.default_rng(0)
    assert calls == [("_smooth", 1.0, float(rng.uniform())) for _ in range(8)]


def test_the_inputs_themselves_are_held(held: Callable[[str, Any], None]) -> None:
    for name in INPUTS:
        held(name, case_input(name))
    held("calibration", np.stack(calibration_frames()))


def test_a_network_without_pytorch(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "torch", None)
    with pytest.raises(MissingPartError, match=r"^hard cases need PyTorch; install it with: .*\[train\]"):
        float_network("batch")


@pytest.fixture
def torch(monkeypatch: pytest.MonkeyPatch) -> Any:
    torch = pytest.importorskip("torch")
    torch.set_num_threads(1)
    from trilane.training import network

    monkeypatch.setattr(network, "export_onnx", lambda network, *shape: (network, shape))
    return torch


def weights_of(name: str) -> dict[str, Any]:
    network, shape = float_network(name)  # type: ignore[misc]
    assert shape == (64, 64)
    return dict(network.state_dict())


def test_convolutions_are_smooth_and_their_weights_add_up_to_0(torch: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """Without its random part, a kernel is a weight for each input times 1 2 1 / 4 along both sides."""
    monkeypatch.setattr(hard_cases, "RANDOM_PART", 0.0)
    layer = torch.nn.Conv2d(6, 5, 3)
    with torch.no_grad():
        hard_cases._draw(layer, torch.Generator().manual_seed(3))
    weight = layer.weight.detach().numpy()
    across = weight.sum((2, 3))
    np.testing.assert_allclose(across.sum(1), np.zeros(5), atol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(across, axis=1), np.full(5, 2**0.5), rtol=1e-6)
    np.testing.assert_allclose(weight, across[..., None, None] * np.outer([1, 2, 1], [1, 2, 1]) / 16, atol=1e-6)
    assert (layer.bias == 0).all()


def test_the_random_part_of_a_kernel_is_a_half_of_the_smooth_one(torch: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its deviation is 0.5 / (3 sqrt(400)), so that 400 inputs of 9 weights add up to a norm of 0.5."""
    layer = torch.nn.Conv2d(400, 30, 3, bias=False)
    with torch.no_grad():
        hard_cases._draw(layer, torch.Generator().manual_seed(3))
        drawn = layer.weight.detach().clone()
        monkeypatch.setattr(hard_cases, "RANDOM_PART", 0.0)
        hard_cases._draw(layer, torch.Generator().manual_seed(3))
    random = drawn - layer.weight.detach()
    assert float(random.std()) == pytest.approx(0.5 / 60, rel=0.02)  # 108,000 of them: within 0.2 %
    assert float(random.mean()) == pytest.approx(0.0, abs=0.0005)


def test_norms_get_small_biases_and_other_modules_none(torch: Any) -> None:
    norm, generator = torch.nn.BatchNorm2d(4000), torch.Generator().manual_seed(5)
    with torch.no_grad():
        hard_cases._draw(norm, generator)
        hard_cases._draw(torch.nn.ReLU(), generator)
        hard_cases._draw(torch.nn.InstanceNorm2d(4), generator)  # without parameters
    low, high = norm.bias.detach().aminmax()
    assert -0.05 <= float(low) < -0.049 and 0.049 < float(high) <= 0.05
    assert (norm.weight == 1).all()


def test_a_head_gets_contrast_and_means(torch: Any) -> None:
    """On its features each logit has deviation 1.5 and the means go from -1 to 1."""
    torch.manual_seed(1)
    head = torch.nn.Sequential(*(torch.nn.Identity() for _ in range(3)), torch.nn.Conv2d(4, 3, 1))
    features = torch.randn(5, 4, 8, 8) * 7 + 2
    with torch.no_grad():
        head[3].bias.zero_()  # as `_draw` leaves it
        hard_cases._give_contrast(head, features)
        logits = head(features)
    np.testing.assert_allclose(logits.std(dim=(0, 2, 3)), [1.5] * 3, rtol=1e-4)
    np.testing.assert_allclose(logits.mean(dim=(0, 2, 3)), [-1, 0, 1], atol=1e-4)


def test_what_a_network_of_hard_cases_is(torch: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """Deep features weakened to a quarter, skips not; one channel a hundredfold; heads fitted to the calibration."""
    contrasts: list[Any] = []
    monkeypatch.setattr(hard_cases, "_give_contrast", lambda head, features: contrasts.append((head, features)))
    plain, outlier = weights_of("batch"), weights_of("outlier channel")
    monkeypatch.setattr(hard_cases, "DEEP", 1.0)
    network, _ = float_network("batch")  # type: ignore[misc]
    even = network.state_dict()
    assert plain.keys() == outlier.keys() == even.keys()
    *skips, _ = network.encoder.channels
    changed = {}
    for level, skip in enumerate((*reversed(skips), 0)):
        name = f"levels.{level}.0.weight"
        deep = plain[name].shape[1] - skip
        changed[name] = even[name].clone()
        changed[name][:, :deep] *= 0.25
        assert 0 < deep < plain[name].shape[1] or skip == 0
    for name, weight in plain.items():
        expected = changed.get(name, even[name])
        assert torch.equal(weight, expected), name
        times = torch.ones_like(weight, dtype=torch.float32)
        if name == "encoder.stem.0.weight":
            times[0] = 100.0
        assert torch.allclose(outlier[name].float(), weight * times), name
    assert [head is kind for (head, _), kind in zip(contrasts[-2:], (network.colour, network.mask), strict=True)]
    assert contrasts[-2][0] is network.colour and contrasts[-1][0] is network.mask
    tensors = torch.from_numpy(np.stack(calibration_frames()).transpose(0, 3, 1, 2).copy())
    with torch.no_grad():
        assert torch.allclose(contrasts[-1][1], network.features(tensors), atol=1e-5)
    assert not network.training and network.encoder.stem[0].weight.shape[:2] == (8, 4)


def test_networks_have_the_norms_of_their_names(torch: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(hard_cases, "_draw", lambda *_: None)
    monkeypatch.setattr(hard_cases, "_give_contrast", lambda *_: None)
    assert NETWORKS == {
        "batch": ("batch", False),
        "instance": ("instance", False),
        "group": ("group", False),
        "outlier channel": ("batch", True),
    }
    kinds = {"batch": torch.nn.BatchNorm2d, "instance": torch.nn.InstanceNorm2d, "group": torch.nn.GroupNorm}
    for name, kind in kinds.items():
        network, _ = float_network(name)  # type: ignore[misc]
        assert any(isinstance(module, kind) for module in network.modules())
