"""Calibration: the range of each tensor of a network on real frames, and the scales that follow from it.

Rule: ranges are measured. They are narrowed where bytes cannot show the difference, widened where a norm over the
picture reads them, and made equal where an operator only moves bytes. Where all runtimes can round alike, each range
becomes 256 steps of a power of two.
"""

from __future__ import annotations

import contextlib
import io
import math
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import onnx
from numpy.typing import NDArray
from onnx import numpy_helper
from onnxruntime.quantization import CalibrationDataReader, CalibrationMethod, QuantType, create_calibrator

from trilane.errors import BadInputError

FINITE = "a network whose tensors are finite on the frames"
METHODS = {
    "minmax": (CalibrationMethod.MinMax, {}),
    "percentile": (CalibrationMethod.Percentile, {"percentile": 99.99}),
    "entropy": (CalibrationMethod.Entropy, {}),
}
#: At this logit and beyond, the sigmoid rounds to byte 0 or 255, so a wider range would only make steps coarser.
LOGIT_LIMIT = 6.5
#: Operators that only move bytes, so that their output has the range of their input.
MOVES = ("Resize", "MaxPool", "Reshape", "Transpose", "Slice", "Split", "DepthToSpace", "SpaceToDepth")
RECTIFIERS = ("Relu", "Clip")


class _OneFrame(CalibrationDataReader):
    def __init__(self, name: str, frame: NDArray[np.float32]) -> None:
        self.feeds: Iterator[dict[str, Any]] = iter([{name: frame}])

    def get_next(self) -> dict[str, Any] | None:
        return next(self.feeds, None)


def measure(path: Path, frames: Sequence[NDArray[np.float32]], method: str, operators: Sequence[str]) -> Any:
    """Return the ranges of the tensors, ONNX Runtime's TensorsData.

    `path`: file of the float network; a second file is written beside it.
    `frames`: (H, W, C) float32, fed one by one, so that memory does not grow with their number.
    `method`: a name of `METHODS`.
    `operators`: types of the operators whose inputs and outputs are measured.
    Raises BadInputError for an unknown method or tensors that are not finite.
    """
    if method not in METHODS:
        raise BadInputError("quantise", f"method {method!r}", f"one of {', '.join(METHODS)}")
    kind, options = METHODS[method]
    name = onnx.load(path, load_external_data=False).graph.input[0].name
    calibrator = create_calibrator(
        path, list(operators), str(path.with_suffix(".augmented.onnx")), calibrate_method=kind, extra_options=options
    )
    with contextlib.redirect_stdout(io.StringIO()):
        try:
            for frame in frames:
                nchw = np.ascontiguousarray(frame.transpose(2, 0, 1)[None], np.float32)
                calibrator.collect_data(_OneFrame(name, nchw))
            ranges = calibrator.compute_data()
        except ValueError as error:  # a histogram of NaN, or of values of too different sizes
            raise BadInputError("calibration", str(error), FINITE) from error
    for tensor in ranges.keys():  # noqa: SIM118 - no dict
        if not all(np.isfinite(bound).all() for bound in (ranges[tensor].lowest, ranges[tensor].highest)):
            raise BadInputError("calibration", f"tensor {tensor!r} without end", FINITE)
    return ranges


def limit_logits(model: onnx.ModelProto, ranges: Any) -> None:
    """Narrow the range of the last sigmoid's input to `LOGIT_LIMIT`. Raises BadInputError when there is no sigmoid."""
    last = next((node for node in model.graph.node if node.output[0] == model.graph.output[0].name), None)
    if last is None or last.op_type != "Sigmoid":
        raise BadInputError("quantise", f"output made by {last and last.op_type}", "a Sigmoid")
    logits = ranges[last.input[0]]
    logits.lowest = np.maximum(logits.lowest, np.float32(-LOGIT_LIMIT))
    logits.highest = np.minimum(logits.highest, np.float32(LOGIT_LIMIT))


