"""MS-SSIM of pictures, which can be minimised: structure at five scales, without the weights of any other network.

Rule: windows lie wholly inside the picture; a picture that is too small for a scale is compared at the coarser ones
that it has, with their weights scaled to a sum of 1.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional

#: Weights of the scales, finest first: Wang, Simoncelli, Bovik, Multiscale structural similarity, 2003, section 3.2.
SCALES = (0.0448, 0.2856, 0.3001, 0.2363, 0.1333)
WINDOW, SIGMA = 11, 1.5
#: Constants of luminance and of contrast, for values in 0..1.
C1, C2 = 0.01**2, 0.03**2
#: A negative structure has no power; it counts as this.
LEAST = 1e-6


def ms_ssim(one: Tensor, other: Tensor) -> Tensor:
    """(N,): the product of the mean contrast and structure of each scale, and at the last of luminance too.

    `one`, `other` (N, C, H, W) in 0..1, H and W at least 11. Formula 7 of the paper above, with equal exponents.
    """
    sizes = [min(one.shape[-2:]) >> scale for scale in range(len(SCALES))]
    weights = [weight for weight, size in zip(SCALES, sizes, strict=True) if size >= WINDOW]
    product = one.new_ones(len(one))
    for scale, weight in enumerate(weights):
        whole, structure = _similarity(one, other)
        last = scale == len(weights) - 1
        product = product * (whole if last else structure).clamp(min=LEAST) ** (weight / sum(weights))
        one, other = functional.avg_pool2d(one, 2), functional.avg_pool2d(other, 2)
    return product


def _similarity(one: Tensor, other: Tensor) -> tuple[Tensor, Tensor]:
    """(N,) twice: the mean SSIM, and the mean of its factor of contrast and structure."""
    mean_one, mean_other = _blurred(one), _blurred(other)
    variances = _blurred(one**2) - mean_one**2 + _blurred(other**2) - mean_other**2
    covariance = _blurred(one * other) - mean_one * mean_other
    structure = (2 * covariance + C2) / (variances + C2)
    luminance = (2 * mean_one * mean_other + C1) / (mean_one**2 + mean_other**2 + C1)
    return (luminance * structure).mean(dim=(1, 2, 3)), structure.mean(dim=(1, 2, 3))


def _blurred(picture: Tensor) -> Tensor:
    """`picture` (N, C, H, W) under a Gaussian window, where the window lies inside it."""
    places = torch.arange(WINDOW, dtype=picture.dtype, device=picture.device) - WINDOW // 2
    bell = torch.exp(-(places**2) / (2 * SIGMA**2))
    bell = (bell / bell.sum()).expand(picture.shape[1], 1, WINDOW)
    down = functional.conv2d(picture, bell[..., None], groups=picture.shape[1])
    return functional.conv2d(down, bell[:, :, None], groups=picture.shape[1])
