"""Image-space augmentation, which the bench sets beside camera-space: what is resampled, by hand and on a capture."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

pytest.importorskip("skimage")

from trilane.bench.lib import image_space
from trilane.bench.lib.image_space import ImageSpaceRenderer, resampled_uv
from trilane.training.capture.capture_samples import Augmentation, image_map, moved

SHAPE = (24, 32)


def ramp() -> Any:
    """u grows with the column, v with the row, by less than a seam's step; all is covered."""
    rows, columns = np.mgrid[: SHAPE[0], : SHAPE[1]]
    return np.dstack([0.01 * columns, 0.02 * rows, np.ones(SHAPE)]).astype(np.float32)


def test_a_map_that_moves_nothing_changes_nothing() -> None:
    uv = ramp()
    uv[5:9, 3:7] = 0
    assert np.abs(resampled_uv(uv, np.eye(3), SHAPE) - uv).max() < 1e-6


@pytest.mark.parametrize("flip", [False, True])
def test_a_linear_image_is_read_where_its_pixels_come_from(flip: bool) -> None:
    """Closed form: bilinear reading of a linear function is exact, wherever all four neighbours are in the picture."""
    by = image_map(Augmentation((15.0, 11.0), 0.3, (2.5, 2.1), (flip, False), (1.0, -2.0)), (40, 48))
    found = resampled_uv(ramp(), by, (40, 48))
    rows, columns = np.mgrid[:40, :48] + 0.5
    x, y = np.moveaxis(moved(np.stack([columns, rows], axis=-1), np.linalg.inv(by)) - 0.5, -1, 0)
    inner = (x >= 0) & (x <= SHAPE[1] - 1) & (y >= 0) & (y <= SHAPE[0] - 1)
    assert inner.mean() > 0.5 and (found[inner, 2] == 1).all()
    assert np.abs(found[inner, 0] - 0.01 * x[inner]).max() < 1e-6
    assert np.abs(found[inner, 1] - 0.02 * y[inner]).max() < 1e-6
    beyond = (x < -0.51) | (x > SHAPE[1] - 0.49) | (y < -0.51) | (y > SHAPE[0] - 0.49)
    assert beyond.any() and not found[beyond].any()


def test_nothing_is_interpolated_across_a_seam_or_with_what_is_not_covered() -> None:
    """Two charts side by side, far apart in the texture, and beside them no body: only values that there are."""
    uv = np.zeros((8, 12, 3), np.float32)
    uv[:, :5], uv[:, 5:9] = (0.2, 0.3, 1.0), (0.8, 0.9, 1.0)
    found = resampled_uv(uv, image_map(Augmentation((6.0, 4.0), 0.0, (4.0, 4.0)), (32, 48)), (32, 48))
    assert {tuple(np.round(pixel, 4)) for pixel in found.reshape(-1, 3)} == {
        (np.float32(0.2), np.float32(0.3), np.float32(1.0)),
        (np.float32(0.8), np.float32(0.9), np.float32(1.0)),
        (0.0, 0.0, 0.0),
    }
    assert (found[..., 2] > 0).mean() == 9 / 12


def test_a_sample_is_its_whole_frame_moved_to_where_the_sample_is() -> None:
    """A frame of 64 columns, cropped to columns 16 to 47 at half its size; the sample is a shift of the frame by 20
    pixels. So column k of the sample is column k + 20 of the frame, and (k + 20 - 16) / 2 of the crop. Each frame is
    drawn once while its samples follow each other."""
    whole = SimpleNamespace(by=np.array([[0.5, 0, -8.0], [0, 0.5, 0], [0, 0, 1]]), number=0)
    rgba = np.zeros((*SHAPE, 4), np.uint8)
    rgba[..., 0], rgba[..., 3] = np.arange(SHAPE[1]) * 8, 255
    drawn: list[int] = []

    def render(sample: Any) -> Any:
        drawn.append(sample.number)
        return ramp(), rgba

    def whole_sample(number: int, size: str) -> Any:
        assert size == "256"
        whole.number = number
        return whole

    renderer: Any = SimpleNamespace(whole_sample=whole_sample, render=render, training_sample=lambda *said: said)
    source = ImageSpaceRenderer(renderer)
    assert source.training_sample((1, 2), "face", "128") == ((1, 2), "face", "128")  # type: ignore[comparison-overlap]
    by = np.array([[1.0, 0, -20], [0, 1, 0], [0, 0, 1]])
    for number in (4, 4, 7):
        sample: Any = SimpleNamespace(picture=number, by=by, crop=SimpleNamespace(shape=(16, 16)))
        uv, picture = source.render(sample)
    assert drawn == [4, 7]
    columns = (np.arange(16) + 0.5 + 20 - 16) / 2 - 0.5
    assert np.abs(uv[4, :, 0] - 0.01 * columns).max() < 1e-6
    assert np.abs(picture[4, :, 0].astype(float) - 8 * columns).max() <= 1
    assert image_space.VALIDATION_SIZE == "256"
