"""The runtime `openvino`: OpenVINO on the CPU, which reads and writes the slots' own memory.

Rule: after the first run of a session nothing is allocated and nothing is copied. Only the layers in `float_layers` of
the network may run in float.
"""

from __future__ import annotations

import contextlib
import hashlib
import io
from collections.abc import Mapping, Sequence
from functools import cache
from typing import Any

from trilane.arrays import U8
from trilane.avatars.network_file import IntegerNetwork
from trilane.cache import cache_entry
from trilane.errors import BadInputError
from trilane.stages.dsp.runtime import RuntimeOptions, quiet_openvino, said_by_openvino
from trilane.writing import write_bytes

openvino = quiet_openvino()
DEVICE = "CPU"
DIGEST_BYTES = hashlib.sha256().digest_size
LAYERS = {"Convolution", "Deconvolution", "FullyConnected", "MatMul"}
INTEGERS = ("i8", "u8")
WITHOUT_BIAS = "/WithoutBiases"
REMEDY = ("integer layers", "quantise them")


class OpenvinoBinding:
    """An infer request whose tensors are the bound arrays."""

    def __init__(self, compiled: Any, inputs: Sequence[U8], outputs: Sequence[U8]) -> None:
        self._tensors = [openvino.Tensor(array, shared_memory=True) for array in (*inputs, *outputs)]
        self._request = compiled.create_infer_request()
        for port, tensor in zip((*compiled.inputs, *compiled.outputs), self._tensors, strict=True):
            self._request.set_tensor(port, tensor)

    def run(self) -> None:
        self._request.start_async()
        self._request.wait()


class OpenvinoSession:
    """A compiled model of OpenVINO."""

    def __init__(self, compiled: Any) -> None:
        self._compiled = compiled

    def bind(self, inputs: Sequence[U8], outputs: Sequence[U8]) -> OpenvinoBinding:
        return OpenvinoBinding(self._compiled, inputs, outputs)


def load(network: IntegerNetwork, options: RuntimeOptions) -> OpenvinoSession:
    """Return `network` compiled for the threads of `options`, from the cache if it was compiled before.

    Raises BadInputError if OpenVINO cannot load the network, or would run further layers in float than the network's
    `float_layers`.
    """
    settings = {
        "PERFORMANCE_HINT": "LATENCY",
        "INFERENCE_NUM_THREADS": options.threads,
        "NUM_STREAMS": 1,
        "ENABLE_CPU_PINNING": False,
    }
    stored = cache_entry("openvino", f"{_key(network, settings)}.blob")
    if stored is not None:
        with contextlib.suppress(OSError, ValueError, RuntimeError):  # missing or damaged: it is compiled again
            content = stored.read_bytes()
            digest, blob = content[:DIGEST_BYTES], content[DIGEST_BYTES:]
            if hashlib.sha256(blob).digest() == digest:  # OpenVINO would not notice
                return OpenvinoSession(_core().import_model(io.BytesIO(blob), DEVICE, settings))
    try:
        compiled = _core().compile_model(_core().read_model(network.model.SerializeToString()), DEVICE, settings)
    except RuntimeError as error:
        raise BadInputError(network.where, said_by_openvino(error), "a network that OpenVINO loads") from error
    _check_integer(compiled, network)
    if stored is not None:
        with contextlib.suppress(BadInputError):  # a full disk: it is compiled again next time
            blob = compiled.export_model().getvalue()
            write_bytes(stored, hashlib.sha256(blob).digest() + blob)
    return OpenvinoSession(compiled)


def _key(network: IntegerNetwork, settings: Mapping[str, Any]) -> str:
    """Return the cache's file name, which differs if network, `settings`, version or processor differ."""
    core = _core()
    machine = [str(core.get_property(DEVICE, name)) for name in ("FULL_DEVICE_NAME", "OPTIMIZATION_CAPABILITIES")]
    parts = (network.digest, version(), *machine, *(f"{name}={value}" for name, value in settings.items()))
    return hashlib.sha256("\n".join(parts).encode()).hexdigest()


@cache
def _core() -> Any:
    """Return OpenVINO's core, which all sessions share."""
    return openvino.Core()


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
