"""The planner: how much of a frame is made, which tensor it gets, and which shapes of tensors a run prepares.

**Work.** A picture is used again only when everything that it depends on is the same, bit for bit.

**Tensor.** A network paints a body best at about the size that it has learnt, whatever the distance: much smaller it
loses the face, much larger it paints ragged edges. So each avatar in view gets the pixels that its network was trained
to paint. A body that has more pixels on the picture than in its tensor loses detail, so it gets up to `MOST_GROWTH`
times the pixels. One so far off that its tensor would be denser than `MOST_DENSITY` gets fewer
(docs/decisions/planner.md has the figures).

Avatars of different networks have a tensor each, of one shape. The network that needs most sets the budgets of a frame,
and the least dense tensor sets its density.

**Mesh.** An avatar whose surface may move by less than the error budget is drawn with fewer triangles. `hold_mesh`
keeps a level while it can, and goes to coarser ones step by step.

**Changes.** A change of shape is seen, so it costs as much as the pixels of `PATIENCE` frames. The scene is known
ahead: before the run `foreseen_changes` finds the changes that cost least. Each is made while both shapes are good, and
where nobody is in view or the scene moves fast. A frame whose shape is not good enough gets a good one at once,
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

from trilane.arrays import Floats, Shape, shapes_within
from trilane.errors import BadInputError
from trilane.scene.crop import DenseLayout, Rect, apart, by_network, lay_out_at, tight_shape


class FrameWork(IntEnum):
    """The work for a frame. FULL: a new picture of the avatars. REUSE: the present picture. NONE: nobody is seen."""

    FULL = 0
    REUSE = 1
    NONE = 2


def shown_by(arrays: Iterable[Floats]) -> bytes:
    """Return everything that the picture of the avatars depends on as bytes to compare.

    `arrays`: numbers of always the same shapes.
    """
    return b"".join(array.tobytes() for array in arrays)


def work_of(
    shown: bytes, of_picture: bytes | None, of_nobody: bytes | None, is_anybody_seen: Callable[[], bool]
) -> FrameWork:
    """Return the work for a frame that shows `shown`.

    `of_picture`: what the frame of the present picture showed, None when there is none.
    `of_nobody`: what a frame showed on which nobody was seen, None when there was none.
    `is_anybody_seen`: finds out whether an avatar is on the screen; called only when neither frame tells.
    """
    if shown == of_picture:
        return FrameWork.REUSE
    if shown == of_nobody or not is_anybody_seen():
        return FrameWork.NONE
    return FrameWork.FULL


#: Most tensor pixels for one pixel of the picture, along a side: with more, the picture is no nearer to the truth.
MOST_DENSITY = 2.25
#: Least share of the best density at which a density is as good.
AS_GOOD = 0.95
#: Cost of a change in view, in pixels of so many frames; also the number of frames for which a smaller shape must do
#: before it is taken.
PATIENCE = 10
#: Movement in a frame, as a share of the picture's side, at which a change shows half as much as at rest.
FAST = 0.01
#: Factor by which a change of the density shows twice as much as a change of the shape alone.
DENSITY_STEP = 1.25
#: Most pixels of an avatar, as a multiple of its own, where the picture shows as many: 5/4 of the sides.
MOST_GROWTH = 25 / 16
#: Sides of a tensor, as shares of those that its network was trained to paint: sizes for stepping down when frames
#: would be late, or for an error budget.
SIDES = (1.0, 0.75, 0.5)
ALL_WORK = 1000


def work_of_side(side: float) -> int:
    """Return the thousandths of all pixels in a tensor whose sides are `side` times as long."""
    return math.ceil(ALL_WORK * side * side)


@dataclass(frozen=True)
class TensorBudget:
    """The pixels that a tensor may have.

    `own`: pixels of the network's own shape, for each avatar. `most`: most pixels of all avatars together. `work`:
    thousandths of these two that are allowed.
    """

    own: int
    most: int
    work: int = ALL_WORK

    def scaled(self, work: int) -> TensorBudget:
        """Return the budget with `work` thousandths of the pixels."""
        return replace(self, work=work)

    def most_of(self, avatars: int) -> int:
        """Return the most pixels for `avatars` avatars in view, whatever their size."""
        return self._allowed(avatars * self.own * MOST_GROWTH)

    def of(self, rects: Sequence[Rect], output: Shape) -> int:
        """Return the pixels for the avatars at `rects` on a picture of `output`: their own, or as many as it shows."""
        own = len(rects) * self.own
        return min(self._allowed(max(own, area(tight_shape(rects, output)))), self.most_of(len(rects)))

    def _allowed(self, pixels: float) -> int:
        return int(min(pixels, self.most)) * self.work // ALL_WORK


@dataclass(frozen=True)
class HeldShape:
    """The shape in use.

    `foreseen`: foreseen shape that was taken last. `smaller_for`: number of successive frames for which a smaller shape
    would have done.
    """

    shape: Shape
    foreseen: Shape | None = None
    smaller_for: int = 0


#: Share of the error budget below which a coarser level of the mesh does well.
EASE = 0.8


@dataclass(frozen=True)
class HeldMesh:
    """The level of an avatar's mesh in use.

    `level`: 0 for the whole mesh. `coarser_for`: number of successive frames for which the next level would have done
    well.
    """

    level: int
    coarser_for: int = 0


def hold_mesh(errors_px: Sequence[float], budget_px: float, before: HeldMesh | None) -> HeldMesh:
    """Return the level of a frame whose levels have the bounds `errors_px`, finest first; the first is always 0.

    A level beyond `budget_px` is left at once, for the coarsest finer one within it. A coarser level is taken one step
    at a time, after `PATIENCE` frames in which its bound was well within the budget. The first frame takes the coarsest
    level within the budget.
    """
    within = [level for level, error in enumerate(errors_px) if error <= budget_px]
    if before is None:
        return HeldMesh(within[-1])
    if before.level not in within:
        return HeldMesh(max(level for level in within if level < before.level))
    coarser = before.level + 1
    if coarser >= len(errors_px) or errors_px[coarser] > EASE * budget_px:
        return HeldMesh(before.level)
    waited = before.coarser_for + 1
    return HeldMesh(coarser) if waited > PATIENCE else HeldMesh(before.level, waited)


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
    networks: Sequence[int] = (),
) -> TensorPlan:
    """Plan the tensor for the avatars at `rects`, at least one.

    `output`: (height, width) of the picture in pixels.
    `shapes`: shapes that are ready. Where all of them are larger than the budget allows, any may be taken.
    `before`: shape of the frame before, None for the first.
    `foreseen`: shape of this frame by `foreseen_changes`; None where nothing was foreseen.
    `networks`: network of each avatar at `rects`; empty where one paints all.
    Raises BadInputError when no shape has room for all avatars.
    """
    fits, good = _fits(rects, networks, output, shapes, budget)
    if not good:
        raise BadInputError("tensor shapes", f"{list(shapes)}", f"room for {len(rects)} avatars", "use a larger --size")
    held = _held(good, before, foreseen)
    return TensorPlan(fits[held.shape], held)


def _grouped(rects: Sequence[Rect], networks: Sequence[int]) -> list[list[Rect]]:
    """Return the rectangles of each network."""
    return [[rects[place] for place in places] for places in by_network(networks or [0] * len(rects))]


def pixels_of(rects: Sequence[Rect], networks: Sequence[int], output: Shape, budget: TensorBudget) -> int:
    """Return the pixels of a frame's tensor: the most that the avatars of one network may have.

    `networks`: network of each avatar at `rects`; empty where one paints all.
    """
    return max(budget.of(own, output) for own in _grouped(rects, networks))


def _dense(rects: Sequence[Rect], networks: Sequence[int], output: Shape, shape: Shape) -> DenseLayout | None:
    """Return the densest layout in tensors of `shape`, one for each network; None without room for all avatars."""
    return apart(rects, networks or [0] * len(rects), lambda own: lay_out_at(own, output, shape, MOST_DENSITY))


def _fits(
    rects: Sequence[Rect], networks: Sequence[int], output: Shape, shapes: Sequence[Shape], budget: TensorBudget
) -> tuple[dict[Shape, DenseLayout], list[Shape]]:
    """Return the layout in each shape that may be taken and has room for the avatars, and which of the shapes are good.

    A good shape is nearly as dense as the densest within the frame's budget. It may be larger than that one, but not
    than the budget of any frame with as many avatars.
    """
    most = budget.most_of(max(map(len, _grouped(rects, networks))))
    pixels = pixels_of(rects, networks, output, budget)
    allowed = [shape for shape in shapes if area(shape) <= most] or shapes
    fits = {shape: fit for shape in allowed if (fit := _dense(rects, networks, output, shape)) is not None}
    within = [fit.density for shape, fit in fits.items() if area(shape) <= pixels]
    enough = AS_GOOD * max(within or [fit.density for fit in fits.values()], default=0.0)
    return fits, [shape for shape, fit in fits.items() if fit.density >= enough]


def _held(good: Sequence[Shape], before: HeldShape | None, foreseen: Shape | None) -> HeldShape:
    """Return the foreseen shape once, as soon as it is good; then the held one while it is good, else the smallest."""
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
    """A frame that was looked at before the run.

    `rects`: rectangles of the visible avatars, by their numbers.
    """

    frame: int
    rects: Mapping[int, Rect]

    def networks(self, of_all: Sequence[int]) -> list[int]:
        """Return the network of each visible avatar. `of_all`: that of each avatar; empty where one paints all."""
        return [of_all[number] for number in self.rects] if of_all else []


def foreseen_changes(
    looks: Sequence[LookAhead],
    output: Shape,
    shapes: Sequence[Shape],
    budget: TensorBudget,
    networks: Sequence[int] = (),
) -> tuple[tuple[int, Shape], ...]:
    """Return the shape from the first of `looks` on, at least one, and every change of shape with its frame.

    `networks`: network of each avatar of the scene; empty where one paints all.
    The chosen sequence of good shapes is the cheapest in pixels: the pixels of all frames, plus the cost of the
    changes. A shape that is not good at a look is left in the first frame after the look before.
    """
    order = sorted(shapes, key=lambda shape: (area(shape), shape))
    costs, origins, needed = dict.fromkeys(order, 0.0), [], []
    for number, look in enumerate(looks):
        of_seen = look.networks(networks)
        fits, good = _fits([*look.rects.values()], of_seen, output, order, budget) if look.rects else ({}, order)
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
    """Return the cost of the cheapest way to `shape`, and the shape of `costs` where it begins.

    `price`: cost of a change.
    """

    def change(origin: Shape) -> float:
        if origin == shape:
            return 0.0
        if origin not in fits or shape not in fits:
            return price
        return price * (1.0 + abs(math.log(fits[shape].density / fits[origin].density)) / math.log(DENSITY_STEP))

    return min(((cost + change(origin), origin) for origin, cost in costs.items()), key=lambda way: way[0])


def _speed(before: LookAhead, now: LookAhead) -> float:
    """Return the largest move of a side of the avatars' rectangles in a frame, as a share of the picture's sides."""
    frames = max(now.frame - before.frame, 1)
    both = now.rects.keys() & before.rects.keys()
    moved = [abs(a - b) / 2.0 for one in both for a, b in zip(now.rects[one], before.rects[one], strict=True)]
    return max(moved, default=0.0) / frames


def ideal_shape(rects: Sequence[Rect], output: Shape, budget: TensorBudget, networks: Sequence[int] = ()) -> Shape:
    """Return the shape in which the avatars at `rects` are densest within the budget; the smallest of equal ones.

    `networks`: network of each of them; empty where one paints all.
    """
    pixels = pixels_of(rects, networks, output, budget)
    tight = [tight_shape(own, output, MOST_DENSITY) for own in _grouped(rects, networks)]
    shapes = [*shapes_within(pixels), *(shape for shape in tight if area(shape) <= pixels)]
    fits = [(fit.density, shape) for shape in shapes if (fit := _dense(rects, networks, output, shape))]
    if not fits:
        return max(shapes, key=area)
    return max(fits, key=lambda one: (one[0], -area(one[1]), one[1]))[1]


def area(shape: Shape) -> int:
    """Return the number of pixels of a tensor."""
    return shape[0] * shape[1]


MOST_SHAPES = 10
#: Least share of the pixels of all frames that a further shape has to save.
LEAST_SAVING = 0.02


class Demand(NamedTuple):
    """The needs of a frame: its ideal shape (height, width), and the pixels that its tensor may have."""

    ideal: Shape
    pixels: int


@dataclass(frozen=True)
class ShapeSet:
    """The shapes that a run prepares.

    `shapes`: (height, width), the smallest first. `memory_bytes`: memory of their networks. `unserved`: number of
    frames that none of them serves, because there may be no more; they are drawn less densely.
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
    """Choose the shapes to prepare: at least one, whatever its memory, unless they are `optional`.

    `demands`: demands of the foreseen frames, at least one.
    `bytes_per_pixel`: memory of a network that is ready to run, for each pixel of its tensor.
    `memory_bytes`: most memory of all of them.
    `most_shapes`: largest number of shapes.
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
    """Join both sets; a shape in both counts twice as memory.

    `unserved` is the first one's, unless it has no shapes.
    """
    shapes = sorted({*first.shapes, *second.shapes}, key=lambda shape: (area(shape), shape))
    unserved = first.unserved if first.shapes else second.unserved
    return ShapeSet(tuple(shapes), first.memory_bytes + second.memory_bytes, unserved)


def larger_shapes(shapes: Sequence[Shape], most_pixels: int) -> list[Shape]:
    """Return new shapes that hold two of `shapes` each, with at most `most_pixels`."""
    both = {(max(a[0], b[0]), max(a[1], b[1])) for a, b in combinations(shapes, 2)}
    return sorted((shape for shape in both - set(shapes) if area(shape) <= most_pixels), key=area)


def serves(shape: Shape, demand: Demand) -> bool:
    """Return whether the frame of `demand` can be drawn well in a tensor of `shape`."""
    (height, width), (ideal_height, ideal_width) = shape, demand.ideal
    large_enough = height >= AS_GOOD * ideal_height and width >= AS_GOOD * ideal_width
    return large_enough and area(shape) <= demand.pixels


def _next(frames: Mapping[Demand, int], chosen: Sequence[Shape]) -> Shape | None:
    """Return the shape to add, None when a further one is not worth it."""
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
    """Return the pixels of all frames, each in the smallest shape that serves it."""
    return sum(
        count * min(area(shape) for shape in chosen if serves(shape, demand)) for demand, count in frames.items()
    )
