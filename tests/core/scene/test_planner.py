"""The planner: shapes, densities and hysteresis, worked out by hand on a picture of 640x480."""

from __future__ import annotations

import math
from itertools import pairwise, product

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from trilane.arrays import shapes_within
from trilane.errors import BadInputError
from trilane.scene.crop import (
    MARGIN_PX,
    ROUNDING_PX,
    SCREEN,
    Rect,
    grow_on_grid,
    lay_out,
    lay_out_apart,
    lay_out_at,
    on_grid,
    tight_shape,
)
from trilane.scene.planner import (
    AS_GOOD,
    PATIENCE,
    Demand,
    HeldMesh,
    HeldShape,
    LookAhead,
    ShapeSet,
    choose_shapes,
    foreseen_changes,
    hold_mesh,
    ideal_shape,
    joined,
    larger_shapes,
    plan_tensor,
    serves,
)
from trilane.scene.tensor_budget import MOST_DENSITY, TensorBudget, area

OUTPUT = (480, 640)
SIDES = st.integers(1, 40).map(lambda steps: 32 * steps)
SHAPES = st.lists(st.tuples(SIDES, SIDES), min_size=1, max_size=6)


def pixels(left: float, top: float, width: float, height: float) -> Rect:
    """A rectangle of the picture in its pixels, row 0 on top."""
    return Rect(left / 320 - 1, 1 - (top + height) / 240, (left + width) / 320 - 1, 1 - top / 240)


def in_pixels(rect: Rect) -> tuple[float, float, float, float]:
    """left, top, width, height."""
    return (rect.x0 + 1) * 320, (1 - rect.y1) * 240, rect.width * 320, rect.height * 240


boxes = st.tuples(st.floats(0, 600), st.floats(0, 440), st.floats(0.01, 640), st.floats(0.01, 480)).map(
    lambda b: pixels(b[0], b[1], min(b[2], 640 - b[0]), min(b[3], 480 - b[1]))
)


@pytest.mark.parametrize(
    ("rect", "expected"),
    [
        (pixels(10.2, 20.7, 5.0, 5.0), (10, 20, 6, 6)),
        (pixels(10, 20, 5, 5), (10, 20, 5, 5)),
        (pixels(10.25, 20.25, 0.1, 0.1), (10, 20, 1, 1)),
        (SCREEN, (0, 0, 640, 480)),
    ],
)
def test_a_rectangle_is_widened_to_whole_pixels(rect: Rect, expected: tuple[int, ...]) -> None:
    assert in_pixels(on_grid(rect, OUTPUT)) == pytest.approx(expected, abs=1e-9)


@pytest.mark.parametrize(
    ("rect", "size", "expected"),
    [
        (pixels(100, 100, 40, 200), (256, 64), (88, 72, 64, 256)),
        (pixels(0, 0, 40, 200), (256, 64), (0, 0, 64, 256)),
        (pixels(600, 280, 40, 200), (256, 64), (576, 224, 64, 256)),
        (pixels(0, 10, 640, 470), (512, 672), (-16, -11, 672, 512)),
        (pixels(0, 0, 1, 180), (480, 1), (0, 0, 1, 480)),
        (pixels(101, 100, 40, 200), (256, 65), (88, 72, 65, 256)),
    ],
)
def test_a_grown_rectangle_begins_on_a_pixel(rect: Rect, size: tuple[float, float], expected: tuple[int, ...]) -> None:
    """Centred on the rectangle, and moved onto the screen where it fits."""
    left, top, width, height = in_pixels(grow_on_grid(rect, OUTPUT, size))
    assert (width, height) == pytest.approx(expected[2:], abs=1e-9)
    assert (left, top) == pytest.approx(expected[:2], abs=1.0)
    assert left == pytest.approx(round(left), abs=1e-9)
    assert top == pytest.approx(round(top), abs=1e-9)


