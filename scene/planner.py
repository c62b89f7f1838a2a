"""The planner: which tensor a frame gets. Rule: as dense as the picture and never denser, in the smallest shape that is
ready; pure functions of what is on the screen, and of what was chosen before.

A larger shape is taken at once. A smaller one is taken only when it would have done for `PATIENCE` frames in a row, so
that a body at the edge of two shapes does not go to and fro between them (hysteresis).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from trilane.errors import BadInputError
from trilane.scene.crop import Rect
from trilane.scene.tensor_layout import DenseLayout, lay_out_at, tight_shape
from trilane.shapes import Shape, shape_buckets

#: Tensor pixels for one pixel of the picture: more would paint what the picture cannot show.
FULL_DENSITY = 1.0
#: Frames for which a smaller shape has to do before it is taken.
PATIENCE = 10
#: A density is as good as another one that is larger by less than this share.
AS_GOOD = 1e-6


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
    rects: Sequence[Rect],
    output: Shape,
    shapes: Sequence[Shape],
    before: Held | None,
    density: float = FULL_DENSITY,
) -> TensorPlan:
    """The tensor for the avatars at `rects`, at least one.

    `output`: (height, width) of the picture in pixels.
    `shapes`: that are ready.
    `before`: of the frame before, None for the first.
    `density`: that is wanted; a frame for which no shape is large enough has less.
    Raises BadInputError when no shape has room for all avatars.
    """
    fits = {shape: fit for shape in shapes if (fit := lay_out_at(rects, output, shape, density)) is not None}
    if not fits:
        raise BadInputError("tensor shapes", f"{list(shapes)}", f"room for {len(rects)} avatars", "use a larger --size")
    enough = max(fit.density for fit in fits.values()) * (1 - AS_GOOD)
    best = min((shape for shape, fit in fits.items() if fit.density >= enough), key=lambda one: (one[0] * one[1], one))
    held = _held(best, before, before is not None and before.shape in fits and fits[before.shape].density >= enough)
    return TensorPlan(fits[held.shape], held)


def _held(best: Shape, before: Held | None, still_fits: bool) -> Held:
    if before is None or not still_fits or best == before.shape:
        return Held(best)
    waited = before.smaller_for + 1
    return Held(best) if waited > PATIENCE else Held(before.shape, waited)


def foreseen_shape(rects: Sequence[Rect], output: Shape, side: int) -> Shape:
    """The smallest shape for the avatars at `rects` at full density; with more pixels than `side`², the densest shape
    of `shape_buckets(side)`.
    """
    tight = tight_shape(rects, output)
    if tight[0] * tight[1] <= side * side:
        return tight
    fits = [(fit.density, shape) for shape in shape_buckets(str(side)) if (fit := lay_out_at(rects, output, shape))]
    return max(fits)[1] if fits else (side, side)
