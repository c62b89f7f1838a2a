"""What training minimises: errors of the picture, of its decibels, colours, edges, structure and its mask.

Rule: every term is a mean over the pixels it is about, so that the weights in the table mean the same for every view.
Each picture of a batch stands before a background of its own: before one colour for all, a person who lets that colour
through has no error.

The colour where there is no person is not visible and is trained to be black: left alone it would be noise that differs
from runtime to runtime.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from trilane.training.backgrounds import backgrounds
from trilane.training.structural_similarity import ms_ssim

#: Pixels round the person that count as its outline.
MARGIN_PX = 5
WEIGHTS = {
    "composite": 0.4,
    "decibels": 0.03,
    "colour": 0.1,
    "edges": 0.2,
    "coarse": 0.2,
    "mask": 0.1,
    "background": 0.05,
    "overlap": 0.1,
}
#: One minus MS-SSIM, a term that is computed only where it has a weight: it takes several blurs.
STRUCTURE = "structure"
LEAST_SQUARE = 1e-5


def loss_terms(
    output: Tensor, target: Tensor, behind: Tensor, weights: Mapping[str, float] = WEIGHTS
) -> dict[str, Tensor]:
    """The terms by name, before weighting. `output` and `target` (N, 4, H, W): straight colour and mask, 0..1.

    `behind` (N, 3, H, W): what stands behind both, as `drawn_behind` draws it.
    `weights`: by name; of `STRUCTURE` it decides whether that is among the terms. `overlap` is the Dice loss, with one
    pixel more in numerator and denominator, so that it is 0 without a person.
    """
    mask, true_mask = output[:, 3:], target[:, 3:]
    near = _grown(true_mask)
    pixels = near.sum() * 3 + 1
    shown, wanted = composite(output, behind), composite(target, behind)
    difference = shown - wanted
    size = difference.abs()
    terms = {
        "composite": (size * (near + 0.05)).sum() / pixels,
        "decibels": missing_db(difference, near).mean(),
        "colour": ((output[:, :3] - target[:, :3]).abs() * true_mask).sum() / pixels,
        "edges": (
            (difference[..., 1:] - difference[..., :-1]).abs().sum()
            + (difference[..., 1:, :] - difference[..., :-1, :]).abs().sum()
        )
        / pixels,
        "coarse": functional.avg_pool2d(difference, 4).abs().sum() * 16 / pixels,
        "mask": functional.binary_cross_entropy(mask.clamp(1e-4, 1 - 1e-4), true_mask),
        "background": -(torch.log1p(-output[:, :3].clamp(max=1 - 1e-4)) * (true_mask == 0)).mean(),
        "overlap": 1 - (2 * (mask * true_mask).sum() + 1) / (mask.sum() + true_mask.sum() + 1),
    }
    if weights.get(STRUCTURE):
        terms[STRUCTURE] = 1 - ms_ssim(shown, wanted).mean()
    return terms


def missing_db(difference: Tensor, near: Tensor) -> Tensor:
    """(N,): dB of PSNR that each picture's `difference` (N, 3, H, W) costs where `near` (N, 1, H, W) is 1.

    Counted from a mean square of `LEAST_SQUARE`, which is 50 dB and as good as none.
    """
    pixels = 3 * near.sum(dim=(1, 2, 3)) + 1
    square = (difference.square() * near).sum(dim=(1, 2, 3)) / pixels
    return 10 * torch.log10(1 + square / LEAST_SQUARE)


def _grown(mask: Tensor) -> Tensor:
    """(N, 1, H, W): 1 on the person of `mask` and up to `MARGIN_PX` round it, else 0."""
    grown = mask.detach().contiguous()
    for along in ((1, 0), (0, 1)):
        kernel, padding = tuple(2 * MARGIN_PX * side + 1 for side in along), tuple(MARGIN_PX * side for side in along)
        grown = functional.max_pool2d(grown, kernel, stride=1, padding=padding)
    return grown.gt(0).float()


def total_loss(terms: Mapping[str, Tensor], weights: Mapping[str, float] = WEIGHTS) -> Tensor:
    """The sum of the terms, weighted by `weights`; a term without a weight counts nothing."""
    return torch.stack([weights.get(name, 0.0) * term for name, term in terms.items()]).sum()


def composite(image: Tensor, behind: Tensor) -> Tensor:
    """`image` (N, 4, H, W) over `behind` (N, 3, H, W): (N, 3, H, W)."""
    mask = image[:, 3:]
    return image[:, :3] * mask + behind * (1 - mask)


def drawn_behind(target: Tensor) -> Tensor:
    """(N, 3, H, W): a background for each of `target` (N, 4, H, W), drawn by PyTorch's random numbers."""
    rng = np.random.default_rng(int(torch.randint(2**62, ())))
    drawn = backgrounds(len(target), (target.shape[2], target.shape[3]), rng)
    return torch.from_numpy(drawn).permute(0, 3, 1, 2).to(target.device)
