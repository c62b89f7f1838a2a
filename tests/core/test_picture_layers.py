"""Layers over a background: places by hand, blending by closed form."""

from __future__ import annotations

import numpy as np
import pytest

from trilane.bench.lib.full_picture import FINE_SIDE, fineness
from trilane.bench.lib.layers import Box, Layer, blended, box_around, premultiplied, shrunk, to_code, to_light
from trilane.stages.cpu.crop import Rect

CODES = np.arange(256, dtype=np.uint8)


def layer(box: Box, rgba: tuple[float, float, float, float], depth: float = -1.0) -> Layer:
    return Layer(box, depth, premultiplied(np.tile(np.array(rgba), (*box.shape, 1))))


def test_a_box_is_whole_pixels_around_the_rectangle_in_multiples_of_32() -> None:
    """Of 100 x 200 pixels: rows 20.5 to 50.5 are 20 to 51, 31 of them, one more below; columns 99.2 to 132 are 33."""
    rect = Rect(x0=-0.008, x1=0.32, y0=-0.01, y1=0.59)
    assert box_around(rect, (100, 200)) == Box(top=20, left=84, bottom=52, right=148)
    exact = Rect(x0=-1.0, x1=-0.68, y0=0.36, y1=1.0)
    assert box_around(exact, (100, 200)) == Box(0, 0, 32, 32)


def test_the_rectangle_of_a_box_is_where_its_pixels_are() -> None:
    assert Box(25, -50, 75, 150).rect((100, 200)) == Rect(-1.5, -0.5, 0.5, 0.5)
    assert Box(25, -50, 75, 250).on((60, 200)) == Box(25, 0, 60, 200)


@pytest.mark.parametrize(
    ("shape", "times"),
    [((160, 96), 3), ((96, 128), 4), ((257, 32), 1), ((256, 32), 2), ((640, 480), 1), ((32, 32), 16)],
)
def test_a_small_box_has_a_finer_tensor_of_at_most_512(shape: tuple[int, int], times: int) -> None:
    assert fineness(shape) == times
    assert times == 1 or max(shape) * times <= FINE_SIDE


def test_light_and_code_are_srgb() -> None:
    """IEC 61966-2-1: code 10 lies on the straight part, 128 on the curve; every byte comes back."""
    assert to_light(np.array([10 / 255, 128 / 255])) == pytest.approx([0.00303527, 0.21586050], abs=1e-8)
    assert np.array_equal(np.rint(to_code(to_light(CODES / 255.0)) * 255), CODES)
    assert to_code(np.array([-0.1, 1.1])) == pytest.approx([0, 1])


def test_half_of_white_over_black_is_half_the_light() -> None:
    """Light 0.5 is code 187.5: 188. Where nothing is, all bytes stay; so they do under a layer that is clear."""
    background = np.tile(CODES[:, None], (1, 5, 3)).reshape(256, 5, 3)
    background[100:104] = 0
    half, clear = layer(Box(100, 1, 102, 3), (1, 1, 1, 0.5)), layer(Box(150, 0, 256, 5), (1, 0, 0, 0))
    expected = background.copy()
    expected[100:102, 1:3] = 188
    assert np.array_equal(blended(background, [half, clear]), expected)


def test_the_nearer_layer_hides_the_farther_and_none_reaches_beyond_the_picture() -> None:
    background = np.zeros((6, 8, 3), np.uint8)
    far, near = layer(Box(-2, -3, 3, 4), (1, 0, 0, 1), -5.0), layer(Box(1, 2, 9, 12), (0, 0, 1, 1), -2.0)
    expected = background.copy()
    expected[:3, :4] = 255, 0, 0
    expected[1:, 2:] = 0, 0, 255
    for order in ([far, near], [near, far]):
        assert np.array_equal(blended(background, order), expected)


def test_colour_counts_by_its_alpha_when_pixels_become_one() -> None:
    """White with alpha 1 and black with alpha 0, one pixel in four white: a quarter of alpha, and no grey in it."""
    fine = np.zeros((2, 4, 4))
    fine[0, 0] = 1
    fine[:, 2:] = 1, 1, 1, 1
    once = shrunk(premultiplied(fine), 2)
    assert np.allclose(once, [[[0.25] * 4, [1] * 4]])
