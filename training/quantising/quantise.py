"""Makes the INT8 network: a float network is calibrated on real frames and becomes an integer one.

Rule: unsigned 8-bit activations, signed symmetric weights with a scale per channel, real 0 exact, output bytes are the
picture. All runtimes round alike where the network allows it, see `power_of_two_scales`.

With `reduce_range`, weights stay within 64: on a CPU without VNNI two products of larger ones overflow 16 bits.
"""

from __future__ import annotations

import copy
import json
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnxruntime
from numpy.typing import NDArray
from onnx import TensorProto, TypeProto, helper, numpy_helper
from onnxruntime.quantization.shape_inference import quant_pre_process

from trilane.arrays import F32
from trilane.avatars.network_file import FLOAT_LAYERS_KEY, NetworkFile, check_network, constants_of
from trilane.errors import BadInputError
from trilane.training.quantising.byte_input_output import replace_ends_by_bytes
from trilane.training.quantising.calibration import limit_logits, measure, norm_inputs, saturated, share_ranges, widen
from trilane.training.quantising.power_of_two_scales import (
    CannotRoundAlikeError,
    may_round_alike,
    power_of_two_ranges,
    power_of_two_weights,
)
from trilane.training.quantising.scales_and_zero_points import QUANTISED_OPERATORS, insert_scales_and_zero_points

MIN_FRAMES, MAX_FRAMES = 1, 1000


@dataclass(frozen=True)
class Quantised:
    """An integer network, and the `facts` of how it was made: method, frames, weight bits, float layers, version.

    `float_constants`: by name, the weights and biases as they were before rounding.
    """

    network: NetworkFile
    facts: dict[str, Any]
    float_constants: Mapping[str, NDArray[Any]] = field(repr=False)


@dataclass(frozen=True)
class ByteRanges:
    """`ends`: of each tensor of a float network by name, the real values of bytes 0 and 255.

    `alike`: whether weights are even multiples of powers of two, so that all runtimes round alike.
    """

    ends: dict[str, tuple[float, float]]
    alike: bool


@dataclass(frozen=True)
class _Calibrated:
    """A float network with the ranges of its tensors. `overrides`: scales of weights, empty when they are measured."""

    model: onnx.ModelProto
    ranges: Any
    overrides: dict[str, Any]
    rounds_alike: bool


def quantise(
    model: onnx.ModelProto,
    frames: Sequence[F32],
    method: str = "minmax",
    reduce_range: bool = True,
    keep_float: Sequence[str] = (),
) -> Quantised:
    """Quantise a float NCHW network.

    `model`: one float32 input (1, C, H, W), one output (1, 4, H, W) in 0..1 made by a Sigmoid.
    `frames`: real inputs (H, W, C) float32, 1 to 1000, which it is calibrated on.
    `method`: of calibration, a name of `METHODS`.
    `reduce_range`: weights of 7 bits instead of 8.
    `keep_float`: names of nodes that stay in float.
    Raises BadInputError for wrong frames, an unknown method or layer, or a network that is not finite.
    """
    _check_frames(model, frames)
    _check_weights(model)
    plain, ranges = _measured(model, frames, method)
    unknown = set(keep_float) - {node.name for node in plain.graph.node}
    if unknown:
        raise BadInputError("quantise", f"no layer {', '.join(sorted(unknown))}", "names of layers to keep in float")
    limit_logits(plain, ranges)
    calibrated = _calibrated(plain, ranges, reduce_range, keep_float)
    constants = _float_constants(plain, calibrated.model)
    quantised = insert_scales_and_zero_points(
        calibrated.model, calibrated.ranges, calibrated.overrides, reduce_range, keep_float
    )
    replace_ends_by_bytes(quantised)
    _describe(quantised, keep_float)
    facts = {
        "method": method,
        "calibration_frames": len(frames),
        "weight_bits": (7 if reduce_range else 8) - calibrated.rounds_alike,
        "rounds_alike": calibrated.rounds_alike and reduce_range,
        "per_channel": True,
        "float_layers": list(keep_float),
        "onnxruntime": onnxruntime.__version__,
    }
    return Quantised(check_network(quantised, "quantised network"), facts, constants)


