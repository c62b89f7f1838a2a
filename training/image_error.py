"""Error of an avatar's picture against the ground truth: PSNR, SSIM and IoU.

Rule: pictures are compared over mid-grey, inside the box of the true mask; beside that PSNR, which counts the
background in the box too, stands that of the true mask's pixels alone.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from skimage.metrics import structural_similarity

from trilane.arrays import U8

GREY = 0.5
HALF = 128
SSIM_WINDOW = 7
#: The least mean square that a PSNR is computed of, which makes 100 dB the most.
LEAST_SQUARE = 1e-10


@dataclass(frozen=True)
class ImageError:
    """How far a picture is from the truth.

    `psnr_db`, `ssim`: inside the box of the true mask. `body_psnr_db`: in dB, over the true mask's pixels alone.
    `background`: share of the box that the mask does not cover. `iou`: of the masks, over the whole tensor.
    """

    psnr_db: float
    body_psnr_db: float
    background: float
    ssim: float
    iou: float


def image_error(picture: U8, truth: U8) -> ImageError | None:
    """Error of `picture` against `truth`, both (h,w,4) with straight alpha; None when the truth shows no person."""
    mask, true_mask = picture[..., 3] >= HALF, truth[..., 3] >= HALF
    if not true_mask.any():
        return None
    rows, columns = (np.flatnonzero(true_mask.any(axis=axis)) for axis in (1, 0))
    box = np.s_[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
    shown, wanted = over_grey(picture)[box], over_grey(truth)[box]
    square = (shown - wanted) ** 2
    window = min(SSIM_WINDOW, *(side - 1 + side % 2 for side in shown.shape[:2]))
    ssim = structural_similarity(shown, wanted, data_range=1.0, channel_axis=2, win_size=window) if window >= 3 else 1.0
    return ImageError(
        psnr_db=_psnr_db(square),
        body_psnr_db=_psnr_db(square[true_mask[box]]),
        background=1.0 - float(true_mask[box].mean()),
        ssim=float(ssim),
        iou=float((mask & true_mask).sum() / (mask | true_mask).sum()),
    )


def over_grey(image: U8) -> NDArray[np.float64]:
    """`image` (h,w,4) uint8 over mid-grey: (h,w,3) in 0..1."""
    alpha = image[..., 3:] / 255
    return np.asarray(image[..., :3] / 255 * alpha + GREY * (1 - alpha))


def _psnr_db(square: NDArray[np.float64]) -> float:
    """PSNR in dB of values in 0..1 whose differences have the squares `square`."""
    return -10 * float(np.log10(max(float(square.mean()), LEAST_SQUARE)))
