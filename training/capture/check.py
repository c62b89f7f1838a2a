"""Checks a capture: does the body lie where the masks are, from where is the person seen, and what is never seen.

Rule: the body is drawn as training draws it; what is bad is said by frame, and no frame is changed.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from trilane.arrays import F32, Mask
from trilane.training.body_arrays import body_arrays
from trilane.training.capture.body_raster import BodyRaster
from trilane.training.capture.capture import HALF, Capture
from trilane.training.capture.texel_coverage import TexelCoverage

#: Below it body and mask have less in common than either has alone with nothing: a third each, and a third shared.
LEAST_IOU = 0.5
#: A frame is an outlier where it lies further below the median than this many deviations (scaled to a normal
#: distribution's), as usual for the median absolute deviation, and by no less than what outlines of pixels make.
OUTLYING, NORMAL_MAD = 4.0, 1.4826
LEAST_DROP = 0.05


@dataclass(frozen=True)
class CheckedFrame:
    """`iou` of the drawn body and the mask; `outside`: share of the drawn body that the mask does not cover.

    Clothes and hair make the mask larger than the body, so a good fit has a small `outside`, and an IoU below 1.
    """

    number: int
    iou: float
    outside: float


def check_frames(capture: Capture, raster: BodyRaster, coverage: TexelCoverage) -> Iterator[CheckedFrame]:
    """Each frame of `capture` as it was checked; `coverage` counts the texels that it shows."""
    for number in range(len(capture)):
        frame, uv, mask = checked_frame(capture, raster, number)
        coverage.add(coverage.drawn(uv, mask))
        yield frame


def checked_frame(capture: Capture, raster: BodyRaster, number: int) -> tuple[CheckedFrame, F32, Mask]:
    """Frame `number` as it was checked, the UV image (h,w,3) of its body, and the person (h,w)."""
    uv = raster.uv_of(capture, number)
    mask = np.asarray(capture.masks.read(capture.mask_of[number]) >= HALF)
    return checked(number, uv[..., 2] > 0, mask), uv, mask


def checked(number: int, drawn: Mask, mask: Mask) -> CheckedFrame:
    """Frame `number`, whose body is `drawn` (h,w) where the person is `mask` (h,w)."""
    together, both = int((drawn | mask).sum()), int((drawn & mask).sum())
    bodys = int(drawn.sum())
    return CheckedFrame(number, both / max(together, 1), 1 - both / bodys if bodys else 1.0)


def bad_frames(frames: Sequence[CheckedFrame]) -> list[CheckedFrame]:
    """Frames whose fit is off, worst first: an IoU below `LEAST_IOU`, or far below that of the other frames."""
    ious = np.array([frame.iou for frame in frames])
    median = float(np.median(ious))
    deviation = NORMAL_MAD * float(np.median(np.abs(ious - median)))
    limit = max(LEAST_IOU, median - max(OUTLYING * deviation, LEAST_DROP))
    return sorted((frame for frame in frames if frame.iou < limit), key=lambda frame: frame.iou)


def coverage_of(capture: Capture) -> TexelCoverage:
    """Nothing counted yet of the body of `capture`."""
    return TexelCoverage(body_arrays(capture.shaped))