@given(boxes, st.floats(0, 300), st.floats(0, 300))
@example(pixels(0, 0, 1, 180), 300.0, 0.0)
@example(pixels(0, 121, 1, 239), 241.0, 0.0)
def test_a_grown_rectangle_holds_the_other(rect: Rect, more_rows: float, more_columns: float) -> None:
    """It has the size that was asked for, holds the rectangle, and lies on the screen when it fits."""
    whole = on_grid(rect, OUTPUT)
    _, _, width, height = in_pixels(whole)
    grown = grow_on_grid(whole, OUTPUT, (height + more_rows, width + more_columns))
    assert in_pixels(grown)[2:] == pytest.approx((width + more_columns, height + more_rows), abs=1e-6)
    for low, high, least, most in (
        (grown.x0, grown.x1, whole.x0, whole.x1),
        (grown.y0, grown.y1, whole.y0, whole.y1),
    ):
        assert low <= least + 1e-9
        assert high >= most - 1e-9
        if high - low <= 2.0:
            assert low >= -1.0 - 2 * ROUNDING_PX / 480
            assert high <= 1.0 + 2 * ROUNDING_PX / 480


def test_a_tensor_that_is_too_small_is_less_dense() -> None:
    """400x200 pixels in 256x128: 0.64 tensor pixels for one of the picture, by the width and by the height alike."""
    dense = lay_out_at([pixels(100, 40, 200, 400)], OUTPUT, (256, 128))
    assert dense is not None
    assert dense.density == pytest.approx(0.64)
    rect = dense.layout.crops[0][0]
    assert in_pixels(rect) == pytest.approx((100, 40, 200, 400), abs=1e-6)


def test_several_avatars_keep_the_pictures_density() -> None:
    """Two of 40x100 in one row: 80 + 16 columns and a pixel each for rounding; their cells are their own pixels.

    In two rows they need 218 by 41 pixels, and 224 x 64 is less than 128 x 128.
    """
    rects = [pixels(100, 100, 40, 100), pixels(400, 200, 40, 100)]
    assert tight_shape(rects, OUTPUT) == (224, 64)
    dense = lay_out_at(rects, OUTPUT, (128, 128))
    assert dense is not None
    assert dense.density == 1.0
    (first, cell), (second, other) = dense.layout.crops
    assert (cell[2:], other[2:]) == ((100, 40), (100, 40))
    assert other[1] - cell[1] == 40 + MARGIN_PX
    assert in_pixels(first) == pytest.approx((100, 100, 40, 100))
    assert in_pixels(second) == pytest.approx((400, 200, 40, 100))


@pytest.mark.parametrize(
    ("rects", "density", "expected"),
    [
        ([pixels(0, 0, 100, 300)], 1.0, (320, 128)),
        ([pixels(0, 0, 128, 320)], 1.0, (320, 128)),
        ([pixels(0, 0, 128.5, 320)], 1.0, (320, 160)),
        ([pixels(0, 0, 100, 300)], 0.5, (160, 64)),
        # three of 100x60: in one row 100 + 1 by 3 * 60 + 2 * 16 + 3 = 215; in two 218 by 138; in three 335 by 61
        # the last is more than four times as long as wide, and of the others the first has less area
        ([pixels(70 * k, 0, 60, 100) for k in range(3)], 1.0, (128, 224)),
        # of 20x100: 101 by 95, 218 by 58 and 335 by 21
        ([pixels(70 * k, 0, 20, 100) for k in range(3)], 1.0, (128, 96)),
        ([pixels(0, 70 * k, 630, 10) for k in range(2)], 1.0, (64, 640)),
    ],
)
def test_the_tight_shape(rects: list[Rect], density: float, expected: tuple[int, int]) -> None:
    """128 x 224 = 28,672 pixels, 224 x 160 = 35,840, and 352 x 64 = 22,528.

    Two of 630x10 are too long in any arrangement: 38 by 631 pixels, or 11 by 1278.
    """
    assert tight_shape(rects, OUTPUT, density) == expected


