"""Makes the integer network: a float network is calibrated on real frames, then quantised.

Rule: activations are unsigned bytes. Weights are signed and symmetric, with a scale for each channel. Real 0 is exact.
The output bytes are the picture. All runtimes round alike if the network's operators allow it (`calibration`).

With `reduce_range`, weights stay within ±64. On a CPU without VNNI, the sum of two products of larger weights would
overflow 16 bits.
"""

from __future__ import annotations

import copy
import json
import logging
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnxruntime
from numpy.typing import NDArray
from onnx import TensorProto, TypeProto, helper, numpy_helper
from onnxruntime.quantization import QDQQuantizer, QuantType
from onnxruntime.quantization.shape_inference import quant_pre_process

from trilane.arrays import F32, psnr_db
from trilane.avatars.network_file import FLOAT_LAYERS_KEY, NetworkFile, check_network, constants_of
from trilane.errors import BadInputError
from trilane.hw_profiles.governor import figure_for
from trilane.stages.dsp.ort import ERRORS_ONLY, PROVIDER
from trilane.training.quantising.calibration import (
    CannotRoundAlikeError,
    limit_logits,
    may_round_alike,
    measure,
    norm_inputs,
    power_of_two_ranges,
    power_of_two_weights,
    saturated,
    share_ranges,
    widen,
)
from trilane.units import CALIBRATION_METHOD, CALIBRATION_METHODS
from trilane.writing import write_atomically

MIN_FRAMES, MAX_FRAMES = 1, 1000


@dataclass(frozen=True)
class Quantised:
    """An integer network, and facts about its making.

    `facts`: key `quantisation` of the manifest: method, number of frames, bits of the weights, float layers, version of
    ONNX Runtime.
    `float_constants`: weights and biases before rounding, by name.
    """

    network: NetworkFile
    facts: dict[str, Any]
    float_constants: Mapping[str, NDArray[Any]] = field(repr=False)


@dataclass(frozen=True)
class ByteRanges:
    """The ranges that bytes cover for each tensor of a float network.

    `ends`: (real value of byte 0, real value of byte 255), by the tensor's name.
    `alike`: whether weights are even multiples of powers of two, so that all runtimes round alike.
    """

    ends: dict[str, tuple[float, float]]
    alike: bool


@dataclass(frozen=True)
class _Calibrated:
    """A float network that is ready to be quantised.

    `ranges`: ranges of its tensors, ONNX Runtime's TensorsData.
    `overrides`: scales of weights, by the weights' name; if empty, ONNX Runtime computes the scales.
    `rounds_alike`: whether all runtimes round alike.
    """

    model: onnx.ModelProto
    ranges: Any
    overrides: dict[str, Any]
    rounds_alike: bool


def quantise(
    model: onnx.ModelProto,
    frames: Sequence[F32],
    method: str = CALIBRATION_METHOD,
    reduce_range: bool = True,
    keep_float: Sequence[str] = (),
) -> Quantised:
    """Return the integer network that is made from the float network `model`.

    `model`: network with one float32 input (1, C, H, W), and one output (1, 4, H, W) in 0..1 from a Sigmoid.
    `frames`: real inputs (H, W, C) float32 for the calibration; 1 to 1000 frames.
    `method`: calibration method, a name of `CALIBRATION_METHODS`.
    `reduce_range`: whether weights have 7 bits instead of 8. If all runtimes round alike, weights use only even numbers
    of steps, so 6 or 7 bits count.
    `keep_float`: names of nodes that stay in float.

    Raises BadInputError for wrong frames, an unknown method or layer, or a network of another form or not finite.
    """
    plain, ranges = _measured(model, frames, method)
    unknown = set(keep_float) - {node.name for node in plain.graph.node}
    if unknown:
        raise BadInputError("quantise", f"no layer {', '.join(sorted(unknown))}", "names of layers to keep in float")
    limit_logits(plain, ranges)
    calibrated = _calibrated(plain, ranges, reduce_range, keep_float)
    # A bias that was added by the rounding has the float value 0.
    constants = {name: np.zeros(tensor.dims, np.float32) for name, tensor in constants_of(calibrated.model).items()}
    constants |= {name: numpy_helper.to_array(tensor) for name, tensor in constants_of(plain).items()}
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


def byte_ranges(model: onnx.ModelProto, frames: Sequence[F32], method: str = CALIBRATION_METHOD) -> ByteRanges:
    """Return the ranges that `quantise` gives the tensors of `model` for the same arguments.

    Raises BadInputError as `quantise` does.
    """
    plain, ranges = _measured(model, frames, method)
    limit_logits(plain, ranges)
    calibrated = _calibrated(plain, ranges, reduce_range=True, keep_float=())
    names = list(calibrated.ranges.keys())
    ends = {name: (calibrated.ranges[name].lowest, calibrated.ranges[name].highest) for name in names}
    reals = {
        name: (float(np.asarray(low).item()), float(np.asarray(high).item())) for name, (low, high) in ends.items()
    }
    return ByteRanges(reals, calibrated.rounds_alike)


