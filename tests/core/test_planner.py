"""The planner: shapes, densities and hysteresis, worked out by hand on a picture of 640x480."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from trilane.errors import BadInputError
from trilane.scene.crop import SCREEN, Rect, grow_on_grid, on_grid
from trilane.scene.planner import PATIENCE, Held, foreseen_shape, plan_tensor
from trilane.scene.shape_set import ShapeSet, choose_shapes, serves
from trilane.scene.tensor_layout import MARGIN_PX, lay_out_at, tight_shape

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
            assert low >= -1.0 - 1e-9
            assert high <= 1.0 + 1e-9


def test_at_full_density_a_tensor_pixel_is_a_pixel_of_the_picture() -> None:
    """A body of 100x300 pixels in a tensor of 128x320: 1 to 1, with 14 columns and 10 rows of background round it."""
    dense = lay_out_at([pixels(200, 100, 100, 300)], OUTPUT, (320, 128))
    assert dense is not None
    assert dense.density == 1.0
    ((rect, cell),) = dense.layout.crops
    assert in_pixels(rect) == pytest.approx((186, 90, 128, 320), abs=1e-9)
    assert cell == (0, 0, 320, 128)


def test_a_tensor_that_is_too_small_is_less_dense() -> None:
    """400x200 pixels in 256x128: 0.64 tensor pixels for one of the picture, by the width and by the height alike."""
    dense = lay_out_at([pixels(100, 40, 200, 400)], OUTPUT, (256, 128))
    assert dense is not None
    assert dense.density == pytest.approx(0.64)
    rect = dense.layout.crops[0][0]
    assert in_pixels(rect) == pytest.approx((100, 40, 200, 400), abs=1e-6)


def test_no_tensor_is_denser_than_the_picture() -> None:
    dense = lay_out_at([pixels(300, 200, 10, 20)], OUTPUT, (256, 256))
    assert dense is not None
    assert dense.density == 1.0
    assert in_pixels(dense.layout.crops[0][0])[2:] == pytest.approx((256, 256))


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


def test_five_avatars_in_a_tensor_of_32_pixels_have_no_room() -> None:
    assert lay_out_at([pixels(10 * k, 0, 5, 5) for k in range(5)], OUTPUT, (32, 32)) is None


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


def test_a_foreseen_shape_is_never_larger_than_allowed() -> None:
    """The whole screen, 480x640, is 307,200 pixels: more than 512². The widest that fits is 448x576 (density 0.9)."""
    assert foreseen_shape([pixels(0, 0, 100, 300)], OUTPUT, 512) == (320, 128)
    assert foreseen_shape([SCREEN], OUTPUT, 512) == (448, 576)


# --- one frame after the other --------------------------------------------------------------------------------------

SMALL, TALL, LARGE = (128, 128), (256, 128), (512, 512)


def test_the_smallest_shape_that_is_dense_enough_is_taken() -> None:
    shapes = [LARGE, TALL, SMALL]
    for rect, expected in ((pixels(0, 0, 100, 100), SMALL), (pixels(0, 0, 100, 200), TALL), (SCREEN, LARGE)):
        assert plan_tensor([rect], OUTPUT, shapes, None).held == Held(expected)


def test_a_larger_shape_is_taken_at_once_and_a_smaller_one_after_a_while() -> None:
    """Of 30 frames the first and the second ten show a small body, and frame 5 a tall one."""
    held, taken = None, []
    for frame in range(30):
        rect = pixels(0, 0, 100, 200 if frame == 5 else 100)
        plan = plan_tensor([rect], OUTPUT, [SMALL, TALL], held)
        held = plan.held
        taken.append(plan.dense.layout.shape)
    assert taken == [SMALL] * 5 + [TALL] * (1 + PATIENCE) + [SMALL] * (24 - PATIENCE)


def test_a_shape_that_is_needed_again_is_kept() -> None:
    """The frames for which a smaller one would have done are counted anew."""
    held: Held | None = Held(TALL, PATIENCE)
    held = plan_tensor([pixels(0, 0, 100, 200)], OUTPUT, [SMALL, TALL], held).held
    assert held == Held(TALL, 0)
    assert plan_tensor([pixels(0, 0, 9, 9)], OUTPUT, [SMALL, TALL], held).held == Held(TALL, 1)


def test_a_wanted_density_makes_a_smaller_shape_do() -> None:
    plan = plan_tensor([pixels(0, 0, 200, 200)], OUTPUT, [SMALL, LARGE], None, density=0.5)
    assert (plan.held.shape, plan.dense.density) == (SMALL, 0.5)


def test_a_shape_that_is_no_longer_ready_is_let_go() -> None:
    assert plan_tensor([pixels(0, 0, 50, 50)], OUTPUT, [TALL], Held(SMALL)).held == Held(TALL)


def test_no_room_for_all_is_an_error() -> None:
    rects = [pixels(10 * k, 0, 5, 5) for k in range(5)]
    with pytest.raises(BadInputError, match=r"tensor shapes.*room for 5 avatars.*use a larger --size"):
        plan_tensor(rects, OUTPUT, [(32, 32)], None)


@given(boxes, SHAPES)
def test_no_ready_shape_would_have_been_denser_or_as_dense_and_smaller(
    rect: Rect, shapes: list[tuple[int, int]]
) -> None:
    plan = plan_tensor([rect], OUTPUT, shapes, None)
    chosen, density = plan.held.shape, plan.dense.density
    assert density <= 1.0
    for shape in shapes:
        other = lay_out_at([rect], OUTPUT, shape)
        assert other is not None
        assert other.density <= density * (1 + 1e-5)
        if other.density >= density * (1 + 1e-12):
            continue
        assert other.density < density or shape[0] * shape[1] >= chosen[0] * chosen[1]


# --- which shapes are made ready -------------------------------------------------------------------------------------


def test_one_size_of_body_needs_one_shape() -> None:
    assert choose_shapes([(320, 128)] * 9, 512**2, 100.0, 10**9) == ShapeSet(((320, 128),), 4_096_000, False)


def test_a_further_shape_has_to_save_enough() -> None:
    """99 frames of 64x64 and one of 512x512: both. The other way round a small shape saves 1 % and is not worth it."""
    often_small = [(64, 64)] * 99 + [(512, 512)]
    assert choose_shapes(often_small, 512**2, 1.0, 10**9).shapes == ((64, 64), (512, 512))
    seldom_small = [(64, 64)] + [(512, 512)] * 99
    assert choose_shapes(seldom_small, 512**2, 1.0, 10**9).shapes == ((512, 512),)


def test_memory_and_number_are_limits() -> None:
    """Shapes of 1,024, 4,096 and 16,384 pixels at 1 byte each; the first must serve all, then the best that fits."""
    frames = [(32, 32)] * 10 + [(64, 64)] * 10 + [(128, 128)] * 10
    assert choose_shapes(frames, 512**2, 1.0, 10**9).shapes == ((32, 32), (64, 64), (128, 128))
    assert choose_shapes(frames, 512**2, 1.0, 20_480) == ShapeSet(((64, 64), (128, 128)), 20_480, False)
    assert choose_shapes(frames, 512**2, 1.0, 20_479).shapes == ((128, 128),)
    assert choose_shapes(frames, 512**2, 1.0, 10**9, most_shapes=2).shapes == ((64, 64), (128, 128))
    assert choose_shapes(frames, 512**2, 1.0, 16_383) == ShapeSet(((128, 128),), 16_384, True)


def test_tall_and_wide_bodies_have_one_shape_unless_it_is_too_large() -> None:
    """Room for 64x512 and 512x64 at once is 512x512; with at most 256² pixels each has its own."""
    frames = [(64, 512), (512, 64)]
    assert (512, 512) in choose_shapes(frames, 512**2, 1.0, 10**9).shapes
    assert choose_shapes(frames, 256**2, 1.0, 10**9).shapes == ((64, 512), (512, 64))


@given(SHAPES, st.integers(0, 10**6))
def test_every_frame_is_served(frames: list[tuple[int, int]], memory: int) -> None:
    chosen = choose_shapes(frames, 512**2, 1.0, memory)
    assert all(any(serves(shape, tight) for shape in chosen.shapes) for tight in frames)
    assert chosen.over_limit == (chosen.memory_bytes > memory)
