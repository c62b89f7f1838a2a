"""The planner: how much of a frame is made, which tensor it gets, and which tensor shapes a run prepares.

**Work.** A picture is used again only if everything that it depends on is the same, bit for bit.

**Tensor.** A network paints a body best at about the size at which it was trained, whatever the distance. At a much
smaller size it loses the face; at a much larger size it paints ragged edges. Therefore each visible avatar gets the
number of pixels for which its network was trained. A body with more pixels on the picture than in its tensor loses
detail. Such a body gets up to `MOST_GROWTH` times that number. A body so far away that its tensor would be denser than
`MOST_DENSITY` gets fewer pixels (docs/decisions/planner.md has the figures).

If the error of the avatars was measured by size of body and tensor, the measured curve takes the place of this rule: it
has the fewest pixels with which a body of each size is painted nearly as well as possible.

Avatars of different networks have separate tensors of one shape. The network that needs the most pixels sets a frame's
budget, and the least dense tensor sets its density.

**Mesh.** An avatar whose surface may be off by less than the error budget is drawn with fewer triangles. `hold_mesh`
keeps a level while it is good enough, and goes to coarser levels step by step.

**Changes.** A change of shape is visible, so it costs as much as the pixels of `PATIENCE` frames. Before the run,
`foreseen_changes` finds the changes that cost least. Each is made while both shapes are good, and preferably while
nobody is visible or the scene moves fast. If a frame's shape is not good enough, the frame gets a good shape at once,
whatever was foreseen. If nothing was foreseen, a smaller shape is taken after `PATIENCE` frames in which it would have
been good.

**Shapes.** Shapes are chosen before the run, from the frames that can be foreseen. Every shape then has its network
ready. Number and memory of the shapes are limited. A shape serves a frame if it is within the frame's pixel budget and
nearly as dense as the frame's ideal shape. The shapes that serve the most frames are chosen first, until all frames are
served. After that, shapes that save enough work are added.

All functions are pure: they take what is visible, held and foreseen as arguments.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from enum import IntEnum
from itertools import combinations, pairwise
from typing import NamedTuple

from trilane.arrays import Floats, Shape, shapes_within
from trilane.errors import BadInputError
from trilane.scene.crop import DenseLayout, Rect, apart, by_network, lay_out_at, tight_shape
from trilane.scene.tensor_budget import TensorBudget, area


class FrameWork(IntEnum):
    """The work for a frame. FULL: a new picture of the avatars. REUSE: the present picture. NONE: nobody is seen."""

    FULL = 0
    REUSE = 1
    NONE = 2


def shown_by(arrays: Iterable[Floats]) -> bytes:
    """Return `arrays` as bytes to compare.

    `arrays`: everything on which the avatars' picture depends; number and shapes never change during a run.
    """
    return b"".join(array.tobytes() for array in arrays)


def work_of(
    shown: bytes, of_picture: bytes | None, of_nobody: bytes | None, is_anybody_seen: Callable[[], bool]
) -> FrameWork:
    """Return the work for a frame.

    `shown`: bytes of `shown_by` for this frame.
    `of_picture`: the bytes for the frame of the present picture; None before the first picture.
    `of_nobody`: the bytes for the last frame without anybody; None before the first such frame.
    `is_anybody_seen`: function that returns whether an avatar is on the screen; called only if bytes do not decide.
    """
    if shown == of_picture:
        return FrameWork.REUSE
    if shown == of_nobody or not is_anybody_seen():
        return FrameWork.NONE
    return FrameWork.FULL


#: A density counts as good if it is at least this share of the best density.
AS_GOOD = 0.95
#: Cost of a visible change of shape, in pixels of this many frames; also the number of frames in which a smaller shape
#: must be good before it is taken.
PATIENCE = 10
#: Movement per frame, as a share of the picture's side, at which a change is half as visible as at rest.
FAST = 0.01
#: A change of the density by this factor makes a change of shape twice as visible.
DENSITY_STEP = 1.25


@dataclass(frozen=True)
class HeldShape:
    """The shape in use.

    `shape`: (height, width). `foreseen`: foreseen shape that was taken last; None if none was taken yet.
    `smaller_for`: number of successive frames for which a smaller shape would have been good.
    """

    shape: Shape
    foreseen: Shape | None = None
    smaller_for: int = 0


#: A coarser level of the mesh is good if its error is below this share of the error budget.
EASE = 0.8


@dataclass(frozen=True)
class HeldMesh:
    """The level of an avatar's mesh in use.

    `level`: 0 for the whole mesh. `coarser_for`: number of successive frames for which the next coarser level would
    have been good.
    """

    level: int
    coarser_for: int = 0


def hold_mesh(errors_px: Sequence[float], budget_px: float, before: HeldMesh | None) -> HeldMesh:
    """Return the mesh level for a frame.

    `errors_px`: error bound of each level in this frame, finest level first; the first bound is 0.
    `budget_px`: error budget.
    `before`: level of the frame before, None for the first frame.

    The first frame takes the coarsest level within the budget. If the level in use exceeds the budget, the coarsest of
    the finer levels within the budget replaces it at once. Coarser levels are taken one by one, each after `PATIENCE`
    frames in which its bound was well within the budget.
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
    """The layout of one frame's tensor. `held`: state that the next call of `plan_tensor` gets as `before`."""

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
    """Return the plan of the tensor for the avatars at `rects`, at least one.

    `output`: (height, width) of the picture in pixels.
    `shapes`: shapes that are ready. If all of them are larger than the budget allows, any may be taken.
    `budget`: number of pixels that the tensor may have.
    `before`: state after the frame before, None for the first frame.
    `foreseen`: shape of this frame by `foreseen_changes`; None if nothing was foreseen.
    `networks`: number of the network of each avatar at `rects`; empty if one network paints all.
    Raises BadInputError when no shape has room for all avatars.
    """
    fits, good = _fits(rects, networks, output, shapes, budget)
    if not good:
        raise BadInputError("tensor shapes", f"{list(shapes)}", f"room for {len(rects)} avatars", "use a larger --size")
    held = _held(good, before, foreseen)
    return TensorPlan(fits[held.shape], held)


