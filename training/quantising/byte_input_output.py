"""Gives an integer network bytes at both ends: NHWC input bytes, and output bytes that are the picture.

Rule: bytes are dequantised first and transposed after; in the other order OpenVINO computes the first layer in float.
"""

from __future__ import annotations

import onnx
from onnx import TensorProto, helper

from trilane.training.quantising.scales_and_zero_points import set_picture_scale_and_zero_point


def replace_ends_by_bytes(model: onnx.ModelProto) -> None:
    """Replace the first Quantize and the last Dequantize by Transposes, which the runtimes fold away. In place."""
    graph = model.graph
    source, target = graph.input[0], graph.output[0]
    first = next(node for node in graph.node if source.name in node.input and node.op_type == "QuantizeLinear")
    last = next(node for node in graph.node if target.name in node.output and node.op_type == "DequantizeLinear")
    maker = next(node for node in graph.node if last.input[0] in node.output)
    set_picture_scale_and_zero_point(graph, maker)
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
    """The nodes that dequantise and transpose the input; `inner` reads their output instead of `quantised`."""
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
