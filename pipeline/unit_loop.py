"""A unit's process: its `UnitSpec`, its stages with their slots, and the loop that answers messages.

Rule: each message has one answer, and an error is an answer too. Slots are bound once, before the first job. The loop,
not the stage, copies a packet's header from the input slot to the output slot.

A process gets its `UnitSpec` as one JSON document of plain data and numbers of descriptors.
"""

from __future__ import annotations

import contextlib
import errno
import gc
import os
import sys
import time
import traceback
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from importlib import import_module
from pathlib import Path
from typing import Any, cast

from trilane.arrays import U8
from trilane.errors import MissingPartError, TrilaneError, UnitLostError
from trilane.machine import UNIT_SLICE_NS, shortage, use_slice
from trilane.pipeline.description import Model, PipelineStage, UnitSettings
from trilane.pipeline.job_times import TASKS, CoreMeter, HardwareCounters, JobClock, NoCounters, counters_here
from trilane.pipeline.memory import EdgeRegion, map_assets
from trilane.pipeline.stage import JoiningStage, Skip, SkippingStage, Stage, StageFactory, SteppedStage, UnitContext
from trilane.scheduler.events import unpacked
from trilane.transport.messages import (
    BUILDING,
    CLOSING,
    LINGER_MS,
    MAX_TEXT,
    Close,
    Closed,
    Failed,
    JobPipe,
    JobPipeEnd,
    Link,
    MessageError,
    Ping,
    PongMessage,
    Ready,
    RunJob,
    context_on_cores,
)
from trilane.transport.packets import FRAME_FIELDS, Packet, map_region
from trilane.units import NS_PER_S


class UnitSpec(Model):
    """The description of one unit of a run for the unit's process.

    `unit`: name of the unit.
    `endpoint`: ZeroMQ address of the heartbeat socket.
    `job_pipe`, `assets_fd`: descriptors of the job pipe and the assets.
    `settings`: settings of the unit.
    `scheduler_cores`: cores of the scheduler.
    `run_cores`: cores of all units.
    `stages`: stages of this unit; messages name a stage by its index in this list.
    `module_folders`: folders that come first in the module search path.
    `edges`: shared memory of each edge of the unit's stages, by the edge's name.
    `inputs`: names of the input edges of each stage that has inputs, by the stage's name.
    `outputs`: name of the output edge of each stage that has an output, by the stage's name.
    `may_skip`: name of the stage at which the pipeline's bypass begins, or "".
    """

    unit: str
    endpoint: str
    job_pipe: JobPipeEnd
    assets_fd: int
    settings: UnitSettings
    scheduler_cores: tuple[int, ...]
    run_cores: tuple[int, ...]
    stages: tuple[PipelineStage, ...]
    module_folders: tuple[Path, ...]
    edges: dict[str, EdgeRegion]
    inputs: dict[str, tuple[str, ...]]
    outputs: dict[str, str]
    may_skip: str = ""

    @property
    def fds(self) -> list[int]:
        """The descriptors that the unit's process needs."""
        return [*self.job_pipe, self.assets_fd, *(edge.fd for edge in self.edges.values())]

    def renumbered(self, number_of: Mapping[int, int]) -> UnitSpec:
        """Return this spec with every descriptor n replaced by `number_of[n]`."""
        edges = {name: edge.model_copy(update={"fd": number_of[edge.fd]}) for name, edge in self.edges.items()}
        return self.model_copy(
            update={
                "job_pipe": JobPipeEnd(*(number_of[fd] for fd in self.job_pipe)),
                "assets_fd": number_of[self.assets_fd],
                "edges": edges,
            }
        )


WAKE_UP_NS = 150_000  # time by which a sleep usually ends too late