def _grouped(rects: Sequence[Rect], networks: Sequence[int]) -> list[list[Rect]]:
    return [[rects[place] for place in places] for places in by_network(networks or [0] * len(rects))]


def pixels_of(rects: Sequence[Rect], networks: Sequence[int], output: Shape, budget: TensorBudget) -> int:
    """Return the pixel budget of a frame's tensor: the largest budget for the avatars of any one network.

    `networks`: number of the network of each avatar at `rects`; empty if one network paints all.
    """
    return max(budget.of(own, output) for own in _grouped(rects, networks))


def _dense(
    rects: Sequence[Rect], networks: Sequence[int], output: Shape, shape: Shape, budget: TensorBudget
) -> DenseLayout | None:
    """Return the densest layout in tensors of `shape`, one per network; None if there is no room for all avatars."""

    def lay(own: Sequence[Rect]) -> DenseLayout | None:
        return lay_out_at(own, output, shape, budget.density(own, output))

    return apart(rects, networks or [0] * len(rects), lay)


def _fits(
    rects: Sequence[Rect], networks: Sequence[int], output: Shape, shapes: Sequence[Shape], budget: TensorBudget
) -> tuple[dict[Shape, DenseLayout], list[Shape]]:
    """Return {shape: layout} of all allowed shapes with room for the avatars, and a list of the good ones.

    A good shape is nearly as dense as the densest shape within the frame's budget. A good shape may exceed that budget,
    but not the largest budget of frames with as many avatars.
    """
    most = budget.most_of(max(map(len, _grouped(rects, networks))))
    pixels = pixels_of(rects, networks, output, budget)
    allowed = [shape for shape in shapes if area(shape) <= most] or shapes
    fits = {shape: fit for shape in allowed if (fit := _dense(rects, networks, output, shape, budget)) is not None}
    within = [fit.density for shape, fit in fits.items() if area(shape) <= pixels]
    enough = AS_GOOD * max(within or [fit.density for fit in fits.values()], default=0.0)
    return fits, [shape for shape, fit in fits.items() if fit.density >= enough]


def _held(good: Sequence[Shape], before: HeldShape | None, foreseen: Shape | None) -> HeldShape:
    """Return the shape to use, one of `good`.

    A foreseen shape is taken once, as soon as it is good. Otherwise the held shape stays while it is good; if it is
    not, the smallest good shape is taken. If none was foreseen, a smaller good shape is taken after `PATIENCE` frames.
    """
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
    """A frame that was examined before the run.

    `frame`: number of the frame. `rects`: mesh rectangle of each visible avatar, by the avatar's index.
    """

    frame: int
    rects: Mapping[int, Rect]

    def networks(self, of_all: Sequence[int]) -> list[int]:
        """Return the number of each visible avatar's network.

        `of_all`: number of each avatar's network. If one network paints all, it is empty, and the result is empty too.
        """
        return [of_all[number] for number in self.rects] if of_all else []


