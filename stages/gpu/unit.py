"""The GPU unit's stages: raster and composite on one context.

Rule: everything slow or fallible happens in `build`; the driver's kind decides how the packed pass is drawn, no more.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from trilane.errors import BadInputError
from trilane.pipeline.stage import Stage
from trilane.stages.config import RunConfig
from trilane.stages.gpu.assets import AvatarAssets, load_assets
from trilane.stages.gpu.background import Background, open_background
from trilane.stages.gpu.composite import CompositeStage
from trilane.stages.gpu.opengl_context import describe, open_context
from trilane.stages.gpu.packed_pass import PackedAvatar, PackedPass
from trilane.stages.gpu.raster import RasterStage
from trilane.stages.gpu.skinned_mesh import Mesh, PosedMesh, SkinnedMesh

ROOM = "room"


def build(config: RunConfig) -> dict[str, Stage]:
    """`raster` and `composite`, sharing a context of the unit's threads. Raises BadInputError, MissingPartError."""
    folders = list(dict.fromkeys(config.avatar_dirs))
    assets = {folder: load_assets(folder) for folder in folders}
    _check_one_encoding(assets)
    ctx = open_context(config.units["gpu"].threads)
    first = assets[folders[0]]
    filtering = config.scene.texture_filter
    deferred = filtering == "linear" and not describe(ctx).hardware
    packed = PackedPass(ctx, first.texture.shape[2], first.quantisation, deferred, filtering)
    drawn = {
        folder: PackedAvatar(packed, _mesh(ctx, found, bool(config.posed_vertices)), found.texture)
        for folder, found in assets.items()
    }
    shape = (config.scene.output.height, config.scene.output.width)
    rest = [assets[folder].rest for folder in config.avatar_dirs]
    return {
        "raster": RasterStage(
            packed, [drawn[folder] for folder in config.avatar_dirs], config.buckets, config.posed_vertices
        ),
        "composite": CompositeStage(
            ctx,
            shape,
            config.buckets,
            rest,
            _background(config, shape),
            planes=config.scene.planes,
            hud=config.scene.hud,
        ),
    }


def _mesh(ctx: Any, found: AvatarAssets, posed: bool) -> Mesh:
    return PosedMesh(ctx, found.arrays) if posed else SkinnedMesh(ctx, found.arrays, found.posedirs)


def _background(config: RunConfig, shape: tuple[int, int]) -> Background | None:
    source = config.scene.background
    return None if source == ROOM else open_background(Path(source), shape, config.scene.fps)


def _check_one_encoding(assets: dict[Path, AvatarAssets]) -> None:
    encodings = {(found.quantisation, found.texture.shape[2]): folder for folder, found in assets.items()}
    if len(encodings) > 1:
        names = " and ".join(str(folder) for folder in encodings.values())
        raise BadInputError(names, "networks with different inputs", "avatars that one network can draw together")
