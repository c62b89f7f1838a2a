"""The errors of pictures on known values: closed forms, masks counted by hand, and MS-SSIM written a second time."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from trilane.apps.experiments import picture_errors
from trilane.apps.experiments.picture_errors import (
    LEAST_LPIPS_PX,
    LPIPS_LAYERS,
    Lpips,
    _shapes,
    dice,
    figures,
    flip,
    iou,
    mae,
    ms_ssim,
    mse,
    psnr_db,
    ssim,
)
from trilane.arrays import F64
from trilane.errors import BadInputError

SIDE = 176


def grey(value: float, side: int = 32) -> F64:
    return np.full((side, side, 3), value)


def noisy(side: int, seed: int = 0) -> F64:
    return np.random.default_rng(seed).uniform(0, 1, (side, side, 3))


def test_an_offset_has_its_size() -> None:
    """Five steps of 255 everywhere: MAE 5, PSNR 20 log10(255 / 5)."""
    reference = np.full((8, 9, 3), 100, np.uint8)
    assert mae(reference + np.uint8(5), reference) == pytest.approx(5)
    assert psnr_db(reference + np.uint8(5), reference) == pytest.approx(20 * math.log10(255 / 5))
    assert mse(reference + np.uint8(5), reference) == pytest.approx((5 / 255) ** 2)


def test_bytes_and_real_numbers_are_the_same_picture() -> None:
    shown = np.random.default_rng(1).integers(0, 256, (16, 16, 3), dtype=np.uint8)
    assert mae(shown, shown / 255) == 0
    assert psnr_db(shown, shown / 255) == 100


def test_one_changed_value_of_many() -> None:
    picture = grey(0.5, 10)
    picture[3, 4, 1] += 0.2
    assert mae(picture, grey(0.5, 10)) == pytest.approx(0.2 * 255 / 300)
    assert psnr_db(picture, grey(0.5, 10)) == pytest.approx(-10 * math.log10(0.04 / 300))


@pytest.mark.parametrize("bad", [np.zeros((4, 4)), np.zeros((0, 4, 3)), np.full((4, 4, 3), 1.5), grey(math.nan)])
def test_what_is_no_picture_is_refused(bad: F64) -> None:
    with pytest.raises(ValueError, match="a picture"):
        mae(bad, bad)
    with pytest.raises(ValueError, match="pictures of"):
        mae(grey(0, 4), grey(0, 5))


def test_masks_by_hand() -> None:
    """Four pixels and three, two of them the same: 2 · 2 / 7, and 2 / 5."""
    first, second = (np.array(row, bool) for row in ([[1, 1, 1, 1, 0]], [[0, 0, 1, 1, 1]]))
    assert dice(first, second) == pytest.approx(4 / 7)
    assert iou(first, second) == pytest.approx(2 / 5)
    assert dice(first, first) == iou(second, second) == 1
    nothing = np.zeros((1, 5), bool)
    assert dice(nothing, nothing) == iou(nothing, nothing) == 1
    assert dice(nothing, first) == iou(first, nothing) == 0


def test_ssim_of_one_grey_against_another() -> None:
    """Without variance it is (2ab + c) / (a² + b² + c)."""
    pytest.importorskip("skimage")
    c = 0.01**2
    assert ssim(grey(0.2), grey(0.7)) == pytest.approx((2 * 0.2 * 0.7 + c) / (0.04 + 0.49 + c))
    assert ssim(noisy(20), noisy(20)) == pytest.approx(1)
    assert ssim(grey(0, 6), grey(0, 6)) is None


def test_ms_ssim_of_one_grey_against_another() -> None:
    """Without variance only the coarsest scale's luminance counts, with its exponent."""
    pytest.importorskip("skimage")
    c = 0.01**2
    luminance = (2 * 0.2 * 0.7 + c) / (0.04 + 0.49 + c)
    assert ms_ssim(grey(0.2, SIDE), grey(0.7, SIDE)) == pytest.approx(luminance**0.1333)
    assert ms_ssim(noisy(SIDE), noisy(SIDE)) == pytest.approx(1)
    assert ms_ssim(grey(0, SIDE - 1), grey(0, SIDE - 1)) is None


