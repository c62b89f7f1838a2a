"""The planner: how much of a frame is made, which tensor it gets, and which shapes of tensors a run gets ready.

**Work.** A picture is used again only when all that it depends on is the same, bit for bit.

**Tensor.** A network paints a body best at about the size that it has learnt, whatever the distance: much smaller it
loses the face, much larger it paints ragged edges. So each avatar in view gets the pixels that its network was trained
to paint. A body that has more pixels on the picture than in its tensor loses detail, so it gets up to `MOST_GROWTH`
times the pixels (docs/decisions/planner.md has the figures).

**Changes.** A change of shape is seen, so it costs as much as the pixels of `PATIENCE` frames. The scene is known
ahead: before the run `foreseen_changes` finds the changes that cost least. Each is made while both shapes are good, and
where nobody is in view or what is seen moves fast. A frame whose shape is not good enough gets a good one at once,
whatever was foreseen. Where nothing is foreseen, a smaller shape is taken after `PATIENCE` frames in which it would
have done.

**Shapes.** They are chosen before the run from the frames that can be foreseen, so that every shape has its network
ready; their number and their memory have limits. A shape serves a frame when it is within the frame's budget of pixels
and nearly as dense as the frame's ideal shape. First come the shapes that serve most frames, until all are served; then
those that save enough work.

All functions are pure: they take what is on the screen, held and foreseen.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from enum import IntEnum
from itertools import combinations, pairwise
from typing import NamedTuple

from trilane.arrays import Floats
from trilane.errors import BadInputError
from trilane.scene.crop import Rect
from trilane.scene.tensor_layout import DenseLayout, lay_out_at, tight_shape
from trilane.shapes import Shape, shapes_within


class FrameWork(IntEnum):
    """What a frame asks for. FULL: a new picture of the avatars. REUSE: the one that is there. NONE: nobody is seen."""

    FULL = 0
    REUSE = 1
    NONE = 2


def shown_by(arrays: Iterable[Floats]) -> bytes:
    """What the picture of the avatars depends on, to be compared: `arrays` of always the same shapes."""
    return b"".join(array.tobytes() for array in arrays)


def work_of(
    shown: bytes, of_picture: bytes | None, of_nobody: bytes | None, is_anybody_seen: Callable[[], bool]
) -> FrameWork:
    """What a frame that shows `shown` asks for.

    `of_picture`: what the frame showed whose picture is there, None when there is none.
    `of_nobody`: what a frame showed on which nobody was seen, None when there was none.
    `is_anybody_seen`: looks whether an avatar is on the screen; asked only when neither frame tells.
    """
    if shown == of_picture:
        return FrameWork.REUSE
    if shown == of_nobody or not is_anybody_seen():
        return FrameWork.NONE
    return FrameWork.FULL


#: Tensor pixels for one pixel of the picture, along a side: more could not be seen.
MOST_DENSITY = 4.0
#: A density is as good as the best one when it is at least this share of it.
AS_GOOD = 0.95
#: A change in view costs as much as the pixels of so many frames; so long a smaller shape has to do before it is taken.
PATIENCE = 10
#: What is seen moves by this share of the picture's side in a frame: a change shows half as much as at rest.
FAST = 0.01
#: A change of the density by this factor shows twice as much as one of the shape alone.
DENSITY_STEP = 1.25
#: How many times its own pixels an avatar gets at most, where the picture shows as many: 5/4 of the sides.
MOST_GROWTH = 25 / 16
#: Sides of a tensor, in parts of those that its network was trained to paint: the sizes that it may be stepped down to
#: when frames would be late, or that an error budget allows.
SIDES = (1.0, 0.75, 0.5)
ALL_WORK = 1000


def work_of_side(side: float) -> int:
    """Thousandths of all the pixels that a tensor has whose sides are `side` times as long."""
    return math.ceil(ALL_WORK * side * side)


@dataclass(frozen=True)
class TensorBudget:
    """Pixels of a tensor.

    `own`: pixels of the network's own shape, for each avatar. `most`: most pixels of all together. `work`: thousandths
    of what these two allow.
    """

    own: int
    most: int
    work: int = ALL_WORK

    def scaled(self, work: int) -> TensorBudget:
        """The budget with `work` thousandths of the pixels."""
        return replace(self, work=work)

    def most_of(self, avatars: int) -> int:
        """Pixels for so many avatars in view, however large they are."""
        return self._allowed(avatars * self.own * MOST_GROWTH)

    def of(self, rects: Sequence[Rect], output: Shape) -> int:
        """Pixels for the avatars at `rects` on a picture of `output`: their own, or as many as the picture shows."""
        own = len(rects) * self.own
        return min(self._allowed(max(own, area(tight_shape(rects, output)))), self.most_of(len(rects)))

    def _allowed(self, pixels: float) -> int:
        return int(min(pixels, self.most)) * self.work // ALL_WORK


@dataclass(frozen=True)
class HeldShape:
    """The shape in use.

    `foreseen`: the foreseen shape that was taken last. `smaller_for`: frames in a row for which a smaller shape would
    have done.
    """

    shape: Shape
    foreseen: Shape | None = None
    smaller_for: int = 0


@dataclass(frozen=True)
class TensorPlan:
    """The layout of one frame's tensor, its density, and what to hand to the next `plan_tensor`."""

    dense: DenseLayout
    held: HeldShape


