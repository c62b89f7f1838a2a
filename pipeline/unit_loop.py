"""The loop inside a unit's process. Rule: one message, one answer; an error is an answer, never silence.

Slots are bound once, before the first job.
"""

from __future__ import annotations

import contextlib
import gc
import os
import sys
import traceback
from collections.abc import Iterable, Iterator, Mapping
from importlib import import_module
from pathlib import Path
from typing import Any

from trilane.errors import TrilaneError, UnitLostError
from trilane.pipeline.bound_stage import BoundStage
from trilane.pipeline.core_meter import TASKS, CoreMeter
from trilane.pipeline.hardware_counters import HardwareCounters, NoCounters, counters_here
from trilane.pipeline.job_times import JobClock
from trilane.pipeline.shared_assets import map_assets
from trilane.pipeline.stage import Skip, StageFactory, UnitContext
from trilane.pipeline.unit_spec import UnitSpec
from trilane.transport.link import LINGER_MS, Link, context_on_cores
from trilane.transport.messages import (
    BUILDING,
    CLOSING,
    MAX_TEXT,
    Close,
    Closed,
    Failed,
    JobPipe,
    MessageError,
    Ping,
    Pong,
    Ready,
    RunJob,
)
from trilane.transport.packets import map_region
from trilane.transport.wakeup import UNIT_NS, use_slice


def serve(raw_spec: dict[str, Any], number_of: Mapping[int, int]) -> int:
    """Build the unit's stages, answer messages until Close, and return the process's exit code.

    `number_of`: number in this process of each descriptor that the spec names.
    """
    spec = UnitSpec.model_validate(raw_spec).renumbered(number_of)
    context = context_on_cores(spec.scheduler_cores)
    link = Link(context, JobPipe(spec.job_pipe, waits=True), LINGER_MS)
    # `context_on_cores` leaves this thread with the I/O thread's slice; a unit's is longer.
    use_slice(UNIT_NS)
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
            link.send_heartbeat(Pong())
        elif isinstance(message, Close):
            return _close(spec.unit, link, stages)
        elif link.job_pipe.ended:
            return 1
        else:
            raise MessageError(f"{message} is not for a unit")


@contextlib.contextmanager
def building_cores(spec: UnitSpec) -> Iterator[None]:
    """Let this thread use every core of the run while the stages are built, so that the unit is ready sooner.

    Afterwards it and every thread that was started meanwhile are back on the unit's own cores.
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
    """Return the threads of this process, by the kernel's numbers."""
    return {int(task.name) for task in Path(TASKS).iterdir()}


def build_stages(spec: UnitSpec) -> list[BoundStage]:
    """Return the unit's stages on their slots, in the order of `spec.stages`; raises what their factories raise."""
    sys.path[:0] = map(str, spec.module_folders)
    unit = UnitContext(spec.unit, spec.settings, map_assets(spec.assets_fd))
    stages = [factory_named(stage.factory)(stage.settings, unit) for stage in spec.stages]
    packets = {name: map_region(edge.fd, edge.layout) for name, edge in spec.edges.items()}
    return [
        BoundStage(
            described.name,
            stage,
            [packet for edge in spec.inputs.get(described.name, ()) for packet in packets[edge]],
            packets[spec.outputs[described.name]] if described.name in spec.outputs else [],
            described.pace_ns,
            unit,
            described.name == spec.may_skip,
        )
        for described, stage in zip(spec.stages, stages, strict=True)
    ]


def factory_named(name: str) -> StageFactory:
    """Return the factory that `module:name` names; raises ImportError or AttributeError."""
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
    """Answer with one sentence, and return the exit code; the traceback goes to stderr, whose end the parent keeps."""
    traceback.print_exception(error)
    known = isinstance(error, TrilaneError)
    text = str(error) if known else f"{where}: {type(error).__name__}: {error}"
    code = error.exit_code if isinstance(error, TrilaneError) else 1
    sentence = " ".join(text.split()).encode(errors="replace")  # a file's name may hold bytes that are no text
    link.job_pipe.send(Failed(job_id, code, sentence[:MAX_TEXT].decode(errors="ignore")))
    return code