@given(st.lists(boxes, min_size=1, max_size=5))
def test_the_tight_shape_has_room_at_full_density(rects: list[Rect]) -> None:
    dense = lay_out_at(rects, OUTPUT, tight_shape(rects, OUTPUT))
    assert dense is not None
    assert dense.density == pytest.approx(1.0)


# --- the pixels of a tensor ------------------------------------------------------------------------------------------

OWN = TensorBudget(own=256 * 256, most=512 * 512)


def test_each_avatar_has_its_networks_pixels_up_to_a_limit() -> None:
    dot = pixels(0, 0, 1, 1)
    assert [OWN.of([dot] * count, OUTPUT) for count in (1, 2, 4, 5, 8)] == [65_536, 131_072] + [262_144] * 3


@pytest.mark.parametrize(
    ("rect", "expected"),
    [
        (pixels(0, 0, 100, 300), 65_536),  # in whole steps 320x128, which is less
        (pixels(0, 0, 224, 436), 448 * 224),
        (pixels(0, 0, 225, 480), 102_400),  # 480x256 is 122,880, and 25/16 of its own are 102,400
        (SCREEN, 102_400),
    ],
)
def test_a_body_that_the_picture_shows_larger_gets_more(rect: Rect, expected: int) -> None:
    """Two of them have twice as much between them; three quarters of the sides are 563 thousandths of it all."""
    assert OWN.of([rect], OUTPUT) == expected <= OWN.most_of(1) == 102_400
    assert OWN.scaled(563).of([rect], OUTPUT) == expected * 563 // 1000 <= OWN.scaled(563).most_of(1)
    assert OWN.of([SCREEN, rect], OUTPUT) == 204_800 == OWN.most_of(2)
    assert TensorBudget(256 * 256, 300 * 300).of([rect], OUTPUT) == min(expected, 90_000)


@pytest.mark.parametrize(
    ("rects", "expected"),
    [
        # 100x300: of 512x128, 384x160, 320x192 ... the second is the densest, 384 / 300 = 1.28
        ([pixels(0, 0, 100, 300)], (384, 160)),
        # the whole screen, 480x640, in 102,400 pixels: 288x352 at 0.55, 256x384 at 0.53, 320x320 at 0.5
        ([SCREEN], (288, 352)),
        # two of 100x300 beside each other, within 131,072 pixels, with a margin of 16 and a pixel each for rounding:
        # 448x288 at (288 - 18) / 200 = 1.35; 384x320 at (384 - 1) / 300 = 1.28; 480x256 at 1.19
        ([pixels(0, 0, 100, 300), pixels(200, 0, 100, 300)], (448, 288)),
        # 8x20: 2.25 times as dense is 45x18, which 64x32 has room for; nothing larger is of use
        ([pixels(0, 0, 8, 20)], (64, 32)),
    ],
)
def test_the_ideal_shape_by_hand(rects: list[Rect], expected: tuple[int, int]) -> None:
    assert ideal_shape(rects, OUTPUT, OWN) == expected


@given(st.lists(boxes, min_size=1, max_size=3))
def test_no_other_shape_within_the_budget_is_denser(rects: list[Rect]) -> None:
    ideal = ideal_shape(rects, OUTPUT, OWN)
    most = OWN.of(rects, OUTPUT)
    assert area(ideal) <= most
    fit = lay_out_at(rects, OUTPUT, ideal, MOST_DENSITY)
    others = [lay_out_at(rects, OUTPUT, shape, MOST_DENSITY) for shape in shapes_within(most)]
    densest = max(other.density for other in others if other is not None)
    assert fit is not None
    assert fit.density >= densest
    assert fit.density <= MOST_DENSITY


