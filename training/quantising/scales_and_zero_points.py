"""Writes scales and zero points into a network, as Quantize and Dequantize nodes round its layers.

Rule: every tensor at `QUANTISED_OPERATORS` has unsigned bytes; weights are signed bytes with a scale per channel and
zero point 0; the output has the scale 1/255 and zero point 0, so its bytes are the picture.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np
import onnx
from onnx import numpy_helper
from onnxruntime.quantization import QDQQuantizer, QuantType

OUTPUT_SCALE = 1 / 255
QUANTISED_OPERATORS = [
    *("Conv", "ConvTranspose", "Gemm", "Add", "Mul", "Concat", "MaxPool", "AveragePool", "GlobalAveragePool", "Resize"),
    *("InstanceNormalization", "Relu", "Clip", "Sigmoid", "HardSigmoid", "HardSwish"),
    *("Reshape", "Transpose", "Slice", "Split", "Pad"),
]


@contextmanager
def _no_axis_warnings() -> Iterator[None]:
    """Suppress the quantiser's warning that vectors, of norms, have no second axis; they need none."""

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
    """`model` with Quantize and Dequantize nodes.

    `model`: the float network.
    `ranges`: of its tensors, ONNX Runtime's TensorsData.
    `overrides`: scales of weights by name, ONNX Runtime's `TensorQuantOverrides`.
    `reduce_range`: weights of 7 bits instead of 8.
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


def set_picture_scale_and_zero_point(graph: onnx.GraphProto, node: onnx.NodeProto) -> None:
    """Give the last Quantize `node` the scale 1/255 and zero point 0."""
    values = {"picture_scale": np.float32(OUTPUT_SCALE), "picture_zero_point": np.uint8(0)}
    for slot, (name, value) in enumerate(values.items(), start=1):
        node.input[slot] = name
        graph.initializer.append(numpy_helper.from_array(np.asarray(value), name))