class BoundStage:
    """A stage that is bound to its slots."""

    def __init__(
        self,
        name: str,
        stage: Stage | JoiningStage,
        inputs: list[Packet],
        outputs: list[Packet],
        pace_ns: int,
        unit: UnitContext,
        may_skip: bool = False,
        join: Join | None = None,
    ) -> None:
        """Bind `stage` to its slots.

        `inputs`, `outputs`: slots of the input edges and of the output edge; empty if there is no such edge.
        `pace_ns`: least time of a job in ns; a shorter job is made longer by a wait at its end. 0: none.
        `unit`: context of the unit that runs the stage.
        `may_skip`: whether a bypass begins at the stage.
        `join`: inputs of a `JoiningStage`, for which `inputs` is empty; None for any other stage.
        """
        self.name, self._pace_ns, self._may_skip = name, pace_ns, may_skip
        self._stage, self._outputs, self._unit, self._join = cast(Stage, stage), outputs, unit, join
        self._is_first = not inputs if join is None else join.is_source
        self._rung = self._sampled_ns = 0
        self._pass_on = _header_copier(inputs, outputs)
        if join is None:
            self._stage.bind(inputs, outputs)
        else:
            cast(JoiningStage, stage).bind(join.inputs, outputs)

    def run(
        self, frame: int, slot_in: int, slot_out: int, epoch: int, fresh: bool = False, rung: int = 0
    ) -> Mapping[str, float]:
        """Do a job, wait until its pace has passed, and return the stage's metrics; a `Skip` if the frame skips.

        `frame`: number of the frame.
        `slot_in`, `slot_out`: slots of the job, as in `Job`; -1 if the stage has no input or no output.
        `epoch`: epoch of the output edge, for the packet's header.
        `fresh`: whether the stage must not rely on what earlier frames brought to the end of the bypass.
        `rung`: rung of the frame's work, which is passed to the first stage.

        Raises TrilaneError for a `Skip` of a stage that may not skip.
        """
        if fresh and self._may_skip:
            cast(SkippingStage, self._stage).forget()
        if self._is_first and rung != self._rung:
            self._rung = rung
            cast(SteppedStage, self._stage).step_to(rung)
        end_ns = time.monotonic_ns() + self._pace_ns
        taken: Any = slot_in if slot_in >= 0 else None
        if self._join is not None:
            taken = self._join.slots(slot_in)
        self._sampled_ns = time.monotonic_ns() if self._is_first else 0
        if slot_out >= 0:
            if self._is_first or self._join is not None:
                header = self._outputs[slot_out].header
                sampled_ns = self._sampled_ns if self._join is None else self._join.sampled_ns(taken, self._sampled_ns)
                header["frame"], header["t_sampled_ns"] = frame, sampled_ns
            else:
                self._pass_on(slot_in, slot_out)
            self._outputs[slot_out].header["epoch"] = epoch
        metrics = self._stage.run(frame, taken, slot_out if slot_out >= 0 else None)
        if isinstance(metrics, Skip) and not self._may_skip:
            raise TrilaneError(f"stage {self.name} returned a Skip, and the pipeline's bypass does not begin at it")
        if self._pace_ns:
            hold_until(end_ns)
        return metrics

    @property
    def works_asleep(self) -> bool:
        """Whether time in which the threads of a job sleep counts as busy.

        This is so if a device works for the job, or if the stage has a pace, which models the time of a chip.
        """
        return self._pace_ns > 0 or self._unit.has_device

    def sampled_ns(self, slot_in: int, slot_out: int) -> int:
        """Return the time in ns at which the stage sampled the frame of its last job; 0 if another stage sampled it.

        `slot_in`, `slot_out`: slots of the last job.
        """
        if not self._is_first or (slot_in >= 0 and self._join is None):
            return 0
        return int(self._outputs[slot_out].header["t_sampled_ns"]) if slot_out >= 0 else self._sampled_ns

    def close(self) -> None:
        self._stage.close()