def plan_tensor(
    rects: Sequence[Rect],
    output: Shape,
    shapes: Sequence[Shape],
    budget: TensorBudget,
    before: HeldShape | None,
    foreseen: Shape | None = None,
) -> TensorPlan:
    """The tensor for the avatars at `rects`, at least one.

    `output`: (height, width) of the picture in pixels.
    `shapes`: shapes that are ready. Where all of them are larger than the budget allows, any may be taken.
    `before`: shape of the frame before, None for the first.
    `foreseen`: the shape of this frame by `foreseen_changes`; None where nothing was foreseen.
    Raises BadInputError when no shape has room for all avatars.
    """
    fits, good = _fits(rects, output, shapes, budget)
    if not good:
        raise BadInputError("tensor shapes", f"{list(shapes)}", f"room for {len(rects)} avatars", "use a larger --size")
    held = _held(good, before, foreseen)
    return TensorPlan(fits[held.shape], held)


def _fits(
    rects: Sequence[Rect], output: Shape, shapes: Sequence[Shape], budget: TensorBudget
) -> tuple[dict[Shape, DenseLayout], list[Shape]]:
    """The avatars' layout in each shape that may be taken and has room for them, and which of the shapes are good.

    Good is what is nearly as dense as the densest within the frame's budget. A shape may be larger than that, but not
    than the budget of any frame with as many avatars.
    """
    most, pixels = budget.most_of(len(rects)), budget.of(rects, output)
    allowed = [shape for shape in shapes if area(shape) <= most] or shapes
    fits = {shape: fit for shape in allowed if (fit := lay_out_at(rects, output, shape, MOST_DENSITY)) is not None}
    within = [fit.density for shape, fit in fits.items() if area(shape) <= pixels]
    enough = AS_GOOD * max(within or [fit.density for fit in fits.values()], default=0.0)
    return fits, [shape for shape, fit in fits.items() if fit.density >= enough]


def _held(good: Sequence[Shape], before: HeldShape | None, foreseen: Shape | None) -> HeldShape:
    """What was foreseen, once and as soon as it is good; then what is held while it is good, else the smallest."""
    last = before.foreseen if before is not None else None
    is_kept = before is not None and before.shape in good
    if foreseen is not None and foreseen in good and (foreseen != last or not is_kept):
        return HeldShape(foreseen, foreseen)
    best = min(good, key=lambda shape: (area(shape), shape))
    if before is None or not is_kept:
        return HeldShape(best, last)
    if foreseen is not None or area(best) >= area(before.shape):
        return HeldShape(before.shape, last)
    waited = before.smaller_for + 1
    return HeldShape(best, last) if waited > PATIENCE else HeldShape(before.shape, last, waited)


