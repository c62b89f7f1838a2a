"""The raster stage, which draws the network's input tensor from a pose packet, and the packed pass that it uses.

Rule of the stage: the tensor is written directly to the output slot; a frame with nobody in view costs one fill.

The packed pass draws a posed mesh with its neural texture as bytes of the tensor. The bytes leave the GPU in tensor
order (NHWC, row 0 on top), with the network's scale and zero point already applied. The neural texture is an array
texture with four channels in each layer. Its texels are FP16; a texture with a number beyond FP16 is refused before
anything is uploaded.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import Any

import moderngl
import numpy as np
from numpy.typing import NDArray

from trilane.arrays import F32, U8, Floats, Shape
from trilane.avatars.bundle import split_levels
from trilane.body.body import ShapedBody
from trilane.errors import BadInputError, TrilaneError
from trilane.pipeline.stage import UnitContext
from trilane.scene.crop import Rect, crop_projection
from trilane.stages.avatar_assets import bodies_drawn, distinct, levels_of, quantisation_of, texture_of
from trilane.stages.config import Quantisation, RunConfig, network_parts, posed_vertices
from trilane.stages.gpu import opengl
from trilane.stages.gpu.opengl import (
    CONTEXT,
    build_program,
    checked,
    counter_of,
    describe,
    open_context,
    read_into,
    set_uniforms,
    upload,
)
from trilane.stages.gpu.skinned_mesh import BodyPose, Mesh, MeshDraw, PosedMesh, SkinnedMesh, avatar_mesh
from trilane.transport.packets import Packet
from trilane.units import CHANNELS, MAX_CHANNELS, either

#: (minifying filter, largest anisotropy) of the neural texture, by the scene's word; a driver may limit the anisotropy.
FILTERS = {
    "linear": (moderngl.LINEAR, 1.0),
    "mipmap": (moderngl.LINEAR_MIPMAP_LINEAR, 1.0),
    "anisotropic": (moderngl.LINEAR_MIPMAP_LINEAR, 16.0),
}
FP16_MAX = float(np.finfo(np.float16).max)
HALF_EXPONENTS = 16  # FP16 numbers are below 2**16
HALF_BIAS, FLOAT_BIAS = 15, 127  # biases of the exponents of FP16 and FP32


def texture_array(ctx: Any, texture: Floats, filtering: str = "linear", levels: Sequence[Floats] = ()) -> Any:
    """Return an FP16 array texture of C/4 RGBA layers from `texture` (H,W,C). Reads beyond its edge repeat the edge.

    `filtering`: one of FILTERS.
    `levels`: learnt smaller levels, each (h,w,C), the largest first; they replace the levels that the driver computes.
    With them, `linear` becomes `mipmap`.
    """
    height, width, channels = texture.shape
    array = ctx.texture_array((width, height, channels // 4), 4, _pixels(texture), dtype="f2")
    shrunk, anisotropy = FILTERS["mipmap" if levels and filtering == "linear" else filtering]
    if shrunk != moderngl.LINEAR:
        array.build_mipmaps(**({"max_level": len(levels)} if levels else {}))
    for number, level in enumerate(levels, 1):
        size = (level.shape[1], level.shape[0], channels // 4)
        opengl.write_level(array.glo, number, size, _pixels(level))
    array.filter = (shrunk, moderngl.LINEAR)
    array.anisotropy = anisotropy
    array.repeat_x = array.repeat_y = False
    return array


def texture_words(ctx: Any, texture: Floats) -> tuple[Any, float]:
    """Return (texture of 32-bit words, uniform `unit`) for a deferred pass. The words pack `texture` (H,W,C) as FP16.

    The numbers are first multiplied by the largest power of two that FP16 allows, so that small numbers are not
    subnormal. `packed_tensor.frag` turns the bits of such a number into a float, and multiplies it by `unit`.
    """
    height, width, channels = texture.shape
    halves = texture.astype(np.float16)
    raised = HALF_EXPONENTS - int(np.frexp(np.abs(halves).max(initial=0).astype(np.float64))[1])
    eighths = -(-channels // 8)
    padded = np.zeros((height, width, 8 * eighths), np.float16)
    padded[:, :, :channels] = np.ldexp(halves.astype(np.float32), raised)
    bits = padded.view(np.uint16).reshape(height, width, eighths, 2, 4).astype(np.uint32)
    words = bits[:, :, :, 0] | bits[:, :, :, 1] << 16
    made = ctx.texture((width * eighths, height), 4, np.ascontiguousarray(words).tobytes(), dtype="u4")
    made.filter = (moderngl.NEAREST, moderngl.NEAREST)
    return made, 2.0 ** (FLOAT_BIAS - HALF_BIAS - raised)


def _pixels(texture: Floats) -> bytes:
    height, width, channels = texture.shape
    layers = texture.reshape(height, width, channels // 4, 4).transpose(2, 0, 1, 3)
    return np.ascontiguousarray(layers, np.float16).tobytes()


def check_texture(texture: Floats, channels: int) -> None:
    """Raise BadInputError unless `texture` is (H,W,channels) and all its numbers fit into FP16."""
    if texture.ndim != 3 or texture.shape[2] != channels:
        raise BadInputError("neural texture", f"shape {texture.shape}", f"(height, width, {channels})")
    largest = float(np.abs(texture).max()) if texture.size else 0.0
    if not largest <= FP16_MAX:
        raise BadInputError("neural texture", f"a value of {largest}", f"numbers within FP16's ±{FP16_MAX:.0f}")


WORD_TYPES = {1: "uint", 2: "uvec2", 3: "uvec4", 4: "uvec4"}
#: Number of 32-bit words in a target's pixel, by the number of words in a tensor's pixel. OpenGL does not guarantee
#: targets of three words, so such a target has four words, and the fourth is not read back.
TARGET_WORDS = {1: 1, 2: 2, 3: 4, 4: 4}


@dataclass(frozen=True)
class Placement:
    """One avatar in a tensor.

    `joints`, `feature`, `vertices`: pose, as in `BodyPose`.
    `clip_projection`: projection of the avatar's crop rectangle (4,4).
    `rect`: (top, left, height, width) in tensor pixels.
    `mesh`: number of the mesh that is drawn.
    """

    joints: F32
    clip_projection: Floats
    rect: tuple[int, int, int, int]
    feature: F32 | None = None
    vertices: F32 | None = None
    mesh: int = 0

    @property
    def pose(self) -> BodyPose:
        """The pose in the form that a mesh takes."""
        return BodyPose(self.joints, self.feature, self.vertices)


@dataclass(frozen=True)
class Target:
    """A target of the packed pass.

    `words`: framebuffer of the tensor.
    `uv_image`: texture of u and v in a deferred pass.
    `uv`: framebuffer of `uv_image`, with the same depth buffer as `words`.
    `blank`: bytes of an empty tensor, which software drivers copy faster than they clear a target.
    """

    words: Any
    uv_image: Any = None
    uv: Any = None
    blank: U8 | None = None


class PackedPass:
    """Draws meshes, each with its neural texture, into tensors."""

    def __init__(
        self, ctx: Any, channels: int, quantisation: Quantisation, deferred: bool, filtering: str = "linear"
    ) -> None:
        """Check the settings; targets are made on first use.

        `ctx`: OpenGL context.
        `channels`: number of channels of tensors and textures, one of `CHANNELS`.
        `quantisation`: scale and zero point of the bytes.
        `deferred`: whether to draw u and v of every pixel first, and then read the texture once for each visible pixel.
        The bytes are the same. This is faster on software drivers, which shade whole blocks of pixels for each small
        triangle.
        `filtering`: one of FILTERS. A deferred pass has no derivatives of u and v, so it takes only `linear`.

        Raises BadInputError for another filter or number of channels.
        """
        if filtering not in FILTERS:
            raise BadInputError("texture filter", repr(filtering), f"one of {', '.join(FILTERS)}")
        if deferred and filtering != "linear":
            raise BadInputError("texture filter", filtering, "linear", "draw mesh and texture in one pass")
        if channels not in CHANNELS:
            raise BadInputError("network input", f"{channels} channels", either(CHANNELS), "pad with zero channels")
        self.ctx, self.channels, self.quantisation, self.deferred = ctx, channels, quantisation, deferred
        self.filtering = filtering
        self._targets: dict[Shape, Target] = {}
        self._background = (0x01010101 * quantisation.zero_point,) * 4

    @property
    def layers(self) -> int:
        return self.channels // 4

    @property
    def uniforms(self) -> dict[str, float]:
        """The uniforms of `packed_tensor.frag`."""
        encoding = self.quantisation
        return {"neural": 0, "uv_image": 1, "scale": encoding.scale, "zero_point": float(encoding.zero_point)}

    def target(self, shape: Shape) -> Target:
        """Return the target for tensors of `shape` (height, width); it is made on first use."""
        if shape not in self._targets:
            self._targets[shape] = self._make_target(shape[::-1])
        return self._targets[shape]

    def begin(self, shape: Shape) -> Target:
        """Fill the target of `shape` (height, width) with the zero point and the largest depth, and return it."""
        target = self.target(shape)
        target.words.use()
        target.words.viewport = (0, 0, shape[1], shape[0])
        target.words.depth_mask = True
        if target.blank is None:
            opengl.clear_unsigned(self._background)
        else:
            upload(self.ctx, target.words.color_attachments[0], target.blank)
        opengl.clear_depth()
        return target

    def read_into(self, shape: Shape, tensor: U8) -> None:
        """Copy the target of `shape` (height, width) to `tensor` (h * w * channels,) uint8."""
        box = (0, 0, shape[1], shape[0])
        words = self.target(shape).words
        read_into(self.ctx, words, tensor, box, components=self.layers, dtype="u4", alignment=1)

    def background(self, tensor: U8) -> None:
        """Fill `tensor` with the zero point, the content of a frame without avatars."""
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
    """The meshes and the texture of one avatar, which a `PackedPass` draws."""

    def __init__(
        self,
        packed: PackedPass,
        mesh: Mesh,
        texture: Floats,
        levels: Floats | None = None,
        coarser: Sequence[Mesh] = (),
    ) -> None:
        """Upload meshes and texture.

        `mesh`: whole mesh, number 0.
        `texture`: neural texture (H,W,C).
        `levels`: smaller levels of the texture, packed by `pack_levels`; None without any, as in every deferred pass.
        `coarser`: levels of the mesh, numbers 1, 2, ...
        Raises BadInputError if a texture has a number beyond FP16, if C is not the pass's number of channels, or if a
        deferred pass gets `levels`.
        """
        check_texture(texture, packed.channels)
        smaller = split_levels(levels, texture.shape[1])
        for level in smaller:
            check_texture(level, packed.channels)
        if smaller and packed.deferred:
            raise BadInputError("neural texture", "learnt levels", "one level", "draw mesh and texture in one pass")
        self.meshes, self._ctx = (mesh, *coarser), packed.ctx
        defines: dict[str, int | str] = {"LAYERS": packed.layers, "WORDS": WORD_TYPES[packed.layers]}
        if packed.deferred:
            self._texture, unit = texture_words(packed.ctx, texture)
            self._draws = [MeshDraw(packed.ctx, one, "uv_only.frag") for one in self.meshes]
            defines |= {"DEFERRED": 1, "EIGHTHS": -(-packed.channels // 8)}
            pack = build_program(packed.ctx, "farthest.vert", "packed_tensor.frag", **defines)
            set_uniforms(pack, {**packed.uniforms, "unit": unit})
            self._screen = packed.ctx.vertex_array(pack, [])
        else:
            self._texture = texture_array(packed.ctx, texture, packed.filtering, smaller)
            self._draws = [MeshDraw(packed.ctx, one, "packed_tensor.frag", **defines) for one in self.meshes]
            for draw in self._draws:
                draw.set(packed.uniforms)

    def draw(self, target: Target, view: Floats, placement: Placement) -> None:
        """Draw the avatar into a target.

        `target`: target that `PackedPass.begin` has cleared.
        `view`: matrix (4,4) from world to camera.
        `placement`: pose and place of the avatar in the tensor.
        """
        top, left, height, width = placement.rect
        box = (left, top, width, height)
        self._texture.use(0)
        self.meshes[placement.mesh].prepare(self._ctx)
        first = target.words if target.uv is None else target.uv
        first.use()
        first.viewport = box
        self._draws[placement.mesh].draw(placement.pose, view, placement.clip_projection)
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


class RasterStage:
    """Draws the input tensors of the networks from pose packets.

    `passes`: pass that draws the tensors of each network, by the network's number.
    `avatars`: meshes and texture of each avatar of the scene, by the avatar's number.
    `shapes`: tensor shapes (height, width) that may come.
    `posed_vertices`: number of skinned vertices of each avatar in the input slot; empty if the GPU unit skins.
    `painters`: number of the network that paints each avatar; empty if one network paints all.
    """

    def __init__(
        self,
        passes: Sequence[PackedPass],
        avatars: Sequence[PackedAvatar],
        shapes: Sequence[Shape],
        posed_vertices: Sequence[int] = (),
        painters: Sequence[int] = (),
    ) -> None:
        self._passes, self._avatars, self._shapes, self._counts = passes, avatars, shapes, posed_vertices
        self._ctx, self._painters = passes[0].ctx, painters or [0] * len(avatars)
        self._vertices: list[list[NDArray[np.float32]]] = []
        self._inputs: Sequence[Packet] = ()
        self._outputs: Sequence[Packet] = ()

    def bind(self, inputs: Sequence[Packet], outputs: Sequence[Packet]) -> None:
        """Keep the slots and make a target for every tensor shape."""
        self._inputs, self._outputs = inputs, outputs
        self._vertices = [posed_vertices(packet.payload, self._counts) for packet in inputs]
        for packed, shape in product(self._passes, self._shapes):
            packed.target(shape)

    def run(self, frame: int, slot_in: int | None, slot_out: int | None) -> Mapping[str, float]:
        """Write the tensor (h,w,C) uint8 of each network, empty if the network paints nobody in view. Return metrics.

        The metrics are the bytes moved. The least bytes are the pose of the drawn mesh of each visible avatar, and the
        drawn tensors. Raises ValueError without a slot, TrilaneError for an infinite joint, else as `opengl.check`.
        """
        if slot_in is None or slot_out is None:
            raise ValueError("raster needs an input and an output slot")
        pose, moved = self._inputs[slot_in].header, counter_of(self._ctx)
        moved.start(pose.nbytes)
        shape = (int(pose["tensor_shape"][0]), int(pose["tensor_shape"][1]))
        visible = [a for a in pose["avatars"][: int(pose["avatar_count"])] if a["visible"]]
        for avatar in visible:
            if not np.isfinite(avatar["joints"]).all():
                found = f"avatar {int(avatar['avatar'])} has a joint that is not a finite number"
                raise TrilaneError(f"frame {frame}: {found}")
        skinned = self._vertices[slot_in]
        parts = network_parts(self._outputs[slot_out].payload, len(self._passes), self._shapes, MAX_CHANNELS)
        for network, (packed, part) in enumerate(zip(self._passes, parts, strict=True)):
            tensor = part[: math.prod(shape) * packed.channels]
            own = [avatar for avatar in visible if self._painters[int(avatar["avatar"])] == network]
            moved.written += tensor.nbytes
            if not own:
                packed.background(tensor)
                continue
            with checked(self._ctx):
                target = packed.begin(shape)
                for avatar in own:
                    number = int(avatar["avatar"])
                    placement = _placement(pose, avatar, skinned[number] if skinned else None)
                    self._avatars[number].draw(target, pose["view"], placement)
                    moved.least += self._avatars[number].meshes[placement.mesh].pose_bytes
                packed.read_into(shape, tensor)
            moved.least += tensor.nbytes
        return moved.figures()

    def close(self) -> None:
        """Drop the views of the slots; the context ends with the process."""
        self._vertices = []


def _placement(pose: NDArray[np.void], avatar: Any, vertices: NDArray[np.float32] | None) -> Placement:
    top, left, height, width = (int(side) for side in avatar["tensor_rect"])
    return Placement(
        joints=avatar["joints"],
        clip_projection=crop_projection(pose["projection"], Rect(*map(float, avatar["rect"]))),
        rect=(top, left, height, width),
        feature=avatar["pose_feature"],
        vertices=vertices,
        mesh=int(avatar["mesh"]),
    )


def build(settings: Mapping[str, Any], unit: UnitContext) -> RasterStage:
    """Build the raster stage of the configuration in `settings`. Raises BadInputError, MissingPartError.

    On a software driver, the pass is deferred if the filter is `linear` and no texture has learnt levels.
    """
    config = RunConfig.model_validate(settings["config"])
    ctx = unit.shared(CONTEXT, lambda: open_context(unit.settings.threads))
    folders, filtering = distinct(config), config.scene.texture_filter
    textures = [texture_of(unit.assets, number) for number in range(len(folders))]
    driver = describe(ctx)
    if driver.hardware:
        unit.use_device(driver.renderer)
    levels = [levels_of(unit.assets, number) for number in range(len(folders))]
    deferred = filtering == "linear" and not driver.hardware and all(each is None for each in levels)
    passes: dict[int, PackedPass] = {}
    drawn = {}
    for number, (folder, texture) in enumerate(zip(folders, textures, strict=True)):
        network = config.network_of(config.avatar_dirs.index(folder))
        if network not in passes:
            encoding = quantisation_of(unit.assets, number)
            passes[network] = PackedPass(ctx, texture.shape[2], encoding, deferred, filtering)
        whole, *coarser = _meshes(ctx, bodies_drawn(config, unit.assets, number), config)
        drawn[folder] = PackedAvatar(passes[network], whole, texture, levels[number], coarser)
    avatars = [drawn[folder] for folder in config.avatar_dirs]
    in_order = [passes[network] for network in sorted(passes)]
    return RasterStage(in_order, avatars, config.buckets, config.posed_vertices, config.networks)


def _meshes(ctx: Any, bodies: Sequence[ShapedBody], config: RunConfig) -> list[Mesh]:
    """Return the meshes of `bodies`: a whole body, then the body of each level of its mesh.

    If the whole mesh encloses a volume, each level counts as closed. A level may fold over itself. Its triangles that
    face away are behind other triangles, so they are not drawn.
    """
    whole, *coarser = (avatar_mesh(body) for body in bodies)
    arrays = [whole, *(replace(level, closed=whole.closed) for level in coarser)]
    if config.posed_vertices:
        return [PosedMesh(ctx, one) for one in arrays]
    return [SkinnedMesh(ctx, one, body.body.posedirs) for one, body in zip(arrays, bodies, strict=True)]
