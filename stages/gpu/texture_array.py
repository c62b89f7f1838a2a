"""The neural texture on the GPU: an array texture of four channels a layer.

Rule: texels are FP16; what FP16 cannot hold is refused before anything is uploaded.
"""

from __future__ import annotations

from typing import Any

import moderngl
import numpy as np

from trilane.arrays import Floats
from trilane.errors import BadInputError

#: How the neural texture is read: the filter when it is shrunk, and the greatest anisotropy (a driver may allow less).
FILTERS = {
    "linear": (moderngl.LINEAR, 1.0),
    "mipmap": (moderngl.LINEAR_MIPMAP_LINEAR, 1.0),
    "anisotropic": (moderngl.LINEAR_MIPMAP_LINEAR, 16.0),
}
FP16_MAX = float(np.finfo(np.float16).max)


def texture_array(ctx: Any, texture: Floats, filtering: str = "linear") -> Any:
    """An FP16 array texture of C/4 RGBA layers from `texture` (H,W,C), clamped at its edge. `filtering`: of FILTERS."""
    height, width, channels = texture.shape
    layers = texture.reshape(height, width, channels // 4, 4).transpose(2, 0, 1, 3)
    pixels = np.ascontiguousarray(layers, np.float16).tobytes()
    array = ctx.texture_array((width, height, channels // 4), 4, pixels, dtype="f2")
    shrunk, anisotropy = FILTERS[filtering]
    if shrunk != moderngl.LINEAR:
        array.build_mipmaps()
    array.filter = (shrunk, moderngl.LINEAR)
    array.anisotropy = anisotropy
    array.repeat_x = array.repeat_y = False
    return array


def check_texture(texture: Floats, channels: int) -> None:
    """Raises BadInputError unless `texture` is (H,W,channels) and all its numbers fit into FP16."""
    if texture.ndim != 3 or texture.shape[2] != channels:
        raise BadInputError("neural texture", f"shape {texture.shape}", f"(height, width, {channels})")
    largest = float(np.abs(texture).max()) if texture.size else 0.0
    if not largest <= FP16_MAX:
        raise BadInputError("neural texture", f"a value of {largest}", f"numbers within FP16's ±{FP16_MAX:.0f}")
