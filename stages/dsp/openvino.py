"""The runtime `openvino`: OpenVINO on the CPU, which reads and writes the slots' own memory.

Rule: after the first run of a session nothing is allocated and nothing is copied; no layer runs in float.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from typing import Any

import openvino

from trilane.arrays import U8
from trilane.avatars.integer_network import IntegerNetwork
from trilane.cache import cache_dir
from trilane.errors import BadInputError
from trilane.stages.dsp.runtime import RuntimeOptions

DEVICE = "CPU"
LAYERS = {"Convolution", "Deconvolution", "FullyConnected", "MatMul"}
INTEGERS = ("i8", "u8")
WITHOUT_BIAS = "/WithoutBiases"
REMEDY = ("integer layers", "quantise them")


class OpenvinoBinding:
    """One infer request whose tensors are the bound buffers."""

    def __init__(self, compiled: Any, inputs: Sequence[U8], outputs: Sequence[U8]) -> None:
        self._tensors = [openvino.Tensor(array, shared_memory=True) for array in (*inputs, *outputs)]
        self._request = compiled.create_infer_request()
        for port, tensor in zip((*compiled.inputs, *compiled.outputs), self._tensors, strict=True):
            self._request.set_tensor(port, tensor)

    def run(self) -> None:
        self._request.start_async()
        self._request.wait()


class OpenvinoSession:
    """One compiled model."""

    def __init__(self, compiled: Any) -> None:
        self._compiled = compiled

    def bind(self, inputs: Sequence[U8], outputs: Sequence[U8]) -> OpenvinoBinding:
        return OpenvinoBinding(self._compiled, inputs, outputs)


def load(network: IntegerNetwork, options: RuntimeOptions) -> OpenvinoSession:
    """Compile `network`. Raises BadInputError when OpenVINO cannot load it or would run a layer in float."""
    settings = {
        "PERFORMANCE_HINT": "LATENCY",
        "INFERENCE_NUM_THREADS": options.threads,
        "NUM_STREAMS": 1,
        "ENABLE_CPU_PINNING": False,
    }
    try:
        model = _core().read_model(network.model.SerializeToString())
        compiled = _core().compile_model(model, DEVICE, settings)
    except RuntimeError as error:
        raise BadInputError(network.where, str(error), "a network that OpenVINO loads") from error
    _check_integer(compiled, network)
    return OpenvinoSession(compiled)


@cache
def _core() -> Any:
    """OpenVINO's core, one for all shapes. It finds compiled networks by network, settings, version and CPU."""
    core = openvino.Core()
    folder = cache_dir("openvino")
    if folder is not None:
        core.set_property({"CACHE_DIR": str(folder)})
    return core


def version() -> str:
    return f"openvino {openvino.__version__}"


def _check_integer(compiled: Any, network: IntegerNetwork) -> None:
    float_layers = set()
    for op in compiled.get_runtime_model().get_ops():
        info = op.get_rt_info()
        if _text(info, "layerType") in LAYERS and _text(info, "runtimePrecision").lower() not in INTEGERS:
            float_layers.add(op.get_friendly_name().removesuffix(WITHOUT_BIAS))
    float_layers -= network.float_layers
    if float_layers:
        raise BadInputError(network.where, f"layers left in float: {', '.join(sorted(float_layers))}", *REMEDY)


def _text(info: Any, key: str) -> str:
    return str(info[key].astype(str)) if key in info else ""