def test_shapes_within_an_area_that_is_no_square() -> None:
    """5,000 pixels: 32x128 (32x156 is the widest), 64x64 and 128x32; 96x32 is held by the last."""
    assert shapes_within(5_000) == [(32, 128), (64, 64), (128, 32)]
    assert shapes_within(32 * 32) == [(32, 32)]


# --- one frame after the other --------------------------------------------------------------------------------------

SMALL, TALL, LARGE = (128, 128), (256, 128), (512, 512)
TWO = TensorBudget(own=128 * 256, most=512 * 512)


def held_for(rect: Rect, shapes: list[tuple[int, int]], before: HeldShape | None = None) -> HeldShape:
    return plan_tensor([rect], OUTPUT, shapes, TWO, before).held


def test_the_densest_shape_within_the_budget_is_taken() -> None:
    """A square body is as dense in 128x128 as in 256x128, which has more pixels; 512x512 has too many for one."""
    shapes = [LARGE, TALL, SMALL]
    assert held_for(pixels(0, 0, 100, 100), shapes) == HeldShape(SMALL)
    assert held_for(pixels(0, 0, 100, 200), shapes) == HeldShape(TALL)
    pair = [pixels(0, 0, 100, 200), pixels(300, 0, 100, 200)]
    budget = TensorBudget(own=512 * 256, most=512 * 512)
    assert plan_tensor(pair, OUTPUT, shapes, budget, None).held == HeldShape(LARGE)


def test_a_larger_shape_is_taken_at_once_and_a_smaller_one_after_a_while() -> None:
    """Of 30 frames frame 5 alone shows a tall body, for which the large shape is twice as dense."""
    held, taken = None, []
    for frame in range(30):
        rect = pixels(0, 0, 100, 200 if frame == 5 else 100)
        plan = plan_tensor([rect], OUTPUT, [SMALL, TALL], TWO, held)
        held = plan.held
        taken.append(plan.dense.layout.shape)
    assert taken == [SMALL] * 5 + [TALL] * (1 + PATIENCE) + [SMALL] * (24 - PATIENCE)


def test_of_shapes_with_as_many_pixels_the_held_one_stays_while_it_is_good() -> None:
    """A square in 128x256 and in 256x128: both are 128 pixels high at most."""
    shapes = [(128, 256), (256, 128)]
    for shape in shapes:
        assert held_for(pixels(0, 0, 100, 100), shapes, HeldShape(shape, None, 3)) == HeldShape(shape)


def test_no_tensor_is_denser_than_makes_a_better_picture() -> None:
    """A body of 60x20 pixels has 135x45 of the tensor, so the ideal shape is 160x64, not one of the network's 256²."""
    plan = plan_tensor([pixels(0, 0, 10, 10)], OUTPUT, [SMALL], TWO, None)
    assert plan.dense.density == MOST_DENSITY == 2.25
    assert ideal_shape([pixels(100, 100, 20, 60)], OUTPUT, OWN) == (160, 64)


def test_no_room_for_all_is_an_error() -> None:
    rects = [pixels(10 * k, 0, 5, 5) for k in range(5)]
    with pytest.raises(BadInputError, match=r"tensor shapes.*room for 5 avatars.*use a larger --size"):
        plan_tensor(rects, OUTPUT, [(32, 32)], TWO, None)


def test_bodies_of_two_networks_have_a_tensor_each() -> None:
    """Each has 128/200 in a square of its own; one above the other they have 127/200 in 256x128."""
    bodies, shapes = [pixels(0, 0, 100, 200), pixels(300, 0, 200, 100)], [LARGE, TALL, SMALL]
    together = plan_tensor(bodies, OUTPUT, shapes, TWO, None, networks=[1, 1])
    assert together.dense.layout.shape == TALL and together.dense.density == pytest.approx(0.635)
    plan = plan_tensor(bodies, OUTPUT, shapes, TWO, None, networks=[4, 1])
    assert plan.dense.layout.shape == SMALL and plan.dense.density == pytest.approx(0.64)
    for (crop, cell), body in zip(plan.dense.layout.crops, bodies, strict=True):
        alone = lay_out_at([body], OUTPUT, SMALL, MOST_DENSITY)
        assert alone is not None and (crop, cell) == alone.layout.crops[0]

    def density(shape: tuple[int, int]) -> float:
        return min(shape[0] / 200, shape[1] / 100, shape[0] / 100, shape[1] / 200)

    ideal = ideal_shape(bodies, OUTPUT, TWO, [0, 1])
    assert area(ideal) <= TWO.own and density(ideal) == max(map(density, shapes_within(TWO.own)))


