"""Measures the calls of a network alone on this machine, on distinct inputs, in a process like a unit of a run.

Rule: a measurement is kept with everything that it depends on, so a machine, package or network that changed is
measured again. A network of integers runs as an avatar's does; any other one runs in ONNX Runtime, with its own number
types.
"""

from __future__ import annotations

import hashlib
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from trilane.avatars.network_file import NetworkFile, parse_network, read_network
from trilane.cache import cached_arrays
from trilane.errors import BadInputError
from trilane.pipeline.description import Pipeline, PipelineStage, UnitSettings
from trilane.pipeline.rehearsal import rehearse
from trilane.pipeline.stage import UnitContext
from trilane.pipeline.unit_starter import UnitStarter
from trilane.stages.dsp.runtime import RUNTIMES, RuntimeOptions, load_runtime
from trilane.stages.machine_facts import cpu_facts, versions_with
from trilane.transport.packets import Packet

CACHE = "network-calls-1"
UNIT, STAGE = "dsp", "infer"
CALLS, INPUTS = 100, 4
#: NumPy types by ONNX Runtime's names of the number types that an input may have.
NUMBERS: Mapping[str, type[np.generic]] = {
    "tensor(float)": np.float32,
    "tensor(float16)": np.float16,
    "tensor(double)": np.float64,
    "tensor(uint8)": np.uint8,
    "tensor(int8)": np.int8,
    "tensor(int32)": np.int32,
    "tensor(int64)": np.int64,
    "tensor(bool)": np.bool_,
}
ORT = "ort"
Shapes = Mapping[str, Sequence[int]]


class Calls(NamedTuple):
    """The measured calls of a network.

    `took_ns`: nanoseconds of each call, by number of threads. `runtime`: name of the runtime. `at`: date and time, UTC.
    """

    took_ns: Mapping[int, Sequence[int]]
    runtime: str
    at: str


def calls_of(
    path: Path, shapes: Shapes, runtime: str, counts: Sequence[int], cores: Sequence[int], say: Callable[[], None]
) -> Calls:
    """Measure how long calls of the network in `path` take, without the time in which they had no core.

    `shapes`: shapes of inputs by name, in place of the file's. `runtime`: runtime of a network of integers. `counts`:
    numbers of threads. `cores`: cores to run on, the last ones first. `say`: is called before this takes seconds.
    Raises BadInputError for a file that cannot be read, TrilaneError when the network cannot be run.
    """
    runs = runtime if not shapes and _integers(path) is not None else ORT
    asked = [runs, str([*cores]), str([*counts]), str(sorted(shapes.items()))]
    facts = [str(cpu_facts()), *versions_with(RUNTIMES[runs].package)]

    def measured() -> dict[str, NDArray[Any]]:
        say()
        found = _measured(path, shapes, runs, counts, cores)
        took_ns = {f"{threads}": np.array(ns, np.int64) for threads, ns in found.items()}
        return {**took_ns, "at_s": np.array(time.time(), np.int64)}

    made = dict(cached_arrays(CACHE, [_digest(path), *asked, *facts], measured))
    at_s = int(made.pop("at_s"))
    at = time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime(at_s))
    return Calls({int(threads): ns.tolist() for threads, ns in made.items()}, runs, at)


def _measured(
    path: Path, shapes: Shapes, runtime: str, counts: Sequence[int], cores: Sequence[int]
) -> dict[int, Sequence[int]]:
    settings = {"path": str(path.absolute()), "shapes": {k: list(v) for k, v in shapes.items()}, "runtime": runtime}
    stage = PipelineStage(name=STAGE, unit=UNIT, factory=f"{__name__}:build", settings=settings)
    found = {}
    with UnitStarter((__name__,)) as starter:
        for threads in counts:
            unit = UnitSettings(cores=tuple(cores[-threads:]), threads=threads, spin=threads > 1)
            pipeline = Pipeline(stages=(stage,), edges=(), units={UNIT: unit})
            found[threads] = rehearse(pipeline, [], range(CALLS), {}, starter).took_ns[STAGE]
    return found


def _integers(path: Path) -> NetworkFile | None:
    """Return the network in `path` if it is an integer network that an avatar may have; else None."""
    try:
        return read_network(path)
    except BadInputError:
        return None


def _digest(path: Path) -> str:
    """Return a digest of the file and its size; weights beside it do not change how long a call takes."""
    return hashlib.sha256(path.read_bytes()).hexdigest()


class CallStage:
    """A `trilane.pipeline.stage.Stage`. Frame n is a call with input n modulo the number of inputs."""

    def __init__(self, calls: Sequence[Callable[[], object]]) -> None:
        self._calls = calls

    def bind(self, inputs: Sequence[Packet], outputs: Sequence[Packet]) -> None:
        """Do nothing: there are no slots, and the inputs are made with the calls."""

    def run(self, frame: int, slot_in: int | None, slot_out: int | None) -> Mapping[str, float]:  # noqa: ARG002
        self._calls[frame % len(self._calls)]()
        return {}

    def close(self) -> None:
        """Do nothing: nothing is left."""


def build(settings: Mapping[str, Any], unit: UnitContext) -> CallStage:
    """Build the stage that calls the network in `settings["path"]`. Raises BadInputError, MissingPartError."""
    path, options = Path(settings["path"]), RuntimeOptions(unit.settings.threads, unit.settings.spin)
    network = None if settings["shapes"] else _integers(path)
    if network is None:
        return CallStage(_float_calls(path, settings["shapes"], options))
    session = load_runtime(settings["runtime"]).load(network, options)
    image = np.zeros((*network.shape[:3], 4), np.uint8)
    inputs = [_random(number, network.shape, np.uint8) for number in range(INPUTS)]
    return CallStage([session.bind([each], [image]).run for each in inputs])


def _float_calls(path: Path, shapes: Shapes, options: RuntimeOptions) -> list[Callable[[], object]]:
    """Return calls in ONNX Runtime.

    Raises BadInputError for a graph that it cannot load or whose inputs are no numbers.
    """
    import onnxruntime

    from trilane.stages.dsp.ort import LOAD_ERRORS, PROVIDER, settings_of

    try:
        model = parse_network(path).SerializeToString()
        session = onnxruntime.InferenceSession(model, settings_of(options), providers=[PROVIDER])
    except LOAD_ERRORS as error:
        raise BadInputError(path, str(error), "a network that ONNX Runtime loads") from error
    sources = [(each.name, each.type, shapes.get(each.name, each.shape)) for each in session.get_inputs()]
    for name, kind, shape in sources:
        if kind not in NUMBERS or not all(isinstance(size, int) and size > 0 for size in shape):
            raise BadInputError(path, f"input {name} of {kind} {shape}", "numbers, in a fixed shape")
    feeds = [{name: _random(number, shape, NUMBERS[kind]) for name, kind, shape in sources} for number in range(INPUTS)]
    return [lambda feed=feed: session.run(None, feed) for feed in feeds]  # type: ignore[misc]


def _random(seed: int, shape: Sequence[int], numbers: type[np.generic]) -> NDArray[Any]:
    """Return random numbers, the same for a seed: bytes of all values, normally distributed floats, else 0 and 1."""
    rng = np.random.default_rng(seed)
    if numbers is np.uint8:
        return rng.integers(0, 256, shape, dtype=np.uint8)
    if np.issubdtype(numbers, np.floating):
        return rng.normal(size=shape).astype(numbers)
    return rng.integers(0, 2, shape).astype(numbers)
