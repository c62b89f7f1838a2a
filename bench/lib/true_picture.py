"""The picture of a scene with the clothed body itself, drawn by what training draws its samples with.

Rule: it is what an avatar's network was trained to paint, so it tells of every plan, `full` included, how good its
picture is. Only the package's own avatars have one. Clothes are put on the skin, not on an avatar's offsets,
which are these clothes already.
"""

from __future__ import annotations

from typing import Any

from trilane.arrays import U8
from trilane.avatars.bundle import BUILT_IN, bundle_folder
from trilane.bench.lib.cast import Cast
from trilane.bench.lib.layers import Layer, blended, premultiplied
from trilane.stages.avatar_assets import AvatarData
from trilane.training.clothing.clothed_body import ClothedBody
from trilane.training.clothing.layers import clothing_layers
from trilane.training.clothing.looks import find_landmarks, look_of
from trilane.training.surface import body_arrays

#: Of the clothed body, along each side of a pixel.
SAMPLES = 4


class TruePictures:
    """Pictures of a cast of bundled avatars as the clothed bodies that they were trained on."""

    def __init__(self, cast: Cast, ctx: Any) -> None:
        """`ctx`: the OpenGL context in use. Everybody in the cast must be a bundled avatar."""
        self._cast = cast
        self._clothed = {folder: _clothed(data, ctx) for folder, data in cast.avatars.items()}

    def frame(self, number: int, background: U8) -> U8:
        """(h,w,3) uint8, sRGB: frame `number` over its `background` (h,w,3)."""
        return blended(background, self.layers(number))

    def layers(self, number: int) -> list[Layer]:
        """Those who are seen in frame `number`, on the picture's grid."""
        layers = []
        for seen in self._cast.seen(number):
            rgba = self._clothed[seen.folder].render(seen.joints, seen.view, seen.projection, seen.box.shape) / 255.0
            layers.append(Layer(seen.box, seen.depth, premultiplied(rgba)))
        return layers


def true_pictures(cast: Cast, ctx: Any) -> TruePictures | None:
    """Those of `cast`; None unless everybody in it is a bundled avatar. `ctx`: the OpenGL context in use."""
    is_known = set(cast.avatars) <= {bundle_folder(name).absolute() for name in BUILT_IN}
    return TruePictures(cast, ctx) if is_known else None


def _clothed(data: AvatarData, ctx: Any) -> ClothedBody:
    arrays, look = body_arrays(data.shaped.bare()), look_of(data.bundle.manifest.provenance)
    landmarks = find_landmarks(arrays.vertices, arrays.joints, arrays.weights)
    return ClothedBody(ctx, clothing_layers(arrays, landmarks, look), landmarks, SAMPLES, look)
