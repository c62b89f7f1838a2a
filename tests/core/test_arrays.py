"""Sizes and shapes of tensors, by hand and by trying every pair of sides; the sRGB curve by its standard."""

from __future__ import annotations

import numpy as np
import pytest

from trilane.arrays import checked_size, parse_shape, shape_buckets, to_code, to_light
from trilane.unexpected_value import UnexpectedValue


def test_one_shape_is_itself() -> None:
    assert parse_shape("96x1024") == (96, 1024)
    assert shape_buckets("32x4096") == [(32, 4096)]
    assert checked_size("32x4096") == "32x4096"


def test_shapes_of_an_area_by_hand() -> None:
    """Of at most 64 x 64 = 4096 pixels: 32 high 128 wide, 64 by 64, 96 by 32 (42) is inside 128 by 32."""
    assert shape_buckets("64") == [(32, 128), (64, 64), (128, 32)]
    assert shape_buckets("32") == [(32, 32)]


def test_shapes_of_an_area_are_all_that_fit_and_no_more() -> None:
    """Another way: every pair of sides is tried."""
    for side in (96, 128, 160):
        sides = range(32, 4 * side, 32)
        fit = [(h, w) for h in sides for w in sides if h * w <= side * side and max(h, w) <= 4 * min(h, w)]
        kept = [(h, w) for h, w in fit if not any((b, v) != (h, w) and b >= h and v >= w for b, v in fit)]
        assert shape_buckets(str(side)) == kept


@pytest.mark.parametrize("size", ["0", "31", "33", "4128", "64x4128", "0x64", "64x48"])
def test_sides_out_of_range(size: str) -> None:
    with pytest.raises(UnexpectedValue, match=r"^found side \d+, expected a multiple of 32 from 32 to 4096$"):
        checked_size(size)


@pytest.mark.parametrize("size", ["64 x 64", "64x", "x", "-64", "64x64x64", "", "9" * 5000 + "x1", "9" * 5000])
def test_what_is_no_size(size: str) -> None:
    with pytest.raises(UnexpectedValue) as refused:
        shape_buckets(size)
    assert str(refused.value) == f"found {size!r}, expected HEIGHTxWIDTH such as 256x256"


def test_light_and_code_are_srgb() -> None:
    """IEC 61966-2-1: code 10 lies on the straight part, 128 on the curve; every byte comes back."""
    codes = np.arange(256)
    assert to_light(np.array([10 / 255, 128 / 255])) == pytest.approx([0.00303527, 0.21586050], abs=1e-8)
    assert np.array_equal(np.rint(to_code(to_light(codes / 255.0)) * 255), codes)
    assert to_code(np.array([-0.1, 1.1])) == pytest.approx([0, 1])
