"""Variants of inference that run in interleaved rounds.

Each variant has a process of its own, so that its threads do not disturb the other variants.

Rule: only one process computes at a time; the others wait for a message. An answer that is text is an error message.
The processes end with the `with` block that started them. As in a run, successive inputs differ and slots alternate,
because caches would speed up repetitions. An input is copied into its slot before the time counts.
"""

from __future__ import annotations

import multiprocessing
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from itertools import cycle, islice
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np

from trilane.errors import TrilaneError

START_S = 300.0
WARM_UP = 3
#: Number of inputs that take turns, and of slots that take turns. They have no common divisor, so that each input comes
#: to each slot.
INPUTS, SLOTS = 5, 2


def answer_of(pipe: Connection, name: str, wait_s: float) -> Any:
    """Return the next answer of a process.

    `pipe`: pipe to the process. `name`: name of the process in error messages. `wait_s`: longest time to wait, s.
    Raises TrilaneError if no answer comes within this time, if the process ended, or if the answer is an error message.
    """
    if not pipe.poll(wait_s):
        raise TrilaneError(f"{name}: no answer in {wait_s:g} s")
    try:
        answer = pipe.recv()
    except EOFError as error:
        raise TrilaneError(f"{name}: its process ended") from error
    if isinstance(answer, str):
        raise TrilaneError(f"{name}: {answer}")
    return answer


@contextmanager
def asked_processes() -> Iterator[Callable[[Callable[..., None], Any], Connection]]:
    """Yield a function `start(serve, given)`, which starts a process and returns a pipe to the process.

    The process calls `serve(pipe, given)`, with its own end of the pipe. All processes end with the `with` block.
    """
    context = multiprocessing.get_context("spawn")
    processes, pipes = [], list[Connection]()

    def start(serve: Callable[..., None], given: Any) -> Connection:
        ours, theirs = context.Pipe()
        process = context.Process(target=serve, args=(theirs, given), daemon=True)
        process.start()
        theirs.close()
        processes.append(process)
        pipes.append(ours)
        return ours

    try:
        yield start
    finally:
        for pipe in pipes:
            pipe.close()
        for process in processes:
            process.join(5)
            process.kill()


@dataclass(frozen=True)
class ProcessVariant:
    """A variant of inference that runs in a process.

    `kind`: key of `KINDS`.
    `network`: path of the ONNX file.
    `runtime`: name of the runtime, for the kind `runtime`; "" for other kinds.
    `threads`: number of threads; None for 1 thread of the kind `runtime`, and for the library's default of other kinds.
    `spin`: whether the threads of the kind `runtime` may spin between runs.
    """

    kind: str
    network: Path
    runtime: str = ""
    threads: int | None = None
    spin: bool = False


class Runner:
    """The process of a variant, as the parent process sees it.

    `startup_ms`: time that the process took to import libraries and load the network.
    The constructor waits until the process is ready. It raises TrilaneError if the process does not start.
    """

    def __init__(self, pipe: Connection, name: str) -> None:
        self._pipe, self._name = pipe, name
        self.startup_ms = float(answer_of(pipe, name, START_S))

    def run(self, count: int) -> list[float]:
        """Infer `count` times in succession, and return the time of each, ms. Raises TrilaneError if a run fails."""
        self._pipe.send(count)
        times: list[float] = answer_of(self._pipe, self._name, START_S)
        return times

    def run_for(self, seconds: float) -> list[float]:
        """Infer for about `seconds`, and return the time of each inference, ms. Raises TrilaneError if a run fails."""
        times: list[float] = []
        end = time.monotonic() + seconds
        while (left := end - time.monotonic()) > 0:
            times += self.run(max(1, int(left * 1e3 / (2 * times[-1]))) if times else 1)
        return times


@contextmanager
def runners(variants: Mapping[str, ProcessVariant]) -> Iterator[dict[str, Runner]]:
    """Start a process for each of `variants`, and yield the processes by variant. They end with the `with` block.

    Raises TrilaneError if a process does not start.
    """
    with asked_processes() as start:
        yield {name: Runner(start(serve, variant), name) for name, variant in variants.items()}


