"""The noise that quantisation adds to each layer: its signal-to-noise ratio (SQNR) on one real frame.

Rule: both networks read the same input bytes, so the rounding of the input does not count as a layer's noise.
"""

from __future__ import annotations

import copy
import math
from typing import Any

import numpy as np
import onnx
import onnxruntime
from numpy.typing import NDArray
from onnx import TensorProto, helper

from trilane.avatars.network_file import LAYERS, NetworkFile
from trilane.training.quantising.noise_model import ERRORS_ONLY, PROVIDERS
from trilane.training.quantising.quantise import Quantised

#: Greatest ratio that is reported: a layer without error has an infinite one, which JSON cannot express.
MAX_DB = 200.0


def layer_report(model: onnx.ModelProto, quantised: Quantised, frame: NDArray[np.float32]) -> list[dict[str, Any]]:
    """Rows `name`, `op_type`, `sqnr_db`, worst first, of the layers that both networks have.

    `model`: the float network (1, C, H, W). `frame`: (H, W, C). SQNR = 10 log10(sum x² / sum (x - q)²), where x and q
    are a layer's output after its activation, as the integer network stores it.
    """
    network = quantised.network
    tensor = np.clip(np.round(frame / network.input.scale) + network.input.zero_point, 0, 255).astype(np.uint8)
    real = ((tensor.astype(np.float32) - network.input.zero_point) * np.float32(network.input.scale)).transpose(2, 0, 1)
    known = {name for node in model.graph.node for name in node.output}
    stored = {name: made for name, made in _stored(network).items() if made[1] in known}
    exact = _outputs(model, np.ascontiguousarray(real[None]), [name for _, name in stored.values()])
    rounded = _outputs(network.model, tensor[None], list(stored))
    rows = []
    for dequantised, (node, name) in stored.items():
        sqnr = _sqnr_db(exact[name], rounded[dequantised])
        rows.append({"name": node.name, "op_type": node.op_type, "sqnr_db": sqnr})
    return sorted(rows, key=lambda row: row["sqnr_db"])


def _stored(network: NetworkFile) -> dict[str, tuple[onnx.NodeProto, str]]:
    """Each dequantised tensor to the layer that made it and to its name in the float network, after a folded ReLU."""
    graph = network.model.graph
    quantisers = {node.input[0]: node for node in graph.node if node.op_type == "QuantizeLinear"}
    readers = {node.input[0]: node for node in graph.node if node.op_type == "DequantizeLinear"}
    layers = {}
    for node in graph.node:
        quantiser = quantisers.get(node.output[0])
        if node.op_type in LAYERS and quantiser is not None and quantiser.output[0] in readers:
            layers[readers[quantiser.output[0]].output[0]] = (node, node.output[0])
    return layers


def _outputs(model: onnx.ModelProto, feed: NDArray[Any], names: list[str]) -> dict[str, NDArray[np.float32]]:
    opened = copy.deepcopy(model)
    del opened.graph.output[:]
    opened.graph.output.extend(helper.make_tensor_value_info(name, TensorProto.FLOAT, None) for name in names)
    settings = onnxruntime.SessionOptions()
    settings.log_severity_level = ERRORS_ONLY
    session = onnxruntime.InferenceSession(opened.SerializeToString(), settings, providers=PROVIDERS)
    values = session.run(names, {session.get_inputs()[0].name: feed})
    return dict(zip(names, values, strict=True))


def _sqnr_db(exact: NDArray[np.float32], rounded: NDArray[np.float32]) -> float:
    signal = float(np.square(exact, dtype=np.float64).sum())
    noise = float(np.square(exact.astype(np.float64) - rounded).sum())
    if signal == 0 or noise == 0:
        return MAX_DB if noise == 0 else -MAX_DB
    return max(-MAX_DB, min(MAX_DB, 10 * math.log10(signal / noise)))
