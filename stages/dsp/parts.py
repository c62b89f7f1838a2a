"""Which part of the network a stage runs, and how the tensors of a cut lie in a slot.

Rule: what crosses a cut lies in the order of the cut, each tensor on its own cache lines; every process that looks at
the same configuration finds the same places.
"""

from __future__ import annotations

import math

from trilane.arrays import U8
from trilane.avatars.integer_network import NetworkFile
from trilane.avatars.network_reshape import reshaped
from trilane.avatars.network_split import NetworkPart, Shapes, split
from trilane.shapes import Shape
from trilane.stages.config import RunConfig

LINE = 64  # bytes of a cache line, and of the widest vector register


def parts_for(config: RunConfig, network: NetworkFile, shape: Shape) -> list[NetworkPart]:
    """The parts of `network` for tensors of `shape`, cut as `config` says; one part when it is not cut."""
    return split(reshaped(network, *shape), [cut.at for cut in config.cuts])


def crossing_bytes(config: RunConfig, network: NetworkFile) -> list[int]:
    """Bytes that cross each cut of `network`, for the scene's shape that needs most. Raises BadInputError."""
    if not config.cuts:
        return []
    shapes = [[part.crossing_out for part in parts_for(config, network, shape)[:-1]] for shape in config.buckets]
    return [max(extent(crossing) for crossing in crossings) for crossings in zip(*shapes, strict=True)]


def extent(shapes: Shapes) -> int:
    """Bytes that tensors of `shapes` take up in a slot."""
    return sum(-(-math.prod(shape) // LINE) * LINE for shape in shapes.values())


def views(payload: U8, shapes: Shapes) -> dict[str, U8]:
    """Tensors of `shapes` in a slot, in their order. Raises ValueError when the slot is too small."""
    found, start = {}, 0
    for name, shape in shapes.items():
        size = math.prod(shape)
        if start + size > payload.size:
            raise ValueError(f"a slot of {payload.size} bytes, {start + size} needed")
        found[name] = payload[start : start + size].reshape(shape)
        start += -(-size // LINE) * LINE
    return found