def _measured(model: onnx.ModelProto, frames: Sequence[F32], method: str) -> tuple[onnx.ModelProto, Any]:
    """Return (model as ONNX Runtime prepares it for quantising, measured ranges of its tensors)."""
    _check_frames(model, frames)
    for tensor in model.graph.initializer:
        if tensor.data_type == TensorProto.FLOAT and not np.isfinite(numpy_helper.to_array(tensor)).all():
            raise BadInputError("quantise", f"weights {tensor.name!r} that are not finite", "a trained network")
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
    """Return `model` rounded so that all runtimes round alike.

    If this is impossible, return `model` with its measured ranges, after `share_ranges` has changed them.
    """
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


def _describe(model: onnx.ModelProto, keep_float: Sequence[str]) -> None:
    """Replace all metadata by the list of the layers `keep_float`, and remove all operator sets but ONNX's."""
    for entry in [entry for entry in model.opset_import if entry.domain not in ("", "ai.onnx")]:
        model.opset_import.remove(entry)
    del model.metadata_props[:]
    helper.set_model_props(model, {FLOAT_LAYERS_KEY: json.dumps(list(keep_float))} if keep_float else {})


# Cross-layer equalisation: channels of neighbouring layers get similar ranges, and the network's output stays the same.
#
# Rule: relu(s x) = s relu(x) for s > 0, so a channel may be scaled after one layer and back before the next. Source:
# Nagel et al. 2019, "Data-Free Quantization Through Weight Equalization and Bias Correction", section 4.1.

ROUNDS = 3
#: Least and greatest factor by which one round scales a channel.
SCALE_LIMITS = (1e-2, 1e2)


