"""The noise model of an ideal quantiser: its steps follow from the float network and the input, not from the quantiser.

Rule: of the integer network only the places are used where it rounds, and whether its steps are powers of two. A stored
tensor has 255 steps from the least to the greatest value that the float network gives it on this very input; a weight
has `LARGEST_WEIGHT` to either side of 0, by output channel; biases are exact. Where steps are powers of two, each is
`POWER_OF_TWO` times as wide: the most that rounding up to a power of two costs a stored tensor; for a weight the even
multiples, which rounding alike leaves, cost as much already. The picture has its own steps, of 1/255.
"""

from __future__ import annotations

import numpy as np
import onnx
from numpy.typing import NDArray

from trilane.arrays import F32, U8
from trilane.training.quantising.calibration import MOVES
from trilane.training.quantising.noise_model import PICTURE, TOP, NoiseGraph, NoiseModel, session
from trilane.training.quantising.quantise import Quantised

#: Greatest ratio of the least power of two that is large enough to the step that is large enough.
POWER_OF_TWO = 2
BYTE_TOP, INT16_TOP = 255, 2**15 - 1
#: AVX2 without VNNI adds two products of a byte and a weight in 16 bits and cuts off what is beyond (Intel's manual,
#: VPMADDUBSW). A bundle gives the same picture on every CPU, so no quantiser may use weights that are larger.
LARGEST_WEIGHT = INT16_TOP // (2 * BYTE_TOP)
#: Operators whose output consists of values of their input.
MOVES_VALUES = (*MOVES, "Relu", "Identity")
Range = tuple[float, float]


def ideal_noise_model(model: onnx.ModelProto, quantised: Quantised, tensor: U8) -> NoiseModel:
    """The noise model with the ideal steps for the bytes `tensor` (N, H, W, C).

    `model`: the float network that `quantised` was made from. Raises BadInputError as `noise_model`.
    """
    graph = _IdealGraph(quantised, float_ranges(model, quantised, tensor))
    for node in quantised.network.model.graph.node:
        graph.take(node)
    return graph.finished()


def float_ranges(model: onnx.ModelProto, quantised: Quantised, tensor: U8) -> dict[str, Range]:
    """Of each stored tensor, by its Quantize node's output: least and greatest value in floats, 0 included."""
    graph = _FloatGraph(model, quantised)
    for node in quantised.network.model.graph.node:
        graph.take(node)
    plain = graph.finished()
    plain.model.graph.output.extend(onnx.ValueInfoProto(name=name) for name in graph.stored)
    feeds = {name: value for name, (value, _) in plain.constants.items()}
    values = session(plain.model).run(graph.stored, {plain.model.graph.input[0].name: tensor, **feeds})
    return {
        name: (min(float(value.min()), 0.0), max(float(value.max()), 0.0))
        for name, value in zip(graph.stored, values, strict=True)
    }


class _FloatGraph(NoiseGraph):
    """A network in floats that rounds nothing, with the names of the tensors that would be stored.

    In integers a rectifier is the lower end of its output's range, so it is put back where `model` has one.
    """

    def __init__(self, model: onnx.ModelProto, quantised: Quantised) -> None:
        super().__init__(quantised)
        self.rectified = {node.output[0] for node in model.graph.node if node.op_type == "Relu"}
        self.stored: list[str] = []

    def store(self, node: onnx.NodeProto) -> None:
        self.stored.append(node.output[0])
        kind = "Relu" if node.input[0] in self.rectified else "Identity"
        self.nodes.append(onnx.helper.make_node(kind, [node.input[0]], [node.output[0]]))


class _IdealGraph(NoiseGraph):
    """A noise model with the steps of an ideal quantiser."""

    def __init__(self, quantised: Quantised, ranges: dict[str, Range]) -> None:
        super().__init__(quantised)
        self.ranges = ranges
        self.widened = POWER_OF_TWO if quantised.facts["rounds_alike"] else 1

    def constant(self, node: onnx.NodeProto) -> tuple[F32, NDArray[np.float64]]:
        stored = self.values[node.input[0]]
        value = self.float_value(node.input[0], stored.shape)
        if stored.dtype == np.int32:
            return value, np.zeros(value.shape)
        others = tuple(range(1, value.ndim)) if value.ndim > 1 else None
        step = np.abs(value).max(axis=others, keepdims=True).astype(np.float64) / LARGEST_WEIGHT
        return value, np.where(value == 0, 0.0, self.widened * step / 2)

    def bytes_of(self, node: onnx.NodeProto) -> tuple[float, float, float]:
        if self.makers[self.source.output[0].name].input[0] == node.output[0]:
            return 0.0, 1.0, 1 / PICTURE
        low, high = self.ranges[node.output[0]]
        step = self.widened * max(high - low, float(np.finfo(np.float32).tiny)) / TOP
        return self.widened * low, self.widened * high, step

    def is_multiple(self, name: str, step: float) -> bool:
        """Whether tensor `name` is a stored one that was only moved; joined and added ones have steps of their own."""
        maker = self.makers.get(name)
        if maker is None or maker.op_type == "DequantizeLinear":
            return maker is not None
        return maker.op_type in MOVES_VALUES and self.is_multiple(maker.input[0], step)
