"""Which tensor shapes a scene needs. Rule: chosen before the run from the frames that can be foreseen, so that every
shape has its network ready; their number and their memory have stated limits.

A shape serves a frame when it has room for the frame's tight shape. The first shapes serve all frames; further ones are
added, the one that saves most first, as long as it saves enough and fits into the memory.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

from trilane.shapes import Shape

MOST_SHAPES = 10
#: Share of the pixels of all frames that a further shape has to save.
LEAST_SAVING = 0.02


@dataclass(frozen=True)
class ShapeSet:
    """`shapes` (height, width), the smallest first.

    `memory_bytes`: what their networks take. `over_limit`: whether that is more than was allowed, because fewer shapes
    cannot serve all frames.
    """

    shapes: tuple[Shape, ...]
    memory_bytes: int
    over_limit: bool


def choose_shapes(
    tight: Iterable[Shape],
    most_pixels: int,
    bytes_per_pixel: float,
    memory_bytes: int,
    most_shapes: int = MOST_SHAPES,
) -> ShapeSet:
    """The shapes to prepare.

    `tight`: shape of least area for each foreseen frame, at least one.
    `most_pixels`: of a tensor that is not itself some frame's tight shape.
    `bytes_per_pixel`: memory of a network that is ready to run, for each pixel of its tensor.
    `memory_bytes`: what all of them may take.
    `most_shapes`: how many there may be, unless the frames need more.
    """
    demands = Counter(tight)
    chosen = _serving_all(demands, most_pixels)
    total = _work(demands, chosen)
    while len(chosen) < most_shapes:
        better = min(demands, key=lambda shape: (_work(demands, [*chosen, shape]), shape))
        work = _work(demands, [*chosen, better])
        memory = bytes_per_pixel * sum(map(_area, (*chosen, better)))
        if total - work < LEAST_SAVING * total or memory > memory_bytes:
            break
        chosen, total = [*chosen, better], work
    needed = math.ceil(bytes_per_pixel * sum(map(_area, chosen)))
    return ShapeSet(tuple(sorted(chosen, key=lambda shape: (_area(shape), shape))), needed, needed > memory_bytes)


def serves(shape: Shape, tight: Shape) -> bool:
    """Whether a tensor of `shape` has room for what `tight` has room for."""
    return shape[0] >= tight[0] and shape[1] >= tight[1]


def _serving_all(demands: Iterable[Shape], most_pixels: int) -> list[Shape]:
    """One shape with room for everything; where that is too large, every demand that no other one has room for."""
    shapes = sorted(set(demands))
    whole = max(height for height, _ in shapes), max(width for _, width in shapes)
    if _area(whole) <= most_pixels:
        return [whole]
    return [shape for shape in shapes if not any(serves(other, shape) for other in shapes if other != shape)]


def _work(demands: Mapping[Shape, int], chosen: Sequence[Shape]) -> int:
    """Pixels of all frames, each in the smallest shape that serves it."""
    return sum(
        count * min(_area(shape) for shape in chosen if serves(shape, tight)) for tight, count in demands.items()
    )


def _area(shape: Shape) -> int:
    return shape[0] * shape[1]
