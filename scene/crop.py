"""The crop: a rectangle of the screen, the tensor shape that fits it, its projection, and its place in the tensor.

Rectangles are x0, y0, x1, y1 in normalised device coordinates (NDC), y up. A tensor's pixels are square on the screen.

**Layout.** One visible avatar has the whole tensor. Several avatars are drawn at one scale in rows, so that each has
tensor pixels in proportion to its area on the screen. At least `MARGIN_PX` of background lie between them. `lay_out`
fills the tensor: it takes the largest scale at which all avatars fit. `lay_out_at` takes no scale beyond a given
density. At density 1, tensor pixels coincide with pixels of the picture, and the rest of the tensor is background.
Avatars of different networks have separate tensors of one shape; `apart` lays out the avatars of each network.

**Error.** `error_px` converts an error in metres to pixels, with a proved bound. Let a vertex have the clip coordinates
X, Y, W. Let r_x, r_y, r_w be the first three numbers of the clip matrix's rows 0, 1 and 3. With x = X / W and y = Y /
W, an error d of the vertex moves it on the picture by

    (x' - x, y' - y) = J d / (W + r_w . d),   with the rows r_x - x r_w and r_y - y r_w of J,

where x and y count in halves of the picture's sides. The largest stretch of J is convex in (x, y), so it is largest at
a corner of the picture. The error is at most that stretch, times |d| / (W - |d| |r_w|). For W, the least W of the body
is taken: a skinned vertex is a mean of points that are no farther from the centre of joint j than at rest
(`DetailBounds.reach`).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from trilane.arrays import BUCKET_STEP, F64, MOST_ASPECT, Shape
from trilane.body.joints import Posed
from trilane.errors import BadInputError

#: Least height and width of a crop, in pixels of the picture, however small the body is on the screen.
LEAST_PIXELS = 1.0
ROUNDING_PX = 1e-4  # a side at most this far beyond a pixel's edge counts as on the edge


class Rect(NamedTuple):
    """A rectangle with x0 < x1 and y0 < y1 in NDC, y up."""

    x0: float
    y0: float
    x1: float
    y1: float

    @property
    def width(self) -> float:
        return self.x1 - self.x0

    @property
    def height(self) -> float:
        return self.y1 - self.y0


SCREEN = Rect(-1.0, -1.0, 1.0, 1.0)


def choose_bucket(rect: Rect, output: Shape, buckets: Sequence[Shape]) -> tuple[Shape, Rect]:
    """Return (tensor shape that wastes the least area on `rect`, `rect` grown to the aspect ratio of that shape).

    The grown rectangle contains `rect`, and is moved onto the screen if it fits there. A side that is longer than the
    screen extends beyond both edges of the screen by the same length. Of two shapes that waste the same area, the
    larger one is chosen.

    `rect`: rectangle of the mesh.
    `output`: (height, width) of the picture in pixels.
    `buckets`: tensor shapes (height, width) to choose from.
    Raises BadInputError without buckets.
    """
    if not buckets:
        raise BadInputError("tensor shapes", "none", "at least one")
    height = max(rect.height * output[0] / 2.0, LEAST_PIXELS)
    width = max(rect.width * output[1] / 2.0, LEAST_PIXELS)

    def grown_area(shape: Shape) -> tuple[float, int]:
        scale = max(height / shape[0], width / shape[1])
        return round(shape[0] * shape[1] * scale * scale / (height * width), 9), -shape[0] * shape[1]

    shape = min(buckets, key=grown_area)
    scale = max(height / shape[0], width / shape[1])
    x0, x1 = grow(rect.x0, rect.x1, 2.0 * scale * shape[1] / output[1])
    y0, y1 = grow(rect.y0, rect.y1, 2.0 * scale * shape[0] / output[0])
    return shape, Rect(x0, y0, x1, y1)


def grow(low: float, high: float, length: float) -> tuple[float, float]:
    """Return the (lower, upper) end of an interval of `length` about the middle of [`low`, `high`], NDC.

    The interval is moved into [-1, 1] if it fits; otherwise it is centred on 0.
    """
    if length >= 2.0:
        return -length / 2.0, length / 2.0
    start = min(max((low + high - length) / 2.0, -1.0), 1.0 - length)
    return min(start, low), max(start + length, high)


def on_grid(rect: Rect, output: Shape) -> Rect:
    """Return `rect` widened to whole pixels of a picture of `output` (height, width), to at least one pixel."""
    x0, x1 = _whole_pixels(rect.x0, rect.x1, output[1])
    y0, y1 = _whole_pixels(rect.y0, rect.y1, output[0])
    return Rect(x0, y0, x1, y1)


def _whole_pixels(low: float, high: float, side: int) -> tuple[float, float]:
    first = math.floor((low + 1.0) / 2.0 * side + ROUNDING_PX)
    last = max(math.ceil((high + 1.0) / 2.0 * side - ROUNDING_PX), first + 1)
    return 2.0 * first / side - 1.0, 2.0 * last / side - 1.0


def grow_on_grid(rect: Rect, output: Shape, size: tuple[float, float]) -> Rect:
    """Return `rect`, which lies on the pixel grid of a picture of `output` (height, width), grown to `size`.

    `size`: (height, width) in pixels of the picture. The result begins on the grid; if `size` is whole, it also ends on
    the grid. `rect` stays in the middle of the result, except where the result must be moved to fit on the screen.
    """
    x0, x1 = _grow_from_pixel(rect.x0, rect.x1, size[1], output[1])
    y0, y1 = _grow_from_pixel(rect.y0, rect.y1, size[0], output[0])
    return Rect(x0, y0, x1, y1)


def _grow_from_pixel(low: float, high: float, length: float, side: int) -> tuple[float, float]:
    first, last = round((low + 1.0) / 2.0 * side), round((high + 1.0) / 2.0 * side)
    start = math.floor((first + last - length) / 2.0)
    if length < side + ROUNDING_PX:
        start = min(max(start, 0), math.floor(side - length + ROUNDING_PX))
    begin = min(max(float(start), last - length), first)
    return 2.0 * begin / side - 1.0, 2.0 * (begin + length) / side - 1.0


def crop_projection(projection: ArrayLike, rect: Rect) -> F64:
    """Return `projection` (4,4), followed by the map that stretches `rect` to the whole screen; depth does not change.

    In NDC, x' = (2 x - (x0 + x1)) / (x1 - x0). In clip space, X' = (2 X - (x0 + x1) W) / (x1 - x0), which is linear.
    Therefore the crop is exact for any projection.
    """
    after = np.eye(4)
    after[0, 0], after[0, 3] = 2.0 / rect.width, -(rect.x0 + rect.x1) / rect.width
    after[1, 1], after[1, 3] = 2.0 / rect.height, -(rect.y0 + rect.y1) / rect.height
    return np.asarray(after @ np.asarray(projection, np.float64))


def least_w(posed: Posed, clip: F64, reach: F64, blend_m: float = 0.0) -> float:
    """Return a lower bound on the clip coordinate W of all vertices; 0 or less if a vertex may be behind the camera.

    `posed`: the body's joints in this frame.
    `clip` (4,4): projection @ view.
    `reach` (55,): `DetailBounds.reach`, metres.
    `blend_m`: largest displacement of a vertex by pose blend shapes, metres.
    """
    centres = posed.joints @ clip[3, :3] + clip[3, 3]
    return float((centres - (reach + blend_m) * np.linalg.norm(clip[3, :3]))[reach > 0].min())


class Stretch(NamedTuple):
    """The effect of an error of one metre in the world, in any direction, at W = 1.

    `pixels`: largest displacement on the picture, pixels. `depth`: largest change of W.
    """

    pixels: float
    depth: float


def stretch_of(clip: ArrayLike, output: Shape) -> Stretch:
    """Return the stretch of `clip` (4,4), which is projection @ view, on a picture of `output` (height, width)."""
    x, y, _, depth = np.asarray(clip, np.float64)[:, :3]
    sides = output[1] / 2.0, output[0] / 2.0
    corners = ((x - at_x * depth, y - at_y * depth) for at_x in (-1.0, 1.0) for at_y in (-1.0, 1.0))
    pixels = max(_stretch(sides[0] * across, sides[1] * up) for across, up in corners)
    return Stretch(pixels, math.sqrt(depth @ depth))


def error_px(metres: float, stretch: Stretch, w: float) -> float:
    """Return the largest error on the picture, pixels, of a vertex that is off by `metres`.

    `stretch`: stretch of the picture. `w`: least clip coordinate W of the body. The result is infinite if a vertex may
    be behind the camera.
    """
    if metres == 0.0:
        return 0.0
    left = w - metres * stretch.depth
    return metres * stretch.pixels / left if left > 0.0 else math.inf


def _stretch(first: F64, second: F64) -> float:
    """Return the largest singular value of the matrix with rows `first` and `second` (3,)."""
    a, b, c = float(first @ first), float(second @ second), float(first @ second)
    return math.sqrt((a + b) / 2.0 + math.hypot((a - b) / 2.0, c))


def cheapest_within(errors_px: Sequence[float], budget_px: float) -> int:
    """Return the first index whose error is within the budget, or the last index if there is none.

    `errors_px`: error of each level, the level with the least work first.
    """
    return next((level for level, error in enumerate(errors_px) if error <= budget_px), len(errors_px) - 1)


#: A rectangle in a tensor: top, left, height, width in tensor pixels.
Cell = tuple[int, int, int, int]

#: Least background between two avatars, tensor pixels. At this distance, the default network paints each avatar as if
#: the other were not there. Measured by `trilane bench several`; figures are in docs/decisions/several-avatars.md.
MARGIN_PX = 16


@dataclass(frozen=True)
class TensorLayout:
    """The places of the avatars in a tensor.

    `shape`: (height, width) of the tensor. `crops`: crop rectangle and cell of each avatar, in the avatars' order.
    """

    shape: Shape
    crops: tuple[tuple[Rect, Cell], ...]


@dataclass(frozen=True)
class DenseLayout:
    """A layout and its `density`: the number of tensor pixels per picture pixel, along a side."""

    layout: TensorLayout
    density: float


@dataclass(frozen=True)
class _Arrangement:
    """An arrangement of the avatars in the rows of a tensor.

    `shape`: (height, width) of the tensor. `rows`: indices of the avatars in each row. `scale`: number of tensor pixels
    per picture pixel, along a side.
    """

    shape: Shape
    rows: tuple[tuple[int, ...], ...]
    scale: float


def lay_out(rects: Sequence[Rect], output: Shape, buckets: Sequence[Shape], margin_px: int = MARGIN_PX) -> TensorLayout:
    """Return the layout of the visible avatars in one tensor; margins shrink if the tensor is too small for them.

    `rects`: the avatars' mesh rectangles on the screen, at least one.
    `output`: (height, width) of the picture in pixels.
    `buckets`: tensor shapes (height, width) to choose from.
    `margin_px`: background between two avatars, tensor pixels.
    Raises BadInputError without buckets, or when no bucket has a pixel for every avatar.
    """
    if len(rects) == 1:
        shape, grown = choose_bucket(rects[0], output, buckets)
        return TensorLayout(shape, ((grown, (0, 0, *shape)),))
    sizes = [(max(r.height * output[0] / 2, LEAST_PIXELS), max(r.width * output[1] / 2, LEAST_PIXELS)) for r in rects]
    best = max(_arrangements(sizes, buckets, margin_px), key=lambda arrangement: arrangement.scale, default=None)
    if best is not None and best.scale > 0:
        return TensorLayout(best.shape, _crops(rects, sizes, output, best, margin_px))
    if margin_px == 0:
        raise _no_room(rects, buckets)
    return lay_out(rects, output, buckets, margin_px // 2)


def lay_out_at(rects: Sequence[Rect], output: Shape, shape: Shape, most_density: float = 1.0) -> DenseLayout | None:
    """Return the layout of the visible avatars in a tensor of `shape`; None if there is no room for all.

    `rects`: the avatars' mesh rectangles on the screen, at least one; each is widened to whole pixels of the picture.
    `output`: (height, width) of the picture in pixels.
    `shape`: (height, width) of the tensor.
    `most_density`: largest density of the layout.
    """
    whole = [on_grid(rect, output) for rect in rects]
    sizes = [_pixels(rect, output) for rect in whole]
    if len(rects) == 1:
        density = min(most_density, shape[0] / sizes[0][0], shape[1] / sizes[0][1])
        grown = grow_on_grid(whole[0], output, (shape[0] / density, shape[1] / density))
        return DenseLayout(TensorLayout(shape, ((grown, (0, 0, *shape)),)), density)
    best = max(_arrangements(sizes, [shape], MARGIN_PX), key=lambda one: min(one.scale, most_density))
    if best.scale <= 0:
        return None
    density = min(best.scale, most_density)
    scaled = _Arrangement(best.shape, best.rows, density)
    return DenseLayout(TensorLayout(shape, _crops(whole, sizes, output, scaled, MARGIN_PX)), density)


def by_network(networks: Sequence[int]) -> list[list[int]]:
    """Return, for each network, the indices of its avatars. `networks`: number of each visible avatar's network."""
    return [[place for place, one in enumerate(networks) if one == network] for network in sorted(set(networks))]


