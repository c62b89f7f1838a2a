"""What training minimises: colour where the person is, the composite round the outline, edges, and the mask.

Rule: every term is a mean over what it is about, so that weights in the table below mean the same for every view.
"""

from __future__ import annotations

import torch
from scipy.ndimage import maximum_filter
from torch import Tensor
from torch.nn import functional

GREY = 0.5
#: Pixels round the person that count as its outline.
MARGIN_PX = 5
WEIGHTS = {"composite": 1.0, "square": 10.0, "colour": 0.3, "edges": 0.5, "coarse": 0.5, "mask": 0.15, "overlap": 0.15}


def loss_terms(output: Tensor, target: Tensor) -> dict[str, Tensor]:
    """Terms by name, before weighting. `output` and `target` (N, 4, H, W): straight colour and mask, 0..1."""
    mask, true_mask = output[:, 3:], target[:, 3:]
    near = _grown(true_mask)
    pixels = near.sum() * 3 + 1
    difference = composite(output) - composite(target)
    size = difference.abs()
    return {
        "composite": (size * (near + 0.05)).sum() / pixels,
        "square": (difference.square() * near).sum() / pixels,
        "colour": ((output[:, :3] - target[:, :3]).abs() * true_mask).sum() / pixels,
        "edges": (
            (difference[..., 1:] - difference[..., :-1]).abs().sum()
            + (difference[..., 1:, :] - difference[..., :-1, :]).abs().sum()
        )
        / pixels,
        "coarse": functional.avg_pool2d(difference, 4).abs().sum() * 16 / pixels,
        "mask": functional.binary_cross_entropy(mask.clamp(1e-4, 1 - 1e-4), true_mask),
        "overlap": 1 - (2 * (mask * true_mask).sum() + 1) / (mask.sum() + true_mask.sum() + 1),
    }


def _grown(mask: Tensor) -> Tensor:
    """1 on the person and `MARGIN_PX` round it, else 0; (N, 1, H, W)."""
    side = 2 * MARGIN_PX + 1
    grown = maximum_filter(mask.detach().numpy(), (1, 1, side, side), mode="constant")
    return torch.from_numpy(grown).gt(0).float()


def total_loss(terms: dict[str, Tensor]) -> Tensor:
    """The weighted sum."""
    return torch.stack([WEIGHTS[name] * term for name, term in terms.items()]).sum()


def composite(image: Tensor) -> Tensor:
    """(N, 4, H, W) over mid-grey, (N, 3, H, W)."""
    mask = image[:, 3:]
    return image[:, :3] * mask + GREY * (1 - mask)
