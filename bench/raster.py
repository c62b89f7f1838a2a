"""How much faster is one packed pass than a pass for every four channels and a permute?

Rule: all variants draw the same body in the same poses, in one process, in interleaved rounds. The variants in
`COMPARED` must give the same bytes, except for a share `UNEQUAL` that may differ by 1. The split passes share mesh,
texture and triangles with the packed pass.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from trilane.arrays import MAX_SIDE, U8, Floats
from trilane.bench.lib.fixture import ENCODING, Fixture, interleaved_ms, standing, summary_ms
from trilane.bench.lib.interleaved_processes import INPUTS, SLOTS
from trilane.body.skinning import FrameSkinner
from trilane.errors import BadInputError, TrilaneError
from trilane.stages.config import Quantisation
from trilane.stages.gpu.opengl import describe, open_context
from trilane.stages.gpu.raster import PackedAvatar, PackedPass, Placement, check_texture, texture_array
from trilane.stages.gpu.skinned_mesh import MeshDraw, PosedMesh, SkinnedMesh
from trilane.training.sample_renderer import UvBytes
from trilane.units import CHANNELS, either

#: Variants whose bytes are compared.
COMPARED = ("packed", "packed, other way", "split")
UNEQUAL = 1e-3  # largest share of bytes that may differ, by one step: variants interpolate UVs at other places


def measure(size: int = 512, channels: int = 16, repeats: int = 40, threads: int = 1) -> dict[str, Any]:
    """Measure the time to draw one tensor and read it back to host memory, in ms, by variant.

    `raster_ms`: median time of the stage raster as in a run on this driver. With a software driver, the CPU unit skins
    the body, and the time of skinning does not count.
    `packed_ms`, `split_ms`: median times of the packed pass and of the split passes.
    `ratios`: `split_over_packed`, which is `split_ms` divided by `packed_ms`.
    `rows`: median, minimum and 90th percentile of each variant (`way`) over `repeats` draws.
    `covered`: share of the pixels that the body covers.
    `driver`: facts about the OpenGL driver.
    `config`: settings of the bench.

    Raises BadInputError for an option out of range, MissingPartError if a library is not installed, TrilaneError if the
    variants give different bytes.
    """
    if not 1 <= size <= MAX_SIDE:
        raise BadInputError("--size", str(size), f"1 to {MAX_SIDE}")
    if channels not in CHANNELS:
        raise BadInputError("--channels", str(channels), either(CHANNELS))
    ctx = open_context(threads)
    deferred = not describe(ctx).hardware
    tensors = {name: np.zeros((SLOTS, size * size * channels), np.uint8) for name in COMPARED}
    variants = _variants(ctx, standing(channels), tensors, (size, size), deferred)
    times = interleaved_ms(variants, repeats)
    _check_equal(tensors)
    rows = {name: summary_ms(times_ms) for name, times_ms in times.items()}
    packed_ms, split_ms = rows["packed"]["median_ms"], rows["split"]["median_ms"]
    as_in_a_run = "CPU unit skins: packed" if deferred else "packed"
    return {
        "raster_ms": rows[as_in_a_run]["median_ms"],
        "packed_ms": packed_ms,
        "split_ms": split_ms,
        "ratios": {"split_over_packed": split_ms / packed_ms},
        "rows": [{"way": name, **row} for name, row in rows.items()],
        "covered": float((tensors["packed"].reshape(-1, channels) != ENCODING.zero_point).any(axis=1).mean()),
        "driver": asdict(describe(ctx)),
        "config": {"size": size, "channels": channels, "repeats": repeats, "threads": threads, "deferred": deferred},
    }


def _variants(
    ctx: Any, fixture: Fixture, tensors: dict[str, Any], shape: tuple[int, int], deferred: bool
) -> dict[str, Callable[[int], object]]:
    """Return all variants by name. Each is a function of the input's number, which draws this input.

    `tensors`: array (SLOTS, bytes) that a variant in `COMPARED` writes to, by variant. `deferred`: whether a run on
    this driver draws UVs first and reads the texture in a second pass.
    """
    draws = (
        packed_variant(ctx, fixture, shape, deferred),
        packed_variant(ctx, fixture, shape, not deferred),
        split_variant(ctx, fixture, shape),
    )
    variants: dict[str, Callable[[int], object]] = {
        name: partial(draw, tensors[name]) for name, draw in zip(COMPARED, draws, strict=True)
    }
    skin, draw_skinned = skinned_variant(ctx, fixture, shape, deferred)
    variants["CPU unit skins: packed"] = partial(draw_skinned, np.zeros_like(tensors["packed"]))
    variants["CPU unit skins: skinning"] = skin
    uv_bytes = np.zeros((SLOTS, shape[0] * shape[1] * 2), np.uint8)
    variants["UV bytes alone"] = partial(uv_variant(ctx, fixture, shape), uv_bytes)
    return variants


#: Function of an array (SLOTS, bytes) and an input's number. It draws the input into the array's next slot.
Draw = Callable[[Any, int], None]


def packed_variant(ctx: Any, fixture: Fixture, shape: tuple[int, int], deferred: bool) -> Draw:
    """Return a function that draws the body by the packed pass, and reads the tensor into host memory.

    `ctx`: OpenGL context.
    `fixture`: body to draw.
    `shape`: (height, width) of the tensor.
    `deferred`: whether UVs are drawn first and the texture is read in a second pass.
    """
    packed = PackedPass(ctx, fixture.texture.shape[2], ENCODING, deferred)
    avatar = PackedAvatar(packed, SkinnedMesh(ctx, fixture.arrays), fixture.texture)

    def draw_and_read(tensors: Any, number: int) -> None:
        placement = Placement(fixture.joints(number), fixture.projection, (0, 0, *shape))
        avatar.draw(packed.begin(shape), fixture.view, placement)
        packed.read_into(shape, tensors[number % SLOTS])

    return draw_and_read


def skinned_variant(
    ctx: Any, fixture: Fixture, shape: tuple[int, int], deferred: bool
) -> tuple[Callable[[int], None], Draw]:
    """Return (skin, draw): a function that skins the body as the CPU unit does, and a function that draws the result.

    `draw` uses the packed pass. Parameters: see `packed_variant`.
    """
    packed = PackedPass(ctx, fixture.texture.shape[2], ENCODING, deferred)
    avatar = PackedAvatar(packed, PosedMesh(ctx, fixture.arrays), fixture.texture)
    skinner = FrameSkinner(fixture.shaped)
    slots = np.empty((SLOTS, len(fixture.shaped.vertices), 3), np.float32)
    skinned = np.empty((INPUTS, *slots.shape[1:]), np.float32)
    for posed, vertices in zip(fixture.poses, skinned, strict=True):
        skinner.skin_into(posed, vertices)

    def skin(number: int) -> None:
        skinner.skin_into(fixture.poses[number % INPUTS], slots[number % SLOTS])

    def draw(tensors: Any, number: int) -> None:
        vertices = skinned[number % INPUTS]
        placement = Placement(fixture.joints(number), fixture.projection, (0, 0, *shape), vertices=vertices)
        avatar.draw(packed.begin(shape), fixture.view, placement)
        packed.read_into(shape, tensors[number % SLOTS])

    return skin, draw


def split_variant(ctx: Any, fixture: Fixture, shape: tuple[int, int]) -> Draw:
    """Return a function that draws the body by the split passes, and interleaves their channels in host memory.

    Parameters: see `packed_variant`.
    """
    split = SplitPass(ctx, SkinnedMesh(ctx, fixture.arrays), fixture.texture, ENCODING, shape)

    def draw_and_read(tensors: Any, number: int) -> None:
        split.draw(fixture.view, Placement(fixture.joints(number), fixture.projection, (0, 0, *shape)))
        split.read_into(tensors[number % SLOTS])

    return draw_and_read


def uv_variant(ctx: Any, fixture: Fixture, shape: tuple[int, int]) -> Draw:
    """Return a function that draws the UV coordinates of the body, two bytes a pixel, and reads them back.

    Parameters: see `packed_variant`.
    """
    image = UvBytes(ctx, SkinnedMesh(ctx, fixture.arrays))

    def draw_and_read(images: Any, number: int) -> None:
        image.render_into(images[number % SLOTS], fixture.joints(number), fixture.view, fixture.projection, shape)

    return draw_and_read


def _check_equal(tensors: dict[str, Any]) -> None:
    for name, tensor in tensors.items():
        steps = np.abs(tensor.astype(np.int16) - tensors["packed"])
        if steps.max() > 1 or (steps > 0).mean() > UNEQUAL:
            raise TrilaneError(f"{name} gave other bytes than packed: {steps.max()} steps at most")


class SplitPass:
    """Draws one avatar in several passes, each into an RGBA8 target with four channels of the tensor.

    `ctx`: OpenGL context.
    `mesh`: mesh of the avatar.
    `texture`: neural texture (H,W,C), real numbers, C a multiple of 4.
    `quantisation`: scale and zero point of the tensor.
    `shape`: (height, width) of the tensor in pixels.
    """

    def __init__(
        self,
        ctx: Any,
        mesh: SkinnedMesh,
        texture: NDArray[np.floating[Any]],
        quantisation: Quantisation,
        shape: tuple[int, int],
    ) -> None:
        check_texture(texture, texture.shape[2])
        self._ctx, self._mesh, self._shape = ctx, mesh, shape
        self._draw = MeshDraw(ctx, mesh, "split.frag")
        self._texture = texture_array(ctx, texture)
        zero_point = float(quantisation.zero_point)
        self._draw.set({"neural": 0, "scale": quantisation.scale, "zero_point": zero_point})
        self._background = (zero_point / 255,) * 4
        size = shape[::-1]
        depth = ctx.depth_renderbuffer(size)
        self._targets = [ctx.framebuffer([ctx.texture(size, 4)], depth) for _ in range(texture.shape[2] // 4)]
        self._planes = np.empty((len(self._targets), *shape, 4), np.uint8)

    def draw(self, view: Floats, placement: Placement) -> None:
        """Draw every pass. The avatar gets the whole tensor.

        `view`: view matrix (4,4). `placement`: pose and projection of the avatar; its `rect` is ignored.
        """
        self._texture.use(0)
        self._mesh.prepare(self._ctx)
        for layer, target in enumerate(self._targets):
            target.use()
            target.clear(*self._background)
            self._draw.set({"layer": layer})
            self._draw.draw(placement.pose, view, placement.clip_projection)

    def read_into(self, tensor: U8) -> None:
        """Read the targets of all passes back, and interleave their channels into `tensor`, (h * w * C,) uint8."""
        image = tensor.reshape(*self._shape, 4 * len(self._targets))
        for layer, target in enumerate(self._targets):
            target.read_into(self._planes[layer], components=4)
            image[..., 4 * layer : 4 * layer + 4] = self._planes[layer]
