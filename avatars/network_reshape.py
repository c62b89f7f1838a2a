"""Makes the same network for another tensor shape: rewrites batch, height and width and infers all other shapes again.

Rule: the result is static and passes the checks of every network; weights are not changed.
"""

from __future__ import annotations

import onnx
from onnx import shape_inference

from trilane.avatars.integer_network import NetworkFile
from trilane.avatars.network_checks import check_network
from trilane.errors import BadInputError

STRIDE = 32


def reshaped(network: NetworkFile, height: int, width: int, batch: int = 1) -> NetworkFile:
    """`network` for inputs of another shape; the same object when it has that shape already.

    `network`: the checked network.
    `height`, `width`: of the input in pixels, multiples of 32.
    `batch`: frames that are inferred together.
    Raises BadInputError when the graph cannot run at that shape.
    """
    if height % STRIDE or width % STRIDE or min(height, width, batch) < 1:
        raise BadInputError(network.where, f"shape {batch}x{height}x{width}", f"sides in multiples of {STRIDE}")
    if network.shape[:3] == (batch, height, width):
        return network
    model = onnx.ModelProto()
    model.CopyFrom(network.model)
    del model.graph.value_info[:]
    for value in (model.graph.input[0], model.graph.output[0]):
        for dim, size in zip(value.type.tensor_type.shape.dim[:3], (batch, height, width), strict=True):
            dim.dim_value = size
    try:
        inferred = shape_inference.infer_shapes(model, check_type=True, strict_mode=True, data_prop=True)
    except onnx.shape_inference.InferenceError as error:
        reason = str(error).strip().splitlines()[0]
        raise BadInputError(
            network.where, f"a graph fixed to {network.shape}: {reason}", f"one for {height}x{width}"
        ) from error
    return check_network(inferred, network.where)
