"""Measures isolated calls of a network on this machine, on distinct inputs, in a process like a unit of a run.

Rule: the key of a cached measurement contains everything on which it depends. Therefore a changed machine, package or
network is measured again. An integer network runs like an avatar's network. Any other network runs with its own number
types: in ONNX Runtime, or for a stage of a pipeline file in the runtime of the stage.
"""

from __future__ import annotations

import hashlib
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from onnx import TensorProto

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
ORT = "ort"
Shapes = Mapping[str, Sequence[int]]


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
    `runtime`: runtime of an avatar's integer network if `shapes` is empty; other networks run in ONNX Runtime.
    `counts`: each count of threads to measure.
    `cores`: ids of the cores to use; a call with n threads runs on the last n of them.
    `say`: function that is called before a measurement, which takes seconds.
    `as_stage`: whether the network is a stage of a pipeline file, which always runs in `runtime`.

    Raises BadInputError for a file that cannot be read, TrilaneError if the network cannot run.
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
    stage = PipelineStage(name=STAGE, unit=UNIT, factory=f"{__name__}:build", settings=settings)
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
    """A `trilane.pipeline.stage.Stage`. Frame n is a call with input n modulo the number of inputs."""

    def __init__(self, calls: Sequence[Callable[[], object]]) -> None:
        self._calls = calls

    def bind(self, inputs: Sequence[Packet], outputs: Sequence[Packet]) -> None:
        """Do nothing, because there are no slots, and the calls have their own inputs."""

    def run(self, frame: int, slot_in: int | None, slot_out: int | None) -> Mapping[str, float]:  # noqa: ARG002
        self._calls[frame % len(self._calls)]()
        return {}

    def close(self) -> None:
        """Do nothing, because the calls need no closing."""


def build(settings: Mapping[str, Any], unit: UnitContext) -> CallStage:
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
    """Return functions, each of which calls the network on a random input of its own and throws the outputs away.

    Raises BadInputError for a graph that the runtime cannot load, or whose inputs are no numbers.
    """
    from trilane.stages.blocks.network import engine_of

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