def saturated(frames: Sequence[NDArray[np.float32]]) -> list[NDArray[np.float32]]:
    """Return `frames` with every value moved to the end of their common range on its side of 0; 0 stays.

    These are the bytes of the strongest contrast that the network's input can hold.
    """
    low, high = min(frame.min() for frame in frames), max(frame.max() for frame in frames)
    ends = np.float32(min(low, 0)), np.float32(max(high, 0))
    return [np.where(frame > 0, ends[1], np.where(frame < 0, ends[0], np.float32(0))) for frame in frames]


def norm_inputs(model: onnx.ModelProto) -> set[str]:
    """Return the tensors that norms over the picture read, and the tensors from which these were moved."""
    makers = {out: node for node in model.graph.node for out in node.output}
    norms = (node for node in model.graph.node if node.op_type == "InstanceNormalization")
    return {source for node in norms for source in _sources(node.input[0], makers)}


def widen(ranges: Any, names: set[str], wider: Any) -> None:
    """Extend the ranges of tensors `names`, in place, to the ranges in `wider`.

    A norm divides by the picture's own deviation, so its input carries the same picture at any contrast. Clipped at the
    contrast of usual frames, a stronger picture would become a different one.
    """
    for name in names & set(ranges.keys()):
        ranges[name].lowest = np.minimum(ranges[name].lowest, wider[name].lowest)
        ranges[name].highest = np.maximum(ranges[name].highest, wider[name].highest)


def share_ranges(model: onnx.ModelProto, ranges: Any) -> None:
    """Give the inputs and the output of each Concat one range, so that it moves bytes and rounds nothing. In place.

    Otherwise runtimes that fuse a Concat into the layers before it would clamp at other values than runtimes that do
    not. A Concat is left as it is when the common range would be signed and one of its tensors is rectified: that
    tensor would lose its clamp at 0.
    """
    makers = {out: node for node in model.graph.node for out in node.output}
    for node in model.graph.node:
        if node.op_type != "Concat":
            continue
        members = {node.output[0], *(source for name in node.input for source in _sources(name, makers))}
        known = [ranges[name] for name in members if name in ranges]
        low, high = min(r.lowest for r in known), max(r.highest for r in known)
        rectified = any(name in makers and makers[name].op_type in RECTIFIERS for name in members)
        if low < 0 and rectified:
            continue
        for member in known:
            member.lowest, member.highest = low, high


def _sources(name: str, makers: dict[str, onnx.NodeProto]) -> Iterator[str]:
    """Yield `name`, and the tensors from which operators of `MOVES` made it."""
    yield name
    while name in makers and makers[name].op_type in MOVES:
        name = makers[name].input[0]
        yield name


# Makes the scales powers of two and keeps sums off the middle between two bytes, so that all runtimes round alike.
#
# Rule: between bytes there are only integer sums and shifts, so float32, float64 and fixed point agree on every sum.
# Weights are even and biases odd, so every sum is odd and never half way between two bytes. It then makes no difference
# how a runtime rounds halves.
#
# A scale covers only the share `COVER` of the measured range when that halves the step; values beyond it are clipped.

COVER = 0.75
BYTE = 255
#: Operators that round nothing when their inputs and their output have the same scale.
SHARING = (*MOVES, "Concat", "Add")
#: A network of these operators alone can round alike. Other operators (norms over the picture, means, products) round
#: inside, and runtimes differ in how they do so.
ALIKE = {*SHARING, "Conv", "Relu", "Sigmoid", "Constant", "Identity"}
#: Largest integer weight, by `reduce_range`; all weights are even.
WEIGHT_TOP = {True: 64, False: 126}
#: Least size of an accumulator's unit, in steps of its output, with which float32 represents every sum exactly.
FINEST = 2.0**-16
#: Greatest size of that unit, in the same steps. At a half, all odd sums would be half way between bytes; above a
#: quarter, HTP was seen to give another picture.
COARSEST = 0.25
#: Largest bias in units of the accumulator, so that float32 represents every sum exactly.
LARGEST_BIAS = 2.0**22