def foreseen_changes(
    looks: Sequence[LookAhead],
    output: Shape,
    shapes: Sequence[Shape],
    budget: TensorBudget,
    networks: Sequence[int] = (),
) -> tuple[tuple[int, Shape], ...]:
    """Return the shape at the first of `looks`, and each later change of shape, as (frame, shape).

    `looks`: frames that were examined, in order, at least one.
    `output`: (height, width) of the picture in pixels.
    `shapes`: shapes that are ready.
    `budget`: number of pixels that a tensor may have.
    `networks`: number of the network of each avatar of the scene; empty if one network paints all.

    The result is the sequence of good shapes that costs least: the pixels of all frames, plus the cost of the changes.
    Usually a new shape begins at an examined frame. It begins right after the previous examined frame if nobody was
    visible there, or if the old shape is no longer good.
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
    """Return the least cost, in pixels, of a sequence of shapes that ends with `shape`, and the shape before it.

    Pixels from this examined frame on do not count yet.
    `costs`: least cost by shape, up to the previous examined frame. `fits`: layout of each shape with room for the
    avatars. `price`: least cost of a change of shape, in pixels.
    """

    def change(origin: Shape) -> float:
        if origin == shape:
            return 0.0
        if origin not in fits or shape not in fits:
            return price
        return price * (1.0 + abs(math.log(fits[shape].density / fits[origin].density)) / math.log(DENSITY_STEP))

    return min(((cost + change(origin), origin) for origin, cost in costs.items()), key=lambda way: way[0])


def _speed(before: LookAhead, now: LookAhead) -> float:
    """Return the fastest movement of a side of a rectangle, per frame, as a share of the picture's sides."""
    frames = max(now.frame - before.frame, 1)
    both = now.rects.keys() & before.rects.keys()
    moved = [abs(a - b) / 2.0 for one in both for a, b in zip(now.rects[one], before.rects[one], strict=True)]
    return max(moved, default=0.0) / frames


def ideal_shape(rects: Sequence[Rect], output: Shape, budget: TensorBudget, networks: Sequence[int] = ()) -> Shape:
    """Return the shape within the budget that gives the avatars at `rects` the highest density; if equal, the smallest.

    If no shape has room for all avatars, the largest shape is returned.
    `networks`: number of the network of each avatar at `rects`; empty if one network paints all.
    """
    pixels = pixels_of(rects, networks, output, budget)
    tight = [tight_shape(own, output, budget.density(own, output)) for own in _grouped(rects, networks)]
    shapes = [*shapes_within(pixels), *(shape for shape in tight if area(shape) <= pixels)]
    fits = [(fit.density, shape) for shape in shapes if (fit := _dense(rects, networks, output, shape, budget))]
    if not fits:
        return max(shapes, key=area)
    return max(fits, key=lambda one: (one[0], -area(one[1]), one[1]))[1]


MOST_SHAPES = 10
#: A further shape must save at least this share of the pixels of all frames.
LEAST_SAVING = 0.02


class Demand(NamedTuple):
    """The needs of a frame: its ideal shape (height, width), and the number of pixels that its tensor may have."""

    ideal: Shape
    pixels: int


@dataclass(frozen=True)
class ShapeSet:
    """The shapes that a run prepares.

    `shapes`: (height, width) of each, the smallest first.
    `memory_bytes`: memory of their networks.
    `unserved`: number of frames that no shape serves, because of the limits; these frames are drawn less densely.
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
    """Return the shapes to prepare.

    `demands`: needs of the foreseen frames, at least one.
    `bytes_per_pixel`: memory of a network that is ready to run, per tensor pixel.
    `memory_bytes`: most memory of all networks.
    `most_shapes`: largest number of shapes.
    `optional`: whether the result may be empty; otherwise it has at least one shape, whatever its memory.
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
    """Return the union of two sets of shapes; the memory of a shape in both sets counts twice.

    `unserved` is taken from `first`, or from `second` if `first` has no shapes.
    """
    shapes = sorted({*first.shapes, *second.shapes}, key=lambda shape: (area(shape), shape))
    unserved = first.unserved if first.shapes else second.unserved
    return ShapeSet(tuple(shapes), first.memory_bytes + second.memory_bytes, unserved)


def larger_shapes(shapes: Sequence[Shape], most_pixels: int) -> list[Shape]:
    """Return new shapes that each just contain two of `shapes`, of at most `most_pixels` pixels; smallest first."""
    both = {(max(a[0], b[0]), max(a[1], b[1])) for a, b in combinations(shapes, 2)}
    return sorted((shape for shape in both - set(shapes) if area(shape) <= most_pixels), key=area)


def serves(shape: Shape, demand: Demand) -> bool:
    """Return whether a tensor of `shape` meets the needs `demand` of a frame."""
    (height, width), (ideal_height, ideal_width) = shape, demand.ideal
    large_enough = height >= AS_GOOD * ideal_height and width >= AS_GOOD * ideal_width
    return large_enough and area(shape) <= demand.pixels


def _next(frames: Mapping[Demand, int], chosen: Sequence[Shape]) -> Shape | None:
    """Return the shape to add to `chosen`; None if no further shape is worth it."""
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
    """Return the pixels of all frames, each in the smallest chosen shape that serves it."""
    return sum(
        count * min(area(shape) for shape in chosen if serves(shape, demand)) for demand, count in frames.items()
    )