def byte_ranges(model: onnx.ModelProto, frames: Sequence[F32], method: str = "minmax") -> ByteRanges:
    """What `quantise` would give the tensors of `model`, by the same arguments. Raises BadInputError as it does."""
    _check_frames(model, frames)
    _check_weights(model)
    plain, ranges = _measured(model, frames, method)
    limit_logits(plain, ranges)
    calibrated = _calibrated(plain, ranges, reduce_range=True, keep_float=())
    names = list(calibrated.ranges.keys())
    ends = {name: (calibrated.ranges[name].lowest, calibrated.ranges[name].highest) for name in names}
    reals = {
        name: (float(np.asarray(low).item()), float(np.asarray(high).item())) for name, (low, high) in ends.items()
    }
    return ByteRanges(reals, calibrated.rounds_alike)


def _float_constants(plain: onnx.ModelProto, rounded: onnx.ModelProto) -> dict[str, NDArray[Any]]:
    """The constants of float model `plain`; those that `rounded` has besides are biases that were 0."""
    known = {name: numpy_helper.to_array(tensor) for name, tensor in constants_of(plain).items()}
    added = {name: np.zeros(tensor.dims, np.float32) for name, tensor in constants_of(rounded).items()}
    return added | known


def _measured(model: onnx.ModelProto, frames: Sequence[F32], method: str) -> tuple[onnx.ModelProto, Any]:
    """The model as ONNX Runtime prepares it for quantisation, and the measured ranges of its tensors."""
    with tempfile.TemporaryDirectory(prefix="trilane-quantise-") as folder:
        prepared = Path(folder) / "prepared.onnx"
        source = Path(folder) / "float.onnx"
        onnx.save(model, source)
        quant_pre_process(source, prepared, skip_symbolic_shape=True)
        ranges = measure(prepared, frames, method, QUANTISED_OPERATORS)
        plain = onnx.load(prepared)
        read_by_norms = norm_inputs(plain)
        if read_by_norms:
            widen(ranges, read_by_norms, measure(prepared, saturated(frames), method, QUANTISED_OPERATORS))
        return plain, ranges


def _calibrated(model: onnx.ModelProto, ranges: Any, reduce_range: bool, keep_float: Sequence[str]) -> _Calibrated:
    """Scales with which all runtimes round alike; where that is not possible, the measured ranges."""
    if not keep_float and may_round_alike(model):
        rounded, widened = copy.deepcopy(model), copy.deepcopy(ranges)
        power_of_two_ranges(rounded, widened)
        try:
            return _Calibrated(rounded, widened, power_of_two_weights(rounded, widened, reduce_range), True)
        except CannotRoundAlikeError:
            pass
    share_ranges(model, ranges)
    return _Calibrated(model, ranges, {}, False)


def _check_frames(model: onnx.ModelProto, frames: Sequence[NDArray[np.float32]]) -> None:
    kind = model.graph.input[0].type.tensor_type if len(model.graph.input) == 1 else TypeProto.Tensor()
    sides = [dim.dim_value for dim in kind.shape.dim]
    if kind.elem_type != TensorProto.FLOAT or len(sides) != 4 or sides[0] != 1 or min(sides) < 1:
        raise BadInputError("quantise", f"an input of shape {sides}", "one float32 input 1 x C x H x W of fixed size")
    _, c, h, w = sides
    if not MIN_FRAMES <= len(frames) <= MAX_FRAMES:
        raise BadInputError("calibration", f"{len(frames)} frames", f"{MIN_FRAMES} to {MAX_FRAMES}")
    for i, frame in enumerate(frames):
        if frame.shape != (h, w, c) or not np.isfinite(frame).all():
            raise BadInputError("calibration", f"frame {i} of shape {frame.shape}", f"finite values, ({h}, {w}, {c})")


def _check_weights(model: onnx.ModelProto) -> None:
    for tensor in model.graph.initializer:
        if tensor.data_type == TensorProto.FLOAT and not np.isfinite(numpy_helper.to_array(tensor)).all():
            raise BadInputError("quantise", f"weights {tensor.name!r} that are not finite", "a trained network")


def _describe(model: onnx.ModelProto, keep_float: Sequence[str]) -> None:
    """Remove what runtimes do not read: all but one operator set, and metadata but the layers kept in float."""
    for entry in [entry for entry in model.opset_import if entry.domain not in ("", "ai.onnx")]:
        model.opset_import.remove(entry)
    del model.metadata_props[:]
    helper.set_model_props(model, {FLOAT_LAYERS_KEY: json.dumps(list(keep_float))} if keep_float else {})
