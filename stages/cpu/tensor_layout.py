"""Where each avatar's crop lies in the tensor that all avatars of a frame share.

Rule: one visible avatar has the whole tensor; several have equal cells of it, side by side or one above another,
whichever wastes the least. A crop has its cell's aspect, so that tensor pixels are square on the screen.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from trilane.stages.cpu.crop import Rect, Shape, choose_bucket

#: top, left, height, width in tensor pixels.
Cell = tuple[int, int, int, int]


@dataclass(frozen=True)
class TensorLayout:
    """`shape` (height, width) of the tensor; for each avatar its crop rectangle and its cell."""

    shape: Shape
    crops: tuple[tuple[Rect, Cell], ...]


def lay_out(rects: Sequence[Rect], output: Shape, buckets: Sequence[Shape]) -> TensorLayout:
    """Place the visible avatars' mesh rectangles; `output` (height, width) of the picture in pixels.

    At least one rectangle and one bucket; raises BadInputError without buckets.
    """
    if len(rects) == 1:
        shape, grown = choose_bucket(rects[0], output, buckets)
        return TensorLayout(shape, ((grown, (0, 0, *shape)),))
    options = [_divided(rects, output, shape, across) for shape in buckets for across in (True, False)]
    return min(options, key=lambda layout: _pixels_drawn(layout, output))


def _divided(rects: Sequence[Rect], output: Shape, shape: Shape, across: bool) -> TensorLayout:
    """Cells in a row when `across`, else in a column."""
    count = len(rects)
    height, width = (shape[0], shape[1] // count) if across else (shape[0] // count, shape[1])
    crops = []
    for k, rect in enumerate(rects):
        _, grown = choose_bucket(rect, output, [(height, width)])
        top, left = (0, k * width) if across else (k * height, 0)
        crops.append((grown, (top, left, height, width)))
    return TensorLayout(shape, tuple(crops))


def _pixels_drawn(layout: TensorLayout, output: Shape) -> float:
    """Output pixels that one tensor pixel stands for, at the avatar that is drawn coarsest."""
    return max(rect.height * output[0] / 2 / cell[2] for rect, cell in layout.crops)