def serve(pipe: Connection, variant: ProcessVariant) -> None:
    """Run the process of a variant: load the network, send the start-up time in ms, and answer messages.

    A message is a number of inferences. The answer is the time of each inference in ms, or an error message. The
    process ends when `pipe` closes.
    """
    try:
        begin = time.perf_counter()
        runs = KINDS[variant.kind](variant)
        pipe.send((time.perf_counter() - begin) * 1e3)
        _timed(runs, WARM_UP)
        while True:
            pipe.send(_timed(runs, pipe.recv()))
    except (EOFError, BrokenPipeError):
        return
    except Exception as error:
        pipe.send(f"{type(error).__name__}: {error}")


#: Calls to time, without end. Taking a call from the iterator puts the next input into its slot.
Runs = Iterator[Callable[[], object]]


def _timed(runs: Runs, count: int) -> list[float]:
    times = []
    for run in islice(runs, count):
        begin = time.perf_counter_ns()
        run()
        times.append((time.perf_counter_ns() - begin) / 1e6)
    return times


def _runtime(variant: ProcessVariant) -> Runs:
    """Return endless calls that each infer once with Trilane's runtime `variant.runtime`. Slots are bound once."""
    from trilane.avatars.network_file import read_network
    from trilane.bench.lib.networks import random_tensors
    from trilane.stages.dsp.runtime import RuntimeOptions, load_runtime

    network = read_network(variant.network)
    session = load_runtime(variant.runtime).load(network, RuntimeOptions(variant.threads or 1, variant.spin))
    tensors = np.empty((SLOTS, *network.shape), np.uint8)
    images = np.empty((SLOTS, *network.shape[:3], 4), np.uint8)
    bound = [session.bind([tensor], [image]) for tensor, image in zip(tensors, images, strict=True)]

    def runs() -> Runs:
        for number, tensor in enumerate(cycle(random_tensors(network, INPUTS))):
            tensors[number % SLOTS] = tensor
            yield bound[number % SLOTS].run

    return runs()


def _ort_default(variant: ProcessVariant) -> Runs:
    """Return endless calls that each infer once, as in ONNX Runtime's introductory example.

    All settings are ONNX Runtime's defaults, except the number of threads if `variant` has one.
    """
    import onnxruntime

    settings = onnxruntime.SessionOptions()
    if variant.threads is not None:
        settings.intra_op_num_threads = variant.threads
    session = onnxruntime.InferenceSession(str(variant.network), settings, providers=["CPUExecutionProvider"])
    source = session.get_inputs()[0]
    rng = np.random.default_rng(1)
    shape = (INPUTS, *source.shape)
    if source.type == "tensor(uint8)":
        feeds: Any = rng.integers(0, 256, shape, dtype=np.uint8)
    else:
        feeds = rng.normal(size=shape).astype(np.float32)
    return (partial(session.run, None, {source.name: feed}) for feed in cycle(feeds))


def _openvino_default(variant: ProcessVariant) -> Runs:
    """Return endless calls that each infer once, as in OpenVINO's introductory example.

    All settings are OpenVINO's defaults, except the number of threads if `variant` has one.
    """
    from trilane.stages.dsp.runtime import quiet_openvino

    openvino = quiet_openvino()
    settings = {} if variant.threads is None else {"INFERENCE_NUM_THREADS": variant.threads}
    compiled = openvino.Core().compile_model(str(variant.network), "CPU", settings)
    feeds = np.random.default_rng(1).integers(0, 256, (INPUTS, *compiled.input(0).shape), dtype=np.uint8)
    request = compiled.create_infer_request()
    return (partial(request.infer, {0: feed}) for feed in cycle(feeds))


#: Kind of a variant -> function that makes its calls.
KINDS: dict[str, Callable[[ProcessVariant], Runs]] = {
    "runtime": _runtime,
    "ort": _ort_default,
    "openvino": _openvino_default,
}
