"""From a float network to an integer one: calibrate on real frames, quantise, make bytes of both ends.

Rule: unsigned 8-bit activations, signed symmetric per-channel weights, real 0 exact, output bytes are the picture; and
all runtimes round alike where they can be made to, see `dyadic`.
Weights stay within 64 under `reduce_range`: on a CPU without VNNI two products of larger ones overflow 16 bits.
"""

from __future__ import annotations

import copy
import json
import logging
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnxruntime
from numpy.typing import NDArray
from onnx import TensorProto, TypeProto, helper, numpy_helper
from onnxruntime.quantization import (
    QDQQuantizer,
    QuantType,
)
from onnxruntime.quantization.shape_inference import quant_pre_process

from trilane.avatars.network_file import FLOAT_LAYERS_KEY, NetworkFile, check_network
from trilane.errors import BadInputError
from trilane.training.quantising.calibration import limit_logits, measure, share_ranges
from trilane.training.quantising.dyadic import NotAlikeError, dyadic_ranges, dyadic_weights, may_round_alike

MIN_FRAMES, MAX_FRAMES = 1, 1000
OUTPUT_SCALE = 1 / 255

QUANTISED = [
    *("Conv", "ConvTranspose", "Gemm", "Add", "Mul", "Concat", "MaxPool", "AveragePool", "GlobalAveragePool", "Resize"),
    *(
        "InstanceNormalization",
        "Relu",
        "Clip",
        "Sigmoid",
        "HardSigmoid",
        "HardSwish",
        "Reshape",
        "Transpose",
        "Slice",
        "Split",
        "Pad",
    ),
]


@dataclass(frozen=True)
class Quantised:
    """An integer network, and the `facts` of how it was made: method, frames, weight bits, exceptions, version."""

    network: NetworkFile
    facts: dict[str, Any]


def quantise(
    model: onnx.ModelProto,
    frames: Sequence[NDArray[np.float32]],
    method: str = "minmax",
    reduce_range: bool = True,
    keep_float: Sequence[str] = (),
) -> Quantised:
    """Quantise a float NCHW network, one image at a time.

    `model`: one float32 input (1, C, H, W), one output (1, 4, H, W) in 0..1. `frames`: real inputs (H, W, C).
    `keep_float`: names of nodes that stay in float. Raises BadInputError for wrong frames, an unknown method, or a
    network whose weights or tensors are not finite.
    """
    _check_frames(model, frames)
    _check_weights(model)
    with tempfile.TemporaryDirectory(prefix="trilane-quantise-") as folder:
        prepared = Path(folder) / "prepared.onnx"
        source = Path(folder) / "float.onnx"
        onnx.save(model, source)
        quant_pre_process(source, prepared, skip_symbolic_shape=True)
        ranges = measure(prepared, frames, method, QUANTISED)
        plain = onnx.load(prepared)
        unknown = set(keep_float) - {node.name for node in plain.graph.node}
        if unknown:
            raise BadInputError(
                "quantise", f"no layer {', '.join(sorted(unknown))}", "names of layers to keep in float"
            )
        limit_logits(plain, ranges)
        made = None if keep_float else _made_alike(plain, ranges, reduce_range)
        alike = made is not None
        if made is None:
            share_ranges(plain, ranges)
        quantised = _insert(*(made or (plain, ranges, {})), reduce_range, keep_float)
    _integer_ends(quantised)
    _describe(quantised, keep_float)
    facts = {
        "method": method,
        "calibration_frames": len(frames),
        "weight_bits": (7 if reduce_range else 8) - alike,
        "rounds_alike": alike and reduce_range,
        "per_channel": True,
        "float_layers": list(keep_float),
        "onnxruntime": onnxruntime.__version__,
    }
    return Quantised(check_network(quantised, "quantised network"), facts)


@contextmanager
def _no_axis_warnings() -> Iterator[None]:
    """The quantiser says through the root logger that vectors (of norms) have no second axis; they need none."""

    def other(record: logging.LogRecord) -> bool:
        return "is out-of-range for weight" not in record.getMessage()

    logger = logging.getLogger()
    logger.addFilter(other)
    try:
        yield
    finally:
        logger.removeFilter(other)


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


