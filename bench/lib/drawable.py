"""An avatar as the GPU draws it, without a run around it. Rule: made by the same functions as in a run."""

from __future__ import annotations

from dataclasses import dataclass

from trilane.arrays import F32
from trilane.avatars.bundle import load_bundle
from trilane.stages.avatar_assets import load_avatar
from trilane.stages.gpu.packed_pass import Quantisation
from trilane.stages.gpu.skinned_mesh import MeshArrays, avatar_mesh


@dataclass(frozen=True)
class Drawable:
    """`texture` (H,W,C) float32."""

    arrays: MeshArrays
    texture: F32
    quantisation: Quantisation


def load_drawable(name: str) -> Drawable:
    """The avatar `name`. Raises BadInputError."""
    avatar = load_avatar(load_bundle(name))
    packed = avatar.bundle.manifest.network.input
    return Drawable(avatar_mesh(avatar.shaped), avatar.texture, Quantisation(packed.scale, packed.zero_point))