@dataclass(frozen=True)
class LookAhead:
    """A frame that was looked at before the run. `rects`: rectangles of the visible avatars, by their numbers."""

    frame: int
    rects: Mapping[int, Rect]


def foreseen_changes(
    looks: Sequence[LookAhead], output: Shape, shapes: Sequence[Shape], budget: TensorBudget
) -> tuple[tuple[int, Shape], ...]:
    """The shape from the first of `looks` on, at least one, and every change of shape with its frame.

    The way through the good shapes is the cheapest one in pixels: those of all frames, and the cost of the changes. A
    shape that is not good at a look is left in the first frame behind the look before.
    """
    order = sorted(shapes, key=lambda shape: (area(shape), shape))
    costs, origins, needed = dict.fromkeys(order, 0.0), [], []
    for number, look in enumerate(looks):
        fits, good = _fits(list(look.rects.values()), output, order, budget) if look.rects else ({}, order)
        before, after = looks[max(number - 1, 0)], looks[min(number + 1, len(looks) - 1)]
        price = PATIENCE * budget.own / (1.0 + _speed(before, look) / FAST) if before.rects and look.rects else 0.0
        ways = {shape: _cheapest_way(shape, costs, fits, price) for shape in good or order}
        frames = max(after.frame - look.frame, 1) if look.rects else 0
        costs = {shape: cost + frames * area(shape) for shape, (cost, _) in ways.items()}
        origins.append({shape: origin for shape, (_, origin) in ways.items()})
        needed.append(set(order) if not before.rects else set(order) - set(good))
    path = [min(costs, key=lambda shape: costs[shape])]
    for ways_back in reversed(origins[1:]):
        path.insert(0, ways_back[path[0]])
    changes = [(looks[0].frame, path[0])]
    for number, (old, new) in enumerate(pairwise(path), start=1):
        if new != old:
            changes.append((looks[number - 1].frame + 1 if old in needed[number] else looks[number].frame, new))
    return tuple(changes)


def _cheapest_way(
    shape: Shape, costs: Mapping[Shape, float], fits: Mapping[Shape, DenseLayout], price: float
) -> tuple[float, Shape]:
    """Cost of the cheapest way to `shape`, and the shape of `costs` where it begins. `price`: cost of a change."""

    def change(origin: Shape) -> float:
        if origin == shape:
            return 0.0
        if origin not in fits or shape not in fits:
            return price
        return price * (1.0 + abs(math.log(fits[shape].density / fits[origin].density)) / math.log(DENSITY_STEP))

    return min(((cost + change(origin), origin) for origin, cost in costs.items()), key=lambda way: way[0])


def _speed(before: LookAhead, now: LookAhead) -> float:
    """How far the sides of the avatars' rectangles move in a frame, at most, as a share of the picture's sides."""
    frames = max(now.frame - before.frame, 1)
    both = now.rects.keys() & before.rects.keys()
    moved = [abs(a - b) / 2.0 for one in both for a, b in zip(now.rects[one], before.rects[one], strict=True)]
    return max(moved, default=0.0) / frames


def ideal_shape(rects: Sequence[Rect], output: Shape, budget: TensorBudget) -> Shape:
    """The shape in which the avatars at `rects` are densest within the budget; of equal ones the smallest."""
    pixels = budget.of(rects, output)
    tight = tight_shape(rects, output, MOST_DENSITY)
    shapes = [*shapes_within(pixels), *([tight] if area(tight) <= pixels else [])]
    fits = [(fit.density, shape) for shape in shapes if (fit := lay_out_at(rects, output, shape, MOST_DENSITY))]
    if not fits:
        return max(shapes, key=area)
    return max(fits, key=lambda one: (one[0], -area(one[1]), one[1]))[1]


def area(shape: Shape) -> int:
    """Pixels of a tensor."""
    return shape[0] * shape[1]


