"""The crop: a rectangle of the screen, the tensor shape that fits it, and the projection that draws only that part.

Rectangles are x0, y0, x1, y1 in normalised device coordinates, y up; a tensor's pixels are square on the screen.

`error_px` leads from metres to pixels, with a proved bound. A vertex has the clip coordinates X, Y, W. The vectors r_x,
r_y, r_w are the first three numbers of the clip matrix's rows. With x = X / W and y = Y / W, an error d moves it by

    (x' - x, y' - y) = J d / (W + r_w . d),   with the rows r_x - x r_w and r_y - y r_w of J,

where x and y count in halves of the picture's sides. The largest stretch of J is convex in (x, y), so no vertex that is
seen has a larger one than a corner of the picture. The error is at most that, times |d| / (W - |d| |r_w|). W is the
least of the body: a skinned vertex is a mean of points that lie no further from the centre of joint j than at rest
(`DetailBounds.reach`).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from trilane.arrays import F64
from trilane.body.kinematics import Posed
from trilane.errors import BadInputError
from trilane.shapes import Shape

#: Least height and width of a crop, in output pixels, however small the body is on the screen.
LEAST_PIXELS = 1.0
ROUNDING_PX = 1e-4  # a side this little beyond the edge of a pixel is still on that edge


class Rect(NamedTuple):
    """A rectangle with x0 < x1, y0 < y1 in normalised device coordinates, y up."""

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
    """Return the tensor shape that wastes the least area on `rect`, and `rect` grown to the shape's aspect.

    The grown rectangle holds `rect`. It is moved onto the screen where it fits; a side longer than the screen reaches
    over both of its edges by the same length. Of two shapes that waste the same area the larger is chosen.

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
    """Return an interval of `length` about the middle of [low, high], moved onto [-1, 1] if it fits, else centred."""
    if length >= 2.0:
        return -length / 2.0, length / 2.0
    start = min(max((low + high - length) / 2.0, -1.0), 1.0 - length)
    return min(start, low), max(start + length, high)


def on_grid(rect: Rect, output: Shape) -> Rect:
    """Widen `rect` to whole pixels of a picture of `output` (height, width), at least one each way."""
    x0, x1 = _whole_pixels(rect.x0, rect.x1, output[1])
    y0, y1 = _whole_pixels(rect.y0, rect.y1, output[0])
    return Rect(x0, y0, x1, y1)


def _whole_pixels(low: float, high: float, side: int) -> tuple[float, float]:
    first = math.floor((low + 1.0) / 2.0 * side + ROUNDING_PX)
    last = max(math.ceil((high + 1.0) / 2.0 * side - ROUNDING_PX), first + 1)
    return 2.0 * first / side - 1.0, 2.0 * last / side - 1.0


def grow_on_grid(rect: Rect, output: Shape, size: tuple[float, float]) -> Rect:
    """Grow `rect`, which lies on the pixel grid of a picture of `output`, to `size` (height, width) in its pixels.

    The result begins on the grid, so where `size` is whole each of its pixels is a pixel of the picture. It has `rect`
    in its middle, unless it has to be moved onto the screen, where it fits.
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
    """Return `projection` (4,4) followed by the map of `rect` onto the whole screen; depth does not change.

    With x' = (2 x - (x0 + x1)) / (x1 - x0) in normalised device coordinates the clip coordinate is X' = (2 X - (x0 +
    x1) W) / (x1 - x0), which is linear, so the crop is exact for any projection.
    """
    after = np.eye(4)
    after[0, 0], after[0, 3] = 2.0 / rect.width, -(rect.x0 + rect.x1) / rect.width
    after[1, 1], after[1, 3] = 2.0 / rect.height, -(rect.y0 + rect.y1) / rect.height
    return np.asarray(after @ np.asarray(projection, np.float64))


def least_w(posed: Posed, clip: F64, reach: F64, blend_m: float = 0.0) -> float:
    """Return the least W of clip space that a vertex can have, 0 or less when it may lie behind the camera.

    `clip`: projection @ view, (4,4). `reach`: `DetailBounds.reach`, (55,). `blend_m`: furthest that pose blend shapes
    move a vertex, metres.
    """
    centres = posed.joints @ clip[3, :3] + clip[3, 3]
    return float((centres - (reach + blend_m) * np.linalg.norm(clip[3, :3]))[reach > 0].min())


class Stretch(NamedTuple):
    """How far a metre in the world is on the picture at W = 1.

    `pixels`: most pixels. `depth`: most by which it changes W.
    """

    pixels: float
    depth: float


def stretch_of(clip: ArrayLike, output: Shape) -> Stretch:
    """Return the stretch of `clip`, projection @ view (4,4), on a picture of `output` (height, width)."""
    x, y, _, depth = np.asarray(clip, np.float64)[:, :3]
    sides = output[1] / 2.0, output[0] / 2.0
    corners = ((x - at_x * depth, y - at_y * depth) for at_x in (-1.0, 1.0) for at_y in (-1.0, 1.0))
    pixels = max(_stretch(sides[0] * across, sides[1] * up) for across, up in corners)
    return Stretch(pixels, math.sqrt(depth @ depth))


def error_px(metres: float, stretch: Stretch, w: float) -> float:
    """Return the largest error in pixels of a vertex that is wrong by `metres`.

    `stretch`: that of the picture. `w`: least W of the body in clip space. The result is infinite when a vertex may be
    behind the camera.
    """
    if metres == 0.0:
        return 0.0
    left = w - metres * stretch.depth
    return metres * stretch.pixels / left if left > 0.0 else math.inf


def _stretch(first: F64, second: F64) -> float:
    """Return the largest factor by which the matrix of two rows (3,) makes a vector longer."""
    a, b, c = float(first @ first), float(second @ second), float(first @ second)
    return math.sqrt((a + b) / 2.0 + math.hypot((a - b) / 2.0, c))


def cheapest_within(errors_px: Sequence[float], budget_px: float) -> int:
    """Return the index of the first level, from the least work on, whose error is within the budget; else the last."""
    return next((level for level, error in enumerate(errors_px) if error <= budget_px), len(errors_px) - 1)