@given(st.lists(boxes, min_size=2, max_size=4), st.data())
def test_a_fixed_tensor_of_each_network_is_filled_as_if_it_were_alone(rects: list[Rect], data: st.DataObject) -> None:
    networks = data.draw(st.lists(st.sampled_from([0, 2]), min_size=len(rects), max_size=len(rects)))
    buckets = [(512, 256), (256, 512)]
    layout = lay_out_apart(rects, networks, OUTPUT, buckets)
    assert layout.shape in buckets
    for network in set(networks):
        places = [place for place, one in enumerate(networks) if one == network]
        own = lay_out([rects[place] for place in places], OUTPUT, [layout.shape])
        assert [layout.crops[place] for place in places] == list(own.crops)
    if len(set(networks)) == 1:
        assert layout == lay_out(rects, OUTPUT, buckets)


@given(boxes, SHAPES)
def test_no_ready_shape_is_much_denser_and_none_as_good_is_smaller(rect: Rect, shapes: list[tuple[int, int]]) -> None:
    everything = TensorBudget(own=10**9, most=10**9)
    plan = plan_tensor([rect], OUTPUT, shapes, everything, None)
    chosen, density = plan.held.shape, plan.dense.density
    fits = [(shape, lay_out_at([rect], OUTPUT, shape, MOST_DENSITY)) for shape in shapes]
    densest = max(fit.density for _, fit in fits if fit is not None)
    assert density >= AS_GOOD * densest
    for shape, fit in fits:
        if fit is not None and fit.density >= AS_GOOD * densest:
            assert area(shape) >= area(chosen)


def test_a_foreseen_shape_is_taken_at_once_and_then_kept() -> None:
    """A square body is good in both; the small one is not taken, however long it would do."""
    held = held_for(pixels(0, 0, 100, 100), [SMALL, TALL], HeldShape(SMALL))
    assert held == HeldShape(SMALL)
    for _ in range(2 * PATIENCE):
        held = plan_tensor([pixels(0, 0, 100, 100)], OUTPUT, [SMALL, TALL], TWO, held, TALL).held
        assert held == HeldShape(TALL, TALL)


def test_a_foreseen_shape_that_is_not_good_waits_until_it_is() -> None:
    """A tall body is half as dense in the small shape, so the tall one is held; it comes with the first low body."""
    held: HeldShape | None = HeldShape(TALL, TALL)
    for height, expected in ((200, TALL), (200, TALL), (100, SMALL)):
        plan = plan_tensor([pixels(0, 0, 100, height)], OUTPUT, [SMALL, TALL], TWO, held, SMALL)
        held = plan.held
        assert held.shape == expected
    assert held == HeldShape(SMALL, SMALL)


def test_a_frame_that_was_foreseen_wrongly_gets_a_good_shape_and_keeps_it() -> None:
    """For one tall body the tall shape is taken; the foreseen small one comes back with what is foreseen next."""
    held = plan_tensor([pixels(0, 0, 100, 200)], OUTPUT, [SMALL, TALL], TWO, HeldShape(SMALL, SMALL), SMALL).held
    assert held == HeldShape(TALL, SMALL)
    held = plan_tensor([pixels(0, 0, 100, 100)], OUTPUT, [SMALL, TALL], TWO, held, SMALL).held
    assert held == HeldShape(TALL, SMALL)
    wide = (128, 130)
    assert plan_tensor([pixels(0, 0, 99, 99)], OUTPUT, [SMALL, TALL, wide], TWO, held, wide).held == HeldShape(
        wide, wide
    )


