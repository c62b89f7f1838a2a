"""Calibration: the range of each tensor of a network on real frames, and the scales that follow from the ranges.

Rule: ranges are measured, and then changed in four cases. The range of the logits (inputs of the last Sigmoid) is
narrowed to values that bytes can show. The range of a tensor that a norm over the picture reads is widened. The inputs
and the output of a Concat get one range. If all runtimes can round alike, each range becomes 256 steps of a power of
two.
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
from trilane.units import CALIBRATION_METHODS

FINITE = "a network whose tensors are finite on the frames"
#: ONNX Runtime's methods by their names in small letters; `CALIBRATION_METHODS` has some of these names.
KINDS = {kind.name.lower(): kind for kind in CalibrationMethod}
#: Settings of ONNX Runtime's calibrators; each reads its own.
SETTINGS = {"percentile": 99.99}
#: If a logit's size is at least this, its sigmoid rounds to byte 0 or 255. A wider range would only make steps coarser.
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
    """Return the range of each tensor on `frames`, as ONNX Runtime's TensorsData.

    `path`: file of the float network; a second file is written beside it.
    `frames`: inputs (H, W, C) float32. They are fed one by one, so that memory does not grow with their number.
    `method`: a name of `CALIBRATION_METHODS`.
    `operators`: types of the operators whose inputs and outputs are measured.

    Raises BadInputError for an unknown method or tensors that are not finite.
    """
    if method not in CALIBRATION_METHODS:
        raise BadInputError("quantise", f"method {method!r}", f"one of {', '.join(CALIBRATION_METHODS)}")
    name = onnx.load(path, load_external_data=False).graph.input[0].name
    kind = KINDS[method]
    calibrator = create_calibrator(
        path, list(operators), str(path.with_suffix(".augmented.onnx")), calibrate_method=kind, extra_options=SETTINGS
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
    """Narrow the range of the last Sigmoid's input to ±`LOGIT_LIMIT`, in place.

    `ranges`: ONNX Runtime's TensorsData.

    Raises BadInputError if the last node of `model` is no Sigmoid.
    """
    last = next((node for node in model.graph.node if node.output[0] == model.graph.output[0].name), None)
    if last is None or last.op_type != "Sigmoid":
        raise BadInputError("quantise", f"output made by {last and last.op_type}", "a Sigmoid")
    logits = ranges[last.input[0]]
    logits.lowest = np.maximum(logits.lowest, np.float32(-LOGIT_LIMIT))
    logits.highest = np.minimum(logits.highest, np.float32(LOGIT_LIMIT))


def saturated(frames: Sequence[NDArray[np.float32]]) -> list[NDArray[np.float32]]:
    """Return `frames` with every positive value set to the largest of all, and every negative value to the smallest.

    These are the frames of the strongest contrast that the network's input can hold.
    """
    low, high = min(frame.min() for frame in frames), max(frame.max() for frame in frames)
    ends = np.float32(min(low, 0)), np.float32(max(high, 0))
    return [np.where(frame > 0, ends[1], np.where(frame < 0, ends[0], np.float32(0))) for frame in frames]


def norm_inputs(model: onnx.ModelProto) -> set[str]:
    """Return the names of the tensors that norms over the picture read, directly or through operators of `MOVES`."""
    makers = {out: node for node in model.graph.node for out in node.output}
    norms = (node for node in model.graph.node if node.op_type == "InstanceNormalization")
    return {source for node in norms for source in _sources(node.input[0], makers)}


def widen(ranges: Any, names: set[str], wider: Any) -> None:
    """Extend the ranges of the tensors `names` in `ranges`, in place, to include their ranges in `wider`.

    A norm divides by the picture's own deviation, so its output is the same at any contrast. If its input were clipped
    at the contrast of usual frames, pictures of stronger contrast would change.

    `ranges`, `wider`: ONNX Runtime's TensorsData.
    """
    for name in names & set(ranges.keys()):
        ranges[name].lowest = np.minimum(ranges[name].lowest, wider[name].lowest)
        ranges[name].highest = np.maximum(ranges[name].highest, wider[name].highest)


def share_ranges(model: onnx.ModelProto, ranges: Any) -> None:
    """Give the inputs and the output of each Concat one range, in place, so that the Concat rounds nothing.

    With different ranges, runtimes that fuse a Concat into the layers before it would clamp at other values than
    runtimes that do not fuse. The ranges of a Concat stay if a rectified tensor would get a range with negative values,
    because it would lose its clamp at 0.

    `ranges`: ONNX Runtime's TensorsData.
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
    """Yield the tensor `name`, and then each tensor from which operators of `MOVES` alone have made it."""
    yield name
    while name in makers and makers[name].op_type in MOVES:
        name = makers[name].input[0]
        yield name


