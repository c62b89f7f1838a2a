"""The avatar's pipeline as `trilane.pipeline` runs it: its stages, what passes between them, and their data.

Rule: everything that the run must know of the avatar is said here, as data; no other module of the run knows an avatar.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise
from typing import Any

from trilane.pipeline.description import Pipeline, PipelineEdge, PipelineStage
from trilane.pipeline.result import RunResult
from trilane.pipeline.run import run_pipeline
from trilane.pipeline.shared_assets import Assets
from trilane.stages.avatar_assets import network_of
from trilane.stages.config import RunConfig
from trilane.stages.dsp.parts import crossing_bytes
from trilane.stages.factories import FACTORIES, PRELOAD
from trilane.stages.packets import pose_dtype, posed_vertices_bytes
from trilane.units import AFTER_INFER, BEFORE_INFER, BYPASS, LATENCY_TO

MAX_CHANNELS = 16  # of a tensor: what the GPU packs in one pass


def avatar_pipeline(config: RunConfig, assets: Assets, edge: str = "double") -> Pipeline:
    """The stages of `config`, every edge with the rule `edge`. Raises BadInputError for an unknown rule."""
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
    """Bytes of payload of each edge, for the largest tensor that the scene's size allows."""
    output, names = config.scene.output, config.infer_names
    crossings = crossing_bytes(config, network_of(assets)) if config.cuts else []
    return {
        "pose->raster": posed_vertices_bytes(config.posed_vertices),
        "raster->infer": config.max_tensor_pixels * MAX_CHANNELS,
        **{f"{a}->{b}": size for (a, b), size in zip(pairwise(names), crossings, strict=True)},
        f"{names[-1]}->composite": config.max_tensor_pixels * 4,
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
    config: RunConfig, assets: Assets, *, edge: str = "double", frames: int | None = None, **options: Any
) -> RunResult:
    """Run the avatar of `config`.

    `assets`: of the same avatars and scene, see `trilane.stages.avatar_assets.pack_assets`.
    `edge`: the rule of every edge.
    `frames`: how many; the scene's when None.
    `options`: what `run_pipeline` takes. Raises as `run_pipeline`.
    """
    pipeline = avatar_pipeline(config, assets, edge)
    if len(config.works) > 1 and not config.pace_ns:
        options |= {"works": config.works, "follow": config.infer_names}
    return run_pipeline(pipeline, frames or config.scene.frames, fps=config.scene.fps, assets=assets, **options)
