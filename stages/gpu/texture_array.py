"""The neural texture on the GPU: an array texture of four channels a layer.

Rule: texels are FP16; what FP16 cannot hold is refused before anything is uploaded.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import moderngl
import numpy as np

from trilane.arrays import Floats
from trilane.errors import BadInputError
from trilane.stages.gpu import opengl_calls

#: How the neural texture is read: the filter when it is shrunk, and the greatest anisotropy (a driver may allow less).
FILTERS = {
    "linear": (moderngl.LINEAR, 1.0),
    "mipmap": (moderngl.LINEAR_MIPMAP_LINEAR, 1.0),
    "anisotropic": (moderngl.LINEAR_MIPMAP_LINEAR, 16.0),
}
FP16_MAX = float(np.finfo(np.float16).max)


def texture_array(ctx: Any, texture: Floats, filtering: str = "linear", levels: Sequence[Floats] = ()) -> Any:
    """An FP16 array texture of C/4 RGBA layers from `texture` (H,W,C), clamped at its edge.

    `filtering`: of FILTERS. `levels`: smaller ones that were learnt; they are read in place of the driver's means, and
    none below them, so `linear` becomes `mipmap`.
    """
    height, width, channels = texture.shape
    array = ctx.texture_array((width, height, channels // 4), 4, _pixels(texture), dtype="f2")
    shrunk, anisotropy = FILTERS[filter_of(filtering, bool(levels))]
    if shrunk != moderngl.LINEAR:
        array.build_mipmaps(**({"max_level": len(levels)} if levels else {}))
    for number, level in enumerate(levels, 1):
        size = (level.shape[1], level.shape[0], channels // 4)
        opengl_calls.write_level(array.glo, number, size, _pixels(level))
    array.filter = (shrunk, moderngl.LINEAR)
    array.anisotropy = anisotropy
    array.repeat_x = array.repeat_y = False
    return array


def filter_of(asked: str, learnt: bool) -> str:
    """The filter of a texture for which the scene has `asked`; one with `learnt` levels is never read without them."""
    return "mipmap" if learnt and asked == "linear" else asked


def _pixels(texture: Floats) -> bytes:
    height, width, channels = texture.shape
    layers = texture.reshape(height, width, channels // 4, 4).transpose(2, 0, 1, 3)
    return np.ascontiguousarray(layers, np.float16).tobytes()


def check_texture(texture: Floats, channels: int) -> None:
    """Raises BadInputError unless `texture` is (H,W,channels) and all its numbers fit into FP16."""
    if texture.ndim != 3 or texture.shape[2] != channels:
        raise BadInputError("neural texture", f"shape {texture.shape}", f"(height, width, {channels})")
    largest = float(np.abs(texture).max()) if texture.size else 0.0
    if not largest <= FP16_MAX:
        raise BadInputError("neural texture", f"a value of {largest}", f"numbers within FP16's ±{FP16_MAX:.0f}")
