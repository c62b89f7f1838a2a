"""What the scheduler knows of a pipeline file: its graph, the rules of its streams, and the settings of a run.

Rule: a run on this machine and a prediction both take them from here, so that a file means the same on both clocks.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from fractions import Fraction
from typing import Any, Final

import numpy as np

from trilane.pipeline.pipeline_file import PipelineFile, stage_inputs
from trilane.scheduler.events import Graph, Input, Settings, StageSpec
from trilane.scheduler.period_bound import LEAST_SLOTS, fewest_slots
from trilane.scheduler.policy import POLICIES, run_settings
from trilane.scheduler.virtual import Skips, none_skips
from trilane.transport.slots import DEFAULT_EDGE
from trilane.units import NS_PER_MS, NS_PER_S

DEFAULT_FRAMES: Final = 1000


def graph_of(file: PipelineFile, rules: Mapping[str, str]) -> Graph:
    """Return the scheduler's graph of a file; it is a chain if each stage reads the stage before it.

    `rules`: rule of the stream of each stage that has a reader.
    """
    stages = tuple(
        StageSpec(
            name,
            stage.unit,
            tuple(Input(one.stage, one.latest, round(one.max_age_ms * NS_PER_MS)) for one in stage_inputs(stage)),
            stage.every,
        )
        for name, stage in file.stages.items()
    )
    if file.is_chain:
        stages = tuple(StageSpec(stage.name, stage.unit) for stage in stages)
    edges = tuple(rules[name] for name in file.readers)
    from_release = file.run.fps is not None or file.run.arrivals is not None
    return Graph(stages, edges, file.latency_to, bypass_of(file), from_release)


def bypass_of(file: PipelineFile) -> tuple[str, str] | None:
    """Return the two stages between which a frame may skip stages; None without a bypass."""
    return None if file.bypass is None else (file.bypass[0], file.bypass[1].to)


def skips_of(file: PipelineFile, seed: int = 0) -> Skips:
    """Return which frames take the bypass in virtual time: those that the file says, none where it says nothing."""
    if file.bypass is None:
        return none_skips
    _, way = file.bypass
    return lambda frame, _fresh: way.takes(frame, seed)


def shares_of(file: PipelineFile) -> dict[str, Fraction]:
    """Return, for each stage that some frames skip, the share of the frames that it does."""
    if file.bypass is None or not (taken := file.bypass[1].taken):
        return {}
    names, (begin, end) = list(file.stages), (file.bypass[0], file.bypass[1].to)
    return dict.fromkeys(names[names.index(begin) + 1 : names.index(end)], 1 - taken)


def source_ns(file: PipelineFile) -> int:
    """Return the period of the source, a mean for random arrivals; 0: it is always ready."""
    rate = file.run.fps or (file.run.arrivals.poisson if file.run.arrivals else 0.0)
    return round(NS_PER_S / rate) if rate else 0


def settings_of(file: PipelineFile, frames: int = 0, seed: int = 0, **others: Any) -> Settings:
    """Return the settings of a run of the file.

    `frames`: number of frames; 0: as the file says, or DEFAULT_FRAMES.
    `seed`: seed of the arrivals.
    `others`: further fields of Settings.
    """
    run, count, period_ns = file.run, frames or file.run.frames or DEFAULT_FRAMES, source_ns(file)
    given = {"in_flight": run.in_flight, "in_queue": run.in_queue, **others}
    if run.arrivals is not None:
        gaps = np.random.default_rng([seed, 0]).exponential(NS_PER_S / run.arrivals.poisson, count)
        given["arrivals_ns"] = tuple(np.rint(gaps.cumsum()).astype(np.int64).tolist())
    return run_settings(run.policy, count, period_ns, period_ns, **given)


def edge_rules(file: PipelineFile, times_ns: Mapping[str, int] | None = None) -> dict[str, str]:
    """Return the rule of each stream: that of the file, else two slots, or more where branches meet.

    Where branches meet, a stream has the fewest slots that do not lengthen the period by the times of the file. If the
    file does not state all times, all stages count as equally long, each on a unit of its own. These slots are enough
    for any times, because no cycle then has more stages than slots. A run and all predictions of a file have the same
    slots.

    `times_ns`: time of a job of each stage, in place of those of the file.
    """
    given = {name: file.run.edge for name in file.readers} if file.run.edge else {}
    given |= file.edges
    rules = {name: given.get(name, DEFAULT_EDGE) for name in file.readers}
    graph, in_flight, times_ns = graph_of(file, rules), in_flight_of(file), times_ns or _own_times_ns(file)
    if not times_ns:
        apart = tuple(replace(stage, unit=stage.name) for stage in graph.stages)
        graph, in_flight, times_ns = replace(graph, stages=apart), 0, dict.fromkeys(file.stages, 1)
    slots = fewest_slots(graph, times_ns, given, in_flight)
    pairs = zip(rules, slots, strict=True)
    return rules | {name: f"fifo:{count}" for name, count in pairs if name not in given and count > LEAST_SLOTS}


def _own_times_ns(file: PipelineFile) -> dict[str, int]:
    """Return the mean time of a job of each stage, if the file states all of them; else nothing."""
    known = {name: time.mean_ms for name, stage in file.stages.items() if (time := stage.own_time) is not None}
    return {name: round(ms * NS_PER_MS) for name, ms in known.items()} if len(known) == len(file.stages) else {}


def in_flight_of(file: PipelineFile) -> int:
    """Return the limit of frames in flight, by the file or by its policy; 0: none."""
    limits = [each for each in (file.run.in_flight, POLICIES[file.run.policy].in_flight) if each]
    return min(limits, default=0)
