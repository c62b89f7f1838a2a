"""The packed pass: a posed mesh and a neural texture become the network's INT8 input in one draw.

Rule: bytes leave the GPU in tensor order (NHWC, row 0 on top), already in the network's encoding.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import moderngl
import numpy as np
from numpy.typing import NDArray

from trilane.arrays import F32, U8, Floats
from trilane.errors import BadInputError
from trilane.stages.gpu import gl
from trilane.stages.gpu.mesh import BodyPose, Mesh
from trilane.stages.gpu.mesh_draw import MeshDraw
from trilane.stages.gpu.program import build_program, set_uniforms

Shape = tuple[int, int]

CHANNELS = (4, 8, 12, 16)
#: How the neural texture is read: the filter when it is shrunk, and the greatest anisotropy (the driver's may be less).
FILTERS = {
    "linear": (moderngl.LINEAR, 1.0),
    "mipmap": (moderngl.LINEAR_MIPMAP_LINEAR, 1.0),
    "anisotropic": (moderngl.LINEAR_MIPMAP_LINEAR, 16.0),
}
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
    """One avatar in a tensor. `clip_projection`: of its crop. `rect`: top, left, height, width in tensor pixels.

    `joints`, `feature`, `vertices`: as of `BodyPose`.
    """

    joints: F32
    clip_projection: Floats
    rect: tuple[int, int, int, int]
    feature: F32 | None = None
    vertices: F32 | None = None

    @property
    def pose(self) -> BodyPose:
        """What the mesh needs of it."""
        return BodyPose(self.joints, self.feature, self.vertices)


@dataclass(frozen=True)
class Target:
    """`words`: framebuffer of the tensor. A deferred pass has `uv_image` and its framebuffer `uv` on the same depth.

    `blank`: bytes of a tensor with nothing in it, which software drivers copy in less time than they clear.
    """

    words: Any
    uv_image: Any = None
    uv: Any = None
    blank: U8 | None = None


class PackedPass:
    """Draws meshes with one neural texture each into tensors of `channels` channels.

    `deferred`: first u and v of every pixel, then the texture once for each pixel that is seen; the bytes are the same.
    Software drivers shade whole blocks of pixels for each small triangle, so there this is the faster way.
    `filtering`: of `FILTERS`; a deferred pass has no derivatives and takes `linear` alone. Raises BadInputError.
    """

    def __init__(
        self, ctx: Any, channels: int, quantisation: Quantisation, deferred: bool, filtering: str = "linear"
    ) -> None:
        if filtering not in FILTERS:
            raise BadInputError("texture filter", repr(filtering), f"one of {', '.join(FILTERS)}")
        if deferred and filtering != "linear":
            raise BadInputError("texture filter", filtering, "linear", "draw mesh and texture in one pass")
        if channels not in CHANNELS:
            raise BadInputError("network input", f"{channels} channels", "4, 8, 12 or 16", "pad with zero channels")
        self.ctx, self.channels, self.quantisation, self.deferred = ctx, channels, quantisation, deferred
        self.filtering = filtering
        self._targets: dict[Shape, Target] = {}
        self._background = (0x01010101 * quantisation.zero_point,) * 4

    @property
    def layers(self) -> int:
        return self.channels // 4

    @property
    def uniforms(self) -> dict[str, float]:
        """What the packing shader is told."""
        encoding = self.quantisation
        return {"neural": 0, "uv_image": 1, "scale": encoding.scale, "zero_point": float(encoding.zero_point)}

    def target(self, shape: Shape) -> Target:
        """What tensors of `shape` (height, width) are drawn into; made on first use."""
        if shape not in self._targets:
            self._targets[shape] = self._make_target(shape[::-1])
        return self._targets[shape]

    def begin(self, shape: Shape) -> Target:
        """Clear the target of `shape`: the zero point everywhere, nothing covered."""
        target = self.target(shape)
        target.words.use()
        target.words.viewport = (0, 0, shape[1], shape[0])
        target.words.depth_mask = True
        if target.blank is None:
            gl.clear_unsigned(self._background)
        else:
            target.words.color_attachments[0].write(target.blank)
        gl.clear_depth()
        return target

    def read_into(self, shape: Shape, tensor: U8) -> None:
        """Copy the target of `shape` to `tensor`, (h * w * channels,) uint8."""
        box = (0, 0, shape[1], shape[0])
        self.target(shape).words.read_into(tensor, box, components=self.layers, dtype="u4", alignment=1)

    def background(self, tensor: U8) -> None:
        """Fill `tensor` with what a frame without avatars holds."""
        tensor[:] = self.quantisation.zero_point

    def _make_target(self, size: tuple[int, int]) -> Target:
        depth = self.ctx.depth_renderbuffer(size)
        words = self.ctx.framebuffer([self.ctx.texture(size, TARGET_WORDS[self.layers], dtype="u4")], depth)
        if not self.deferred:
            return Target(words)
        image = self.ctx.texture(size, 2, dtype="f4")
        image.filter = (moderngl.NEAREST, moderngl.NEAREST)
        blank = np.full(size[0] * size[1] * 4 * TARGET_WORDS[self.layers], self.quantisation.zero_point, np.uint8)
        return Target(words, image, self.ctx.framebuffer([image], depth), blank)


class PackedAvatar:
    """One avatar's mesh and texture, ready for a `PackedPass`. `texture` (H,W,C): finite, within FP16's range."""

    def __init__(self, packed: PackedPass, mesh: Mesh, texture: NDArray[np.floating[Any]]) -> None:
        check_texture(texture, packed.channels)
        self._mesh, self._ctx = mesh, packed.ctx
        self._texture = texture_array(packed.ctx, texture, packed.filtering)
        defines: dict[str, int | str] = {"LAYERS": packed.layers, "WORDS": WORD_TYPES[packed.layers]}
        if packed.deferred:
            self._geometry = MeshDraw(packed.ctx, mesh, "uv_only.frag")
            pack = build_program(packed.ctx, "behind.vert", "pack.frag", **defines, DEFERRED=1)
            set_uniforms(pack, packed.uniforms)
            self._screen = packed.ctx.vertex_array(pack, [])
        else:
            self._geometry = MeshDraw(packed.ctx, mesh, "pack.frag", **defines)
            self._geometry.set(packed.uniforms)

    def draw(self, target: Target, view: Floats, placement: Placement) -> None:
        """Draw into `target`, which a `PackedPass` began."""
        top, left, height, width = placement.rect
        box = (left, top, width, height)
        self._texture.use(0)
        self._mesh.prepare(self._ctx)
        first = target.words if target.uv is None else target.uv
        first.use()
        first.viewport = box
        self._geometry.draw(placement.pose, view, placement.clip_projection)
        if target.uv is not None:
            self._write_words(target, box)

    def _write_words(self, target: Target, box: tuple[int, int, int, int]) -> None:
        target.words.use()
        target.words.viewport = box
        target.words.depth_mask = False
        self._ctx.enable_only(moderngl.DEPTH_TEST)
        self._ctx.depth_func = ">"
        target.uv_image.use(1)
        self._screen.render(vertices=3)
        self._ctx.depth_func = "<"


def texture_array(ctx: Any, texture: NDArray[np.floating[Any]], filtering: str = "linear") -> Any:
    """An FP16 array texture of C/4 RGBA layers from `texture` (H,W,C), clamped to its edge, read as `FILTERS` says."""
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


def check_texture(texture: NDArray[np.floating[Any]], channels: int) -> None:
    """Raises BadInputError unless `texture` is (H,W,channels) of numbers that FP16 can hold."""
    if texture.ndim != 3 or texture.shape[2] != channels:
        raise BadInputError("neural texture", f"shape {texture.shape}", f"(height, width, {channels})")
    largest = float(np.abs(texture).max()) if texture.size else 0.0
    if not largest <= FP16_MAX:
        raise BadInputError("neural texture", f"a value of {largest}", f"numbers within FP16's ±{FP16_MAX:.0f}")
