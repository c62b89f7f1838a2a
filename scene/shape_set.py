"""Which tensor shapes a scene needs. Rule: chosen before the run from the frames that can be foreseen, so that every
shape has its network ready; their number and their memory have stated limits.

A shape serves a frame when it is within the frame's budget of pixels and nearly as dense as the frame's ideal shape.
First come the shapes that serve most frames, until all are served; then those that save work, as long as they save
enough.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import NamedTuple

from trilane.scene.planner import AS_GOOD, area
from trilane.shapes import Shape

MOST_SHAPES = 10
#: Share of the pixels of all frames that a further shape has to save.
LEAST_SAVING = 0.02


class Demand(NamedTuple):
    """Of a frame: its ideal shape (height, width), and the pixels that its tensor may have."""

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

    `demands`: of the frames that can be foreseen, at least one.
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
    """Both sets. `unserved` is that of the first, unless it has no shapes. A shape of both counts twice as memory."""
    shapes = sorted({*first.shapes, *second.shapes}, key=lambda shape: (area(shape), shape))
    unserved = first.unserved if first.shapes else second.unserved
    return ShapeSet(tuple(shapes), first.memory_bytes + second.memory_bytes, unserved)


def larger_shapes(shapes: Sequence[Shape], most_pixels: int) -> list[Shape]:
    """Of each two of `shapes` the one that holds both, where that is none of them and has at most `most_pixels`."""
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
