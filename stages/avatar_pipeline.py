"""The avatar's pipeline for `trilane.pipeline`: its stages, the sizes of its edges, and its rehearsal.

This module describes the avatar as data for the run; no module of `trilane.pipeline` knows an avatar. A rehearsal runs
the stages one after the other, before they share the cores, and measures the work of each stage.
"""

from __future__ import annotations

import math
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from itertools import pairwise
from pathlib import Path
from typing import Any

from trilane.arrays import Shape
from trilane.hw_profiles.host import settings_of
from trilane.pipeline.description import Pipeline, PipelineEdge, PipelineStage
from trilane.pipeline.memory import Assets
from trilane.pipeline.rehearsal import SLICE, Group, Rehearsed, Round, rehearse, try_in_turns
from trilane.pipeline.result import RunResult
from trilane.pipeline.run import run_pipeline
from trilane.pipeline.unit_starter import UnitStarter
from trilane.scheduler.placement import CpuCore, Place, Placement
from trilane.stages import FACTORIES, PRELOAD
from trilane.stages.avatar_assets import only_network_of
from trilane.stages.config import PAINTED_CHANNELS, RunConfig, pose_dtype, posed_vertices_bytes
from trilane.stages.configure import Checked
from trilane.stages.dsp.infer import crossing_bytes
from trilane.transport.slots import DEFAULT_EDGE
from trilane.units import AFTER_INFER, BEFORE_INFER, BYPASS, LATENCY_TO, MAX_CHANNELS, UNITS


def avatar_pipeline(config: RunConfig, assets: Assets, edge: str = DEFAULT_EDGE) -> Pipeline:
    """Return the pipeline of `config`. `edge`: rule of every edge. Raises BadInputError for an unknown rule."""
    header = pose_dtype(len(config.avatar_dirs))
    return Pipeline(
        stages=tuple(_stages(config)),
        edges=tuple(PipelineEdge(payload_bytes=size, header=header) for size in edge_bytes(config, assets).values()),
        units=dict(config.units),
        latency_to=LATENCY_TO,
        bypass=BYPASS,
        preload=PRELOAD,
    ).with_rule(edge)


def edge_bytes(config: RunConfig, assets: Assets) -> dict[str, int]:
    """Return the payload bytes of each edge by its name, such as `pose->raster`, for the largest tensors of the run."""
    output, names = config.scene.output, config.infer_names
    pixels = config.max_tensor_pixels * (len(set(config.networks)) or 1)
    crossings = crossing_bytes(config, only_network_of(assets)) if config.cuts else []
    return {
        "pose->raster": posed_vertices_bytes(config.posed_vertices),
        "raster->infer": pixels * MAX_CHANNELS,
        **{f"{a}->{b}": size for (a, b), size in zip(pairwise(names), crossings, strict=True)},
        f"{names[-1]}->composite": pixels * PAINTED_CHANNELS,
        "composite->present": output.width * output.height * 3,
    }


def _stages(config: RunConfig) -> Iterator[PipelineStage]:
    said = config.model_dump(mode="json")
    infer = zip(config.infer_names, config.infer_units, strict=True)
    for part, (name, unit) in enumerate([*BEFORE_INFER, *infer, *AFTER_INFER], start=-len(BEFORE_INFER)):
        is_part = 0 <= part < len(config.infer_names)
        settings: dict[str, Any] = {"config": said, "part": part} if is_part else {"config": said}
        factory = FACTORIES["infer" if is_part else name]
        pace_ns = config.pace_ns.get(name, 0)
        yield PipelineStage(name=name, unit=unit, factory=factory, settings=settings, pace_ns=pace_ns)


def run_avatar(
    config: RunConfig, assets: Assets, *, edge: str = DEFAULT_EDGE, frames: int | None = None, **options: Any
) -> RunResult:
    """Run the avatar of `config`. Raises as `run_pipeline` does.

    `assets`: arrays of the same avatars and scene, from `trilane.stages.avatar_assets.pack_assets`.
    `edge`: rule of every edge.
    `frames`: number of frames; None for the scene's number.
    `options`: further arguments of `run_pipeline`.
    """
    pipeline = avatar_pipeline(config, assets, edge)
    if len(config.works) > 1 and not config.pace_ns:
        options |= {"works": config.works, "follow": config.infer_names}
    count = config.scene.frames if frames is None else frames
    return run_pipeline(pipeline, count, fps=config.scene.fps, assets=assets, **options)


FRAMES = 12  # frames of a rehearsal, spread evenly over the scene; the first two warm up