def apart(
    rects: Sequence[Rect], networks: Sequence[int], lay: Callable[[Sequence[Rect]], DenseLayout | None]
) -> DenseLayout | None:
    """Return a layout with a separate tensor for the avatars of each network; None if a tensor has too little room.

    `rects`: mesh rectangle of each visible avatar. `networks`: number of its network.
    `lay`: function that lays out the avatars of one network, always in a tensor of the same shape.
    The density of the result is the least density of these tensors.
    """
    groups = by_network(networks)
    found = [lay([rects[place] for place in places]) for places in groups]
    fits = [one for one in found if one is not None]
    if len(fits) < len(groups):
        return None
    placed = {
        place: crop
        for places, one in zip(groups, fits, strict=True)
        for place, crop in zip(places, one.layout.crops, strict=True)
    }
    crops = tuple(placed[place] for place in range(len(rects)))
    return DenseLayout(TensorLayout(fits[0].layout.shape, crops), min(one.density for one in fits))


def lay_out_apart(
    rects: Sequence[Rect], networks: Sequence[int], output: Shape, buckets: Sequence[Shape]
) -> TensorLayout:
    """Return a layout as `lay_out` does, but with a separate tensor for the avatars of each network.

    All tensors have the same shape: the bucket that gives the least dense tensor the highest density.
    `networks`: number of each avatar's network. The other parameters and the errors are as in `lay_out`.
    """
    if len(set(networks)) == 1:
        return lay_out(rects, output, buckets)

    def filled(shape: Shape) -> DenseLayout | None:
        def lay(own: Sequence[Rect]) -> DenseLayout | None:
            try:
                layout = lay_out(own, output, [shape])
            except BadInputError:
                return None
            crop, cell = layout.crops[0]
            return DenseLayout(layout, cell[2] / (crop.height * output[0] / 2))

        return apart(rects, networks, lay)

    found = [one for shape in buckets if (one := filled(shape)) is not None]
    if not found:
        raise _no_room(rects, buckets)
    return max(found, key=lambda one: one.density).layout


