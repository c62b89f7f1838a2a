"""A network as a stage: `onnx = "net.onnx"` of a pipeline file, in a runtime that reads and writes the slots.

Rule: the runtime reads an input with the network's type directly from its slot, and writes an output directly to its
slot. A picture is first converted into memory of the stage, as by the block `prepare`. If there is no newest frame yet,
the input is zeros.

The module runs networks of any number types, inputs and outputs, in each of the runtimes:

    engine = engine_of(path, "openvino", {"image": (1, 3, 224, 224)}, options)
    call = engine.bound({"image": pictures}, {"scores": scores})
    call()

Rule: only the runtime `cuda` copies inputs and outputs. A runtime runs the whole network or refuses it; no runtime
falls back to another. The number types are those of the file: a float network is computed in floats, unlike an avatar's
network.
"""

from __future__ import annotations

import ctypes
import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import numpy as np
import onnxruntime
from numpy.typing import NDArray

from trilane.errors import BadInputError
from trilane.pipeline.file_keys import TYPES, PortType, port_type
from trilane.pipeline.stage import Arrays, PortedStage, UnitContext
from trilane.stages.blocks.pictures import Preparation
from trilane.stages.dsp.ort import LOAD_ERRORS, PROVIDER, Named, OrtSession, settings_of
from trilane.stages.dsp.runtime import RuntimeOptions, has_device, quiet_openvino, resolve, said_by_openvino

Shapes = Mapping[str, Sequence[int]]
ORT, OPENVINO, QNN, CUDA = "ort", "openvino", "qnn", "cuda"


class LoadedNetwork(Protocol):
    """A loaded network. `outputs`: names of its outputs, in the network's order."""

    outputs: Sequence[str]

    def bound(self, inputs: Named, outputs: Named) -> Callable[[], object]:
        """Return a function that computes `outputs` from `inputs`, both arrays by name.

        The arrays must be C-contiguous, and outlive the function. All inputs must be given. An output that is left out
        is computed, but not stored.
        """


class OpenvinoEngine:
    """A compiled model of OpenVINO, with only one infer request, because each request has memory of its own."""

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
    """Return a writeable array on the same memory, because OpenVINO takes only writeable arrays, even as inputs."""
    memory = (ctypes.c_char * array.nbytes).from_address(array.ctypes.data)
    return np.frombuffer(memoryview(memory), array.dtype).reshape(array.shape)


def engine_of(path: Path, runtime: str, shapes: Shapes, options: RuntimeOptions) -> LoadedNetwork:
    """Return the loaded network in `path`.

    `runtime`: name of the runtime.
    `shapes`: shape of each input by name.
    `options`: options of the runtime.

    Raises BadInputError for a network that the runtime does not load, MissingPartError for an absent runtime.
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
        "INFERENCE_PRECISION_HINT": "f32",  # otherwise floats become bfloat16 on processors that have it
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


class _Fed(NamedTuple):
    """An input of the network.

    `own`: memory of the stage for a prepared picture or for zeros.
    `preparation`: conversion of a picture into this memory; None if the slot is read directly.
    """

    name: str
    type: PortType
    own: NDArray[Any]
    preparation: Preparation | None


class NetworkStage(PortedStage):
    """Runs one inference for each frame.

    Its keys are `onnx`, `runtime`, and `inputs`, the type of each input of the network by name, in the network's order.

    Raises BadInputError for a network that the runtime does not load, MissingPartError for an absent runtime.
    """

    def __init__(self, settings: Mapping[str, Any], options: RuntimeOptions) -> None:
        super().__init__(settings)
        keys = self.settings.keys
        wanted = {name: port_type(text) for name, text in keys["inputs"].items()}
        shapes = {name: each.shape for name, each in wanted.items()}
        self._engine = engine_of(self.settings.folder / keys["onnx"], keys["runtime"], shapes, options)
        self._fed = [self._fed_by(each.name, each.type, wanted) for each in self.reads]
        self._calls: dict[tuple[int, ...], Callable[[], object]] = {}

    def _fed_by(self, port: str, found: PortType, wanted: Mapping[str, PortType]) -> _Fed:
        name = port or next(iter(wanted))
        own = np.zeros(wanted[name].shape, TYPES[wanted[name].dtype])
        is_same = found.dtype == wanted[name].dtype and math.prod(found.shape) == math.prod(wanted[name].shape)
        preparation = None if is_same else Preparation(found, wanted[name], {}, self.settings.where)
        return _Fed(name, wanted[name], own, preparation)

    def ready(self) -> None:
        """Run once on zeros, because the first run of a session allocates its memory."""
        outputs = self._outputs[0] if self._outputs else {}
        self.work(0, [None] * len(self._fed), outputs)
        for array in outputs.values():
            array[...] = 0

    def work(self, frame: int, arrays: Sequence[NDArray[Any] | None], outputs: Arrays) -> Mapping[str, float]:  # noqa: ARG002
        sources = []
        for fed, array in zip(self._fed, arrays, strict=True):
            if array is None:
                fed.own[...] = 0
            elif fed.preparation is not None:
                fed.preparation.into(array, fed.own)
            sources.append(fed.own if array is None or fed.preparation is not None else array)
        places = tuple(each.ctypes.data for each in (*sources, *outputs.values()))
        if (call := self._calls.get(places)) is None:
            call = self._calls[places] = self._bound(sources, outputs)
        call()
        return {}

    def _bound(self, sources: Sequence[NDArray[Any]], outputs: Arrays) -> Callable[[], object]:
        """Return the function that computes `outputs` from `sources`, which has one array for each input."""
        given = {fed.name: array.reshape(fed.type.shape) for fed, array in zip(self._fed, sources, strict=True)}
        return self._engine.bound(given, {name or self._engine.outputs[0]: array for name, array in outputs.items()})


def build(settings: Mapping[str, Any], unit: UnitContext) -> NetworkStage:
    """Build the stage that runs the network of `settings`. Raises BadInputError, MissingPartError."""
    if has_device(settings["keys"]["runtime"]):
        unit.use_device(settings["keys"]["runtime"])
    return NetworkStage(settings, RuntimeOptions(unit.settings.threads, unit.settings.spin))
