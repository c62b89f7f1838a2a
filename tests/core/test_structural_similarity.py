"""MS-SSIM beside a second implementation in NumPy, its closed forms, and its place in the loss."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

torch = pytest.importorskip("torch")
pytest.importorskip("skimage")
from scipy.ndimage import gaussian_filter  # noqa: E402
from skimage.metrics import structural_similarity  # noqa: E402

from trilane.training.objective import (  # noqa: E402
    WEIGHTS,
    loss_terms,
    ms_ssim,
    total_loss,
)

#: Weights of the paper, of which those that fit are scaled to a sum of 1.
PAPER = np.array([0.0448, 0.2856, 0.3001, 0.2363, 0.1333])


def pair(shape: tuple[int, int], seed: int = 0) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Two pictures (h,w,3) in 0..1 that are alike: smooth noise, and the same with other noise."""
    rng = np.random.default_rng(seed)
    one = gaussian_filter(rng.uniform(0, 1, (*shape, 3)), (3, 3, 0))
    one = (one - one.min()) / (one.max() - one.min())
    return one, np.clip(one * 0.9 + rng.normal(0, 0.05, one.shape), 0, 1)


def found(one: NDArray[np.float64], other: NDArray[np.float64]) -> float:
    as_tensors = (torch.from_numpy(each.transpose(2, 0, 1).copy())[None] for each in (one, other))
    return float(ms_ssim(*as_tensors))


def inner(picture: NDArray[np.float64]) -> NDArray[np.float64]:
    """Under a Gaussian of 11 x 11, without the margin in which it reaches out of the picture."""
    blurred = gaussian_filter(picture, (1.5, 1.5, 0), radius=(5, 5, 0))
    return np.asarray(blurred[5:-5, 5:-5])


def by_numpy(one: NDArray[np.float64], other: NDArray[np.float64]) -> float:
    scales = [scale for scale in range(5) if min(one.shape[:2]) // 2**scale >= 11]
    product = 1.0
    for scale in scales:
        m, n = inner(one), inner(other)
        vm, vn, cov = inner(one * one) - m * m, inner(other * other) - n * n, inner(one * other) - m * n
        factor = (2 * cov + 0.0009) / (vm + vn + 0.0009)
        if scale == scales[-1]:
            factor = factor * (2 * m * n + 0.0001) / (m * m + n * n + 0.0001)
        product *= float(factor.mean()) ** (PAPER[scale] / PAPER[scales].sum())
        h, w = (side // 2 for side in one.shape[:2])
        one, other = (each[: 2 * h, : 2 * w].reshape(h, 2, w, 2, 3).mean(axis=(1, 3)) for each in (one, other))
    return product


@pytest.mark.parametrize("shape", [(192, 180), (97, 60), (30, 12)], ids=["five scales", "three, odd sides", "one"])
def test_it_is_what_a_second_implementation_finds(shape: tuple[int, int]) -> None:
    one, other = pair(shape)
    value = found(one, other)
    assert value == pytest.approx(by_numpy(one, other), abs=1e-9) and 0.3 < value < 0.999


def test_one_scale_is_ssim_of_scikit_image() -> None:
    one, other = pair((21, 20))
    settings = {"gaussian_weights": True, "sigma": 1.5, "use_sample_covariance": False, "data_range": 1.0}
    _, whole = structural_similarity(one, other, channel_axis=2, full=True, **settings)
    assert found(one, other) == pytest.approx(whole[5:-5, 5:-5].mean(), abs=1e-6)


def test_plain_pictures_differ_by_luminance_alone() -> None:
    """Contrast and structure of two plain pictures are 1; luminance counts at the last of five scales."""
    one, other = np.full((200, 200, 3), 0.8), np.full((200, 200, 3), 0.2)
    luminance = (2 * 0.8 * 0.2 + 1e-4) / (0.8**2 + 0.2**2 + 1e-4)
    assert found(one, other) == pytest.approx(luminance ** (0.1333 / PAPER.sum()), abs=1e-9)
    assert found(one, one) == pytest.approx(1, abs=1e-12)


def test_it_is_a_term_of_the_loss_only_where_it_has_a_weight() -> None:
    rng = np.random.default_rng(2)
    output, target = (torch.from_numpy(rng.uniform(0.1, 0.9, (2, 4, 32, 32))) for _ in range(2))
    behind = torch.from_numpy(rng.uniform(0, 1, (2, 3, 32, 32)))
    plain, weights = loss_terms(output, target, behind), dict.fromkeys(WEIGHTS, 0.0) | {"structure": 20.0}
    terms = loss_terms(output.requires_grad_(), target, behind, weights)
    assert set(plain) == set(WEIGHTS) and set(terms) == set(WEIGHTS) | {"structure"}
    total = total_loss(terms, weights)
    over = [each[:, :3] * each[:, 3:] + behind * (1 - each[:, 3:]) for each in (output.detach(), target)]
    value = np.mean([by_numpy(*(each[k].permute(1, 2, 0).numpy() for each in over)) for k in range(2)])
    assert float(total.detach()) == pytest.approx(20 * (1 - value), rel=1e-6)
    total.backward()
    assert bool(torch.isfinite(output.grad).all()) and float(output.grad.abs().sum()) > 0