def _no_room(rects: Sequence[Rect], buckets: Sequence[Shape]) -> BadInputError:
    return BadInputError("tensor shapes", f"{list(buckets)}", f"room for {len(rects)} avatars", "use a larger --size")


def tight_shape(rects: Sequence[Rect], output: Shape, density: float = 1.0) -> Shape:
    """Return the shape of least area with room for the avatars at `density`; sides are multiples of `BUCKET_STEP`.

    For several avatars, a shape whose longer side exceeds `MOST_ASPECT` times the shorter is taken only if every
    arrangement has such a shape. The other parameters are as in `lay_out_at`.
    """
    whole = [_pixels(on_grid(rect, output), output) for rect in rects]
    sizes = [(math.ceil(height * density), math.ceil(width * density)) for height, width in whole]
    if len(sizes) == 1:
        return _whole_steps(sizes[0][0]), _whole_steps(sizes[0][1])
    shapes = [_extent(sizes, rows, MARGIN_PX) for rows in _rows(sizes)]
    return min(shapes, key=lambda shape: (max(shape) > MOST_ASPECT * min(shape), shape[0] * shape[1], max(shape)))


def covered(rect: Rect, output: Shape) -> int:
    """Return the number of pixels of a picture of `output` (height, width) that `rect` touches."""
    return math.prod(_pixels(on_grid(rect, output), output))


