"""Calibration: the range of each tensor of a network on real frames.

Rule: ranges are measured. They change afterwards in three cases alone. They are narrowed where bytes cannot show the
difference, widened where a norm over the picture reads them, and made equal where an operator only moves bytes.
"""

from __future__ import annotations

import contextlib
import io
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import onnx
from numpy.typing import NDArray
from onnxruntime.quantization import CalibrationDataReader, CalibrationMethod, create_calibrator

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
    """Return the tensors that norms over the picture read, and those that were moved to become them."""
    makers = {out: node for node in model.graph.node for out in node.output}
    norms = (node for node in model.graph.node if node.op_type == "InstanceNormalization")
    return {source for node in norms for source in _sources(node.input[0], makers)}


def widen(ranges: Any, names: set[str], wider: Any) -> None:
    """Extend the ranges of tensors `names` to those of `wider`, in place.

    A norm divides by the picture's own deviation, so its input carries the same picture at any contrast. Clipped at the
    contrast of usual frames, a stronger picture would become a different one.
    """
    for name in names & set(ranges.keys()):
        ranges[name].lowest = np.minimum(ranges[name].lowest, wider[name].lowest)
        ranges[name].highest = np.maximum(ranges[name].highest, wider[name].highest)


def share_ranges(model: onnx.ModelProto, ranges: Any) -> None:
    """Give the inputs and the output of each Concat one range, so that it moves bytes and rounds nothing. In place.

    Otherwise runtimes that fuse a Concat into the layers before it would clamp at other values than those that do not.
    A Concat is left as it is when the common range would be signed and one of its tensors is rectified: that tensor
    would lose its clamp at 0.
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
