"""How far a picture is from another one, and a mask from another one, by the errors that people know.

Rule: pure functions. Pictures are (h,w,3) sRGB, bytes or real numbers in 0..1, masks (h,w) of bools; what a library
has is the library's. SSIM is as in the avatars' validations: windows of 7 x 7 pixels, mean over the colours.

Sources: SSIM: Wang et al., "Image Quality Assessment", IEEE TIP 13 (2004); MS-SSIM: Wang, Simoncelli and Bovik,
"Multiscale structural similarity", Asilomar 2003; FLIP: Andersson et al., HPG 2020, at 67 pixels a degree.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass

import numpy as np

from trilane.arrays import F64, Floats, Mask
from trilane.bench.lib import picture_error
from trilane.bench.lib.picture_error import flip_map, require_metrics, ssim_map

__all__ = ["ErrorFigures", "dice", "figures", "flip", "iou", "mae", "ms_ssim", "psnr_db", "require_metrics", "ssim"]

#: Exponents of MS-SSIM's scales, the finest first.
SCALES = (0.0448, 0.2856, 0.3001, 0.2363, 0.1333)
#: MS-SSIM's window: a Gaussian of this deviation, in pixels, over 11 x 11 of them.
DEVIATION_PX, WINDOW_PX = 1.5, 11
#: The least side of a picture with room for the window at the coarsest scale.
LEAST_MS_SSIM_PX = WINDOW_PX * 2 ** (len(SCALES) - 1)
#: The least side of a picture that SSIM has windows for.
LEAST_SSIM_PX = 7
#: Constants that keep SSIM's quotients from 0 / 0, of values in 0..1.
C1, C2 = 0.01**2, 0.03**2
#: LPIPS of a picture and its reference, real numbers in 0..1: `trilane.apps.experiments.lpips_error.Lpips`.
Perceived = Callable[[F64, F64], float | None]


@dataclass(frozen=True)
class ErrorFigures:
    """Errors of a picture against a reference.

    `mae`: mean difference, in steps of 1/255. `psnr_db`: at most 100, which is a picture without an error. `ssim`,
    `ms_ssim`: 1 without an error; None where the picture is too small for them. `flip`: mean, 0 without an error.
    `dice`, `iou`: of the masks, 1 where they are the same; None without masks. `lpips`: 0 without an
    error; None without its weights and where the picture is too small.
    """

    mae: float
    psnr_db: float
    ssim: float | None
    ms_ssim: float | None
    flip: float
    dice: float | None = None
    iou: float | None = None
    lpips: float | None = None

    def as_json(self) -> dict[str, float | None]:
        """The figures by their names."""
        return asdict(self)


def figures(
    picture: Floats,
    reference: Floats,
    mask: Mask | None = None,
    reference_mask: Mask | None = None,
    lpips: Perceived | None = None,
) -> ErrorFigures:
    """All errors of `picture` against `reference`, with both masks those of the masks, with `lpips` what it says.

    Raises ValueError when shapes or numbers are not those of two pictures, ImportError without the extra `metrics`.
    """
    masks = None if mask is None or reference_mask is None else (mask, reference_mask)
    if np.array_equal(*_pair(picture, reference)):
        return _no_error(min(picture.shape[:2]), masks, lpips)
    return ErrorFigures(
        mae=mae(picture, reference),
        psnr_db=psnr_db(picture, reference),
        ssim=ssim(picture, reference),
        ms_ssim=ms_ssim(picture, reference),
        flip=flip(picture, reference),
        dice=None if masks is None else dice(*masks),
        iou=None if masks is None else iou(*masks),
        lpips=None if lpips is None else lpips(*_pair(picture, reference)),
    )


def _no_error(side: int, masks: tuple[Mask, Mask] | None, lpips: Perceived | None) -> ErrorFigures:
    """Figures of two pictures that are the same, whose shorter side is `side`: nothing has to be computed."""
    return ErrorFigures(
        mae=0.0,
        psnr_db=picture_error.psnr_db(0.0),
        ssim=None if side < LEAST_SSIM_PX else 1.0,
        ms_ssim=None if side < LEAST_MS_SSIM_PX else 1.0,
        flip=0.0,
        dice=None if masks is None else dice(*masks),
        iou=None if masks is None else iou(*masks),
        lpips=None if lpips is None else 0.0,
    )


def mae(picture: Floats, reference: Floats) -> float:
    """Mean difference of all values, in steps of 1/255."""
    shown, wanted = _pair(picture, reference)
    return float(np.abs(shown - wanted).mean() * 255)


def mse(picture: Floats, reference: Floats) -> float:
    """Mean square of the differences of all values, in 0..1."""
    shown, wanted = _pair(picture, reference)
    return float(((shown - wanted) ** 2).mean())


def psnr_db(picture: Floats, reference: Floats) -> float:
    """-10 log10 of the mean square; at most 100 dB."""
    return picture_error.psnr_db(mse(picture, reference))


def ssim(picture: Floats, reference: Floats) -> float | None:
    """Mean SSIM; None when a side is shorter than `LEAST_SSIM_PX`."""
    shown, wanted = _pair(picture, reference)
    return None if min(shown.shape[:2]) < LEAST_SSIM_PX else float(ssim_map(shown, wanted).mean())


def ms_ssim(picture: Floats, reference: Floats) -> float | None:
    """MS-SSIM of five scales, mean over the colours; None when a side is shorter than `LEAST_MS_SSIM_PX`.

    Between scales squares of 2 x 2 pixels are averaged. A mean contrast and structure below 0 counts as 0.
    """
    shown, wanted = _pair(picture, reference)
    if min(shown.shape[:2]) < LEAST_MS_SSIM_PX:
        return None
    product = np.ones(shown.shape[2])
    for exponent in SCALES[:-1]:
        product *= np.maximum(_similarity(shown, wanted)[1], 0.0) ** exponent
        shown, wanted = _halved(shown), _halved(wanted)
    product *= np.maximum(_similarity(shown, wanted)[0], 0.0) ** SCALES[-1]
    return float(product.mean())


def flip(picture: Floats, reference: Floats) -> float:
    """Mean FLIP."""
    return float(flip_map(*_pair(picture, reference)).mean())


def dice(mask: Mask, reference: Mask) -> float:
    """Twice what both masks have, over the sum of what each has; 1 when both are empty."""
    total = int(mask.sum()) + int(reference.sum())
    return 1.0 if total == 0 else 2 * int((mask & reference).sum()) / total


def iou(mask: Mask, reference: Mask) -> float:
    """What both masks have over what either has; 1 when both are empty."""
    either = int((mask | reference).sum())
    return 1.0 if either == 0 else int((mask & reference).sum()) / either


def _similarity(picture: F64, reference: F64) -> tuple[F64, F64]:
    """Of each colour (3,): mean SSIM, and mean of its contrast and structure alone, where windows lie inside."""
    from skimage.metrics import structural_similarity

    _, whole = structural_similarity(
        picture,
        reference,
        channel_axis=2,
        data_range=1.0,
        full=True,
        gaussian_weights=True,
        sigma=DEVIATION_PX,
        use_sample_covariance=False,
    )
    first, second = _means(picture), _means(reference)
    luminance = (2 * first * second + C1) / (first**2 + second**2 + C1)
    edge = WINDOW_PX // 2
    inside = np.s_[edge:-edge, edge:-edge]
    return whole[inside].mean(axis=(0, 1)), (whole / luminance)[inside].mean(axis=(0, 1))


def _means(picture: F64) -> F64:
    """The window's weighted means about each pixel, as `structural_similarity` has them."""
    from skimage.filters import gaussian

    reach = WINDOW_PX // 2 / DEVIATION_PX
    return np.asarray(gaussian(picture, DEVIATION_PX, truncate=reach, mode="reflect", channel_axis=2))


def _halved(picture: F64) -> F64:
    height, width = (side // 2 * 2 for side in picture.shape[:2])
    squares = picture[:height, :width].reshape(height // 2, 2, width // 2, 2, -1)
    return np.asarray(squares.mean(axis=(1, 3)))


def _pair(picture: Floats, reference: Floats) -> tuple[F64, F64]:
    shown, wanted = _real(picture), _real(reference)
    if shown.shape != wanted.shape:
        raise ValueError(f"pictures of {shown.shape} and {wanted.shape}")
    return shown, wanted


def _real(picture: Floats) -> F64:
    """`picture` in 0..1. Raises ValueError when it is none."""
    if picture.ndim != 3 or picture.shape[2] != 3 or not picture.size:
        raise ValueError(f"a picture of shape {picture.shape}, expected (height, width, 3)")
    if picture.dtype == np.uint8:
        return np.asarray(picture / 255.0)
    real = np.asarray(picture, np.float64)
    if not (real.min() >= 0 and real.max() <= 1):
        raise ValueError("a picture with numbers outside 0 to 1, or none at all")
    return real