# Makes the scales powers of two, and keeps sums away from the middle between two bytes, so that all runtimes round
# alike.
#
# Rule: from bytes to bytes there are only integer sums and shifts, so float32, float64 and fixed point agree on every
# sum. Weights are even and biases odd. Therefore every sum is odd and never half way between two bytes, and it does not
# matter how a runtime rounds halves.
#
# A range need cover only the share `COVER` of the measured range; values outside are clipped. A smaller range often
# halves the step.

COVER = 0.75
BYTE = 255
#: Operators that round nothing when their inputs and their output have the same scale.
SHARING = (*MOVES, "Concat", "Add")
#: Only a network of these operators can round alike on all runtimes. Other operators (norms over the picture, means,
#: products) round intermediate values, and runtimes differ in how they round them.
ALIKE = {*SHARING, "Conv", "Relu", "Sigmoid", "Constant", "Identity"}
#: Largest integer weight with (True) and without (False) `reduce_range`; all weights are even.
WEIGHT_TOP = {True: 64, False: 126}
#: Least unit of a layer's integer sum, in steps of the layer's output. With a smaller unit, float32 could not represent
#: every sum exactly.
FINEST = 2.0**-16
#: Greatest unit of a layer's integer sum, in steps of the layer's output. With ½, all odd sums would be half way
#: between bytes. Above ¼, Qualcomm's HTP was seen to give another picture.
COARSEST = 0.25
#: Largest bias in units of the layer's integer sum, so that float32 represents every sum exactly.
LARGEST_BIAS = 2.0**22


class CannotRoundAlikeError(ValueError):
    """A layer's weights are so large that the unit of its integer sum exceeds `COARSEST` steps of its output."""


def may_round_alike(model: onnx.ModelProto) -> bool:
    """Return whether the float network `model` has only operators that can round alike on every runtime."""
    return all(node.op_type in ALIKE for node in model.graph.node)


def power_of_two_ranges(model: onnx.ModelProto, ranges: Any) -> None:
    """Change each range of `ranges`, in place, so that bytes 0 to 255 are equal steps whose size is a power of two.

    The inputs and the output of an operator of `SHARING` get the same step, so that the operator rounds nothing. Ranges
    of rectified tensors begin at 0.

    `ranges`: ONNX Runtime's TensorsData.
    """
    cut = {name: _cut(name, ranges[name], model) for name in ranges.keys()}  # noqa: SIM118 - no dict
    for members in _groups(model, cut):
        step = max(_step(*cut[name]) for name in members)
        for name in members:
            zero = _zero_point(cut[name][0], step)
            ranges[name].lowest = np.float32(-zero * step)
            ranges[name].highest = np.float32((BYTE - zero) * step)


def power_of_two_weights(model: onnx.ModelProto, ranges: Any, reduce_range: bool) -> dict[str, list[dict[str, Any]]]:
    """Round the weights and biases of every Conv in place. Return the scales of the weights, all powers of two.

    Weights become even numbers of steps, and biases odd numbers, so that no sum is half way between two bytes. The
    result has, by the name of the weights, a scale for each output channel, as ONNX Runtime's `TensorQuantOverrides`.

    `ranges`: ranges from `power_of_two_ranges`.
    `reduce_range`: whether weights stay within ±64 steps instead of ±126.

    Raises CannotRoundAlikeError if a layer's weights are too large.
    """
    stored = _stored_as(model)
    constants = {tensor.name: tensor for tensor in model.graph.initializer}
    known = set(ranges.keys())
    overrides = {}
    for node in model.graph.node:
        ends = {node.input[0], node.output[0]} if node.op_type == "Conv" else set()
        if not ends or not ends <= known or node.input[1] not in constants:
            continue
        source, target = (
            float(ranges[name].highest - ranges[name].lowest) / BYTE for name in (node.input[0], stored[node.output[0]])
        )
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
    """Return the bias (O,) of the Conv `node`. If it has none, first add a bias of zeros to `model` and `constants`."""
    if len(node.input) == 2:
        zeros = numpy_helper.from_array(np.zeros(kernel.dims[0], np.float32), f"{node.output[0]}_bias")
        constants[zeros.name] = model.graph.initializer.add()
        constants[zeros.name].CopyFrom(zeros)
        node.input.append(zeros.name)
    return constants[node.input[2]]