# --- changes that are foreseen ---------------------------------------------------------------------------------------

WIDE = (128, 256)
FOR_TWO = TensorBudget(own=128 * 256, most=512 * 512)


def tall(left: float = 0.0) -> Rect:
    return pixels(left, 0, 100, 200)


def square(left: float = 0.0) -> Rect:
    """As dense in `TALL` as in `WIDE`."""
    return pixels(left, 0, 128, 128)


def wide(left: float = 0.0) -> Rect:
    return pixels(left, 0, 200, 100)


def looks_at(rects: list[Rect | None], apart: int = 3) -> list[LookAhead]:
    return [LookAhead(apart * k, {} if rect is None else {0: rect}) for k, rect in enumerate(rects)]


def foreseen(rects: list[Rect | None], *shapes: tuple[int, int]) -> tuple[tuple[int, tuple[int, int]], ...]:
    return foreseen_changes(looks_at(rects), OUTPUT, shapes, FOR_TWO)


def test_a_change_that_is_needed_is_made_early() -> None:
    """The tall shape is no good at the last look, so the wide one comes in the frame behind the look before. There
    the body moves by 250 pixels, before it by 28.
    """
    rects = [pixels(0, 0, 100, 140), square(), square(), pixels(250, 0, 140, 100)]
    assert foreseen([*rects], TALL, WIDE) == ((0, TALL), (7, WIDE))
    assert foreseen([tall(), wide(), wide()], TALL, WIDE) == ((0, TALL), (1, WIDE))


def test_a_shape_that_is_good_for_all_spares_changes_where_they_cost_more_than_its_pixels() -> None:
    """130x100 pixels and 100x130 in turns. 160x128 and 128x160 are 1.23 times as dense each, and so is 160x160 for
    both. It has 5,120 pixels more, 15,360 in the three frames of a look. A change costs ten times 20,480, twice that
    for the density, which becomes 1.25 times as large, by 1 + 30 / 480 / 3 / 0.01: 132,817.
    """
    high, broad, both = (160, 128), (128, 160), (160, 160)
    assert larger_shapes([high, broad], 25_600) == [both]
    assert larger_shapes([high, broad], 25_599) == larger_shapes([high, both], 99_999) == []
    budget = TensorBudget(own=20_480, most=512 * 512)
    looks = looks_at([pixels(0, 0, 100, 130), pixels(0, 0, 130, 100)] * 3)
    assert foreseen_changes(looks, OUTPUT, [high, broad, both], budget) == ((0, both),)
    to_and_fro = [(0, high), (1, broad), (4, high), (7, broad), (10, high), (13, broad)]
    assert foreseen_changes(looks, OUTPUT, [high, broad], budget) == tuple(to_and_fro)


