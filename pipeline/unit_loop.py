"""The loop inside a unit's process. Rule: one message, one answer; an error is an answer, never silence.

Slots are bound once, before the first job. A job copies the pose header from its input to its output slot and runs
its stage; the first stage of the chain has no input, so the loop itself stamps frame, epoch and the pose's instant.
"""

from __future__ import annotations

import gc
import os
import time
import traceback
from collections.abc import Iterable, Mapping
from importlib import import_module
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict

from trilane.errors import TrilaneError, UnitLostError
from trilane.pipeline.description import HeaderDtype
from trilane.pipeline.stage import Stage
from trilane.stages.config import RunConfig
from trilane.transport.heartbeats import LINGER_MS, context_on_cores
from trilane.transport.job_pipe import JobPipe, JobPipeEnd
from trilane.transport.link import Link
from trilane.transport.memory import RegionLayout, map_region
from trilane.transport.messages import (
    BUILDING,
    CLOSING,
    MAX_TEXT,
    MEASURING,
    Close,
    Closed,
    Done,
    Duration,
    Failed,
    MessageError,
    Ping,
    Pong,
    Ready,
    RunIsolated,
    RunJob,
)
from trilane.transport.packets import Packet, SlotLayout
from trilane.transport.wakeup import UNIT_NS, use_slice

WATCH_NS = 150_000  # of a hold: a sleep ends about this much late
SCHEDULER = "cpu"  # the unit whose cores the scheduler shares
INFERRING = "dsp"  # the unit whose own stages are those of the network


class EdgeSpec(BaseModel):
    """A region that the unit maps. `fd` is inherited."""

    model_config = ConfigDict(extra="forbid", frozen=True, arbitrary_types_allowed=True)
    fd: int
    slots: int
    header: HeaderDtype
    payload_bytes: int

    @property
    def layout(self) -> RegionLayout:
        return RegionLayout(self.slots, SlotLayout(self.header, self.payload_bytes))


class UnitSpec(BaseModel):
    """What a unit's process is told. `line` is inherited.

    `stages`: name to (input edge, output edge), each a key of `edges` or None; messages count them in this order.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)
    parent_pid: int
    endpoint: str
    line: JobPipeEnd
    config: RunConfig
    edges: dict[str, EdgeSpec]
    stages: dict[str, tuple[str | None, str | None]]


class _BoundStage:
    """A stage with its slots and byte views of their headers. `pace_ns`: how long a job is held, at least."""

    def __init__(self, name: str, stage: Stage, inputs: list[Packet], outputs: list[Packet], pace_ns: int) -> None:
        self.name, self._pace_ns = name, pace_ns
        self._stage, self._inputs, self._outputs = stage, inputs, outputs
        self._header_in = [_header_bytes(packet) for packet in inputs]
        self._header_out = [_header_bytes(packet) for packet in outputs]
        stage.bind(inputs, outputs)

    def run(self, frame: int, slot_in: int, slot_out: int, epoch: int) -> Mapping[str, float]:
        """Do the job, and hold it until its pace has passed."""
        end_ns = time.monotonic_ns() + self._pace_ns
        figures = self._do(frame, slot_in, slot_out, epoch)
        if self._pace_ns:
            hold_until(end_ns)
        return figures

    def _do(self, frame: int, slot_in: int, slot_out: int, epoch: int) -> Mapping[str, float]:
        if slot_out >= 0:
            if slot_in >= 0:
                self._header_out[slot_out][:] = self._header_in[slot_in]
            else:
                pose = self._outputs[slot_out].header
                pose["frame"], pose["t_sampled_ns"] = frame, time.monotonic_ns()
            self._outputs[slot_out].header["epoch"] = epoch
        return self._stage.run(frame, slot_in if slot_in >= 0 else None, slot_out if slot_out >= 0 else None)

    def pose_ns(self, slot_in: int, slot_out: int) -> int:
        """Of the chain's first stage: when the pose in its output slot was sampled; else 0."""
        return int(self._outputs[slot_out].header["t_sampled_ns"]) if slot_in < 0 <= slot_out else 0

    def close(self) -> None:
        self._stage.close()


def hold_until(end_ns: int) -> None:
    """Return at `end_ns` of CLOCK_MONOTONIC, or at once when that has passed: sleep, and watch the last moments."""
    while (left_ns := end_ns - time.monotonic_ns()) > 0:
        if left_ns > WATCH_NS:
            time.sleep((left_ns - WATCH_NS) / 1e9)


