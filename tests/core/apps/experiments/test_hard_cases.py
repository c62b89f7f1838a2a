"""What wrong pictures cost, and what a row of the hard cases says."""

from __future__ import annotations

import dataclasses
import sys
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from trilane.apps.experiments import hard_cases
from trilane.apps.experiments.hard_cases import (
    EXCEEDED,
    HOLDS,
    IDEAL_STEPS,
    INPUTS,
    SIDE,
    UNTOLD,
    Case,
    calibration_frames,
    case_input,
    float_network,
    wrong_answers,
)
from trilane.errors import MissingPartError


def test_wrong_pictures_by_hand():
    """In the last quarter of the rows red is 100 and blue 40, else all is 0, as are the medians. Moved sideways, the
    picture is the same."""
    picture = np.zeros((32, 32, 4), np.float32)
    picture[24:, :, 0], picture[24:, :, 2] = 100, 40
    wrong = wrong_answers(picture)
    assert wrong == {
        "constant_error": (100 + 40) / 4 / 4,
        "shifted_error": 0.0,
        "swapped_error": 2 * (100 - 40) / 4 / 4,
    }


def test_a_shift_is_by_8_pixels_in_the_direction_that_costs_least():
    """A bright column costs nothing when it is moved along itself; a bright square of 12 costs 8 of its 12 twice."""
    picture = np.zeros((32, 32, 4), np.float32)
    picture[:, 10:22] = 64
    assert wrong_answers(picture)["shifted_error"] == 0.0
    picture[:10] = picture[22:] = 0
    assert wrong_answers(picture)["shifted_error"] == 64 * 2 * 8 * 12 / 32**2


@pytest.fixture
def case():
    """Bound 10; the nearest wrong picture is at 11."""
    wrong = {"constant_error": 20.0, "shifted_error": 11.0, "swapped_error": 30.0}
    return Case(None, np.zeros(1, np.uint8), np.zeros(1, np.float32), 8.0, 10.0, IDEAL_STEPS, 12.0, wrong)


@pytest.mark.parametrize(("error", "verdict"), [(0.0, HOLDS), (10.0, HOLDS), (10.01, EXCEEDED), (np.nan, EXCEEDED)])
def test_an_error_above_the_bound_fails(case, error, verdict):
    assert case.verdict(error) == verdict


@pytest.mark.parametrize("bound", [11.0, 12.0, np.nan])
def test_a_row_whose_bound_a_wrong_picture_keeps_fails_without_any_error(case, bound):
    assert dataclasses.replace(case, bound=bound).verdict(0.0) == UNTOLD


def test_inputs_have_a_figure_on_background_and_are_no_frame_of_the_calibration():
    for name in INPUTS:
        frame = case_input(name)
        shown = (frame != 0).any(axis=-1)
        assert 0.1 < shown.mean() < 0.4 and not shown[0].any() and shown[SIDE // 2, SIDE // 2]
    assert (case_input("saturating") == 10 * case_input("usual")).all()
    assert not any((frame == case_input("usual")).all() for frame in calibration_frames())


def test_a_case_has_the_smaller_bound_of_two(monkeypatch: pytest.MonkeyPatch) -> None:
    """The input in steps of 0.5 round 100: 1.3 is 102.6, 103 when rounded; bytes end at 0 and 255."""
    frame = np.array([[[1.3, -60.0], [90.0, -0.2]]], np.float32)
    encoding = SimpleNamespace(scale=0.5, zero_point=100)
    quantised: Any = SimpleNamespace(network=SimpleNamespace(input=encoding))
    wanted = np.zeros((1, 2, 2, 4), np.float32)
    wanted[0, :, :, 0] = 40.0
    bounds = {"own": (3.0, 9.0), "ideal": (4.0, 8.0)}
    monkeypatch.setattr(hard_cases, "case_input", lambda name: frame if name == "odd" else None)
    monkeypatch.setattr(hard_cases, "float_picture", lambda *_: wanted)
    monkeypatch.setattr(hard_cases, "ideal_noise_model", lambda *_: "ideal")
    monkeypatch.setattr(hard_cases, "predicted_bound", lambda model, *_: bounds[model])
    pair = hard_cases.NetworkPair("net", quantised, "own")  # type: ignore[arg-type]
    case = hard_cases.make_case(pair, "odd")
    assert case.tensor.tolist() == [[[[103, 0], [255, 100]]]]
    assert (case.tensor.dtype, case.tensor.flags.c_contiguous) == (np.uint8, True)
    assert (case.predicted, case.bound, case.source, case.own_bound) == (4.0, 8.0, hard_cases.IDEAL_STEPS, 9.0)
    assert case.wrong == {"constant_error": 0.0, "shifted_error": 0.0, "swapped_error": 20.0}
    assert (case.pair, case.wanted is wanted) == (pair, True)
    bounds["own"] = (3.0, 7.0)
    case = hard_cases.make_case(pair, "odd")
    assert (case.predicted, case.bound, case.source, case.own_bound) == (3.0, 7.0, hard_cases.OWN_STEPS, 7.0)


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