@given(
    st.lists(
        st.one_of(st.none(), st.tuples(st.integers(40, 220), st.integers(40, 220), st.integers(0, 300))),
        min_size=1,
        max_size=5,
    ),
    st.lists(st.sampled_from([SMALL, TALL, WIDE, (192, 192), (224, 160)]), min_size=1, max_size=3, unique=True),
)
def test_no_other_way_through_the_good_shapes_costs_less(
    rects: list[tuple[int, int, int] | None], shapes: list[tuple[int, int]]
) -> None:
    """All ways, one by one, each with its own cost: pixels, and ten own tensors for a change, less in motion."""
    looks = looks_at([None if one is None else pixels(one[2], 0, one[0], one[1]) for one in rects])
    fits = [
        {shape: lay_out_at([look.rects[0]], OUTPUT, shape, 2.25) for shape in shapes} if look.rects else {}
        for look in looks
    ]
    densities = [{shape: fit.density for shape, fit in each.items() if fit} for each in fits]

    def is_good(number: int, shape: tuple[int, int]) -> bool:
        if not looks[number].rects:
            return True
        within = FOR_TWO.of([looks[number].rects[0]], OUTPUT)
        fair = [d for one, d in densities[number].items() if area(one) <= within] or [*densities[number].values()]
        return densities[number][shape] >= 0.95 * max(fair)

    def cost(way: tuple[tuple[int, int], ...]) -> float:
        total = 0.0
        for number, shape in enumerate(way):
            if looks[number].rects:
                total += area(shape) * (3 if number + 1 < len(way) else 1)
        for number, (old, new) in enumerate(pairwise(way), start=1):
            if old != new and looks[number].rects and looks[number - 1].rects:
                a, b = in_pixels(looks[number - 1].rects[0]), in_pixels(looks[number].rects[0])
                sides = [abs(a[0] - b[0]) / 640, abs(a[0] + a[2] - b[0] - b[2]) / 640]
                sides += [abs(a[1] - b[1]) / 480, abs(a[1] + a[3] - b[1] - b[3]) / 480]
                denser = abs(math.log(densities[number][new] / densities[number][old], 1.25))
                total += 10 * 32_768 * (1 + denser) / (1 + max(sides) / 3 / 0.01)
        return total

    ways = [
        way
        for way in product(shapes, repeat=len(looks))
        if all(is_good(number, shape) for number, shape in enumerate(way))
    ]
    changes = foreseen_changes(looks, OUTPUT, shapes, FOR_TWO)
    assert changes[0][0] == 0 and all(a < b for (a, _), (b, _) in pairwise(changes))
    taken = tuple([shape for frame, shape in changes if frame <= look.frame][-1] for look in looks)
    assert cost(taken) == pytest.approx(min(map(cost, ways)))
    assert all(is_good(number, shape) for number, shape in enumerate(taken))


# --- which shapes are made ready -------------------------------------------------------------------------------------


def wanted(*shapes: tuple[int, int], pixels: int = 512**2) -> list[Demand]:
    return [Demand(shape, pixels) for shape in shapes]


def test_a_shape_serves_what_is_at_most_a_little_larger() -> None:
    """64 is more than 95 % of 67, and less than that of 68; a tensor beyond the frame's budget serves nothing."""
    assert serves((320, 64), Demand((320, 67), 10**6))
    assert not serves((320, 64), Demand((320, 68), 10**6))
    assert serves((304, 64), Demand((320, 64), 10**6))
    assert not serves((303, 64), Demand((320, 64), 10**6))
    assert serves((320, 64), Demand((320, 64), 320 * 64))
    assert not serves((320, 64), Demand((320, 64), 320 * 64 - 1))


def test_what_serves_most_frames_comes_first() -> None:
    """Nine tall frames and one wide one; with a single shape the wide frame is left unserved."""
    frames = wanted(*[(512, 128)] * 9, (128, 512), pixels=256**2)
    assert choose_shapes(frames, 1.0, 10**9) == ShapeSet(((128, 512), (512, 128)), 2 * 65_536, 0)
    assert choose_shapes(frames, 1.0, 10**9, most_shapes=1) == ShapeSet(((512, 128),), 65_536, 1)


def test_a_further_shape_has_to_save_enough() -> None:
    """99 frames of 64x64 and one of 512x512: both. The other way round a small shape saves 1 % and is not worth it."""
    often_small = wanted(*[(64, 64)] * 99, (512, 512))
    assert choose_shapes(often_small, 1.0, 10**9).shapes == ((64, 64), (512, 512))
    seldom_small = wanted((64, 64), *[(512, 512)] * 99)
    assert choose_shapes(seldom_small, 1.0, 10**9).shapes == ((512, 512),)