def _pixels(rect: Rect, output: Shape) -> tuple[int, int]:
    """Return (height, width) in pixels of `rect`, a rectangle on the pixel grid of a picture of `output`."""
    return round(rect.height * output[0] / 2), round(rect.width * output[1] / 2)


def _extent(sizes: Sequence[tuple[int, int]], rows: Sequence[Sequence[int]], margin: int) -> Shape:
    """Return the least tensor shape for `rows`; one pixel per row and per avatar is reserved, as in `_scale`.

    `sizes`: (height, width), tensor pixels.
    """
    height = sum(max(sizes[k][0] for k in row) for row in rows) + margin * (len(rows) - 1) + len(rows)
    width = max(sum(sizes[k][1] for k in row) + margin * (len(row) - 1) + len(row) for row in rows)
    return _whole_steps(height), _whole_steps(width)


def _whole_steps(side: int) -> int:
    """Return `side` rounded up to a multiple of `BUCKET_STEP`."""
    return -(-side // BUCKET_STEP) * BUCKET_STEP


def _arrangements(
    sizes: Sequence[tuple[float, float]], buckets: Sequence[Shape], margin: int
) -> Iterator[_Arrangement]:
    """Yield the avatars' arrangements in each bucket: in one row, in two rows, and so on up to one row per avatar.

    `sizes`: (height, width), picture pixels.
    """
    for rows in _rows(sizes):
        for shape in buckets:
            yield _Arrangement(shape, rows, _scale(sizes, shape, rows, margin))


def _rows(sizes: Sequence[tuple[float, float]]) -> Iterator[tuple[tuple[int, ...], ...]]:
    """Yield the avatars' indices, tallest avatar first, divided into one row, two rows, and so on."""
    order = sorted(range(len(sizes)), key=lambda k: -sizes[k][0])
    for count in range(1, len(order) + 1):
        each = math.ceil(len(order) / count)
        yield tuple(tuple(order[start : start + each]) for start in range(0, len(order), each))


def _scale(sizes: Sequence[tuple[float, float]], shape: Shape, rows: Sequence[Sequence[int]], margin: int) -> float:
    """Return the largest scale at which `rows` fit in `shape`, the number of tensor pixels per picture pixel.

    `sizes`: (height, width), picture pixels.
    """
    high = (shape[0] - margin * (len(rows) - 1) - len(rows)) / sum(max(sizes[k][0] for k in row) for row in rows)
    wide = ((shape[1] - margin * (len(row) - 1) - len(row)) / sum(sizes[k][1] for k in row) for row in rows)
    return min(high, *wide)


def _crops(
    rects: Sequence[Rect], sizes: Sequence[tuple[float, float]], output: Shape, arrangement: _Arrangement, margin: int
) -> tuple[tuple[Rect, Cell], ...]:
    """Return crop rectangle and cell of each avatar, in the order of `rects`.

    `sizes`: (height, width), picture pixels.
    """
    placed: dict[int, tuple[Rect, Cell]] = {}
    top = 0
    for row in arrangement.rows:
        left = 0
        for k in row:
            height, width = (math.ceil(side * arrangement.scale) for side in sizes[k])
            placed[k] = _grown(rects[k], output, (height, width), arrangement.scale), (top, left, height, width)
            left += width + margin
        top += max(cell[2] for _, cell in (placed[k] for k in row)) + margin
    return tuple(placed[k] for k in range(len(rects)))


def _grown(rect: Rect, output: Shape, cell: Shape, scale: float) -> Rect:
    x0, x1 = grow(rect.x0, rect.x1, 2 * cell[1] / (scale * output[1]))
    y0, y1 = grow(rect.y0, rect.y1, 2 * cell[0] / (scale * output[0]))
    return Rect(x0, y0, x1, y1)