class Join:
    """The inputs of a `JoiningStage`, which takes one slot of each input for a job.

    `inputs`: slots of each input.
    `is_source`: whether all inputs take the newest frame, so that the run's source releases the stage's frames.
    """

    def __init__(self, inputs: Sequence[list[Packet]], latest: Sequence[bool]) -> None:
        """Keep the slots. `latest`: for each input, whether it takes the newest frame."""
        self.inputs = list(inputs)
        self._by_frame = [place for place, is_latest in enumerate(latest) if not is_latest]
        self.is_source = not self._by_frame

    def slots(self, packed: int) -> tuple[int | None, ...]:
        """Return the slot of each input of a job; None for an input without a frame. `packed`: `Job.slot_in`."""
        return tuple(slot if slot >= 0 else None for slot in unpacked(packed, len(self.inputs)))

    def sampled_ns(self, slots: Sequence[int | None], now_ns: int) -> int:
        """Return the earliest sampling time, in ns, of the inputs that do not take the newest frame.

        `slots`: slot of each input.
        `now_ns`: result if all inputs take the newest frame.
        """
        found = [int(self.inputs[place][slots[place] or 0].header["t_sampled_ns"]) for place in self._by_frame]
        return min(found, default=now_ns)


def hold_until(end_ns: int) -> None:
    """Wait until `end_ns` of CLOCK_MONOTONIC: sleep for most of the time, then spin."""
    while (left_ns := end_ns - time.monotonic_ns()) > 0:
        if left_ns > WAKE_UP_NS:
            time.sleep((left_ns - WAKE_UP_NS) / NS_PER_S)


def _header_copier(inputs: list[Packet], outputs: list[Packet]) -> Callable[[int, int], None]:
    """Return a function of (input slot, output slot) that copies the header, or only FRAME_FIELDS if dtypes differ."""
    if inputs and outputs and inputs[0].header.dtype != outputs[0].header.dtype:
        return lambda slot_in, slot_out: _copy_fields(inputs[slot_in].header, outputs[slot_out].header)
    sources, targets = [_bytes_of(packet) for packet in inputs], [_bytes_of(packet) for packet in outputs]

    def copy(slot_in: int, slot_out: int) -> None:
        targets[slot_out][:] = sources[slot_in]

    return copy


def _copy_fields(source: Any, target: Any) -> None:
    for name, _ in FRAME_FIELDS:
        target[name] = source[name]


def _bytes_of(packet: Packet) -> U8:
    return packet.header.reshape(1).view("u1")


def serve(raw_spec: dict[str, Any], number_of: Mapping[int, int]) -> int:
    """Build the unit's stages, answer messages until Close, and return the process's exit code.

    `raw_spec`: a `UnitSpec` as JSON values.
    `number_of`: number in this process of each descriptor, by the number that the spec states.
    """
    spec = UnitSpec.model_validate(raw_spec).renumbered(number_of)
    context = context_on_cores(spec.scheduler_cores)
    link = Link(context, JobPipe(spec.job_pipe, waits=True), LINGER_MS)
    # `context_on_cores` leaves this thread with the I/O thread's slice; a unit's is longer.
    use_slice(UNIT_SLICE_NS)
    link.connect(spec.endpoint)
    try:
        return _serve(spec, link)
    finally:
        link.close()
        context.term()


def _serve(spec: UnitSpec, link: Link) -> int:
    with contextlib.closing(counters_here()) as counters:  # these count the threads that the stages begin, too
        return _answer(spec, link, counters)


def _answer(spec: UnitSpec, link: Link, counters: HardwareCounters | NoCounters) -> int:
    others = _threads() - {os.getpid()}
    try:
        with building_cores(spec):
            stages = build_stages(spec)
    except Exception as error:
        return _fail(link, BUILDING, f"unit {spec.unit}", error)
    gc.collect()
    gc.freeze()
    clock = JobClock(CoreMeter(others), len(spec.settings.cores), len(stages))
    link.send_heartbeat(Ready(os.getpid()))
    while True:
        message = link.job_pipe.receive()
        if isinstance(message, RunJob):
            _run_job(link, stages[message.stage], message, clock, counters)
        elif isinstance(message, Ping):
            link.send_heartbeat(PongMessage())
        elif isinstance(message, Close):
            return _close(spec.unit, link, stages)
        elif link.job_pipe.ended:
            return 1
        else:
            raise MessageError(f"{message} is not for a unit")