def equalised(model: onnx.ModelProto) -> onnx.ModelProto:
    """Return a copy of the float network in which each Conv -> ReLU -> Conv chain from `_pairs` is equalised.

    ROUNDS times, each chain in turn is equalised channel by channel. For a channel between the two Convs, r1 is the
    largest absolute weight with which the first Conv makes the channel. r2 is the largest absolute weight with which
    the second Conv reads it. The scale s is sqrt(r1 / r2), clipped to SCALE_LIMITS; s is 1 if r1 or r2 is 0. The
    first Conv's weights and bias of the channel are divided by s. The second Conv's weights are multiplied by s.
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
    """Yield pairs (Conv, next Conv) with only a ReLU between them.

    A pair is skipped if a second operator reads the output of the first Conv or of the ReLU. Both Convs are `_plain`.
    `weights`: constants of `graph`, by name.
    """
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
    """Return the only node that reads the output of `node`; None if several nodes read it, or no node does."""
    readers = users.get(node.output[0], [])
    return readers[0] if len(readers) == 1 else None


def _plain(node: onnx.NodeProto, weights: dict[str, onnx.TensorProto], users: dict[str, list[onnx.NodeProto]]) -> bool:
    """Return whether `node` is a Conv of one group whose weights and bias are constants that no other node reads."""
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


# Writes scales and zero points into a network, as Quantize and Dequantize nodes around its layers.
#
# Rule: every tensor that an operator of `QUANTISED_OPERATORS` reads or writes has unsigned bytes. Weights are signed
# bytes with a scale for each channel and zero point 0. The output has the scale 1/255 and zero point 0, so its bytes
# are the picture.

OUTPUT_SCALE = 1 / 255
QUANTISED_OPERATORS = [
    *("Conv", "ConvTranspose", "Gemm", "Add", "Mul", "Concat", "MaxPool", "AveragePool", "GlobalAveragePool", "Resize"),
    *("InstanceNormalization", "Relu", "Clip", "Sigmoid", "HardSigmoid", "HardSwish"),
    *("Reshape", "Transpose", "Slice", "Split", "Pad"),
]


@contextmanager
def _no_axis_warnings() -> Iterator[None]:
    """Suppress the quantiser's warning that a vector, such as a norm's scale, has no second axis: it needs none."""

    def other(record: logging.LogRecord) -> bool:
        return "is out-of-range for weight" not in record.getMessage()

    logger = logging.getLogger()
    logger.addFilter(other)
    try:
        yield
    finally:
        logger.removeFilter(other)


def insert_scales_and_zero_points(
    model: onnx.ModelProto, ranges: Any, overrides: dict[str, Any], reduce_range: bool, keep_float: Sequence[str]
) -> onnx.ModelProto:
    """Return `model` with Quantize and Dequantize nodes around its layers.

    `model`: float network.
    `ranges`: ranges of the model's tensors, ONNX Runtime's TensorsData.
    `overrides`: scales of weights by name, ONNX Runtime's `TensorQuantOverrides`.
    `reduce_range`: whether weights have 7 bits instead of 8.
    `keep_float`: names of nodes that stay in float.
    """
    quantiser = QDQQuantizer(
        model,
        per_channel=True,
        reduce_range=reduce_range,
        weight_qType=QuantType.QInt8,
        activation_qType=QuantType.QUInt8,
        tensors_range=ranges,
        nodes_to_quantize=[],
        nodes_to_exclude=list(keep_float),
        op_types_to_quantize=QUANTISED_OPERATORS,
        extra_options={"WeightSymmetric": True, "TensorQuantOverrides": overrides},
    )
    for end in (model.graph.input[0], model.graph.output[0]):
        quantiser.quantize_activation_tensor(end.name)
    with _no_axis_warnings():
        quantiser.quantize_model()
    quantiser.model.topological_sort()
    result: onnx.ModelProto = quantiser.model.model
    return result


# Gives an integer network bytes at both ends: NHWC input bytes, and output bytes that are the picture.
#
# Rule: bytes are dequantised first and then transposed. In the opposite order OpenVINO computes the first layer in
# float.


def replace_ends_by_bytes(model: onnx.ModelProto) -> None:
    """Give `model`, in place, a uint8 NHWC input and output: remove the first Quantize and the last Dequantize.

    The runtimes fold the added Transposes away.
    """
    graph = model.graph
    source, target = graph.input[0], graph.output[0]
    first = next(node for node in graph.node if source.name in node.input and node.op_type == "QuantizeLinear")
    last = next(node for node in graph.node if target.name in node.output and node.op_type == "DequantizeLinear")
    maker = next(node for node in graph.node if last.input[0] in node.output)
    values = {"picture_scale": np.float32(OUTPUT_SCALE), "picture_zero_point": np.uint8(0)}
    for slot, (name, value) in enumerate(values.items(), start=1):
        maker.input[slot] = name
        graph.initializer.append(numpy_helper.from_array(np.asarray(value), name))
    n, c, h, w = (dim.dim_value for dim in source.type.tensor_type.shape.dim)
    inner = [node for node in graph.node if node not in (first, last)]
    real = _nhwc_to_real(inner, source.name, first.output[0])
    bytes_out = helper.make_node("Transpose", [maker.output[0]], [target.name], name="bytes_out", perm=[0, 2, 3, 1])
    del graph.node[:], graph.input[:], graph.output[:], graph.value_info[:]
    graph.node.extend([*real, *inner, bytes_out])
    graph.input.append(helper.make_tensor_value_info(source.name, TensorProto.UINT8, [n, h, w, c]))
    graph.output.append(helper.make_tensor_value_info(target.name, TensorProto.UINT8, [n, h, w, 4]))
    used = {name for node in graph.node for name in node.input}
    initializers = [tensor for tensor in graph.initializer if tensor.name in used]
    del graph.initializer[:]
    graph.initializer.extend(initializers)


def _nhwc_to_real(inner: list[onnx.NodeProto], source: str, quantised: str) -> list[onnx.NodeProto]:
    """Return nodes that dequantise and transpose the input `source`.

    The nodes `inner` are changed in place: they read the new nodes' output instead of dequantising `quantised`.
    """
    readers = [node for node in inner if quantised in node.input]
    scale, zero_point = readers[0].input[1:3]
    nchw = readers[0].output[0]
    for reader in readers:
        inner.remove(reader)
    outputs = {source, *(reader.output[0] for reader in readers)}
    for node in inner:
        for slot, name in enumerate(node.input):
            if name in outputs:
                node.input[slot] = nchw
    return [
        helper.make_node("DequantizeLinear", [source, scale, zero_point], [f"{nchw}_nhwc"], name="bytes_in"),
        helper.make_node("Transpose", [f"{nchw}_nhwc"], [nchw], name="to_nchw", perm=[0, 3, 1, 2]),
    ]


# The calibration table: compares calibration methods and numbers of frames by the error of the picture.
#
# Rule: the error is measured on frames that are never used for calibration, against the float network's pictures.

#: PSNRs that differ by at most this many dB count as equal.
TIE_DB = 0.1
COUNTS = (5, 10, 50, 100)
#: Default number of frames, at the end of all frames, on which the error is measured.
EVALUATED = 5


def calibration_table(
    model: onnx.ModelProto,
    frames: Sequence[F32],
    methods: Sequence[str] = CALIBRATION_METHODS,
    counts: Sequence[int] = COUNTS,
    held_out: int = EVALUATED,
) -> Iterator[dict[str, Any]]:
    """Yield a row for each method and count: `method`, `count`, `psnr_db`, `mean`, `largest`.

    `psnr_db` is the mean PSNR over the last `held_out` frames. `mean` and `largest` are the mean and the largest
    absolute error of a value, in steps of 1/255.

    `model`: float network with an input of (1, C, H, W).
    `frames`: inputs (H, W, C) float32.
    `methods`: names of `CALIBRATION_METHODS`.
    `counts`: numbers of calibration frames. A count that would reach into the last `held_out` frames is left out.
    `held_out`: number of frames, at the end of `frames`, on which the error is measured.

    Raises BadInputError for too few frames for the smallest count, and for an unknown method.
    """
    spare = len(frames) - held_out
    possible = [count for count in counts if count <= spare]
    if not possible:
        raise BadInputError("frames", f"{len(frames)} of them", f"at least {min(counts) + held_out}")
    for method in methods:
        if method not in CALIBRATION_METHODS:
            raise BadInputError("--method", repr(method), f"one of {', '.join(CALIBRATION_METHODS)}")
    evaluated = frames[spare:]
    run = _session(model)
    channels_first = [np.ascontiguousarray(frame.transpose(2, 0, 1)[None]) for frame in evaluated]
    float_pictures = [255 * run(frame).transpose(0, 2, 3, 1) for frame in channels_first]
    for method in methods:
        for count in possible:
            network = quantise(model, frames[:count], method).network
            integer, scale, zero = _session(network.model), network.input.scale, network.input.zero_point
            tensors = [np.clip(np.round(f / scale) + zero, 0, 255).astype(np.uint8)[None] for f in evaluated]
            yield {"method": method, "count": count, **_errors(float_pictures, [integer(t) for t in tensors])}


def recommended(rows: Sequence[Mapping[str, Any]]) -> Mapping[str, Any]:
    """Return the row with the fewest frames among the rows whose PSNR is within `TIE_DB` of the best PSNR.

    If several rows have equally few frames, return the row with the highest PSNR. Raises ValueError without rows.
    """
    best = max(float(row["psnr_db"]) for row in rows)
    ties = [row for row in rows if best - float(row["psnr_db"]) <= TIE_DB]
    return min(ties, key=lambda row: (row["count"], -row["psnr_db"]))


def recommendation(rows: Sequence[Mapping[str, Any]]) -> str:
    """Return one line about the recommended row of the table and its distance to the best row."""
    row, best = recommended(rows), max(float(row["psnr_db"]) for row in rows)
    return (
        f"{row['method']} on {row['count']} frames: {row['psnr_db']:.2f} dB, {best - row['psnr_db']:.2f} dB below the "
        f"best; within {TIE_DB} dB the fewest frames win"
    )


def _session(model: onnx.ModelProto) -> Any:
    """Return a function that runs the network: it takes the only input array and returns the only output array."""
    settings = onnxruntime.SessionOptions()
    settings.log_severity_level = ERRORS_ONLY
    session = onnxruntime.InferenceSession(model.SerializeToString(), settings, providers=[PROVIDER])
    name = session.get_inputs()[0].name
    return lambda feed: session.run(None, {name: feed})[0]


def _errors(float_pictures: Sequence[F32], pictures: Sequence[NDArray[np.uint8]]) -> dict[str, float]:
    differences = [np.abs(true - picture) for true, picture in zip(float_pictures, pictures, strict=True)]
    squares = [float(np.square(difference, dtype=np.float64).mean()) for difference in differences]
    return {
        "psnr_db": float(np.mean([psnr_db(square / 255**2) for square in squares])),
        "mean": float(np.mean([difference.mean() for difference in differences])),
        "largest": float(max(difference.max() for difference in differences)),
    }


def plot_calibrations(rows: Sequence[Mapping[str, Any]], recommendation: str, path: Path) -> None:
    """Draw `rows` of the calibration table into a picture file, with `recommendation` as its title.

    It shows the PSNR of the picture over the number of frames, with a line for each method.

    Raises MissingPartError without Matplotlib, BadInputError for an unknown suffix or a file that cannot be written.
    """
    figure = figure_for(path, (9, 4.5))
    axes = figure.subplots()
    for method in dict.fromkeys(row["method"] for row in rows):
        own = [row for row in rows if row["method"] == method]
        axes.plot([row["count"] for row in own], [row["psnr_db"] for row in own], marker="o", label=method)
    counts = sorted({row["count"] for row in rows})
    axes.set_xscale("log")
    axes.set_xticks(counts, [str(count) for count in counts])
    axes.minorticks_off()
    axes.set(xlabel="frames to calibrate on", ylabel="PSNR to the float network, dB")
    axes.set_title(f"recommended: {recommendation}", fontsize="medium")
    axes.grid(alpha=0.3)
    axes.legend(title="method", fontsize="small", loc="upper left", bbox_to_anchor=(1.0, 1.0))
    with write_atomically(path) as draft:
        figure.savefig(draft, dpi=120)
