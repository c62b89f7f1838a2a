"""Image errors of pictures that are small enough to work out by hand."""

from __future__ import annotations

import numpy as np
import pytest

from trilane.arrays import psnr_db
from trilane.bench.lib import picture_error
from trilane.bench.lib.cast import Box
from trilane.bench.lib.picture_error import (
    PictureErrors,
    box_psnr_db,
    inside,
    psnr_of_frames,
    require_metrics,
)
from trilane.errors import MissingPartError

SHAPE = (24, 32, 3)


def grey(value: int) -> np.ndarray:
    return np.full(SHAPE, value, np.uint8)


def test_a_missing_library_is_named_with_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(picture_error, "MODULES", ("numpy", "no_such_module"))
    with pytest.raises(MissingPartError, match=r"no_such_module.*install") as caught:
        require_metrics()
    assert caught.value.exit_code == 3 and "metrics" in caught.value.install


def test_psnr_of_a_mean_square() -> None:
    assert psnr_db(0.01) == pytest.approx(20)
    assert psnr_db(0.0) == 100


def test_the_pixels_of_two_boxes_count_once() -> None:
    mask = inside([Box(0, 0, 4, 4), Box(2, 2, 6, 8)], grey(0))
    assert mask.sum() == 16 + 24 - 4 and mask[3, 3] and not mask[0, 5]


def test_psnr_in_boxes_is_of_their_pixels_alone() -> None:
    """Steps of 51, a fifth, in a quarter of the box's pixels: 0.04 / 4. Outside of it all is wrong."""
    picture = grey(255)
    picture[2:6, 2:10] = 100
    picture[2:4, 2:6] = 151
    assert box_psnr_db(picture, grey(100), [Box(2, 2, 6, 10)]) == pytest.approx(20)
    assert box_psnr_db(grey(7), grey(7), [Box(0, 0, 1, 1)]) == 100


def test_one_bad_frame_moves_the_worst_and_hardly_the_mean() -> None:
    """100 frames of 40 dB, then one of them 20: the mean falls by a fifth of a dB, the worst by 20. The 1st percentile
    lies at 0.99 of the way from the worst to the next one.
    """
    frames = [40.0] * 100
    assert psnr_of_frames(frames) == {"psnr_db": 40, "worst_psnr_db": 40, "p1_psnr_db": 40}
    frames[37] = 20.0
    found = psnr_of_frames(frames)
    assert found == pytest.approx({"psnr_db": 39.8, "worst_psnr_db": 20, "p1_psnr_db": 20 + 0.99 * 20})


class TestErrors:
    """The three errors over several pictures."""

    @pytest.fixture(autouse=True)
    def libraries(self) -> None:
        for module in picture_error.MODULES:
            pytest.importorskip(module)

    def test_nothing_differs(self) -> None:
        errors = PictureErrors()
        errors.add(grey(90), grey(90), [])
        found = errors.figures("fixed")
        assert found["psnr_fixed_db"] == 100
        assert found["ssim_fixed"] == pytest.approx(1) and found["flip_fixed"] == pytest.approx(0, abs=1e-6)
        assert [found[f"box_{name}"] for name in ("psnr_fixed_db", "ssim_fixed", "flip_fixed")] == [None] * 3

    def test_squares_of_all_pictures_are_taken_together(self) -> None:
        """Steps of 51, a fifth, in a quarter of one picture of two: 0.04 / 8 in all, 0.04 / 2 in the boxes."""
        picture, errors = grey(100), PictureErrors()
        picture[:12, :16] = 151
        box = [Box(0, 0, 12, 16)]
        errors.add(picture, grey(100), box)
        errors.add(grey(100), grey(100), box)
        found = errors.figures("planned")
        assert found["psnr_planned_db"] == pytest.approx(-10 * np.log10(0.04 / 8))
        assert found["box_psnr_planned_db"] == pytest.approx(-10 * np.log10(0.04 / 2))

    def test_ssim_of_pictures_of_one_grey_each(self) -> None:
        """Without variance it is (2ab + c) / (a² + b² + c), c = (0.01 · 255)²."""
        errors = PictureErrors()
        errors.add(grey(60), grey(180), [])
        c = 2.55**2
        assert errors.figures("x")["ssim_x"] == pytest.approx((2 * 60 * 180 + c) / (60**2 + 180**2 + c), abs=1e-6)

    def test_flip_grows_with_the_difference_and_is_of_the_place(self) -> None:
        """Black and white are almost as far apart as two pictures can be, and only the changed half is."""
        reference, near, far = grey(0), grey(0), grey(0)
        near[:, :16], far[:, :16] = 40, 255
        found = []
        for picture in (near, far):
            errors = PictureErrors()
            errors.add(picture, reference, [Box(0, 0, 24, 8)])
            found.append(errors.figures("x"))
        small, large = (one["box_flip_x"] for one in found)
        assert small is not None and large is not None
        assert 0 < small < large and 0.9 < large <= 1
        whole = found[1]["flip_x"]
        assert whole is not None and 0.4 < whole < 0.75