@contextlib.contextmanager
def building_cores(spec: UnitSpec) -> Iterator[None]:
    """Let this thread use every core of the run inside the `with` block, so that the unit's stages are built sooner.

    At the end this thread, and every thread that was started in the block, gets only the unit's own cores.
    """
    before = _threads()
    os.sched_setaffinity(0, spec.run_cores)
    try:
        yield
    finally:
        os.sched_setaffinity(0, spec.settings.cores)
        for thread in _threads() - before:
            with contextlib.suppress(ProcessLookupError):  # it has ended meanwhile
                os.sched_setaffinity(thread, spec.settings.cores)


def _threads() -> set[int]:
    """Return the kernel's ids of this process's threads."""
    return {int(task.name) for task in Path(TASKS).iterdir()}


def build_stages(spec: UnitSpec) -> list[BoundStage]:
    """Return the unit's stages, bound to their slots, in the order of `spec.stages`. Raises any error of a factory."""
    sys.path[:0] = map(str, spec.module_folders)
    unit = UnitContext(spec.unit, spec.settings, map_assets(spec.assets_fd))
    stages = [factory_named(stage.factory)(stage.settings, unit) for stage in spec.stages]
    packets = {name: map_region(edge.fd, edge.layout) for name, edge in spec.edges.items()}
    bound = []
    for described, stage in zip(spec.stages, stages, strict=True):
        read = [packets[edge] for edge in spec.inputs.get(described.name, ())]
        outputs = packets[spec.outputs[described.name]] if described.name in spec.outputs else []
        join = Join(read, [each.latest for each in described.inputs or ()]) if described.joins else None
        inputs = [packet for slots in read for packet in slots] if join is None else []
        skips = described.name == spec.may_skip
        bound.append(BoundStage(described.name, stage, inputs, outputs, described.pace_ns, unit, skips, join))
    return bound


def factory_named(name: str) -> StageFactory:
    """Return the factory that `module:name` names. Raises ImportError or AttributeError."""
    module, _, attribute = name.partition(":")
    factory: StageFactory = getattr(import_module(module), attribute)
    return factory


def _run_job(
    link: Link, stage: BoundStage, job: RunJob, clock: JobClock, counters: HardwareCounters | NoCounters
) -> None:
    counters.begin()
    clock.begin(job.stage, job.t_dispatch_ns)
    try:
        metrics = stage.run(job.frame, job.slot_in, job.slot_out, job.epoch, job.fresh > 0, job.rung)
        clock.end(stage.works_asleep)
        values = counters.figures()
        values.update((str(name), float(value)) for name, value in metrics.items())
        sampled_ns = stage.sampled_ns(job.slot_in, job.slot_out)
        link.job_pipe.send(clock.done(job.id, sampled_ns, values, isinstance(metrics, Skip)))
    except UnitLostError:
        raise
    except Exception as error:
        _fail(link, job.id, f"stage {stage.name}, frame {job.frame}", error)
    clock.answered()


def _close(unit: str, link: Link, stages: Iterable[BoundStage]) -> int:
    code = 0
    for stage in stages:
        try:
            stage.close()
        except Exception as error:
            code = _fail(link, CLOSING, f"unit {unit}, closing {stage.name}", error)
    link.job_pipe.send(Closed())
    return code


def _fail(link: Link, job_id: int, where: str, error: Exception) -> int:
    """Send the error to the scheduler as one sentence, and return its exit code. The traceback goes to stderr.

    `job_id`: id of the failed job; BUILDING or CLOSING outside a job.
    """
    traceback.print_exception(error)
    known = isinstance(error, TrilaneError)
    text = str(error) if known else f"{where}: {type(error).__name__}: {error}"
    code = error.exit_code if isinstance(error, TrilaneError) else 1
    is_of_memory = isinstance(error, MemoryError) or (isinstance(error, OSError) and error.errno == errno.ENOMEM)
    if (is_of_memory or job_id == BUILDING) and (short := shortage()):
        said = error.what if isinstance(error, MissingPartError) else text
        text, code = f"{where}: memory is short: {short}; it failed with: {said}", 1
    sentence = " ".join(text.split()).encode(errors="replace")  # a file's name may contain bytes that are no text
    link.job_pipe.send(Failed(job_id, code, sentence[:MAX_TEXT].decode(errors="ignore")))
    return code
