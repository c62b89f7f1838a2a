"""Turns a pipeline file into the scheduler's input: the graph, the rules of its streams, and the settings of a run.

Rule: a run on this machine and a prediction both use these functions, so that a file means the same on both clocks.
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
    """Return the scheduler's graph of a file. It is a chain if each stage reads only the stage before, in every frame.

    `rules`: edge rule of each stream, by the name of the stage that writes it.
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
    """Return (name of the stage at which the bypass begins, name of the stage at its end); None without a bypass."""
    return None if file.bypass is None else (file.bypass[0], file.bypass[1].to)


def skips_of(file: PipelineFile, seed: int = 0) -> Skips:
    """Return a function that says whether a frame takes the bypass in virtual time.

    If the file states neither `share` nor `pattern`, no frame takes the bypass.

    `seed`: seed of the random choice by the file's `share`.
    """
    if file.bypass is None:
        return none_skips
    _, way = file.bypass
    return lambda frame, _fresh: way.takes(frame, seed)


def shares_of(file: PipelineFile) -> dict[str, Fraction]:
    """Return the share (0 to 1) of the frames that do not skip a stage, for each stage that some frames skip.

    The result is empty if no frame takes a bypass.
    """
    if file.bypass is None or not (taken := file.bypass[1].taken):
        return {}
    names, (begin, end) = list(file.stages), (file.bypass[0], file.bypass[1].to)
    return dict.fromkeys(names[names.index(begin) + 1 : names.index(end)], 1 - taken)


def source_ns(file: PipelineFile) -> int:
    """Return the period of the source in ns; for random arrivals, the mean period. 0: the source has no rate."""
    rate = file.run.fps or (file.run.arrivals.poisson if file.run.arrivals else 0.0)
    return round(NS_PER_S / rate) if rate else 0


def settings_of(file: PipelineFile, frames: int = 0, seed: int = 0, **others: Any) -> Settings:
    """Return the settings of a run of the file.

    `frames`: number of frames; 0: the file's number, or DEFAULT_FRAMES if the file has none.
    `seed`: seed of random arrivals.
    `others`: further fields of Settings.
    """
    run, count, period_ns = file.run, frames or file.run.frames or DEFAULT_FRAMES, source_ns(file)
    given = {"in_flight": run.in_flight, "in_queue": run.in_queue, **others}
    if run.arrivals is not None:
        gaps = np.random.default_rng([seed, 0]).exponential(NS_PER_S / run.arrivals.poisson, count)
        given["arrivals_ns"] = tuple(np.rint(gaps.cumsum()).astype(np.int64).tolist())
    return run_settings(run.policy, count, period_ns, period_ns, **given)


def edge_rules(file: PipelineFile) -> dict[str, str]:
    """Return the edge rule of each stream, by the name of the stage that writes it.

    If the file states no rule, a stream has two slots. Where branches meet, two slots may make the period longer. Such
    a stream gets just enough slots for the file's times. If the file does not state all times, the stages count as
    equally long, each on a unit of its own. The slots for this case are enough for any times, because no cycle has more
    stages than slots. A run and all predictions of a file have the same slots.
    """
    given = {name: file.run.edge for name in file.readers} if file.run.edge else {}
    given |= file.edges
    rules = {name: given.get(name, DEFAULT_EDGE) for name in file.readers}
    graph, in_flight = graph_of(file, rules), in_flight_of(file)
    known = {name: time.mean_ms for name, stage in file.stages.items() if (time := stage.own_time) is not None}
    times_ns = {name: round(ms * NS_PER_MS) for name, ms in known.items()}
    if len(times_ns) < len(file.stages):
        apart = tuple(replace(stage, unit=stage.name) for stage in graph.stages)
        graph, in_flight, times_ns = replace(graph, stages=apart), 0, dict.fromkeys(file.stages, 1)
    slots = fewest_slots(graph, times_ns, given, in_flight)
    pairs = zip(rules, slots, strict=True)
    return rules | {name: f"fifo:{count}" for name, count in pairs if name not in given and count > LEAST_SLOTS}


def in_flight_of(file: PipelineFile) -> int:
    """Return the limit of frames in flight: the smaller of the file's limit and its policy's limit; 0: no limit."""
    limits = [each for each in (file.run.in_flight, POLICIES[file.run.policy].in_flight) if each]
    return min(limits, default=0)
