"""Run the pipeline on this machine. Rule: whatever happens, the units' processes are gone when this returns."""

from __future__ import annotations

import contextlib
import gc
import os
import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import pairwise

from trilane.errors import BadInputError
from trilane.hw_profiles.application import application_graph
from trilane.hw_profiles.governor import Governor
from trilane.pipeline.processes import UnitProcesses, check_open_files
from trilane.pipeline.realtime import RealtimeDriver
from trilane.pipeline.requests import FrameRequestQueue
from trilane.pipeline.result import RunResult
from trilane.pipeline.signals import Interrupts
from trilane.pipeline.unit_loop import EdgeSpec
from trilane.scheduler.causes import OutcomeKind
from trilane.scheduler.events import Graph, Settings
from trilane.scheduler.policy import policy_named
from trilane.scheduler.stats import energy_score
from trilane.stages.config import RunConfig
from trilane.stages.dsp.parts import crossing_bytes
from trilane.stages.packets import pose_dtype, posed_vertices_bytes
from trilane.transport.memory import RegionLayout, create_region
from trilane.transport.packets import SlotLayout
from trilane.transport.slots import edge_rule
from trilane.transport.wakeup import DEFAULT, SHORTEST_NS, awake, use_slice

MAX_CHANNELS = 16  # of a tensor: what the GPU packs in one pass
DEADLINE_PERIODS = 3  # from a frame's release until it must be presented: one period for each unit
HANG_NS = 10_000_000_000
SWITCH_S = 0.0002  # longest that another thread of this process keeps the interpreter


def run_pipeline(
    config: RunConfig,
    *,
    policy: str = "pipelined",
    edge: str = "double",
    frames: int | None = None,
    pace_fps: float | None = None,
    isolate_frames: int = 16,
    hang_ns: int = HANG_NS,
    on_progress: Callable[[int, int], None] | None = None,
    on_message: Callable[[str], None] | None = None,
    inlet: FrameRequestQueue | None = None,
    governor: Governor | None = None,
    latch_ms: float = 0.0,
) -> RunResult:
    """Run `frames` frames (the scene's count when None) through the three units and report.

    `policy`: sequential, pipelined, latest, deadline. `edge`: single, double, triple, fifo:N, orphan[:N].
    `pace_fps`: frames are released at that rate; None releases them as fast as they are taken (`latest` and
    `deadline` are always paced, by the scene's fps when None). `isolate_frames`: frames measured with the other
    units quiet, half of them before and half after the run, which efficiency needs; 0 warms up and leaves both out.
    `hang_ns`: a unit whose job takes longer is restarted. `on_progress(presented, requested)` and
    `on_message(text)` are called from this thread. SIGINT or SIGTERM ends the run cleanly with its result marked
    `interrupted`; a second one ends the units at once; before the first frame KeyboardInterrupt is raised instead.
    `inlet`: frames are released as somebody asks for them, `frames` at most; it is closed when this returns.
    `latch_ms`: a pose is sampled so late that it is expected to end so long before the raster can take it; 0: at once.
    `governor`: holds the units to shares of the time, and says in the report what it did.

    Raises BadInputError for an unknown policy or edge, TrilaneError (with the exit code of the unit's error) when a
    unit cannot start; a failure after that is `RunResult.failure`.
    """
    check_open_files()
    graph, settings = _plan(config, policy, edge, frames or config.scene.frames, pace_fps, hang_ns)
    settings = replace(settings, asked=inlet is not None, latch_ns=round(latch_ms * 1e6))
    with (
        contextlib.closing(inlet) if inlet is not None else contextlib.nullcontext(),
        Interrupts() as interrupts,
        _on_cores(config.units[graph.stages[0].unit].cores),
        _prompt(),
        awake(governor is None or governor.is_prompt) as idle_cores,
        _regions(config, graph) as edges,
        _processes(config, edges, graph) as processes,
    ):
        driver = RealtimeDriver(graph, settings, processes, interrupts, on_progress, on_message, inlet, governor)
        driver.start()
        pids = processes.pids
        sample = _spread(settings.frames, max(isolate_frames, 1))
        driver.measure_alone(sample[::2])
        outcome = driver.run()
        if sample[1::2] and outcome.kind == OutcomeKind.DONE:
            driver.measure_again(sample[1::2])
        pids = {**pids, **processes.pids}
        if outcome.kind != OutcomeKind.ABORTED:
            driver.close()
    requested = settings.frames if inlet is None else driver.core.source.released
    target_ns = 0 if settings.deadline_ns else round(1e9 / config.scene.fps)
    report = driver.core.ledger.report(
        clock="host",
        requested=requested,
        target_period_ns=target_ns,
        isolated_ns=driver.alone_ns if isolate_frames else None,
    )
    report.update(
        policy=policy, edge=edge, idle_cores=idle_cores, **(governor.report() if governor is not None else {})
    )
    if governor is not None and governor.power_w is not None and report["fps"]:
        report["xrbench"]["energy"] = energy_score(1e3 * governor.power_w / report["fps"])
    for unit, row in report["units"].items():
        row.update(pid=pids[unit], **config.units[unit].model_dump(mode="json"))
    return RunResult(
        report=report,
        requested=requested,
        presented=len(driver.core.ledger.presented_ns),
        lost=driver.core.ledger.lost_by_cause,
        dropped=driver.core.ledger.dropped_by_cause,
        pids=pids,
        startup_ms=driver.startup_ms,
        jobs=tuple(driver.jobs),
        recording=driver.recording,
        figures={stage: _means(driver, stage) for stage in driver.figures},
        messages=tuple(driver.messages),
        interrupted=outcome.kind in (OutcomeKind.STOPPED, OutcomeKind.ABORTED) and interrupts.count > 0,
        failure=driver.failure,
    )


