"""The packed pass: a posed mesh and a neural texture become the network's INT8 input in one draw.

Rule: bytes leave the GPU in tensor order (NHWC, row 0 on top), already in the network's encoding.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import moderngl
import numpy as np
from numpy.typing import NDArray

from trilane.errors import BadInputError
from trilane.stages.gpu import gl
from trilane.stages.gpu.camera import Matrix, target_clip
from trilane.stages.gpu.mesh import SkinnedMesh
from trilane.stages.gpu.program import build_program, set_uniforms

F32 = NDArray[np.float32]
U8 = NDArray[np.uint8]

CHANNELS = (4, 8, 12, 16)
FP16_MAX = float(np.finfo(np.float16).max)
WORD_TYPES = {1: "uint", 2: "uvec2", 3: "uvec4", 4: "uvec4"}
TARGET_WORDS = {1: 1, 2: 2, 3: 4, 4: 4}  # three-word targets need not be drawable; the fourth word is not read back


@dataclass(frozen=True)
class Quantisation:
    """real = (q - zero_point) * scale, q in 0..255."""

    scale: float
    zero_point: int

    def __post_init__(self) -> None:
        if not (np.isfinite(self.scale) and self.scale > 0):
            raise BadInputError("quantisation scale", str(self.scale), "a positive number")
        if not 0 <= self.zero_point <= 255:
            raise BadInputError("quantisation zero point", str(self.zero_point), "0 to 255")


@dataclass(frozen=True)
class Placement:
    """One avatar in a tensor. `clip_projection`: of its crop. `rect`: top, left, height, width in tensor pixels."""

    joints: F32
    clip_projection: Matrix
    rect: tuple[int, int, int, int]
    feature: F32 | None = None


class PackedPass:
    """Draws meshes with one neural texture each into tensors of `channels` channels."""

    def __init__(self, ctx: Any, channels: int, quantisation: Quantisation) -> None:
        if channels not in CHANNELS:
            raise BadInputError("network input", f"{channels} channels", "4, 8, 12 or 16", "pad with zero channels")
        self.ctx, self.channels, self.quantisation = ctx, channels, quantisation
        self._targets: dict[tuple[int, int], Any] = {}
        self._background = (0x01010101 * quantisation.zero_point,) * 4

    @property
    def layers(self) -> int:
        return self.channels // 4

    def target(self, shape: tuple[int, int]) -> Any:
        """The framebuffer for tensors of `shape` (height, width); made on first use."""
        if shape not in self._targets:
            size = (shape[1], shape[0])
            words = self.ctx.texture(size, TARGET_WORDS[self.layers], dtype="u4")
            self._targets[shape] = self.ctx.framebuffer([words], self.ctx.depth_renderbuffer(size))
        return self._targets[shape]

    def begin(self, shape: tuple[int, int]) -> Any:
        """Clear the target of `shape` to the zero point and make it the one in use."""
        target = self.target(shape)
        target.use()
        target.depth_mask = True
        target.viewport = (0, 0, shape[1], shape[0])
        self.ctx.enable_only(moderngl.DEPTH_TEST)
        target.clear(depth=1.0)
        gl.clear_unsigned(self._background)
        return target

    def read_into(self, shape: tuple[int, int], tensor: U8) -> None:
        """Copy the target of `shape` to `tensor`, (h * w * channels,) uint8."""
        self.target(shape).read_into(
            tensor, (0, 0, shape[1], shape[0]), components=self.layers, dtype="u4", alignment=1
        )

    def background(self, tensor: U8) -> None:
        """Fill `tensor` with what a frame without avatars holds."""
        tensor[:] = self.quantisation.zero_point


class PackedAvatar:
    """One avatar's mesh and texture, ready for a `PackedPass`. `texture` (H,W,C): finite, within FP16's range."""

    def __init__(self, packed: PackedPass, mesh: SkinnedMesh, texture: NDArray[np.floating[Any]]) -> None:
        check_texture(texture, packed.channels)
        self._mesh, self._ctx = mesh, packed.ctx
        defines: dict[str, Any] = mesh.defines | {"LAYERS": packed.layers, "WORDS": WORD_TYPES[packed.layers]}
        self._program = build_program(packed.ctx, "skin.vert", "pack.frag", **defines)
        self._vertices = mesh.vertex_array(self._program)
        self._texture = texture_array(packed.ctx, texture)
        quantisation = packed.quantisation
        set_uniforms(
            self._program,
            {"neural": 0, "scale": quantisation.scale, "zero_point": float(quantisation.zero_point)},
        )

    def draw(self, target: Any, view: Matrix, placement: Placement) -> None:
        """Draw into `target`, which a `PackedPass` began."""
        top, left, height, width = placement.rect
        target.viewport = (left, top, width, height)
        self._texture.use(0)
        self._mesh.pose(self._program, placement.joints, placement.feature)
        self._program["clip_from_world"].write(target_clip(view, placement.clip_projection))
        self._vertices.render()


def texture_array(ctx: Any, texture: NDArray[np.floating[Any]]) -> Any:
    """An FP16 array texture of C/4 RGBA layers from `texture` (H,W,C): bilinear, clamped to its edge."""
    height, width, channels = texture.shape
    layers = texture.reshape(height, width, channels // 4, 4).transpose(2, 0, 1, 3)
    pixels = np.ascontiguousarray(layers, np.float16).tobytes()
    array = ctx.texture_array((width, height, channels // 4), 4, pixels, dtype="f2")
    array.filter = (moderngl.LINEAR, moderngl.LINEAR)
    array.repeat_x = array.repeat_y = False
    return array


def check_texture(texture: NDArray[np.floating[Any]], channels: int) -> None:
    """Raises BadInputError unless `texture` is (H,W,channels) of numbers that FP16 can hold."""
    if texture.ndim != 3 or texture.shape[2] != channels:
        raise BadInputError("neural texture", f"shape {texture.shape}", f"(height, width, {channels})")
    largest = float(np.abs(texture).max()) if texture.size else 0.0
    if not largest <= FP16_MAX:
        raise BadInputError("neural texture", f"a value of {largest}", f"numbers within FP16's ±{FP16_MAX:.0f}")
