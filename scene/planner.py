"""The planner: which tensor a frame gets. Rule: each avatar in view gets the pixels that its network was trained to
paint, no more than the picture can show, in a shape that is ready; pure functions of what is on the screen and held.

A network paints a body best at the size that it has learnt, whatever the distance: smaller it loses the face, larger it
paints ragged edges (docs/decisions/planner.md has the figures). So the pixels follow from how many avatars are seen,
and the shape from where they are.

A shape is changed at once when another would be denser, and after `PATIENCE` frames in a row when a smaller one would
have done, so that a body at the edge of two shapes does not go to and fro between them (hysteresis).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from trilane.errors import BadInputError
from trilane.scene.crop import Rect
from trilane.scene.tensor_layout import DenseLayout, lay_out_at, tight_shape
from trilane.shapes import Shape, shapes_within

#: Tensor pixels for one pixel of the picture, along a side: more could not be seen.
MOST_DENSITY = 4.0
#: A density is as good as the best one when it is at least this share of it.
AS_GOOD = 0.95
#: Frames for which a smaller shape has to do before it is taken.
PATIENCE = 10
#: Sides of a tensor, in parts of those that its network was trained to paint: the sizes that it may be stepped down to
#: when frames would be late, or that an error budget allows.
SIDES = (1.0, 0.75, 0.5)
ALL_WORK = 1000


def work_of_side(side: float) -> int:
    """Thousandths of all the pixels that a tensor has whose sides are `side` times as long."""
    return math.ceil(ALL_WORK * side * side)


@dataclass(frozen=True)
class TensorBudget:
    """Pixels of a tensor. `own`: of each avatar, those of its network's own shape. `most`: of all together."""

    own: int
    most: int

    def scaled(self, work: int) -> TensorBudget:
        """With so many thousandths of the pixels."""
        return TensorBudget(self.own * work // ALL_WORK, self.most * work // ALL_WORK)

    def of(self, avatars: int) -> int:
        """For so many avatars in view."""
        return min(avatars * self.own, self.most)


@dataclass(frozen=True)
class Held:
    """The shape in use, and for how many frames in a row a smaller one would have done."""

    shape: Shape
    smaller_for: int = 0


@dataclass(frozen=True)
class TensorPlan:
    """The layout of one frame's tensor, its density, and what to hand to the next `plan_tensor`."""

    dense: DenseLayout
    held: Held


def plan_tensor(
    rects: Sequence[Rect], output: Shape, shapes: Sequence[Shape], budget: TensorBudget, before: Held | None
) -> TensorPlan:
    """The tensor for the avatars at `rects`, at least one.

    `output`: (height, width) of the picture in pixels.
    `shapes`: that are ready. Where all of them are larger than the budget allows, any may be taken.
    `before`: of the frame before, None for the first.
    Raises BadInputError when no shape has room for all avatars.
    """
    allowed = [shape for shape in shapes if area(shape) <= budget.of(len(rects))] or shapes
    fits = {shape: fit for shape in allowed if (fit := lay_out_at(rects, output, shape, MOST_DENSITY)) is not None}
    if not fits:
        raise BadInputError("tensor shapes", f"{list(shapes)}", f"room for {len(rects)} avatars", "use a larger --size")
    enough = AS_GOOD * max(fit.density for fit in fits.values())
    best = min((shape for shape, fit in fits.items() if fit.density >= enough), key=lambda one: (area(one), one))
    held = _held(best, before, before is not None and before.shape in fits and fits[before.shape].density >= enough)
    return TensorPlan(fits[held.shape], held)


def _held(best: Shape, before: Held | None, still_good: bool) -> Held:
    if before is None or not still_good or area(best) >= area(before.shape):
        return Held(before.shape if before is not None and still_good else best)
    waited = before.smaller_for + 1
    return Held(best) if waited > PATIENCE else Held(before.shape, waited)


def ideal_shape(rects: Sequence[Rect], output: Shape, budget: TensorBudget) -> Shape:
    """The shape in which the avatars at `rects` are densest within the budget; of equal ones the smallest."""
    pixels = budget.of(len(rects))
    tight = tight_shape(rects, output, MOST_DENSITY)
    shapes = [*shapes_within(pixels), *([tight] if area(tight) <= pixels else [])]
    fits = [(fit.density, shape) for shape in shapes if (fit := lay_out_at(rects, output, shape, MOST_DENSITY))]
    if not fits:
        return max(shapes, key=area)
    return max(fits, key=lambda one: (one[0], -area(one[1]), one[1]))[1]


def area(shape: Shape) -> int:
    """Pixels of a tensor."""
    return shape[0] * shape[1]
