"""Errors of pictures against reference pictures: PSNR, SSIM and FLIP.

Rule: all pictures count alike, also with nobody in view; the PSNR follows from the mean square over all pictures. Box
figures only count the pixels in the boxes around avatars.

Sources: Wang et al., "Image Quality Assessment", IEEE TIP 13 (2004), by scikit-image; Andersson et al., "FLIP: A
Difference Evaluator for Alternating Images", HPG 2020, by its authors' flip-evaluator, at 67 pixels a degree.
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
    """Sums up the errors of pictures that are added one after the other."""

    def __init__(self) -> None:
        # Number of pixels, first of the whole frames, then of the boxes.
        self._pixels = np.zeros(2)
        self._squares, self._similar, self._flip = np.zeros(2), np.zeros(2), np.zeros(2)

    def add(self, picture: U8, reference: U8, boxes: Sequence[Box]) -> None:
        """Count `picture` against `reference`, both (h,w,3) sRGB, with avatars in `boxes`."""
        maps = error_maps(picture, reference)
        for part, mask in enumerate((np.ones(picture.shape[:2], bool), inside(boxes, picture))):
            self._pixels[part] += mask.sum()
            for total, values in zip((self._squares, self._similar, self._flip), maps, strict=True):
                total[part] += values[mask].sum()

    def figures(self, plan: str) -> dict[str, float | None]:
        """Return the errors so far: `psnr_PLAN_db`, `ssim_PLAN`, `flip_PLAN`, and the same with `box_` in front.

        `plan`: PLAN in these keys. Box figures are None without boxes.
        """
        found: dict[str, float | None] = {}
        for part, prefix in enumerate(("", "box_")):
            count = self._pixels[part]
            means = [total[part] / count if count else None for total in (self._squares, self._similar, self._flip)]
            found[f"{prefix}psnr_{plan}_db"] = None if means[0] is None else psnr_db(means[0])
            found[f"{prefix}ssim_{plan}"] = None if means[1] is None else float(means[1])
            found[f"{prefix}flip_{plan}"] = None if means[2] is None else float(means[2])
        return found


def psnr_of_frames(psnr_db: Sequence[float]) -> dict[str, float]:
    """Return the mean, the worst and the 1st percentile (linear between ranks) of single frames' PSNR.

    A mean hides single bad frames, which people see. The worst frame depends on the number of frames, the percentile
    hardly does. `psnr_db`: at least one.
    """
    return {
        "psnr_db": float(np.mean(psnr_db)),
        "worst_psnr_db": float(np.min(psnr_db)),
        "p1_psnr_db": float(np.quantile(psnr_db, 0.01)),
    }


def require_metrics() -> None:
    """Raise MissingPartError if a library for errors is missing. Call it before long work."""
    for module in MODULES:
        if not machine.here.has_package(module):
            raise MissingPartError(f"image errors need {module}", extra="metrics")


def error_maps(picture: U8, reference: U8) -> tuple[F64, F64, F64]:
    """Return, for each pixel (h,w), the mean square difference of values in 0..1, the SSIM and the FLIP.

    `picture`, `reference`: (h,w,3) sRGB.
    """
    shown, wanted = picture / 255, reference / 255
    return ((shown - wanted) ** 2).mean(axis=2), ssim_map(shown, wanted), flip_map(shown, wanted)


def ssim_map(picture: F64, reference: F64) -> F64:
    """Return the SSIM (h,w) of two pictures (h,w,3) in 0..1: windows of 7 x 7 pixels, mean over the colours."""
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
    """Return a mask (h,w) of the pixels of `picture` that lie in any of `boxes`."""
    mask = np.zeros(picture.shape[:2], bool)
    for box in boxes:
        mask[box.top : box.bottom, box.left : box.right] = True
    return mask


def box_psnr_db(picture: U8, reference: U8, boxes: Sequence[Box]) -> float:
    """Return the PSNR of `picture` against `reference`, both (h,w,3) sRGB, over the pixels in `boxes`, at least one."""
    mask = inside(boxes, picture)
    return psnr_db(float((((picture[mask] / 255) - reference[mask] / 255) ** 2).mean()))
