"""A network as a stage: `onnx = "net.onnx"` of a pipeline file, in a runtime that reads and writes the slots.

Rule: if an input has the number type and the number of elements that the network reads, the runtime reads it in its
slot. Otherwise the input is a picture, and the stage first converts it into its own memory, like the block `prepare`.
An input with `sync = "latest"` is zeros while it has no frame, or only one older than `max_age_ms`. The runtime writes
outputs to the memory of their slots.

The module runs networks of any number types, inputs and outputs, in each of the runtimes:

    engine = engine_of(path, "openvino", {"image": (1, 3, 224, 224)}, options)
    call = engine.bound({"image": pictures}, {"scores": scores})
    call()

Rule: the runtime `cuda` copies inputs to the GPU and outputs back. The other runtimes read and write the arrays
themselves. A runtime runs the whole network or refuses it; no runtime falls back to another. The file decides the
number types: a float network is computed in floats, unlike an avatar's network.

`calls_of` measures isolated calls of a network on this machine, on distinct inputs, in a process like a unit of a run.
A measurement is cached under everything that it depends on, so that a changed machine, package or network is measured
again. An integer network runs like an avatar's network if it is no stage of a pipeline file (`as_stage`) and no shapes
are given. All other networks run with their own number types. Networks of avatars and of stages run in the runtime that
the caller gives, all others in ONNX Runtime.
"""

from __future__ import annotations

import ctypes
import hashlib
import math
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import numpy as np
import onnxruntime
from numpy.typing import NDArray
from onnx import TensorProto

from trilane.avatars.network_file import NetworkFile, parse_network, read_network
from trilane.cache import cached_arrays
from trilane.errors import BadInputError
from trilane.pipeline.description import Pipeline, PipelineStage, UnitSettings
from trilane.pipeline.file_keys import TYPES, PortType, port_type
from trilane.pipeline.rehearsal import rehearse
from trilane.pipeline.stage import Arrays, PortedStage, UnitContext
from trilane.pipeline.unit_starter import UnitStarter
from trilane.stages.blocks.pictures import Preparation
from trilane.stages.dsp.ort import LOAD_ERRORS, PROVIDER, Named, OrtSession, settings_of
from trilane.stages.dsp.runtime import (
    RUNTIMES,
    RuntimeOptions,
    has_device,
    load_runtime,
    quiet_openvino,
    resolve,
    said_by_openvino,
)
from trilane.stages.machine_facts import cpu_facts, versions_with
from trilane.transport.packets import Packet

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
        pairs = []
        for port, array in given:
            # OpenVINO takes only writeable arrays, even as inputs.
            memory = memoryview((ctypes.c_char * array.nbytes).from_address(array.ctypes.data))
            writeable = np.frombuffer(memory, array.dtype).reshape(array.shape)
            pairs.append((port, self._openvino.Tensor(writeable, shared_memory=True)))

        def call() -> None:
            for port, tensor in pairs:
                self._request.set_tensor(port, tensor)
            self._request.start_async()
            self._request.wait()

        return call


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

    `own`: memory of the stage for a prepared picture, or for zeros while the input has no frame.
    `preparation`: conversion of a picture into this memory; None if the runtime gets the array of the slot.
    """

    name: str
    type: PortType
    own: NDArray[Any]
    preparation: Preparation | None


class NetworkStage(PortedStage):
    """Runs one inference for each frame.

    Its keys are `onnx`, `runtime`, and `inputs`, the type of each input of the network by name, in the network's order.

    Raises BadInputError if the runtime does not load the network, or no conversion of a picture fits an input. Raises
    MissingPartError for an absent runtime.
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
        preparation = None if is_same else Preparation(wanted[name], {}, self.settings.where)
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


CACHE = "network-calls-1"
UNIT, STAGE = "dsp", "infer"
CALLS, INPUTS = 100, 4
#: NumPy types by ONNX's names of the number types that an input may have.
NUMBERS: Mapping[int, type[np.generic]] = {
    TensorProto.FLOAT: np.float32,
    TensorProto.FLOAT16: np.float16,
    TensorProto.DOUBLE: np.float64,
    TensorProto.UINT8: np.uint8,
    TensorProto.INT8: np.int8,
    TensorProto.INT32: np.int32,
    TensorProto.INT64: np.int64,
    TensorProto.BOOL: np.bool_,
}


class Calls(NamedTuple):
    """The measured calls of a network.

    `took_ns`: time of each call in ns, by number of threads.
    `runtime`: name of the runtime.
    `at`: date and time of the measurement, UTC.
    """

    took_ns: Mapping[int, Sequence[int]]
    runtime: str
    at: str