def thread_counts(cores: int, rule: Placement) -> dict[str, list[int]]:
    """Return, by unit, the numbers of threads besides 1 with which the unit is measured.

    Each unit is measured with its number in `rule`. The network's unit is also measured with 2 to 4 threads. Further
    numbers of its threads are half of the cores, all but two, all but one, and all cores.

    `cores`: number of cores.
    `rule`: placement that suits any run, with the cores that the options choose.
    """
    counts = {unit: {place.threads} for unit, place in rule.items()}
    counts["dsp"] |= {*range(2, min(cores, 4) + 1), cores // 2, cores - 2, cores - 1, cores}
    return {unit: sorted(count for count in of if count > 1) for unit, of in counts.items()}


def measured_times(checked: Checked, cores: Sequence[CpuCore], rule: Placement, starter: UnitStarter) -> Rehearsed:
    """Return the measured work of each unit for a frame.

    `checked`: run to measure.
    `cores`: available cores.
    `rule`: placement whose numbers of threads are measured too.
    `starter`: unit starter.
    Raises TrilaneError if a unit cannot start or a stage fails, KeyboardInterrupt if interrupted.
    """
    fastest = [core.number for core in sorted(cores, key=lambda core: (-core.permille, core.number))]
    one = {unit: Place((fastest[0],), 1) for unit in UNITS}
    variants = [
        {**one, unit: Place(tuple(sorted(fastest[:count])), count)}
        for unit, counts in thread_counts(len(cores), rule).items()
        for count in counts
    ]
    with _thrown_away(checked) as config:
        pipelines = []
        for placement in (one, *variants):
            units = settings_of(placement)
            for unit, settings in units.items():
                # Threads spin if there are so many cores that no unit shares one.
                spin = 1 < settings.threads <= len(cores) - len(UNITS) + 1
                units[unit] = settings.model_copy(update={"spin": spin})
            pipelines.append(avatar_pipeline(config.model_copy(update={"units": units}), checked.assets))
        first, *others = pipelines
        frames = config.scene.frames
        spread = [number * frames // FRAMES for number in range(FRAMES)]
        return rehearse(first, others, spread, checked.assets, starter)


def tried(
    checked: Checked,
    placements: Sequence[Placement],
    rounds: int,
    starter: UnitStarter,
    limit_s: float = math.inf,
    least: int = 1,
) -> list[Round]:
    """Return measured rounds. In a round, each of `placements` runs once. Raises as `measured_times` does.

    `checked`: run to measure.
    `rounds`: number of rounds, on frames spread over the scene.
    `starter`: unit starter.
    `limit_s`: time in seconds after which no round begins, apart from the first `least` rounds.
    `least`: number of rounds that take place in any case.
    """
    # Placements with equal threads differ only in cores, so the same processes serve all of them.
    groups: dict[tuple[tuple[int, bool], ...], list[int]] = {}
    for number, placement in enumerate(placements):
        settings = settings_of(placement).values()
        kind = tuple((each.threads, each.spin and each.threads > 1) for each in settings)
        groups.setdefault(kind, []).append(number)
    windows = [turn * max(checked.config.scene.frames - SLICE, 0) // rounds for turn in range(rounds)]
    end = time.monotonic() + limit_s
    with _thrown_away(checked) as config:
        of_kind = [
            Group(
                avatar_pipeline(config.model_copy(update={"units": settings_of(placements[own[0]])}), checked.assets),
                [{unit: place.cores for unit, place in placements[number].items()} for number in own],
            )
            for own in groups.values()
        ]
        found = try_in_turns(
            of_kind, windows, checked.assets, starter, lambda done: len(done) >= least and time.monotonic() > end
        )
    order = [number for own in groups.values() for number in own]
    places = sorted(range(len(order)), key=order.__getitem__)
    return [Round(tuple(each.frame_ns[place] for place in places), each.others) for each in found]


@contextmanager
def _thrown_away(checked: Checked) -> Iterator[RunConfig]:
    """Yield the configuration of `checked` with one tensor shape and a run folder that is removed afterwards.

    A single shape is prepared faster than many. The other shapes have less than twice this shape's area.
    """
    with tempfile.TemporaryDirectory(prefix="trilane-rehearsal-") as folder:
        height, width = one_shape(checked.config)
        scene = checked.config.scene.model_copy(update={"size": f"{height}x{width}"})
        yield checked.config.model_copy(update={"out_dir": Path(folder), "scene": scene, "shapes": ()})


def one_shape(config: RunConfig) -> Shape:
    """Return the most square tensor shape. Shapes with at most half of the largest area are left out."""
    large = [shape for shape in config.buckets if 2 * shape[0] * shape[1] > config.max_tensor_pixels]
    return min(large, key=lambda shape: (abs(shape[0] - shape[1]), shape))
