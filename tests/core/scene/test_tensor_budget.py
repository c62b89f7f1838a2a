"""The pixels of a tensor by the measured curve, on a picture of 640x480; test_planner.py has the budget without one."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from trilane.scene.crop import SCREEN, Rect
from trilane.scene.planner import ideal_shape, plan_tensor
from trilane.scene.tensor_budget import MOST_DENSITY, TensorBudget, area, pixels_at

OUTPUT = (480, 640)
CURVE = ((64**2, 96**2), (128**2, 128**2), (256**2, 192**2))
MEASURED = TensorBudget(own=256 * 256, most=512 * 512, curves=(CURVE,))


def body(width: int, height: int, left: int = 0) -> Rect:
    return Rect(left / 320 - 1, 1 - height / 240, (left + width) / 320 - 1, 1.0)


sizes = st.integers(1, 4096)
curves = st.lists(st.tuples(sizes, sizes), min_size=1, max_size=6, unique_by=lambda knot: knot[0]).map(
    lambda knots: tuple(
        zip(sorted(64 * picture for picture, _ in knots), sorted(1024 + 16 * t for _, t in knots), strict=True)
    )
)


def test_the_curve_by_hand() -> None:
    """Half way between 64² and 128², in logarithms, is half way between 96² and 128².

    Smaller bodies have as many as the smallest, and larger ones the density of the largest, up to a limit that is never
    below the pixels of the largest.
    """
    found = [round(pixels_at(CURVE, side * side, 1.0)) for side in (1, 64, 128, 256)]
    assert found == [96**2, 96**2, 128**2, 192**2]
    assert pixels_at(CURVE, 64 * 128, 1.0) == pytest.approx(96 * 128)
    assert pixels_at(CURVE, 512**2, math.inf) == pytest.approx(384**2)
    assert pixels_at(CURVE, 512**2, 320**2) == 320**2
    assert pixels_at(CURVE, 512**2, 1.0) == CURVE[-1][1]


@given(curves, sizes, sizes)
def test_a_body_costs_what_its_neighbours_in_the_curve_cost(
    curve: tuple[tuple[int, int], ...], a: int, most: int
) -> None:
    """Also where the curve falls, as here, where it is read backwards."""
    falling = tuple(zip((picture for picture, _ in curve), (tensor for _, tensor in reversed(curve)), strict=True))
    for knots in (curve, falling):
        below = [tensor for picture, tensor in knots if picture <= 40 * a][-1:]
        above = [tensor for picture, tensor in knots if picture >= 40 * a][:1]
        highest = max(below + above) if above else max(most, knots[-1][1])
        assert min(below + above) * (1 - 1e-12) <= pixels_at(knots, 40 * a, most) <= highest * (1 + 1e-12)


@pytest.mark.parametrize(
    ("rect", "pixels", "density"),
    [
        (body(64, 256), 128**2, 1.0),
        (body(32, 128), 96**2, 1.5),
        (body(16, 64), 96**2, MOST_DENSITY),  # below the range: the density could be 3
        (body(128, 512 // 2), 154**2, None),
        (SCREEN, 102_400, None),  # beyond the range: 25/16 of the network's own
    ],
)
def test_a_body_has_the_pixels_and_the_density_of_the_curve(rect: Rect, pixels: int, density: float | None) -> None:
    assert MEASURED.of([rect], OUTPUT) == pytest.approx(pixels, rel=0.04)
    assert area(ideal_shape([rect], OUTPUT, MEASURED)) <= MEASURED.of([rect], OUTPUT)
    if density is not None:
        assert MEASURED.density([rect], OUTPUT) == pytest.approx(density)
        assert plan_tensor([rect], OUTPUT, [(512, 512)], MEASURED, None).dense.density == pytest.approx(density)


def test_a_curve_may_ask_for_more_than_the_limits() -> None:
    """Three tensor pixels along a side of a pixel of the picture, and four times the network's own pixels."""
    budget = TensorBudget(own=64 * 64, most=512 * 512, curves=(((32**2, 96**2), (64**2, 128**2)),))
    assert budget.of([body(32, 32)], OUTPUT) == 96**2 and budget.density([body(32, 32)], OUTPUT) == 3.0
    assert budget.of([body(64, 64)], OUTPUT) == 128**2 == budget.most_of(1)
    assert budget.density([body(16, 16)], OUTPUT) == 3.0  # below the range: 6, but the curve begins with 3


def test_several_bodies_have_the_density_of_all_and_room_between_them() -> None:
    """Each 128x128 with 128² pixels: side by side 128 x 274, in whole steps 160 x 288."""
    pair = [body(128, 128), body(128, 128, 300)]
    assert MEASURED.density(pair, OUTPUT) == 1.0
    assert MEASURED.of(pair, OUTPUT) == 160 * 288
    uneven = [body(64, 64), body(256, 256, 300)]
    assert MEASURED.density(uneven, OUTPUT) == pytest.approx(math.sqrt((96**2 + 192**2) / (64**2 + 256**2)))


def test_of_several_curves_the_one_with_the_most_pixels_counts() -> None:
    other = ((128**2, 160**2),)
    budget = TensorBudget(own=256 * 256, most=512 * 512, curves=(CURVE, other))
    assert budget.of([body(128, 128)], OUTPUT) == 160**2
    assert budget.of([body(256, 256)], OUTPUT) == 102_400  # 320² by the density of the other


def test_a_smaller_size_has_its_share_but_at_least_the_least_shape() -> None:
    assert MEASURED.scaled(563).of([body(128, 128)], OUTPUT) == 128**2 * 563 // 1000
    tiny = TensorBudget(own=64 * 64, most=512 * 512, work=250, curves=(((64**2, 48**2),),))
    assert tiny.of([body(8, 8)], OUTPUT) == 32 * 32
    assert ideal_shape([body(8, 8)], OUTPUT, tiny) == (32, 32)
