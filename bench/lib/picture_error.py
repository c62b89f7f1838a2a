"""Errors of pictures against reference pictures: PSNR, SSIM and FLIP.

Rule: all pictures count alike, also pictures without a visible avatar. The PSNR over several pictures follows from the
mean square error over all their pixels. Box figures only count the pixels in the boxes around avatars.

SSIM: Wang et al., "Image Quality Assessment", IEEE TIP 13 (2004), computed by scikit-image. FLIP: Andersson et al.,
"FLIP: A Difference Evaluator for Alternating Images", HPG 2020, computed by the authors' package flip-evaluator, at 67
pixels a degree.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from trilane import machine
from trilane.arrays import F64, U8, Mask, psnr_db
from trilane.bench.lib.cast import Box
from trilane.errors import MissingPartError

MODULES = ("skimage", "flip_evaluator")


class PictureErrors:
    """The image errors over all pictures that were added."""

    def __init__(self) -> None:
        # Number of pixels, and the sums of their errors by `error_maps`: of the whole frames, and of the boxes.
        self._sums = {"": np.zeros(4), "box_": np.zeros(4)}

    def add(self, picture: U8, reference: U8, boxes: Sequence[Box]) -> None:
        """Add the errors of `picture` against `reference`, both (h,w,3) uint8 sRGB.

        `boxes`: rectangles of the visible avatars; empty if no avatar is in view.
        """
        maps = error_maps(picture, reference)
        masks = np.ones(picture.shape[:2], bool), inside(boxes, picture)
        for sums, mask in zip(self._sums.values(), masks, strict=True):
            sums += (mask.sum(), *(values[mask].sum() for values in maps))

    def figures(self, plan: str) -> dict[str, float | None]:
        """Return the errors over all pictures added until now, under keys that contain the name `plan`.

        The keys are `psnr_PLAN_db` (dB), `ssim_PLAN` and `flip_PLAN` for the whole pictures, and the same keys after
        `box_` for the boxes. Box figures are None if no picture had a box, and all figures are None without pictures.
        """
        found: dict[str, float | None] = {}
        for prefix, (count, square, similar, flip) in self._sums.items():
            found[f"{prefix}psnr_{plan}_db"] = psnr_db(square / count) if count else None
            found[f"{prefix}ssim_{plan}"] = float(similar / count) if count else None
            found[f"{prefix}flip_{plan}"] = float(flip / count) if count else None
        return found


def psnr_of_frames(psnr_db: Sequence[float]) -> dict[str, float]:
    """Return the mean, the least and the 1st percentile of a PSNR: `psnr_db`, `worst_psnr_db` and `p1_psnr_db`, in dB.

    A mean hides single bad frames, which people see. The least value depends on the number of frames; the percentile
    hardly does. The percentile is linear between ranks. `psnr_db`: PSNR of each frame, at least one.
    """
    return {
        "psnr_db": float(np.mean(psnr_db)),
        "worst_psnr_db": float(np.min(psnr_db)),
        "p1_psnr_db": float(np.quantile(psnr_db, 0.01)),
    }


def require_metrics() -> None:
    """Raise MissingPartError if a library that computes image errors is not installed.

    A caller with long work can call this function before that work.
    """
    for module in MODULES:
        if not machine.here.has_package(module):
            raise MissingPartError(f"image errors need {module}", extra="metrics")


def error_maps(picture: U8, reference: U8) -> tuple[F64, F64, F64]:
    """Return three maps (h,w): the mean square error of the colours, the SSIM and the FLIP error of each pixel.

    The mean square error refers to colours in 0..1. `picture`, `reference`: pictures (h,w,3) uint8 sRGB.
    """
    shown, wanted = picture / 255, reference / 255
    return ((shown - wanted) ** 2).mean(axis=2), ssim_map(shown, wanted), flip_map(shown, wanted)


def ssim_map(picture: F64, reference: F64) -> F64:
    """Return the SSIM (h,w) of two pictures (h,w,3) sRGB in 0..1, as the mean over the three colours.

    The windows have 7 x 7 pixels.
    """
    from skimage.metrics import structural_similarity

    _, similar = structural_similarity(picture, reference, channel_axis=2, data_range=1.0, full=True)
    return np.asarray(similar.mean(axis=2))


def flip_map(picture: F64, reference: F64) -> F64:
    """Return the FLIP error (h,w) of two pictures (h,w,3), sRGB in 0..1."""
    import flip_evaluator

    real = [np.ascontiguousarray(image, np.float32) for image in (reference, picture)]
    flip, _, _ = flip_evaluator.evaluate(*real, "LDR", inputsRGB=True, applyMagma=False, computeMeanError=False)
    return np.asarray(flip, np.float64).reshape(picture.shape[:2])


def inside(boxes: Sequence[Box], picture: U8) -> Mask:
    """Return a mask (h,w) of the pixels that lie in any of `boxes`. `picture`: picture (h,w,3)."""
    mask = np.zeros(picture.shape[:2], bool)
    for box in boxes:
        mask[box.top : box.bottom, box.left : box.right] = True
    return mask


def box_psnr_db(picture: U8, reference: U8, boxes: Sequence[Box]) -> float:
    """Return the PSNR in dB of `picture` against `reference`, both (h,w,3) uint8 sRGB, over the pixels in `boxes`.

    `boxes`: at least one rectangle with pixels of the picture.
    """
    mask = inside(boxes, picture)
    return psnr_db(float((((picture[mask] / 255) - reference[mask] / 255) ** 2).mean()))