def edge_payload_bytes(config: RunConfig) -> dict[str, int]:
    """Bytes of payload of each edge, for the largest tensor that the scene's size allows."""
    output, names = config.scene.output, config.infer_names
    return {
        "pose->raster": posed_vertices_bytes(config.posed_vertices),
        "raster->infer": config.max_tensor_pixels * MAX_CHANNELS,
        **{f"{a}->{b}": size for (a, b), size in zip(pairwise(names), crossing_bytes(config), strict=True)},
        f"{names[-1]}->composite": config.max_tensor_pixels * 4,
        "composite->present": output.width * output.height * 3,
    }


def _plan(
    config: RunConfig, policy: str, edge: str, frames: int, pace_fps: float | None, hang_ns: int
) -> tuple[Graph, Settings]:
    try:
        paced = policy_named(policy).paced
        edge_rule(edge)
    except ValueError as error:
        raise BadInputError.about("the run's settings", error) from None
    fps = pace_fps or (config.scene.fps if paced else None)
    period_ns = round(1e9 / fps) if fps else 0
    settings = Settings(
        frames=frames,
        policy=policy,
        period_ns=period_ns,
        deadline_ns=DEADLINE_PERIODS * period_ns,
        hang_ns=hang_ns,
    )
    return application_graph(edge, zip(config.infer_names, config.infer_units, strict=True)), settings


def _spread(frames: int, count: int) -> list[int]:
    count = min(count, frames)
    return [index * frames // count for index in range(count)]


def _means(driver: RealtimeDriver, stage: str) -> dict[str, float]:
    jobs = sum(record.stage == stage for record in driver.jobs)
    return {name: total / max(jobs, 1) for name, total in driver.figures[stage].items()}


@contextlib.contextmanager
def _on_cores(cores: tuple[int, ...]) -> Iterator[None]:
    """The scheduler runs with the CPU unit, off the cores of the others."""
    before = os.sched_getaffinity(0)
    os.sched_setaffinity(0, cores)
    try:
        yield
    finally:
        os.sched_setaffinity(0, before)


@contextlib.contextmanager
def _prompt() -> Iterator[None]:
    """The scheduler answers at once: it is not kept waiting by the CPU unit on its core, by a thread that draws a
    progress bar, or by collecting garbage, of which a run makes none."""
    switch_s, collects = sys.getswitchinterval(), gc.isenabled()
    sys.setswitchinterval(SWITCH_S)
    gc.disable()
    use_slice(SHORTEST_NS)
    try:
        yield
    finally:
        use_slice(DEFAULT)
        sys.setswitchinterval(switch_s)
        if collects:
            gc.enable()


@contextlib.contextmanager
def _regions(config: RunConfig, graph: Graph) -> Iterator[dict[str, EdgeSpec]]:
    edges: dict[str, EdgeSpec] = {}
    header, payloads = pose_dtype(len(config.scene.avatars)), edge_payload_bytes(config)
    try:
        for index, text in enumerate(graph.edges):
            name = graph.edge_name(index)
            payload = payloads[name]
            slots = edge_rule(text).slots
            fd = create_region(name, RegionLayout(slots, SlotLayout(header, payload)))
            edges[name] = EdgeSpec(fd=fd, slots=slots, header=header, payload_bytes=payload)
        yield edges
    finally:
        for edge in edges.values():
            os.close(edge.fd)


@contextlib.contextmanager
def _processes(config: RunConfig, edges: dict[str, EdgeSpec], graph: Graph) -> Iterator[UnitProcesses]:
    stages: dict[str, dict[str, tuple[str | None, str | None]]] = {unit: {} for unit in graph.units}
    last = len(graph.stages) - 1
    for position, stage in enumerate(graph.stages):
        source = graph.edge_name(position - 1) if position else None
        stages[stage.unit][stage.name] = (source, graph.edge_name(position) if position < last else None)
    processes = UnitProcesses(config, edges, stages)
    try:
        yield processes
    finally:
        processes.end_all()