class CannotRoundAlikeError(ValueError):
    """A layer's weights are so large that a unit of its sum exceeds `COARSEST` steps of its output."""


def may_round_alike(model: onnx.ModelProto) -> bool:
    """Return whether all operators of the float network `model` can be made to round alike on every runtime."""
    return all(node.op_type in ALIKE for node in model.graph.node)


def power_of_two_ranges(model: onnx.ModelProto, ranges: Any) -> None:
    """Change each range of `ranges`, ONNX Runtime's TensorsData, to 256 steps of a power of two, in place.

    Tensors that are moved, joined or added get the same step, so that a Concat and an Add round nothing. Ranges of
    rectified tensors begin at 0.
    """
    cut = {name: _cut(name, ranges[name], model) for name in ranges.keys()}  # noqa: SIM118 - no dict
    for members in _groups(model, cut):
        step = max(_step(*cut[name]) for name in members)
        for name in members:
            zero = _zero_point(cut[name][0], step)
            ranges[name].lowest = np.float32(-zero * step)
            ranges[name].highest = np.float32((BYTE - zero) * step)


def power_of_two_weights(model: onnx.ModelProto, ranges: Any, reduce_range: bool) -> dict[str, list[dict[str, Any]]]:
    """Round the weights and biases of every Conv in place, and return their scales, a power of two by output channel.

    Weights become even numbers of steps and biases odd ones, so that no sum is half way between two bytes. The scales
    are ONNX Runtime's `TensorQuantOverrides`, by the weights' name. `ranges`: ranges from `power_of_two_ranges`. Raises
    CannotRoundAlikeError.
    """
    stored = _stored_as(model)
    constants = {tensor.name: tensor for tensor in model.graph.initializer}
    known = set(ranges.keys())
    overrides = {}
    for node in model.graph.node:
        ends = {node.input[0], node.output[0]} if node.op_type == "Conv" else set()
        if not ends or not ends <= known or node.input[1] not in constants:
            continue
        source, target = (_step_of(ranges[name]) for name in (node.input[0], stored[node.output[0]]))
        kernel = constants[node.input[1]]
        bias = _bias_of(node, kernel, constants, model)
        finest = np.maximum(FINEST * target, np.abs(numpy_helper.to_array(bias)) / LARGEST_BIAS) / source
        scales = _round_weights(kernel, finest, WEIGHT_TOP[reduce_range])
        if (source * scales > COARSEST * target).any():
            raise CannotRoundAlikeError(node.name)
        _round_bias(bias, source * scales)
        overrides[kernel.name] = [
            {"quant_type": QuantType.QInt8, "axis": 0, "scale": np.float32(scale), "zero_point": np.int8(0)}
            for scale in scales
        ]
    return overrides


def _bias_of(
    node: onnx.NodeProto, kernel: onnx.TensorProto, constants: dict[str, onnx.TensorProto], model: onnx.ModelProto
) -> onnx.TensorProto:
    """Return the bias of Conv `node`; a Conv without one is given a bias of zeros."""
    if len(node.input) == 2:
        zeros = numpy_helper.from_array(np.zeros(kernel.dims[0], np.float32), f"{node.output[0]}_bias")
        constants[zeros.name] = model.graph.initializer.add()
        constants[zeros.name].CopyFrom(zeros)
        node.input.append(zeros.name)
    return constants[node.input[2]]


def _stored_as(model: onnx.ModelProto) -> dict[str, str]:
    """Map each tensor to the one that is stored in bytes for it: the output of its Relu, if only a Relu reads it."""
    readers: dict[str, list[onnx.NodeProto]] = {}
    for node in model.graph.node:
        for name in node.input:
            readers.setdefault(name, []).append(node)
    stored = {}
    for name in (name for node in model.graph.node for name in node.output):
        after = readers.get(name, [])
        stored[name] = after[0].output[0] if len(after) == 1 and after[0].op_type == "Relu" else name
    return stored


