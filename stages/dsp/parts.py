"""Which part of the network a stage runs, and how the tensors of a cut lie in a slot.

Rule: what crosses a cut lies in the order of the cut, each tensor on its own cache lines; every process that looks at
the same configuration finds the same places.
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import onnx
from numpy.typing import NDArray

from trilane.arrays import U8
from trilane.avatars.network_file import NetworkFile, constants_of, reshaped
from trilane.avatars.network_split import NetworkPart, Shapes, split
from trilane.cache import Arrays, cached_arrays
from trilane.shapes import Shape
from trilane.stages.config import RunConfig

VERSION = "network parts 1"  # to be raised when the same network and cuts give other parts
SHAPES = ("inputs", "outputs", "crossing_in", "crossing_out")
LINE = 64  # bytes of a cache line, and of the widest vector register


def parts_for(config: RunConfig, network: NetworkFile, shape: Shape) -> list[NetworkPart]:
    """The parts of `network` for tensors of `shape`, cut as `config` says; one part when it is not cut.

    They are cached: inferring every shape of the graph again takes longer than reading them.
    """
    cuts = [cut.at for cut in config.cuts]
    sources = (VERSION, onnx.__version__, network.digest, *map(str, shape), *cuts)
    stored = cached_arrays(VERSION, sources, lambda: _to_arrays(split(reshaped(network, *shape), cuts)))
    return _from_arrays(stored, network.where)


def _to_arrays(parts: Sequence[NetworkPart]) -> dict[str, NDArray[Any]]:
    """Of each part the model's bytes, and its shapes as JSON."""
    arrays: dict[str, NDArray[Any]] = {}
    for number, part in enumerate(parts):
        shapes = json.dumps({name: list(getattr(part, name).items()) for name in SHAPES})
        arrays[f"model{number}"] = np.frombuffer(part.model.SerializeToString(), np.uint8)
        arrays[f"shapes{number}"] = np.frombuffer(shapes.encode(), np.uint8)
    return arrays


def _from_arrays(arrays: Arrays, where: str) -> list[NetworkPart]:
    parts = []
    for number in range(len(arrays) // 2):
        model = onnx.load_from_string(arrays[f"model{number}"].tobytes())
        rows = json.loads(arrays[f"shapes{number}"].tobytes())
        shapes = {name: {tensor: tuple(shape) for tensor, shape in rows[name]} for name in SHAPES}
        parts.append(NetworkPart(where, model, **shapes))
    return parts


def crossing_bytes(config: RunConfig, network: NetworkFile) -> list[int]:
    """Bytes that cross each cut of `network`, for the scene's shape that needs most. Raises BadInputError."""
    if not config.cuts:
        return []
    shapes = [[part.crossing_out for part in parts_for(config, network, shape)[:-1]] for shape in config.buckets]
    return [max(extent(crossing) for crossing in crossings) for crossings in zip(*shapes, strict=True)]


def constant_bytes(model: onnx.ModelProto) -> int:
    """Of the constants of `model`: weights, biases, scales."""
    return sum(
        math.prod(tensor.dims) * onnx.helper.tensor_dtype_to_np_dtype(tensor.data_type).itemsize
        for tensor in constants_of(model).values()
    )


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