def _second_ms_ssim(first: F64, second: F64) -> float:
    """Wang's formula by plain sums over the window, for pictures of one channel."""
    x = np.arange(11) - 5
    window = np.exp(-(x**2) / (2 * 1.5**2))
    window = np.outer(window, window) / window.sum() ** 2

    def mean(image: F64) -> F64:
        return np.einsum("rcab,ab->rc", np.lib.stride_tricks.sliding_window_view(image, (11, 11)), window)

    found = []
    for scale in range(5):
        a, b = mean(first), mean(second)
        contrast = (2 * (mean(first * second) - a * b) + 0.0009) / (
            mean(first**2) - a**2 + mean(second**2) - b**2 + 0.0009
        )
        luminance = (2 * a * b + 0.0001) / (a**2 + b**2 + 0.0001)
        found.append(float((contrast * luminance if scale == 4 else contrast).mean()))
        even = len(first) // 2 * 2
        first, second = (
            (one[:even:2, :even:2] + one[1::2, :even:2] + one[:even:2, 1::2] + one[1::2, 1::2]) / 4
            for one in (first, second)
        )
    return math.prod(value**power for value, power in zip(found, (0.0448, 0.2856, 0.3001, 0.2363, 0.1333), strict=True))


def test_ms_ssim_is_the_published_formula() -> None:
    pytest.importorskip("skimage")
    reference = noisy(SIDE)[..., :1]
    picture = np.clip(0.8 * reference + 0.2 * noisy(SIDE, 1)[..., :1], 0, 1)
    wanted = _second_ms_ssim(picture[..., 0], reference[..., 0])
    assert 0.5 < wanted < 0.99
    assert ms_ssim(*(np.repeat(one, 3, axis=2) for one in (picture, reference))) == pytest.approx(wanted, abs=1e-9)


def _flip_of_greys(first: float, second: float) -> float:
    """FLIP's formulas for two flat grey pictures: no feature differs, so it is the colour's error alone.

    CIELAB lightness; HyAB, which of greys is the difference of lightness; its power 0.7; the largest possible one, of
    pure green and pure blue with Hunt's adjustment; then the two straight pieces of 0.4 and 0.95.
    """

    def lightness(luminance: float) -> float:
        return 116 * (luminance ** (1 / 3) if luminance > 216 / 24389 else (luminance * 24389 / 27 + 16) / 116) - 16

    def linear(code: float) -> float:
        return code / 12.92 if code <= 0.04045 else ((code + 0.055) / 1.055) ** 2.4

    matrix = np.array(
        [
            [10135552 / 24577794, 8788810 / 24577794, 4435075 / 24577794],
            [2613072 / 12288897, 8788810 / 12288897, 887015 / 12288897],
            [1425312 / 73733382, 8788810 / 73733382, 70074185 / 73733382],
        ]
    )
    white = matrix.sum(axis=1)

    def hunt_lab(rgb: list[float]) -> F64:
        ratio = (matrix @ rgb) / white
        f = np.where(ratio > 216 / 24389, np.cbrt(ratio), (ratio * 24389 / 27 + 16) / 116)
        light = 116 * f[1] - 16
        return np.array([light, 0.01 * light * 500 * (f[0] - f[1]), 0.01 * light * 200 * (f[1] - f[2])])

    apart = hunt_lab([0, 1, 0]) - hunt_lab([0, 0, 1])
    largest = (abs(apart[0]) + math.hypot(apart[1], apart[2])) ** 0.7
    error = abs(lightness(linear(first)) - lightness(linear(second))) ** 0.7
    bend = 0.4 * largest
    return 0.95 * error / bend if error < bend else 0.95 + 0.05 * (error - bend) / (largest - bend)


@pytest.mark.parametrize(("first", "second"), [(0.0, 1.0), (0.4, 0.5), (0.1, 0.6), (0.3, 0.3)])
def test_flip_of_flat_greys_is_its_formula(first: float, second: float) -> None:
    pytest.importorskip("flip_evaluator")
    assert flip(grey(first), grey(second)) == pytest.approx(_flip_of_greys(first, second), abs=2e-3)


def test_all_figures_of_a_picture() -> None:
    for module in ("skimage", "flip_evaluator"):
        pytest.importorskip(module)
    mask = np.eye(32, dtype=bool)
    nearly = np.full((32, 32, 3), 0.5)
    nearly[0, 0, 0] += 1e-12
    computed, known = (figures(grey(0.5), one, mask, ~mask).as_json() for one in (nearly, grey(0.5)))
    assert computed == pytest.approx(known, abs=1e-6)
    found = figures(grey(0.5), grey(0.5), mask, ~mask).as_json()
    assert found == {
        "mae": 0.0,
        "psnr_db": 100.0,
        "ssim": pytest.approx(1.0),
        "ms_ssim": None,
        "flip": pytest.approx(0.0, abs=1e-6),
        "dice": 0.0,
        "iou": 0.0,
        "lpips": None,
    }
    for side, lpips in ((LEAST_LPIPS_PX - 1, None), (LEAST_LPIPS_PX, 0.0)):
        equal = np.full((side, 80, 3), 0.5)
        assert figures(equal, equal, lpips=lambda *_: 7.0).lpips == lpips
    assert figures(grey(0.5), nearly, lpips=lambda a, b: float(b[0, 0, 0] - a[0, 0, 0])).lpips == pytest.approx(1e-12)
    plain = figures(grey(0.5), grey(0.5))
    assert plain.dice is None and plain.iou is None
    assert set(picture_errors.__all__) >= {"ErrorFigures", "require_metrics"}