def _stored_as(model: onnx.ModelProto) -> dict[str, str]:
    """Return, for each tensor by name, the name of the tensor that is stored as bytes in its place.

    If only one node reads the tensor and this is a Relu, the Relu's output is stored, else the tensor itself.
    """
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
    """Round `kernel` (O, I, h, w) in place, and return the scale (O,) of each output channel, a power of two.

    The weights of a channel become even multiples of its scale.
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

    A bias of 0 lies half way between two odd multiples. It is rounded up in even channels and down in odd channels,
    because the whole picture would become brighter if all were rounded up.
    """
    steps = numpy_helper.to_array(bias).astype(np.float64) / scales
    below = 2 * np.floor(steps / 2) + 1
    goes_down = (steps % 2 == 0) & (np.arange(len(steps)) % 2 == 1)
    bias.CopyFrom(_like(bias, (below - 2 * goes_down) * scales, steps.shape))


def _like(tensor: onnx.TensorProto, values: NDArray[np.float64], shape: tuple[int, ...]) -> onnx.TensorProto:
    return numpy_helper.from_array(values.reshape(shape).astype(np.float32), tensor.name)


def _cut(name: str, data: Any, model: onnx.ModelProto) -> tuple[float, float]:
    """Return (low, high) of the part of a tensor's measured range that bytes must cover; 0 is included.

    Bytes must cover the whole range of the network's input, of its output and of the logits: with clipped logits, no
    pixel would be fully transparent.
    """
    makers = {out: node for node in model.graph.node for out in node.output}
    ends = {value.name for value in (model.graph.input[0], model.graph.output[0])}
    logits = {source for node in model.graph.node if node.op_type == "Sigmoid" for source in node.input}
    share = 1.0 if name in ends | logits else COVER
    low, high = (share * float(np.asarray(bound).item()) for bound in (data.lowest, data.highest))
    rectified = name in makers and makers[name].op_type == "Relu"
    return 0.0 if rectified else min(low, 0.0), max(high, 0.0)


def _step(low: float, high: float) -> float:
    """Return the step of a range: the least power of two with which 256 steps from `low` reach `high`.

    The value of byte 255 may be up to one step below `high`.
    """
    step = 2.0 ** math.ceil(math.log2(max(high - low, 1e-9) / (BYTE + 1)))
    while high / step + _zero_point(low, step) > BYTE + 1:
        step *= 2
    return step


def _zero_point(low: float, step: float) -> int:
    return math.ceil(-low / step - 0.5)


def _groups(model: onnx.ModelProto, known: Iterable[str]) -> list[set[str]]:
    """Return the names `known` of tensors in groups; the tensors of a group must have the same step."""
    group = {name: {name} for name in known}
    for names in _sharing(model):
        together: set[str] = set().union(*(group[name] for name in names if name in group))
        group.update(dict.fromkeys(together, together))
    return list({id(members): members for members in group.values()}.values())


def _sharing(model: onnx.ModelProto) -> Iterator[list[str]]:
    """Yield lists of tensors that must have the same step: inputs and output of an operator of `SHARING`.

    If a Relu follows an Add, the Relu's output must have this step too.
    """
    followers = {name: node for node in model.graph.node for name in node.input}
    for node in model.graph.node:
        if node.op_type in SHARING:
            yield [*node.input, node.output[0]]
            after = followers.get(node.output[0])
            if node.op_type == "Add" and after is not None and after.op_type == "Relu":
                yield [node.output[0], after.output[0]]
                yield [*node.input, after.output[0]]