MOST_SHAPES = 10
#: Share of the pixels of all frames that a further shape has to save.
LEAST_SAVING = 0.02


class Demand(NamedTuple):
    """What a frame asks for: its ideal shape (height, width), and the pixels that its tensor may have."""

    ideal: Shape
    pixels: int


@dataclass(frozen=True)
class ShapeSet:
    """`shapes` (height, width), the smallest first. `memory_bytes`: what their networks take.

    `unserved`: frames that none of them serves, because there may be no more; they are drawn less densely.
    """

    shapes: tuple[Shape, ...]
    memory_bytes: int
    unserved: int


def choose_shapes(
    demands: Iterable[Demand],
    bytes_per_pixel: float,
    memory_bytes: int,
    most_shapes: int = MOST_SHAPES,
    *,
    optional: bool = False,
) -> ShapeSet:
    """The shapes to prepare: at least one, whatever its memory, unless they are `optional`.

    `demands`: demands of the foreseen frames, at least one.
    `bytes_per_pixel`: memory of a network that is ready to run, for each pixel of its tensor.
    `memory_bytes`: what all of them may take.
    `most_shapes`: how many there may be.
    """
    frames = Counter(demands)
    chosen: list[Shape] = []
    while len(chosen) < most_shapes:
        shape = _next(frames, chosen)
        if shape is None or (
            (chosen or optional) and bytes_per_pixel * sum(map(area, (*chosen, shape))) > memory_bytes
        ):
            break
        chosen.append(shape)
    unserved = sum(count for demand, count in frames.items() if not any(serves(shape, demand) for shape in chosen))
    memory = math.ceil(bytes_per_pixel * sum(map(area, chosen)))
    return ShapeSet(tuple(sorted(chosen, key=lambda shape: (area(shape), shape))), memory, unserved)


def joined(first: ShapeSet, second: ShapeSet) -> ShapeSet:
    """Both sets. `unserved` is the first one's, unless it has no shapes. A shape of both counts twice as memory."""
    shapes = sorted({*first.shapes, *second.shapes}, key=lambda shape: (area(shape), shape))
    unserved = first.unserved if first.shapes else second.unserved
    return ShapeSet(tuple(shapes), first.memory_bytes + second.memory_bytes, unserved)


def larger_shapes(shapes: Sequence[Shape], most_pixels: int) -> list[Shape]:
    """New shapes that hold two of `shapes` each, with at most `most_pixels`."""
    both = {(max(a[0], b[0]), max(a[1], b[1])) for a, b in combinations(shapes, 2)}
    return sorted((shape for shape in both - set(shapes) if area(shape) <= most_pixels), key=area)


def serves(shape: Shape, demand: Demand) -> bool:
    """Whether the frame of `demand` can be drawn well in a tensor of `shape`."""
    (height, width), (ideal_height, ideal_width) = shape, demand.ideal
    large_enough = height >= AS_GOOD * ideal_height and width >= AS_GOOD * ideal_width
    return large_enough and area(shape) <= demand.pixels


def _next(frames: Mapping[Demand, int], chosen: Sequence[Shape]) -> Shape | None:
    """The shape to add, None when a further one is not worth it."""
    candidates = sorted({demand.ideal for demand in frames} - set(chosen))
    if not candidates:
        return None
    unserved = {d: count for d, count in frames.items() if not any(serves(shape, d) for shape in chosen)}
    if unserved:
        return max(candidates, key=lambda one: (sum(c for d, c in unserved.items() if serves(one, d)), -area(one)))
    work = _work(frames, chosen)
    best = min(candidates, key=lambda shape: _work(frames, [*chosen, shape]))
    return best if work - _work(frames, [*chosen, best]) >= LEAST_SAVING * work else None


def _work(frames: Mapping[Demand, int], chosen: Sequence[Shape]) -> int:
    """Pixels of all frames, each in the smallest shape that serves it."""
    return sum(
        count * min(area(shape) for shape in chosen if serves(shape, demand)) for demand, count in frames.items()
    )
