"""Errors of a picture against a reference picture, and of a mask against a reference mask, by the usual measures.

Rule: a picture is (h,w,3) sRGB, as bytes or as real numbers in 0..1. A mask is (h,w) bool. SSIM is as in the avatars'
validations: windows of 7 x 7 pixels, mean over the colours. The weights of LPIPS come from a file that the user names.
Only tensors are read from this file; none of its code runs.

SSIM: Wang et al., "Image Quality Assessment", IEEE TIP 13 (2004). MS-SSIM: Wang, Simoncelli and Bovik, "Multiscale
structural similarity", Asilomar 2003. FLIP: Andersson et al., HPG 2020, at 67 pixels a degree. LPIPS: Zhang et al.,
"Unreasonable Effectiveness", CVPR 2018, version 0.1.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from trilane import arrays
from trilane.arrays import F64, Floats, Mask
from trilane.bench.lib.picture_error import flip_map, require_metrics, ssim_map
from trilane.errors import BadInputError, MissingPartError

__all__ = ["ErrorFigures", "dice", "figures", "flip", "iou", "mae", "ms_ssim", "psnr_db", "require_metrics", "ssim"]
#: Exponents of MS-SSIM's scales, the finest first.
SCALES = (0.0448, 0.2856, 0.3001, 0.2363, 0.1333)
#: MS-SSIM's window: standard deviation of a Gaussian, and side, pixels.
DEVIATION_PX, WINDOW_PX = 1.5, 11
#: The least side of a picture for MS-SSIM: its coarsest scale has room for one window.
LEAST_MS_SSIM_PX = WINDOW_PX * 2 ** (len(SCALES) - 1)
#: The least side of a picture for SSIM: one window.
LEAST_SSIM_PX = 7
#: Constants of SSIM for values in 0..1. They prevent 0 / 0.
C1, C2 = 0.01**2, 0.03**2
#: Function that takes a picture and its reference, real numbers in 0..1, and returns their LPIPS; an `Lpips` is one.
Perceived = Callable[[F64, F64], float | None]
LPIPS_FILE = "a file of all weights of lpips.LPIPS(net='alex')"
LPIPS_REMEDY = "torch.save(lpips.LPIPS().state_dict(), FILE) writes one"
#: AlexNet's convolutions: name in the file, outputs, inputs, kernel side, stride, padding, whether pooling precedes it.
LPIPS_LAYERS = (
    ("slice1.0", 64, 3, 11, 4, 2, False),
    ("slice2.3", 192, 64, 5, 1, 2, True),
    ("slice3.6", 384, 192, 3, 1, 1, True),
    ("slice4.8", 256, 384, 3, 1, 1, False),
    ("slice5.10", 256, 256, 3, 1, 1, False),
)
#: Shift and scale of the network's input by channel: (2 x picture - 1 - shift) / scale.
LPIPS_SHIFT, LPIPS_SCALE = (-0.030, -0.088, -0.188), (0.458, 0.448, 0.450)
#: Added to the length of a feature vector, which may be 0.
LPIPS_TINY = 1e-10
#: The least side of a picture for which every layer has an output.
LEAST_LPIPS_PX = 64


@dataclass(frozen=True)
class ErrorFigures:
    """Errors of a picture against a reference.

    `mae`: mean absolute difference, in steps of 1/255. `psnr_db`: PSNR, at most 100, which means no error.
    `ssim`, `ms_ssim`: similarity, 1 without an error; None if the picture is too small.
    `flip`: mean FLIP, 0 without an error.
    `dice`, `iou`: agreement of the masks, 1 if they are equal; None without masks.
    `lpips`: LPIPS, 0 without an error; None without weights, or if the pictures are too small.
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
        """Return the figures by their names."""
        return asdict(self)


def figures(
    picture: Floats,
    reference: Floats,
    mask: Mask | None = None,
    reference_mask: Mask | None = None,
    lpips: Perceived | None = None,
) -> ErrorFigures:
    """Return all errors of `picture` against `reference`.

    `mask`, `reference_mask`: masks to compare; None for either leaves `dice` and `iou` out.
    `lpips`: function that computes LPIPS; None leaves LPIPS out.
    Raises ValueError if the pictures differ in shape or an argument is no picture, ImportError without the extra
    `metrics`.
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
    """Return the figures of two equal pictures without computing errors.

    `side`: shorter side of the pictures, pixels. `masks`: (mask, reference mask); None without masks. `lpips`: None if
    LPIPS is left out.
    """
    return ErrorFigures(
        mae=0.0,
        psnr_db=arrays.psnr_db(0.0),
        ssim=None if side < LEAST_SSIM_PX else 1.0,
        ms_ssim=None if side < LEAST_MS_SSIM_PX else 1.0,
        flip=0.0,
        dice=None if masks is None else dice(*masks),
        iou=None if masks is None else iou(*masks),
        lpips=None if lpips is None or side < LEAST_LPIPS_PX else 0.0,
    )


def mae(picture: Floats, reference: Floats) -> float:
    """Return the mean absolute difference of all values, in steps of 1/255. Raises ValueError as `figures` does."""
    shown, wanted = _pair(picture, reference)
    return float(np.abs(shown - wanted).mean() * 255)


def mse(picture: Floats, reference: Floats) -> float:
    """Return the mean square difference of all values, as numbers in 0..1. Raises ValueError as `figures` does."""
    shown, wanted = _pair(picture, reference)
    return float(((shown - wanted) ** 2).mean())


def psnr_db(picture: Floats, reference: Floats) -> float:
    """Return the PSNR in dB, -10 log10 of the mean square difference; at most 100.

    Raises ValueError as `figures` does.
    """
    return arrays.psnr_db(mse(picture, reference))


def ssim(picture: Floats, reference: Floats) -> float | None:
    """Return the mean SSIM; None if a side is shorter than `LEAST_SSIM_PX`. Raises ValueError as `figures` does."""
    shown, wanted = _pair(picture, reference)
    return None if min(shown.shape[:2]) < LEAST_SSIM_PX else float(ssim_map(shown, wanted).mean())


def ms_ssim(picture: Floats, reference: Floats) -> float | None:
    """Return MS-SSIM of five scales, mean over the colours; None if a side is shorter than `LEAST_MS_SSIM_PX`.

    From each scale to the next, squares of 2 x 2 pixels are averaged. A mean contrast-structure term below 0 counts as
    0. Raises ValueError as `figures` does.
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
    """Return the mean of the FLIP map; 0 means no visible difference. Raises ValueError as `figures` does."""
    return float(flip_map(*_pair(picture, reference)).mean())


