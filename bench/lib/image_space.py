"""Samples of a capture with image-space augmentation, as training usually does it: to be set beside camera-space.

Rule: frame and body are drawn once at the tensor's resolution, then the view's map resamples both; the view itself is
the camera-space sample's, so the two differ in nothing else.

It is the best form of its kind. The picture is shrunk as the mean of its pixels before it is read, and the UV image is
interpolated, within a chart, so that the texture is read as finely as it is; the thesis (section 3.3) interpolates what
was read from the texture.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from trilane.arrays import F32, F64, U8, Ints, Mask
from trilane.shapes import Shape
from trilane.training.capture.capture_samples import CaptureRenderer, CaptureSample, moved, resampled
from trilane.training.dataset import VALIDATION_SIZE
from trilane.training.first_texture import LARGEST_SPAN


class ImageSpaceRenderer:
    """Renders the samples that `renderer` plans by resampling its whole frames."""

    def __init__(self, renderer: CaptureRenderer) -> None:
        self._renderer = renderer
        self._last: tuple[int, F64, F32, U8] | None = None

    def training_sample(self, seed: Sequence[int], band: str, size: str) -> CaptureSample:
        """The sample of `seed`, `band` and `size`, as the capture's renderer plans it. Raises BadInputError."""
        return self._renderer.training_sample(seed, band, size)

    def render(self, sample: CaptureSample) -> tuple[F32, U8]:
        """The UV image (h,w,3) float32 and the picture (h,w,4) uint8 of `sample`, both resampled."""
        from_frame, uv, rgba = self._whole(sample.picture)
        by = sample.by @ np.linalg.inv(from_frame)
        return resampled_uv(uv, by, sample.crop.shape), resampled(rgba, by, sample.crop.shape)

    def _whole(self, number: int) -> tuple[F64, F32, U8]:
        """Frame `number`, cropped to the person: the map from the frame (3,3), UV image and picture."""
        if self._last is None or self._last[0] != number:
            whole = self._renderer.whole_sample(number, VALIDATION_SIZE)
            assert whole is not None, "a sample was planned of this frame, so it shows the body"
            self._last = (number, whole.by, *self._renderer.render(whole))
        return self._last[1:]


def resampled_uv(uv: F32, by: F64, target: Shape) -> F32:
    """The UV image (h,w,3) of shape `target` that `by` (3,3) makes of `uv` (H,W,3), both u, v and coverage.

    A pixel is covered where the nearest one of `uv` is. Its u and v are interpolated bilinearly between those of its
    four neighbours that are covered and lie beside the nearest one in the texture: not across a seam.
    """
    rows, columns = np.mgrid[: target[0], : target[1]] + 0.5
    at = moved(np.stack([columns, rows], axis=-1), np.linalg.inv(by).astype(np.float64)) - 0.5
    nearest, inside = _read(uv, np.round(at).astype(np.int64))
    low = np.floor(at).astype(np.int64)
    total, weights = np.zeros((*target, 2)), np.zeros(target)
    for corner in ((0, 0), (1, 0), (0, 1), (1, 1)):
        value, known = _read(uv, low + np.array(corner))
        beside = known & (np.abs(value[..., :2] - nearest[..., :2]).max(axis=-1) <= LARGEST_SPAN)
        share = np.abs(1 - np.array(corner) - (at - low)).prod(axis=-1) * beside
        total, weights = total + share[..., None] * value[..., :2], weights + share
    result = np.zeros((*target, 3), np.float32)
    result[..., :2] = total / np.maximum(weights, 1e-9)[..., None]
    result[..., 2] = inside
    result[~inside] = 0
    return result


def _read(uv: F32, at: Ints) -> tuple[F32, Mask]:
    """Pixels of `uv` (H,W,3) at (..., 2) columns and rows, and which of them are in it and covered."""
    height, width = uv.shape[:2]
    column, row = at[..., 0], at[..., 1]
    inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    value = uv[row.clip(0, height - 1), column.clip(0, width - 1)]
    return value, inside & (value[..., 2] > 0)
