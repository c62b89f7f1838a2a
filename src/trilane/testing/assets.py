"""The arrays of a run, for stages that a test builds without one. Rule: packed by the same functions as in a run."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from trilane.avatars.bundle import load_bundle
from trilane.scene.staging import stage_scene
from trilane.stages.avatar_assets import distinct, load_avatar, pack_assets, require_one_tensor
from trilane.stages.config import RunConfig


def assets_of(config: RunConfig) -> dict[str, NDArray[Any]]:
    """What the parent hands to the units of `config`. Raises BadInputError."""
    avatars = {folder: load_avatar(load_bundle(folder)) for folder in distinct(config)}
    require_one_tensor(list(avatars.values()))
    staged = stage_scene(config.scene, [avatars[folder].shaped for folder in config.avatar_dirs], Path.cwd())
    return pack_assets(list(avatars.values()), staged)
