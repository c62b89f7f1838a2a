"""Layers over a background: places by hand, blending by closed form."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest

from trilane.bench.lib.cast import (
    Box,
    RasterLayer,
    blended,
    box_around,
    enlarged,
    grown,
    placed,
    premultiplied,
    shrunk,
)
from trilane.bench.lib.full_picture import fineness
from trilane.scene.crop import Rect

CODES = np.arange(256, dtype=np.uint8)


def layer(box: Box, rgba: tuple[float, float, float, float], depth: float = -1.0) -> RasterLayer:
    return RasterLayer(box, depth, premultiplied(np.tile(np.array(rgba), (*box.shape, 1))))


def test_a_box_is_whole_pixels_around_the_rectangle_in_multiples_of_32() -> None:
    """Of 100 x 200 pixels: rows 20.5 to 50.5 are 20 to 51, 31 of them, one more below; columns 99.2 to 132 are 33."""
    rect = Rect(x0=-0.008, x1=0.32, y0=-0.01, y1=0.59)
    assert box_around(rect, (100, 200)) == Box(top=20, left=84, bottom=52, right=148)
    exact = Rect(x0=-1.0, x1=-0.68, y0=0.36, y1=1.0)
    assert box_around(exact, (100, 200)) == Box(0, 0, 32, 32)


def test_the_rectangle_of_a_box_is_where_its_pixels_are() -> None:
    assert Box(25, -50, 75, 150).rect((100, 200)) == Rect(-1.5, -0.5, 0.5, 0.5)
    assert Box(25, -50, 75, 250).on((60, 200)) == Box(25, 0, 60, 200)


def test_a_box_grows_evenly_to_a_coarser_grid_and_knows_the_rectangle_that_it_came_from() -> None:
    """Of 96 x 64 pixels to multiples of 64: 16 rows on either side. One row too many goes to the end."""
    box = Box(10, 20, 106, 84)
    wide = grown(box, 64)
    assert wide == Box(-6, 20, 122, 84)
    assert grown(Box(0, 0, 31, 33), 32) == Box(0, -15, 32, 49)
    assert wide.within(box) == pytest.approx((-1, -1 - 32 / 96, 1, 1 + 32 / 96))
    assert Box(10, 20, 58, 36).within(box) == pytest.approx((-1, 0, -0.5, 1))


@pytest.mark.parametrize(
    ("shape", "area", "times"),
    [
        ((256, 256), 65536, 1),
        ((160, 96), 65536, 2),  # of 65536: 0.94, and thrice 2.1
        ((96, 128), 65536, 2),  # 0.75 is nearer than 1.69
        ((32, 32), 65536, 8),
        ((320, 288), 65536, 1),  # 1.41 is nearer than 0.35
        ((640, 480), 65536, Fraction(1, 2)),  # 1.17; a third would be 0.52
        ((640, 640), 65536, Fraction(1, 3)),  # 0.69 is nearer than 1.56
        ((32, 64), 4096, 1),  # 0.5 and 2 are as near: the smaller tensor
        ((64, 128), 4096, 1),  # the same of 2 and 0.5: the finer one, which loses nothing
    ],
)
def test_the_tensor_is_as_near_to_the_area_of_the_network_as_whole_pixels_allow(
    shape: tuple[int, int], area: int, times: Fraction
) -> None:
    assert fineness(shape, area) == times
    got = max(shape[0] * shape[1] * times**2, area) / min(shape[0] * shape[1] * times**2, area)
    for other in (*range(1, 9), *(Fraction(1, n) for n in range(2, 9))):
        there = shape[0] * shape[1] * other**2
        assert got <= max(there, area) / min(there, area)


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


def test_one_row_becomes_two_by_hand() -> None:
    """The middles of four pixels over two lie at -1/4, 1/4, 3/4 and 5/4 of their distance."""
    pair = np.array([[[0.0], [1.0]]])
    assert np.array_equal(enlarged(pair, 2), np.array([[[0], [0.25], [0.75], [1]]] * 2))
    assert np.array_equal(enlarged(pair.swapaxes(0, 1), 2), np.array([[[v]] * 2 for v in (0, 0.25, 0.75, 1)]))
    thirds = enlarged(pair, 3)[0, :, 0]
    assert thirds == pytest.approx([0, 0, 1 / 3, 2 / 3, 1, 1])


@pytest.mark.parametrize("factor", [1, 2, 3, 4])
def test_a_ramp_stays_a_ramp_and_a_constant_a_constant_when_enlarged(factor: int) -> None:
    """At the middle of picture pixel i the ramp has its value at (i + 1/2) / factor - 1/2: nothing is shifted."""
    shape = (5, 7)
    rows, columns = np.indices(shape).astype(float)
    light = np.stack([2 + 3 * rows - columns, np.full(shape, 0.3)], axis=-1)
    own = enlarged(light, factor)
    assert own.shape == (5 * factor, 7 * factor, 2)
    row, column = ((place + 0.5) / factor - 0.5 for place in np.indices(own.shape[:2]))
    clear = (row >= 0) & (row <= 4) & (column >= 0) & (column <= 6)
    assert clear[factor:-factor, factor:-factor].all()
    assert np.abs(own[..., 0] - (2 + 3 * row - column))[clear].max() < 1e-12
    assert own[..., 1] == pytest.approx(0.3)
    # Beyond the outermost middles the value goes on: the corner is the corner's.
    assert own[0, 0, 0] == light[0, 0, 0] and own[-1, -1, 0] == light[-1, -1, 0]
    # What was enlarged and is shrunk again is a ramp away from the border: a square has its pixel's value as mean.
    assert shrunk(own, factor)[1:-1, 1:-1] == pytest.approx(light[1:-1, 1:-1])


@pytest.mark.parametrize("times", [1, 2, 3])
def test_what_lies_on_the_grid_is_placed_as_it_is_enlarged_and_shrunk(times: int) -> None:
    """So the reference's two ways and the run's one are one filter: bilinear, or means of whole pixels."""
    light = np.random.default_rng(times).uniform(0, 1, (12, 24, 4))
    output = (40, 80)
    box = Box(3, 5, 3 + 12 * times, 5 + 24 * times).on(output)
    found = placed(light, Box(3, 5, 3 + 12 * times, 5 + 24 * times).rect(output), output, -1.0)
    assert found.box == box
    assert found.light == pytest.approx(enlarged(light, times)[: box.shape[0], : box.shape[1]])
    small = placed(light, Box(3, 5, 3 + 12 // times, 5 + 24 // times).rect(output), output, -1.0)
    assert small.light == pytest.approx(shrunk(light, times))


def test_a_ramp_is_placed_where_it_is() -> None:
    """In a rectangle on no grid: at the middle of each pixel the ramp's own value, but where it goes on as it ends."""
    output, rect = (30, 50), Rect(-0.513, -0.407, 0.618, 0.711)
    count = 16
    ramp = np.broadcast_to(((np.arange(count) + 0.5) / count)[None, :, None], (count, count, 1))
    found = placed(ramp.copy(), rect, output, 0.0)
    middles = (np.arange(found.box.left, found.box.right) + 0.5) / 50 * 2 - 1
    assert middles[0] >= rect.x0 > middles[0] - 2 / 50 and middles[-1] < rect.x1 <= middles[-1] + 2 / 50
    inside = (middles - rect.x0) / rect.width
    clear = np.abs(inside - 0.5) < 0.5 - 0.5 / count
    assert clear.sum() > 20
    assert found.light[:, clear, 0] == pytest.approx(np.broadcast_to(inside[clear], found.light[:, clear, 0].shape))
    rows = (1 - (np.arange(found.box.top, found.box.bottom) + 0.5) / 30 * 2, rect)
    assert rows[0][0] < rect.y1 and rows[0][-1] >= rect.y0