def _round_weights(kernel: onnx.TensorProto, finest: NDArray[np.float64], top: int) -> NDArray[np.float64]:
    """Round `kernel` (O, I, h, w) to even multiples, up to `top`, of the returned scales (O,), in place.

    Each scale is a power of two and at least `finest` (O,).
    """
    values = numpy_helper.to_array(kernel).astype(np.float64)
    rows = values.reshape(len(values), -1)
    largest = np.abs(rows).max(axis=1) / (top + 0.99)
    scales: NDArray[np.float64] = 2.0 ** np.ceil(np.log2(np.maximum(largest, finest)))
    even = 2 * scales[:, None]
    kernel.CopyFrom(_like(kernel, np.rint(rows / even) * even, values.shape))
    return scales


def _round_bias(bias: onnx.TensorProto, scales: NDArray[np.float64]) -> None:
    """Round `bias` (O,) to odd multiples of `scales` (O,), in place.

    A bias of 0 lies half way between two odd multiples. Every second channel then goes up and the others down, because
    the whole picture would move if all went up.
    """
    steps = numpy_helper.to_array(bias).astype(np.float64) / scales
    below = 2 * np.floor(steps / 2) + 1
    goes_down = (steps % 2 == 0) & (np.arange(len(steps)) % 2 == 1)
    bias.CopyFrom(_like(bias, (below - 2 * goes_down) * scales, steps.shape))


def _like(tensor: onnx.TensorProto, values: NDArray[np.float64], shape: tuple[int, ...]) -> onnx.TensorProto:
    return numpy_helper.from_array(values.reshape(shape).astype(np.float32), tensor.name)


def _step_of(data: Any) -> float:
    return float(data.highest - data.lowest) / BYTE


def _cut(name: str, data: Any, model: onnx.ModelProto) -> tuple[float, float]:
    """Return the part of the measured range `data` that bytes will cover; it includes 0.

    The whole range is covered for the network's input, its output and the logits: clipped logits would leave no pixel
    fully transparent.
    """
    makers = {out: node for node in model.graph.node for out in node.output}
    ends = {value.name for value in (model.graph.input[0], model.graph.output[0])}
    logits = {source for node in model.graph.node if node.op_type == "Sigmoid" for source in node.input}
    share = 1.0 if name in ends | logits else COVER
    low, high = (share * float(np.asarray(bound).item()) for bound in (data.lowest, data.highest))
    rectified = name in makers and makers[name].op_type == "Relu"
    return 0.0 if rectified else min(low, 0.0), max(high, 0.0)


def _step(low: float, high: float) -> float:
    """Return the least power of two that suffices as a step: 256 steps reach from `low` to within a step of `high`."""
    step = 2.0 ** math.ceil(math.log2(max(high - low, 1e-9) / (BYTE + 1)))
    while high / step + _zero_point(low, step) > BYTE + 1:
        step *= 2
    return step


def _zero_point(low: float, step: float) -> int:
    return math.ceil(-low / step - 0.5)


def _groups(model: onnx.ModelProto, known: Iterable[str]) -> list[set[str]]:
    """Return the tensors `known`, in groups that share a step."""
    group = {name: {name} for name in known}
    for names in _sharing(model):
        together: set[str] = set().union(*(group[name] for name in names if name in group))
        group.update(dict.fromkeys(together, together))
    return list({id(members): members for members in group.values()}.values())


def _sharing(model: onnx.ModelProto) -> Iterator[list[str]]:
    """Yield the tensors of each operator of `SHARING`; for an Add with a Relu behind it, also the Relu's output."""
    followers = {name: node for node in model.graph.node for name in node.input}
    for node in model.graph.node:
        if node.op_type in SHARING:
            yield [*node.input, node.output[0]]
            after = followers.get(node.output[0])
            if node.op_type == "Add" and after is not None and after.op_type == "Relu":
                yield [node.output[0], after.output[0]]
                yield [*node.input, after.output[0]]