def _made_alike(
    model: onnx.ModelProto, ranges: Any, reduce_range: bool
) -> tuple[onnx.ModelProto, Any, dict[str, Any]] | None:
    """Copies of `model` and `ranges` with which every runtime rounds alike, and the scales of the weights.

    None where that cannot be.
    """
    if not may_round_alike(model):
        return None
    rounded, widened = copy.deepcopy(model), copy.deepcopy(ranges)
    dyadic_ranges(rounded, widened)
    try:
        return rounded, widened, dyadic_weights(rounded, widened, reduce_range)
    except NotAlikeError:
        return None


def _insert(
    model: onnx.ModelProto, ranges: Any, overrides: dict[str, Any], reduce_range: bool, keep_float: Sequence[str]
) -> onnx.ModelProto:
    quantiser = QDQQuantizer(
        model,
        per_channel=True,
        reduce_range=reduce_range,
        weight_qType=QuantType.QInt8,
        activation_qType=QuantType.QUInt8,
        tensors_range=ranges,
        nodes_to_quantize=[],
        nodes_to_exclude=list(keep_float),
        op_types_to_quantize=QUANTISED,
        extra_options={"WeightSymmetric": True, "TensorQuantOverrides": overrides},
    )
    for end in (model.graph.input[0], model.graph.output[0]):
        quantiser.quantize_activation_tensor(end.name)
    with _no_axis_warnings():
        quantiser.quantize_model()
    quantiser.model.topological_sort()
    result: onnx.ModelProto = quantiser.model.model
    return result


def _integer_ends(model: onnx.ModelProto) -> None:
    """Drop the first Quantize and the last Dequantize; transpose instead, which the runtimes fold away."""
    graph = model.graph
    source, target = graph.input[0], graph.output[0]
    first = next(node for node in graph.node if source.name in node.input and node.op_type == "QuantizeLinear")
    last = next(node for node in graph.node if target.name in node.output and node.op_type == "DequantizeLinear")
    maker = next(node for node in graph.node if last.input[0] in node.output)
    _make_picture(graph, maker)
    n, c, h, w = (dim.dim_value for dim in source.type.tensor_type.shape.dim)
    inner = [node for node in graph.node if node not in (first, last)]
    real = _nhwc_to_real(inner, source.name, first.output[0])
    leave = helper.make_node("Transpose", [maker.output[0]], [target.name], name="bytes_out", perm=[0, 2, 3, 1])
    del graph.node[:], graph.input[:], graph.output[:], graph.value_info[:]
    graph.node.extend([*real, *inner, leave])
    graph.input.append(helper.make_tensor_value_info(source.name, TensorProto.UINT8, [n, h, w, c]))
    graph.output.append(helper.make_tensor_value_info(target.name, TensorProto.UINT8, [n, h, w, 4]))
    used = {name for node in graph.node for name in node.input}
    kept = [tensor for tensor in graph.initializer if tensor.name in used]
    del graph.initializer[:]
    graph.initializer.extend(kept)


def _nhwc_to_real(inner: list[onnx.NodeProto], source: str, quantised: str) -> list[onnx.NodeProto]:
    """Dequantise bytes, then transpose: OpenVINO keeps the first layer in integers only in this order."""
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


def _make_picture(graph: onnx.GraphProto, node: onnx.NodeProto) -> None:
    """Give the last Quantize the scale 1/255 and zero point 0."""
    values = {"picture_scale": np.float32(OUTPUT_SCALE), "picture_zero_point": np.uint8(0)}
    for slot, (name, value) in enumerate(values.items(), start=1):
        node.input[slot] = name
        graph.initializer.append(numpy_helper.from_array(np.asarray(value), name))


def _describe(model: onnx.ModelProto, keep_float: Sequence[str]) -> None:
    """Leave what runtimes read: one operator set, and the layers that are meant to stay in float."""
    for entry in [entry for entry in model.opset_import if entry.domain not in ("", "ai.onnx")]:
        model.opset_import.remove(entry)
    del model.metadata_props[:]
    helper.set_model_props(model, {FLOAT_LAYERS_KEY: json.dumps(list(keep_float))} if keep_float else {})
