"""The picture of a scene with the clothed body itself, drawn by what training draws its samples with.

Rule: it is what an avatar's network was trained to paint, so it tells of every plan, `full` included, how good its
picture is. There is one of the default avatar alone.
"""

from __future__ import annotations

from typing import Any

from trilane.arrays import U8
from trilane.avatars.bundle import DEFAULT, bundle_folder
from trilane.bench.lib.cast import Cast
from trilane.bench.lib.layers import Layer, blended, premultiplied
from trilane.training.body_arrays import body_arrays
from trilane.training.clothing.clothed_body import ClothedBody
from trilane.training.clothing.landmarks import find_landmarks
from trilane.training.clothing.layers import clothing_layers

#: Of the clothed body, along each side of a pixel.
SAMPLES = 4


class TruePictures:
    """Pictures of a cast of default avatars as the clothed bodies that they were trained on."""

    def __init__(self, cast: Cast, ctx: Any) -> None:
        """`ctx`: the OpenGL context in use. The cast must be one that `has_truth`."""
        (data,) = cast.avatars.values()
        arrays = body_arrays(data.shaped)
        landmarks = find_landmarks(arrays.vertices, arrays.joints, arrays.weights)
        self._cast = cast
        self._clothed = ClothedBody(ctx, clothing_layers(arrays, landmarks), landmarks, SAMPLES)

    def frame(self, number: int, background: U8) -> U8:
        """(h,w,3) uint8, sRGB: frame `number` over its `background` (h,w,3)."""
        return blended(background, self.layers(number))

    def layers(self, number: int) -> list[Layer]:
        """Those who are seen in frame `number`, on the picture's grid."""
        layers = []
        for seen in self._cast.seen(number):
            rgba = self._clothed.render(seen.joints, seen.view, seen.projection, seen.box.shape) / 255.0
            layers.append(Layer(seen.box, seen.depth, premultiplied(rgba)))
        return layers


def has_truth(cast: Cast) -> bool:
    """Whether every avatar of `cast` is the default one."""
    return list(cast.avatars) == [bundle_folder(DEFAULT).absolute()]