def dice(mask: Mask, reference: Mask) -> float:
    """Return Dice's coefficient: twice the common area over the sum of both areas; 1 if both masks are empty."""
    total = int(mask.sum()) + int(reference.sum())
    return 1.0 if total == 0 else 2 * int((mask & reference).sum()) / total


def iou(mask: Mask, reference: Mask) -> float:
    """Return intersection over union; 1 if both masks are empty."""
    either = int((mask | reference).sum())
    return 1.0 if either == 0 else int((mask & reference).sum()) / either


def _similarity(picture: F64, reference: F64) -> tuple[F64, F64]:
    """Return (mean SSIM, mean contrast-structure term), each (3,) by colour, over all windows inside the picture."""
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
    """Return the weighted mean (h,w,3) of the window around each pixel.

    The window and its weights are the same as in skimage's `structural_similarity`.
    """
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
    """Return `picture` as real numbers in 0..1, (h,w,3) float64. Raises ValueError if it is no picture."""
    if picture.ndim != 3 or picture.shape[2] != 3 or not picture.size:
        raise ValueError(f"a picture of shape {picture.shape}, expected (height, width, 3)")
    if picture.dtype == np.uint8:
        return np.asarray(picture / 255.0)
    real = np.asarray(picture, np.float64)
    if not (real.min() >= 0 and real.max() <= 1):
        raise ValueError("a picture with numbers outside 0 to 1, or none at all")
    return real


class Lpips:
    """LPIPS with AlexNet and the weights in the file `weights`.

    The file has the weights of `lpips.LPIPS(net="alex")` under the names in the `lpips` package.
    `torch.save(lpips.LPIPS().state_dict(), FILE)` writes such a file.
    """

    def __init__(self, weights: Path) -> None:
        """Read the weights. Raises BadInputError for a file without them, MissingPartError without PyTorch."""
        try:
            import torch
        except ImportError as error:
            raise MissingPartError(f"LPIPS needs {error.name}", extra="train") from None
        try:
            state = torch.load(weights, map_location="cpu", weights_only=True)
        except OSError as error:
            raise BadInputError.of_os_error(weights, error, LPIPS_FILE) from None
        except Exception:  # PyTorch raises many kinds; some messages advise to load the file unsafely
            raise BadInputError(str(weights), "a file that is not of tensors alone", LPIPS_FILE, LPIPS_REMEDY) from None
        self._state = {name: _tensor(state, name, shape, weights) for name, shape in _shapes()}

    def __call__(self, picture: F64, reference: F64) -> float | None:
        """Return the LPIPS of two pictures (h,w,3), sRGB in 0..1; None if a side is below `LEAST_LPIPS_PX`."""
        import torch

        if min(picture.shape[:2]) < LEAST_LPIPS_PX:
            return None
        with torch.no_grad():
            pairs = zip(self._features(picture), self._features(reference), strict=True)
            return sum(
                float(((first - second).square() * self._state[f"lin{number}.model.1.weight"]).sum(1).mean())
                for number, (first, second) in enumerate(pairs)
            )

    def _features(self, picture: F64) -> Iterator[Any]:
        """Yield the features (1,C,h,w) of each layer for `picture` (h,w,3).

        The vector of each pixel has length 1 along C.
        """
        import torch
        from torch.nn import functional

        scaled = np.ascontiguousarray(((2 * picture - 1 - LPIPS_SHIFT) / LPIPS_SCALE).transpose(2, 0, 1), np.float32)
        values = torch.from_numpy(scaled)[None]
        for name, _, _, _, stride, padding, pooled in LPIPS_LAYERS:
            values = functional.max_pool2d(values, 3, 2) if pooled else values
            kernel, bias = self._state[f"net.{name}.weight"], self._state[f"net.{name}.bias"]
            values = functional.relu(functional.conv2d(values, kernel, bias, stride, padding))
            yield values / (values.square().sum(1, keepdim=True).sqrt() + LPIPS_TINY)


def _shapes() -> Iterator[tuple[str, tuple[int, ...]]]:
    """Yield (name, shape) of each tensor that the file of LPIPS weights must have."""
    for number, (name, outputs, inputs, side, *_) in enumerate(LPIPS_LAYERS):
        yield f"net.{name}.weight", (outputs, inputs, side, side)
        yield f"net.{name}.bias", (outputs,)
        yield f"lin{number}.model.1.weight", (1, outputs, 1, 1)


def _tensor(state: Any, name: str, shape: tuple[int, ...], weights: Path) -> Any:
    found = state.get(name) if isinstance(state, dict) else None
    if found is None or tuple(found.shape) != shape:
        what = "no tensor" if found is None else f"shape {tuple(found.shape)}"
        raise BadInputError(f"{weights}: {name}", what, f"shape {shape}: {LPIPS_FILE}", LPIPS_REMEDY)
    return found.float()
