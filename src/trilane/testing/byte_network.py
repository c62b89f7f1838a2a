"""A network of bytes small enough to write down. Rule: every part has a name by which a test spoils it."""

from __future__ import annotations

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper


def net(
    shape: tuple[int, ...] = (1, 32, 64, 3),
    out: tuple[int, ...] | None = None,
    scales: tuple[float, float] = (0.5, 0.25),
    zeros: tuple[int, int] = (7, 11),
) -> onnx.ModelProto:
    """NHWC bytes -> dequantise -> transpose -> 1x1 convolution -> quantise (middle) -> ... -> transpose -> bytes."""
    out = (*shape[:3], 4) if out is None else out
    rng = np.random.default_rng(3)
    constants = {
        "in_scale": np.float32(scales[0]), "in_zero": np.uint8(zeros[0]),
        "out_scale": np.float32(scales[1]), "out_zero": np.uint8(zeros[1]),
        "mid_scale": np.float32(0.125), "mid_zero": np.uint8(100),
        "w_scale": np.float32(0.01), "w_zero": np.int8(0),
        "w1": rng.integers(-100, 100, (4, shape[-1], 1, 1)).astype(np.int8),
        "w2": rng.integers(-100, 100, (4, 4, 1, 1)).astype(np.int8),
    }  # fmt: skip
    make = helper.make_node
    nodes = [
        make("DequantizeLinear", ["bytes", "in_scale", "in_zero"], ["real"], "bytes_in"),
        make("Transpose", ["real"], ["nchw"], "to_nchw", perm=[0, 3, 1, 2]),
        make("DequantizeLinear", ["w1", "w_scale", "w_zero"], ["w1_real"], "w1_in"),
        make("Conv", ["nchw", "w1_real"], ["conv1"], "conv1"),
        make("QuantizeLinear", ["conv1", "mid_scale", "mid_zero"], ["mid_q"], "mid_out"),
        make("DequantizeLinear", ["mid_q", "mid_scale", "mid_zero"], ["mid"], "mid_in"),
        make("DequantizeLinear", ["w2", "w_scale", "w_zero"], ["w2_real"], "w2_in"),
        make("Conv", ["mid", "w2_real"], ["conv2"], "conv2"),
        make("QuantizeLinear", ["conv2", "out_scale", "out_zero"], ["rgba_q"], "bytes_out"),
        make("Transpose", ["rgba_q"], ["rgba"], "to_nhwc", perm=[0, 2, 3, 1]),
    ]
    graph = helper.make_graph(
        nodes,
        "net",
        [helper.make_tensor_value_info("bytes", TensorProto.UINT8, shape)],
        [helper.make_tensor_value_info("rgba", TensorProto.UINT8, out)],
        [numpy_helper.from_array(np.asarray(value), name) for name, value in constants.items()],
    )
    return helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)


def node_of(model: onnx.ModelProto, name: str) -> onnx.NodeProto:
    """The node of that name. Raises StopIteration."""
    return next(node for node in model.graph.node if node.name == name)