def calls_of(
    path: Path,
    shapes: Shapes,
    runtime: str,
    counts: Sequence[int],
    cores: Sequence[int],
    say: Callable[[], None],
    as_stage: bool = False,
) -> Calls:
    """Return measured times of calls of the network in `path`, without the time in which they had no core.

    Equal calls that were measured before come from a cache.

    `shapes`: shapes of inputs by name, in place of the file's shapes.
    `runtime`: runtime of a stage, and of an avatar's integer network if `shapes` is empty; others run in ONNX Runtime.
    `counts`: numbers of threads to measure.
    `cores`: numbers of the cores to use; a call with n threads runs on the last n of them.
    `say`: function that is called before a measurement, which takes seconds.
    `as_stage`: whether the network is a stage of a pipeline file.

    Raises OSError if `path` cannot be read, TrilaneError if a unit cannot load or run the network.
    """
    is_avatar = not as_stage and not shapes and _integers(path) is not None
    runs = runtime if as_stage or is_avatar else ORT
    asked = [runs, *([STAGE] if as_stage else []), str([*cores]), str([*counts]), str(sorted(shapes.items()))]
    facts = [str(cpu_facts()), *versions_with(RUNTIMES[runs].package)]

    def measured() -> dict[str, NDArray[Any]]:
        say()
        found = _measured(path, shapes, runs, counts, cores, is_avatar)
        took_ns = {f"{threads}": np.array(ns, np.int64) for threads, ns in found.items()}
        return {**took_ns, "at_s": np.array(time.time(), np.int64)}

    made = dict(cached_arrays(CACHE, [_digest(path), *asked, *facts], measured))
    at_s = int(made.pop("at_s"))
    at = time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime(at_s))
    return Calls({int(threads): ns.tolist() for threads, ns in made.items()}, runs, at)


def _measured(
    path: Path, shapes: Shapes, runtime: str, counts: Sequence[int], cores: Sequence[int], is_avatar: bool
) -> dict[int, Sequence[int]]:
    sizes = {name: list(shape) for name, shape in shapes.items()}
    settings = {"path": str(path.absolute()), "shapes": sizes, "runtime": runtime, "is_avatar": is_avatar}
    stage = PipelineStage(name=STAGE, unit=UNIT, factory=f"{__name__}:build_calls", settings=settings)
    found = {}
    with UnitStarter((__name__,)) as starter:
        for threads in counts:
            unit = UnitSettings(cores=tuple(cores[-threads:]), threads=threads, spin=threads > 1)
            pipeline = Pipeline(stages=(stage,), edges=(), units={UNIT: unit})
            found[threads] = rehearse(pipeline, [], range(CALLS), {}, starter).took_ns[STAGE]
    return found


def _integers(path: Path) -> NetworkFile | None:
    """Return the network in `path` if it is an integer network that an avatar may have; otherwise None."""
    try:
        return read_network(path)
    except BadInputError:
        return None


def _digest(path: Path) -> str:
    """Return a digest of the file; weights in other files are left out, because they do not change times."""
    return hashlib.sha256(path.read_bytes()).hexdigest()


class CallStage:
    """A `trilane.pipeline.stage.Stage`. Frame n calls function n modulo their number. `calls`: functions to call."""

    def __init__(self, calls: Sequence[Callable[[], object]]) -> None:
        self._calls = calls

    def bind(self, inputs: Sequence[Packet], outputs: Sequence[Packet]) -> None:
        """Do nothing, because there are no slots, and the calls have their own inputs."""

    def run(self, frame: int, slot_in: int | None, slot_out: int | None) -> Mapping[str, float]:  # noqa: ARG002
        self._calls[frame % len(self._calls)]()
        return {}

    def close(self) -> None:
        """Do nothing, because the calls need no closing."""


def build_calls(settings: Mapping[str, Any], unit: UnitContext) -> CallStage:
    """Build the stage that calls the network in `settings["path"]`. Raises BadInputError, MissingPartError."""
    path, options = Path(settings["path"]), RuntimeOptions(unit.settings.threads, unit.settings.spin)
    if not settings["is_avatar"]:
        return CallStage(_calls(path, settings["shapes"], settings["runtime"], options))
    network = read_network(path)
    session = load_runtime(settings["runtime"]).load(network, options)
    image = np.zeros((*network.shape[:3], 4), np.uint8)
    inputs = [_random(number, network.shape, np.uint8) for number in range(INPUTS)]
    return CallStage([session.bind([each], [image]).run for each in inputs])


def _calls(path: Path, shapes: Shapes, runtime: str, options: RuntimeOptions) -> list[Callable[[], object]]:
    """Return functions that each call the network in `path` on random inputs, and throw its outputs away.

    Raises BadInputError if the runtime cannot load the graph, or an input has no fixed shape or type of `NUMBERS`.
    """
    graph = parse_network(path).graph
    held = {each.name for each in graph.initializer}
    inputs = {each.name: each.type.tensor_type for each in graph.input if each.name not in held}
    sources = []
    for name, kind in inputs.items():
        shape = tuple(shapes.get(name, [size.dim_value for size in kind.shape.dim]))
        if kind.elem_type not in NUMBERS or 0 in shape:
            raise BadInputError(path, f"input {name} of type {kind.elem_type}, {shape}", "numbers, in a fixed shape")
        sources.append((name, shape, NUMBERS[kind.elem_type]))
    engine = engine_of(path, runtime, {name: shape for name, shape, _ in sources}, options)
    feeds = [{name: _random(number, shape, kind) for name, shape, kind in sources} for number in range(INPUTS)]
    return [engine.bound(feed, {}) for feed in feeds]


def _random(seed: int, shape: Sequence[int], numbers: type[np.generic]) -> NDArray[Any]:
    """Return random numbers from `seed`: uniform bytes, normally distributed floats, or 0 and 1 for other types."""
    rng = np.random.default_rng(seed)
    if numbers is np.uint8:
        return rng.integers(0, 256, shape, dtype=np.uint8)
    if np.issubdtype(numbers, np.floating):
        return rng.normal(size=shape).astype(numbers)
    return rng.integers(0, 2, shape).astype(numbers)
