"""Networks as they come, of any number types, inputs and outputs, in each of the runtimes.

    engine = engine_of(path, "openvino", {"image": (1, 3, 224, 224)}, options)
    call = engine.bound({"image": pictures}, {"scores": scores})
    call()

Rule: inputs are read and outputs are written where they lie; only `cuda` copies. A runtime runs the whole network or
refuses it, and none falls back to another. The number types are those of the file: unlike an avatar's network, one of
floats is computed in these floats.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import onnxruntime
from numpy.typing import NDArray

from trilane.errors import BadInputError
from trilane.stages.dsp.ort import LOAD_ERRORS, PROVIDER, Named, OrtSession, settings_of
from trilane.stages.dsp.runtime import RuntimeOptions, quiet_openvino, resolve, said_by_openvino

Shapes = Mapping[str, Sequence[int]]
ORT, OPENVINO, QNN, CUDA = "ort", "openvino", "qnn", "cuda"


class LoadedNetwork(Protocol):
    """A loaded network. `outputs`: names of its outputs, in its order."""

    outputs: Sequence[str]

    def bound(self, inputs: Named, outputs: Named) -> Callable[[], object]:
        """Return a call that computes `outputs` from `inputs`, by name; the arrays are C-contiguous and outlive it.

        All inputs are given. An output that is left out is computed, and nobody gets it.
        """


class OpenvinoEngine:
    """A compiled model of OpenVINO, with one infer request; requests have memory of their own, so there is but one."""

    def __init__(self, openvino: Any, compiled: Any) -> None:
        self._openvino = openvino
        self._request = compiled.create_infer_request()
        self._inputs = {name: port for port in compiled.inputs for name in port.get_names()}
        self._outputs = {name: port for port in compiled.outputs for name in port.get_names()}
        self.outputs: Sequence[str] = [port.get_any_name() for port in compiled.outputs]

    def bound(self, inputs: Named, outputs: Named) -> Callable[[], object]:
        given = [(self._inputs[name], array) for name, array in inputs.items()]
        given += [(self._outputs[name], array) for name, array in outputs.items()]
        pairs = [(port, self._openvino.Tensor(_writeable(array), shared_memory=True)) for port, array in given]

        def call() -> None:
            for port, tensor in pairs:
                self._request.set_tensor(port, tensor)
            self._request.start_async()
            self._request.wait()

        return call


def _writeable(array: NDArray[Any]) -> NDArray[Any]:
    """Return the same memory as an array that may be written: OpenVINO takes no other, also for what it only reads."""
    memory = (ctypes.c_char * array.nbytes).from_address(array.ctypes.data)
    return np.frombuffer(memoryview(memory), array.dtype).reshape(array.shape)


def engine_of(path: Path, runtime: str, shapes: Shapes, options: RuntimeOptions) -> LoadedNetwork:
    """Load the network in `path`.

    `shapes`: shape of each input by name. Raises BadInputError for a network that the runtime does not load,
    MissingPartError for a runtime that is not there.
    """
    return _ENGINES[resolve(runtime)](path, shapes, options)


def _ort(path: Path, _shapes: Shapes, options: RuntimeOptions) -> LoadedNetwork:
    try:
        return OrtSession(onnxruntime.InferenceSession(str(path), settings_of(options), providers=[PROVIDER]))
    except LOAD_ERRORS as error:
        raise BadInputError(path, str(error), "a network that ONNX Runtime loads") from error


def _cuda(path: Path, _shapes: Shapes, options: RuntimeOptions) -> LoadedNetwork:
    from trilane.stages.dsp.cuda import gpu_session

    return OrtSession(gpu_session(str(path), str(path), options.device))


def _qnn(path: Path, _shapes: Shapes, options: RuntimeOptions) -> LoadedNetwork:
    from trilane.stages.dsp.qnn import DEFAULTS, htp_session

    return OrtSession(htp_session(str(path), str(path), {**DEFAULTS, **options.device}, {}))


def _openvino(path: Path, shapes: Shapes, options: RuntimeOptions) -> LoadedNetwork:
    openvino = quiet_openvino()
    settings = {
        "PERFORMANCE_HINT": "LATENCY",
        "INFERENCE_NUM_THREADS": options.threads,
        "NUM_STREAMS": 1,
        "ENABLE_CPU_PINNING": False,
        "INFERENCE_PRECISION_HINT": "f32",  # else floats become bfloat16 on processors that have it
    }
    try:
        core = openvino.Core()
        model = core.read_model(str(path))
        if model.is_dynamic():
            model.reshape({name: list(shape) for name, shape in shapes.items()})
        return OpenvinoEngine(openvino, core.compile_model(model, "CPU", settings))
    except RuntimeError as error:
        raise BadInputError(path, said_by_openvino(error), "a network that OpenVINO loads") from error


_ENGINES: Mapping[str, Callable[[Path, Shapes, RuntimeOptions], LoadedNetwork]] = {
    ORT: _ort,
    OPENVINO: _openvino,
    QNN: _qnn,
    CUDA: _cuda,
}
