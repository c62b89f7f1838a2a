"""What the scheduler knows of a pipeline file: its graph, the rules of its streams, and the settings of a run.

Rule: a run on this machine and a prediction take theirs from here, so that a file means the same on both clocks.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

import numpy as np

from trilane.pipeline.pipeline_file import PipelineFile, stage_inputs
from trilane.scheduler.events import Graph, Input, Settings, StageSpec
from trilane.scheduler.policy import run_settings
from trilane.units import NS_PER_MS, NS_PER_S

DEFAULT_FRAMES: Final = 1000


def graph_of(file: PipelineFile, rules: Mapping[str, str]) -> Graph:
    """Return the scheduler's graph of a file; a chain where each stage reads the stage before it.

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
    if _is_chain(stages):
        stages = tuple(StageSpec(stage.name, stage.unit) for stage in stages)
    edges = tuple(rules[name] for name in file.readers)
    return Graph(stages, edges, file.latency_to, from_release=file.run.fps is not None or file.run.arrivals is not None)


def _is_chain(stages: tuple[StageSpec, ...]) -> bool:
    before: tuple[Input, ...] = ()
    for stage in stages:
        if stage.inputs != before or stage.every != 1:
            return False
        before = (Input(stage.name),)
    return True


def settings_of(file: PipelineFile, frames: int = 0, seed: int = 0, **others: Any) -> Settings:
    """Return the settings of a run of the file.

    `frames`: number of frames; 0: as the file says, or DEFAULT_FRAMES.
    `seed`: seed of the arrivals.
    `others`: further fields of Settings.
    """
    run, count = file.run, frames or file.run.frames or DEFAULT_FRAMES
    rate = run.fps or (run.arrivals.poisson if run.arrivals else 0.0)
    period_ns = round(NS_PER_S / rate) if rate else 0
    given = {"in_flight": run.in_flight, "in_queue": run.in_queue, **others}
    if run.arrivals is not None:
        gaps = np.random.default_rng([seed, 0]).exponential(NS_PER_S / run.arrivals.poisson, count)
        given["arrivals_ns"] = tuple(np.rint(gaps.cumsum()).astype(np.int64).tolist())
    return run_settings(run.policy, count, period_ns, period_ns, **given)


def depth_rules(file: PipelineFile) -> dict[str, str]:
    """Return the rule of each stream by the graph's form alone, for a file without times.

    A stream gets two slots, and more where its branches meet again after different numbers of stages: one more than
    the difference.
    """
    rules = {}
    for name in file.readers:
        depths = _depths_behind(file, name)
        spread = max((most - least for least, most in depths.values()), default=0)
        slots = max(2, 1 + spread)
        rules[name] = file.edges.get(name) or file.run.edge or ("double" if slots == 2 else f"fifo:{slots}")
    return rules


def _depths_behind(file: PipelineFile, name: str) -> dict[str, tuple[int, int]]:
    """Return the least and the largest number of steps from stage `name` to each stage behind it."""
    found = {name: (0, 0)}
    for other, stage in file.stages.items():
        steps = [found[each.stage] for each in stage.inputs if not each.latest and each.stage in found]
        if steps:
            found[other] = min(least for least, _ in steps) + 1, max(most for _, most in steps) + 1
    return found