@pytest.fixture(scope="module")
def state() -> dict[str, Any]:
    """Weights of nobody's training: the formula is the same."""
    torch = pytest.importorskip("torch")
    generator = torch.Generator().manual_seed(0)
    return {name: torch.randn(shape, generator=generator) / np.prod(shape[1:]) ** 0.5 for name, shape in _shapes()}


@pytest.fixture(scope="module")
def weights(state: dict[str, Any], tmp_path_factory: pytest.TempPathFactory) -> Path:
    import torch

    file = tmp_path_factory.mktemp("lpips") / "alex.pth"
    torch.save({**state, "scaling_layer.shift": torch.zeros(3)}, file)  # the library's file has more than is read
    return file


def _convolved(x: F64, kernel: F64, bias: F64, stride: int, padding: int) -> F64:
    """(C,h,w) to (D,h',w'): sums over windows."""
    x = np.pad(x, ((0, 0), (padding, padding), (padding, padding)))
    windows = np.lib.stride_tricks.sliding_window_view(x, kernel.shape[2:], axis=(1, 2))[:, ::stride, ::stride]
    return np.einsum("chwab,dcab->dhw", windows, kernel, optimize=True) + bias[:, None, None]


def _second(state: dict[str, Any], picture: F64, reference: F64) -> float:
    """Unit feature vectors of five layers; squared differences, weighted by channel, mean over the places."""
    total, both = (
        0.0,
        [((2 * one - 1 - [-0.03, -0.088, -0.188]) / [0.458, 0.448, 0.45]) for one in (picture, reference)],
    )
    both = [one.transpose(2, 0, 1) for one in both]
    for number, (name, *_, stride, padding, pooled) in enumerate(LPIPS_LAYERS):
        kernel, bias = (state[f"net.{name}.{part}"].numpy().astype(float) for part in ("weight", "bias"))
        unit = []
        for index, x in enumerate(both):
            if pooled:
                x = np.lib.stride_tricks.sliding_window_view(x, (3, 3), axis=(1, 2))[:, ::2, ::2].max(axis=(3, 4))
            both[index] = np.maximum(_convolved(x, kernel, bias, stride, padding), 0)
            unit.append(both[index] / np.linalg.norm(both[index], axis=0))
        share = state[f"lin{number}.model.1.weight"].numpy()[0]
        total += float((share * (unit[0] - unit[1]) ** 2).sum(axis=0).mean())
    return total


def test_lpips_is_the_published_formula(state: dict[str, Any], weights: Path) -> None:
    rng = np.random.default_rng(0)
    picture, reference = (rng.uniform(0, 1, (LEAST_LPIPS_PX, 80, 3)) for _ in range(2))
    found, wanted = Lpips(weights), _second(state, picture, reference)
    assert abs(wanted) > 1e-3
    assert found(picture, reference) == pytest.approx(wanted, rel=1e-4)
    assert found(picture, picture) == 0
    assert found(picture[1:], reference[1:]) is None


def test_what_is_no_file_of_lpips_weights_is_refused(state: dict[str, Any], tmp_path: Path) -> None:
    import torch

    text, part, odd = (tmp_path / name for name in ("text.pth", "part.pth", "odd.pth"))
    text.write_text("no weights", encoding="utf-8")
    torch.save({name: state[name] for name in list(state)[:3]}, part)
    torch.save({**state, "lin4.model.1.weight": torch.zeros(1, 7, 1, 1)}, odd)
    no_tensors = "text.pth: found a file that is not of tensors alone"
    for file, said in ((text, no_tensors), (part, "slice2.3.weight: found no tensor"), (odd, "(1, 7, 1, 1)")):
        with pytest.raises(BadInputError, match=r"weights of lpips") as caught:
            Lpips(file)
        assert said in str(caught.value)
    with pytest.raises(BadInputError, match="absent"):
        Lpips(tmp_path / "absent.pth")