def _header_bytes(packet: Packet) -> NDArray[np.uint8]:
    return packet.header.reshape(1).view(np.uint8)


def serve(unit: str, raw_spec: dict[str, Any]) -> int:
    """Build, then answer messages until Close; the process's exit code."""
    spec = UnitSpec.model_validate(raw_spec)
    context = context_on_cores(spec.config.units[SCHEDULER].cores)
    link = Link(context, JobPipe(spec.line, waits=True), LINGER_MS)
    use_slice(UNIT_NS)
    link.connect(spec.endpoint)
    try:
        return _serve(unit, spec, link)
    finally:
        link.close()
        context.term()


def _serve(unit: str, spec: UnitSpec, link: Link) -> int:
    try:
        stages = dict(enumerate(_build(unit, spec)))
    except Exception as error:
        return _fail(link, BUILDING, f"unit {unit}", error)
    gc.collect()
    gc.freeze()
    link.send_heartbeat(Ready(os.getpid()))
    while True:
        message = link.job_pipe.receive()
        if isinstance(message, RunJob):
            _run_job(link, stages[message.stage], message)
        elif isinstance(message, Ping):
            link.send_heartbeat(Pong())
        elif isinstance(message, RunIsolated):
            _isolate(link, stages[message.stage], message)
        elif isinstance(message, Close):
            return _close(unit, link, stages.values())
        elif link.job_pipe.ended:
            return 1
        else:
            raise MessageError(f"{message} is not for a unit")


def _build(unit: str, spec: UnitSpec) -> list[_BoundStage]:
    module = import_module(spec.config.fake.get(unit, f"trilane.stages.{unit}.unit"))
    stages: dict[str, Stage] = module.build(spec.config)
    if unit != INFERRING and unit in spec.config.infer_units:
        from trilane.stages.dsp.infer import infer_stages  # slow to import, and seldom needed by the other units

        stages = {**stages, **infer_stages(spec.config, unit)}
    if set(stages) != set(spec.stages):
        raise TypeError(f"built stages {sorted(stages)}, expected {sorted(spec.stages)}")
    packets = {name: map_region(edge.fd, edge.layout) for name, edge in spec.edges.items()}
    return [
        _BoundStage(
            name,
            stages[name],
            packets[source] if source else [],
            packets[sink] if sink else [],
            spec.config.pace_ns.get(name, 0),
        )
        for name, (source, sink) in spec.stages.items()
    ]


def _run_job(link: Link, stage: _BoundStage, job: RunJob) -> None:
    begin_ns = time.monotonic_ns()
    try:
        figures = stage.run(job.frame, job.slot_in, job.slot_out, job.epoch)
        end_ns = time.monotonic_ns()
        values = {name: float(value) for name, value in figures.items()}
        link.job_pipe.send(Done(job.id, begin_ns, end_ns, stage.pose_ns(job.slot_in, job.slot_out), values))
    except UnitLostError:
        raise
    except Exception as error:
        _fail(link, job.id, f"stage {stage.name}, frame {job.frame}", error)


def _isolate(link: Link, stage: _BoundStage, job: RunIsolated) -> None:
    begin_ns = time.monotonic_ns()
    try:
        stage.run(job.frame, job.slot_in, job.slot_out, 0)
    except Exception as error:
        _fail(link, MEASURING, f"stage {stage.name}, frame {job.frame}", error)
        return
    link.job_pipe.send(Duration(time.monotonic_ns() - begin_ns))


def _close(unit: str, link: Link, stages: Iterable[_BoundStage]) -> int:
    code = 0
    for stage in stages:
        try:
            stage.close()
        except Exception as error:
            code = _fail(link, CLOSING, f"unit {unit}, closing {stage.name}", error)
    link.job_pipe.send(Closed())
    return code


def _fail(link: Link, job_id: int, where: str, error: Exception) -> int:
    """Say it in one sentence; the traceback goes to stderr, which the parent keeps the end of."""
    traceback.print_exception(error)
    known = isinstance(error, TrilaneError)
    text = str(error) if known else f"{where}: {type(error).__name__}: {error}"
    code = error.exit_code if isinstance(error, TrilaneError) else 1
    plain = " ".join(text.split()).encode(errors="replace")  # a name of a file may hold what no text may
    link.job_pipe.send(Failed(job_id, code, plain[:MAX_TEXT].decode(errors="ignore")))
    return code
