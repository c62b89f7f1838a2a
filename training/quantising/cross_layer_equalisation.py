"""Cross-layer equalisation: channels of neighbouring layers get similar ranges, and the network computes the same.

Rule: relu(s x) = s relu(x) for s > 0, so a channel may be scaled after one layer and back before the next.
Source: Nagel et al. 2019, "Data-Free Quantization Through Weight Equalization and Bias Correction", section 4.1.
"""

from __future__ import annotations

import copy
from collections.abc import Iterator

import numpy as np
import onnx
from numpy.typing import NDArray
from onnx import numpy_helper

ROUNDS = 3
#: Least and greatest factor between two layers in one round.
SCALE_LIMITS = (1e-2, 1e2)


def equalised(model: onnx.ModelProto) -> onnx.ModelProto:
    """A copy of the float network with every Conv -> ReLU -> Conv chain equalised; grouped layers are not changed.

    With r1 the range of the weights that make a channel and r2 of those that read it, s = sqrt(r1 r2) / r2: the first
    layer's row is divided by s, the second layer's column is multiplied by it.
    """
    result = copy.deepcopy(model)
    weights = {tensor.name: tensor for tensor in result.graph.initializer}
    arrays = {name: numpy_helper.to_array(tensor).copy() for name, tensor in weights.items()}
    pairs = list(_pairs(result.graph, weights))
    for _ in range(ROUNDS):
        for first, second in pairs:
            _equalise(first, second, arrays)
    for name, array in arrays.items():
        weights[name].CopyFrom(numpy_helper.from_array(array, name))
    return result


def _pairs(
    graph: onnx.GraphProto, weights: dict[str, onnx.TensorProto]
) -> Iterator[tuple[onnx.NodeProto, onnx.NodeProto]]:
    """Pairs of Convs with only a ReLU between them."""
    users: dict[str, list[onnx.NodeProto]] = {}
    for node in graph.node:
        for name in node.input:
            users.setdefault(name, []).append(node)
    for first in graph.node:
        relu = _only(users, first)
        second = _only(users, relu) if relu is not None and relu.op_type == "Relu" else None
        if second is not None and all(_plain(node, weights, users) for node in (first, second)):
            yield first, second


def _only(users: dict[str, list[onnx.NodeProto]], node: onnx.NodeProto) -> onnx.NodeProto | None:
    """The only node that reads the output of `node`; None when there are others or none."""
    readers = users.get(node.output[0], [])
    return readers[0] if len(readers) == 1 else None


def _plain(node: onnx.NodeProto, weights: dict[str, onnx.TensorProto], users: dict[str, list[onnx.NodeProto]]) -> bool:
    """Whether `node` is a Conv of one group that shares its weights with no other node."""
    if node.op_type != "Conv" or any(a.name == "group" and a.i != 1 for a in node.attribute):
        return False
    return all(name in weights and len(users[name]) == 1 for name in node.input[1:])


def _equalise(first: onnx.NodeProto, second: onnx.NodeProto, arrays: dict[str, NDArray[np.float32]]) -> None:
    made, read = arrays[first.input[1]], arrays[second.input[1]]
    r1, r2 = np.abs(made).max(axis=(1, 2, 3)), np.abs(read).max(axis=(0, 2, 3))
    alive = (r1 > 0) & (r2 > 0)
    scale = np.where(alive, np.sqrt(r1 / np.where(alive, r2, 1)), 1).clip(*SCALE_LIMITS).astype(np.float32)
    made /= scale[:, None, None, None]
    read *= scale[None, :, None, None]
    if len(first.input) > 2:
        arrays[first.input[2]] /= scale
