"""Scales that are powers of two, and sums that are never half way between two bytes: every runtime rounds alike.

Rule: between bytes there are only integer sums and shifts, so float32, float64 and fixed point agree on every sum; and
as weights are even and biases odd, sums are odd, and which way a runtime rounds a half does not matter.

A scale holds `COVER` of the measured range: the rest is cut off where that halves the step.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from typing import Any

import numpy as np
import onnx
from numpy.typing import NDArray
from onnx import numpy_helper
from onnxruntime.quantization import QuantType

from trilane.training.quantising.calibration import MOVES

COVER = 0.75
BYTE = 255
#: Operators that need no rounding when what they read and what they make have one scale.
SHARING = (*MOVES, "Concat", "Add")
#: Of these a network must consist: others (norms over the picture, means, products) round inside, each runtime its way.
ALIKE = {*SHARING, "Conv", "Relu", "Sigmoid", "Constant", "Identity"}
#: Largest integer weight, by `reduce_range`; all are even.
WEIGHT_TOP = {True: 64, False: 126}
#: An accumulator's unit is at least this part of its output's step: float32 then holds every sum that counts.
FINEST = 2.0**-16
#: And at most this part: of a half, odd sums would all be half way; of more, HTP gives another picture.
COARSEST = 0.25
#: Units of an accumulator that a bias may be, for the same reason.
LARGEST_BIAS = 2.0**22


class NotAlikeError(ValueError):
    """The network's weights are so large that a unit of a sum is too much of its output's step."""


def may_round_alike(model: onnx.ModelProto) -> bool:
    """Whether float network `model` is made of operators that every runtime can be made to compute alike."""
    return all(node.op_type in ALIKE for node in model.graph.node)


def dyadic_ranges(model: onnx.ModelProto, ranges: Any) -> None:
    """Widen or cut each range of `ranges` (ONNX Runtime's TensorsData) to 256 steps of a power of two.

    Tensors that are moved, joined or added share one step, so that a Concat and an Add round nothing. Rectified tensors
    begin at 0.
    """
    cut = {name: _cut(name, ranges[name], model) for name in ranges.keys()}  # noqa: SIM118 - no dict
    for members in _groups(model, cut):
        step = max(_step(*cut[name]) for name in members)
        for name in members:
            zero = _zero_point(cut[name][0], step)
            ranges[name].lowest = np.float32(-zero * step)
            ranges[name].highest = np.float32((BYTE - zero) * step)


def dyadic_weights(model: onnx.ModelProto, ranges: Any, reduce_range: bool) -> dict[str, list[dict[str, Any]]]:
    """Round the weights and biases of every Conv, and say at what scales: a power of two for each output channel.

    Weights become even numbers of steps and biases odd ones, so that no sum is half way between two bytes. Scales are
    in the form of ONNX Runtime's `TensorQuantOverrides`, by the weights' name. Raises NotAlikeError.
    """
    written = _written(model)
    constants = {tensor.name: tensor for tensor in model.graph.initializer}
    known = set(ranges.keys())
    found = {}
    for node in model.graph.node:
        ends = {node.input[0], node.output[0]} if node.op_type == "Conv" else set()
        if not ends or not ends <= known or node.input[1] not in constants:
            continue
        source, target = (_step_of(ranges[name]) for name in (node.input[0], written[node.output[0]]))
        kernel = constants[node.input[1]]
        if len(node.input) == 2:
            none = numpy_helper.from_array(np.zeros(kernel.dims[0], np.float32), f"{node.output[0]}_bias")
            constants[none.name] = model.graph.initializer.add()
            constants[none.name].CopyFrom(none)
            node.input.append(none.name)
        bias = constants[node.input[2]]
        finest = np.maximum(FINEST * target, np.abs(numpy_helper.to_array(bias)) / LARGEST_BIAS) / source
        scales = _round_weights(kernel, finest, WEIGHT_TOP[reduce_range])
        if (source * scales > COARSEST * target).any():
            raise NotAlikeError(node.name)
        _round_bias(bias, source * scales)
        found[kernel.name] = [
            {"quant_type": QuantType.QInt8, "axis": 0, "scale": np.float32(scale), "zero_point": np.int8(0)}
            for scale in scales
        ]
    return found


def _written(model: onnx.ModelProto) -> dict[str, str]:
    """Each tensor, to what is written of it: what a Relu makes of it when nothing else reads it, else itself."""
    readers: dict[str, list[onnx.NodeProto]] = {}
    for node in model.graph.node:
        for name in node.input:
            readers.setdefault(name, []).append(node)
    written = {}
    for name in (name for node in model.graph.node for name in node.output):
        found = readers.get(name, [])
        written[name] = found[0].output[0] if len(found) == 1 and found[0].op_type == "Relu" else name
    return written


def _round_weights(kernel: onnx.TensorProto, finest: NDArray[np.float64], top: int) -> NDArray[np.float64]:
    """Make `kernel` (O, I, h, w) even multiples, up to `top`, of the scales (O,) returned: `finest` (O,) at least."""
    values = numpy_helper.to_array(kernel).astype(np.float64)
    rows = values.reshape(len(values), -1)
    largest = np.abs(rows).max(axis=1) / (top + 0.99)
    scales: NDArray[np.float64] = 2.0 ** np.ceil(np.log2(np.maximum(largest, finest)))
    even = 2 * scales[:, None]
    kernel.CopyFrom(_like(kernel, np.rint(rows / even) * even, values.shape))
    return scales


def _round_bias(bias: onnx.TensorProto, scales: NDArray[np.float64]) -> None:
    """Make `bias` (O,) odd multiples of `scales`."""
    steps = numpy_helper.to_array(bias).astype(np.float64) / scales
    bias.CopyFrom(_like(bias, (2 * np.rint((steps - 1) / 2) + 1) * scales, steps.shape))


def _like(tensor: onnx.TensorProto, values: NDArray[np.float64], shape: tuple[int, ...]) -> onnx.TensorProto:
    return numpy_helper.from_array(values.reshape(shape).astype(np.float32), tensor.name)


def _step_of(data: Any) -> float:
    return float(data.highest - data.lowest) / BYTE


def _cut(name: str, data: Any, model: onnx.ModelProto) -> tuple[float, float]:
    """What of the measured range is to be held: from at most 0 to at least 0.

    All of the network's own ends, and of the logits, or nothing would be quite transparent.
    """
    makers = {out: node for node in model.graph.node for out in node.output}
    ends = {value.name for value in (model.graph.input[0], model.graph.output[0])}
    logits = {source for node in model.graph.node if node.op_type == "Sigmoid" for source in node.input}
    share = 1.0 if name in ends | logits else COVER
    low, high = (share * float(np.asarray(bound).item()) for bound in (data.lowest, data.highest))
    rectified = name in makers and makers[name].op_type == "Relu"
    return 0.0 if rectified else min(low, 0.0), max(high, 0.0)


def _step(low: float, high: float) -> float:
    """The least power of two of which 256 steps hold `low` to `high`, but for the last step."""
    step = 2.0 ** math.ceil(math.log2(max(high - low, 1e-9) / (BYTE + 1)))
    while high / step + _zero_point(low, step) > BYTE + 1:
        step *= 2
    return step


def _zero_point(low: float, step: float) -> int:
    return math.ceil(-low / step - 0.5)


def _groups(model: onnx.ModelProto, known: Iterable[str]) -> list[set[str]]:
    """Known tensors, those together that share a step."""
    group = {name: {name} for name in known}
    for names in _sharing(model):
        together: set[str] = set().union(*(group[name] for name in names if name in group))
        group.update(dict.fromkeys(together, together))
    return list({id(members): members for members in group.values()}.values())


def _sharing(model: onnx.ModelProto) -> Iterator[list[str]]:
    """The tensors at each operator that shares, with what a rectifier behind an Add makes of its sum."""
    followers = {name: node for node in model.graph.node for name in node.input}
    for node in model.graph.node:
        if node.op_type in SHARING:
            yield [*node.input, node.output[0]]
            after = followers.get(node.output[0])
            if node.op_type == "Add" and after is not None and after.op_type == "Relu":
                yield [node.output[0], after.output[0]]
                yield [*node.input, after.output[0]]