def test_two_sets_of_shapes_are_one() -> None:
    """The smallest first; frames without a shape are those of the first set, unless that is empty."""
    first, second = ShapeSet(((32, 64), (64, 64)), 5, 3), ShapeSet(((64, 32), (32, 32), (64, 64)), 7, 4)
    assert joined(first, second) == ShapeSet(((32, 32), (32, 64), (64, 32), (64, 64)), 12, 3)
    assert joined(ShapeSet((), 0, 9), second).unserved == 4


def test_shapes_that_are_optional_may_have_no_memory_at_all() -> None:
    demands = [Demand((64, 64), 64 * 64)]
    assert choose_shapes(demands, 1.0, 64 * 64 - 1, optional=True) == ShapeSet((), 0, 1)
    assert choose_shapes(demands, 1.0, 64 * 64, optional=True) == ShapeSet(((64, 64),), 64 * 64, 0)
    assert choose_shapes(demands, 1.5, 1) == ShapeSet(((64, 64),), 6144, 0)


def test_memory_is_a_limit_but_for_the_first_shape() -> None:
    """Shapes of 1,024, 4,096 and 16,384 pixels at 1 byte each: the largest serves all, then the best that fits."""
    frames = wanted(*[(32, 32)] * 10, *[(64, 64)] * 10, *[(128, 128)] * 10)
    assert choose_shapes(frames, 1.0, 10**9).shapes == ((32, 32), (64, 64), (128, 128))
    assert choose_shapes(frames, 1.0, 20_480) == ShapeSet(((64, 64), (128, 128)), 20_480, 0)
    assert choose_shapes(frames, 1.0, 20_479).shapes == ((128, 128),)
    assert choose_shapes(frames, 1.0, 1) == ShapeSet(((128, 128),), 16_384, 0)


@given(SHAPES, st.integers(0, 10**6))
def test_served_and_unserved_frames_add_up(frames: list[tuple[int, int]], memory: int) -> None:
    demands = wanted(*frames, pixels=2000**2)
    chosen = choose_shapes(demands, 1.0, memory)
    assert chosen.unserved == sum(not any(serves(shape, demand) for shape in chosen.shapes) for demand in demands)
    assert chosen.memory_bytes == sum(map(area, chosen.shapes))
    assert chosen.memory_bytes <= memory or len(chosen.shapes) == 1
    assert set(chosen.shapes) <= set(frames)


# --- levels of the mesh ----------------------------------------------------------------------------------------------


def test_the_first_frame_has_the_coarsest_mesh_within_the_budget() -> None:
    assert hold_mesh([0.0, 0.2, 0.5, 0.6], 0.5, None) == HeldMesh(2)


def test_a_mesh_beyond_the_budget_is_left_at_once_for_the_coarsest_that_is_not() -> None:
    assert hold_mesh([0.0, 0.4, 0.7, 0.9], 0.5, HeldMesh(3, 4)) == HeldMesh(1)
    assert hold_mesh([0.0, math.inf, math.inf, math.inf], 0.5, HeldMesh(3)) == HeldMesh(0)


def test_a_coarser_mesh_is_taken_step_by_step_after_the_frames_of_patience() -> None:
    """All three would do at once. Each step waits for ten frames, and the eleventh takes it."""
    held, levels = HeldMesh(0), []
    for _ in range(40):
        held = hold_mesh([0.0, 0.1, 0.2, 0.3], 0.5, held)
        levels.append(held.level)
    assert levels == [0] * 10 + [1] * 11 + [2] * 11 + [3] * 8


def test_a_mesh_near_the_budget_is_kept_but_not_taken() -> None:
    """0.45 is within the budget of 0.5 but not within four fifths of it; a frame like that starts the count again."""
    held = HeldMesh(0)
    for frame in range(30):
        held = hold_mesh([0.0, 0.45 if frame % 10 == 9 else 0.3], 0.5, held)
        assert held.level == 0
    assert hold_mesh([0.0, 0.45], 0.5, HeldMesh(1)) == HeldMesh(1)
