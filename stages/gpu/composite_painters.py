"""The painters of the composite, one class per layer of the frame: room, picture, planes, contact shadows, avatars.

Background bytes are copied unchanged, as sRGB; everything blended over them is blended in linear light. Planes are
those of the scene file; nothing is detected here. A contact shadow is a disc under a joint, which grows and fades with
the height of its joint above the floor.

A body fills about half of its rectangle, and a software driver takes as long for a pixel that stays as for any other.
So the network's picture is cut into bands of rows. Each band is cut to the columns between its first and last texel
that is not transparent, widened by what a screen pixel may read beside its middle.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import reduce
from typing import Any

import moderngl
import numpy as np
from numpy.typing import NDArray

from trilane.arrays import F32, F64, U8, Floats, Mask
from trilane.body.joints import JOINT_INDEX
from trilane.scene.schema import PlaneSpec
from trilane.stages.gpu import opengl
from trilane.stages.gpu.builtin_room import Extent, room_mesh, room_textures
from trilane.stages.gpu.opengl import build_program, counter_of, eye_of, target_clip, upload, uploaded_buffer

BAND = 16  # rows of a band
WHOLE: F32 = np.array([[0, 0, 1, 1]], np.float32)


def spans(shown: Mask, margin: int) -> F32:
    """Return the parts (N,4) float32 to draw: left, top, right, bottom of each, as shares of the picture's sides.

    `shown`: (h,w), where the picture is not transparent. `margin`: number of texels that are read beside a pixel's
    middle.
    """
    height, width = shown.shape
    has_any = shown.any(axis=1)
    first = np.where(has_any, shown.argmax(axis=1), width)
    end = np.where(has_any, width - shown[:, ::-1].argmax(axis=1), 0)
    tops = np.arange(0, height, BAND)
    bottoms = np.minimum(tops + BAND, height)
    rows = np.column_stack([np.maximum(tops - margin, 0), np.minimum(bottoms + margin, height)]).ravel()
    left = np.minimum.reduceat(np.append(first, width), rows)[::2] - margin  # reduces over the rows of each pair
    right = np.maximum.reduceat(np.append(end, 0), rows)[::2] + margin
    is_shown = right - left > 2 * margin
    edges = np.column_stack([np.maximum(left, 0), tops, np.minimum(right, width), bottoms])[is_shown]
    return np.asarray(edges / (width, height, width, height), np.float32)


# joint, radius on the floor in metres, strength there, height in metres over which it fades to 1/e
DISCS = (
    ("left_ankle", 0.15, 0.65, 0.18),
    ("right_ankle", 0.15, 0.65, 0.18),
    ("left_foot", 0.16, 0.70, 0.15),
    ("right_foot", 0.16, 0.70, 0.15),
    ("left_knee", 0.22, 0.45, 0.30),
    ("right_knee", 0.22, 0.45, 0.30),
    ("pelvis", 0.50, 0.60, 1.20),
    ("spine3", 0.45, 0.45, 0.60),
    ("head", 0.30, 0.45, 0.30),
    ("left_wrist", 0.16, 0.45, 0.15),
    ("right_wrist", 0.16, 0.45, 0.15),
)
WIDENING = 0.35  # metres of radius gained for each metre of height
FAINTEST = 0.02

_JOINT = np.array([JOINT_INDEX[name] for name, *_ in DISCS])
_RADIUS, _STRENGTH, _FADE = np.array([numbers for _, *numbers in DISCS]).T


def floor_discs(joints: NDArray[np.floating[Any]], rest: F64) -> NDArray[np.float32]:
    """Return discs (N,4) float32: x, z, radius, strength, for skinning matrices (55,3,4) and rest joints (55,3)."""
    matrices = np.asarray(joints, np.float64)[_JOINT]
    place = np.einsum("nij,nj->ni", matrices[..., :3], rest[_JOINT]) + matrices[..., 3]
    height = np.maximum(place[:, 1], 0.0)
    strength = _STRENGTH * np.exp(-height / _FADE)
    discs = np.column_stack([place[:, 0], place[:, 2], _RADIUS + WIDENING * height, strength])
    return np.asarray(discs[strength > FAINTEST], np.float32)


MAX_TAPS = 8
#: Least number of screen pixels at which drawing less saves more time than finding what is transparent takes.
WORTH_CUTTING_PX = 60_000
HALF_TEXEL_INWARD = np.array([0.5, 0.5, -0.5, -0.5])
UNDER_THE_FLOOR = (70, 66, 60)


class RoomPainter:
    """Draws the built-in room, which is made larger when a camera leaves it."""

    def __init__(self, ctx: Any, eyes: Sequence[Floats] = ()) -> None:
        """Make the room.

        `eyes`: places (3,) of cameras that the room holds from the beginning.
        """
        self._ctx = ctx
        self._program = build_program(ctx, "room.vert", "room.frag")
        floor, boards, paint = room_textures()
        self._textures = [
            _detail(ctx, floor, moderngl.LINEAR_MIPMAP_LINEAR, moderngl.LINEAR),
            # The boards are too smooth to show where levels change, and paint is too smooth to show texels.
            _detail(ctx, boards, moderngl.LINEAR_MIPMAP_NEAREST, moderngl.LINEAR),
            _detail(ctx, paint, moderngl.NEAREST, moderngl.NEAREST),
        ]
        self._extent = reduce(Extent.holding, (np.asarray(eye, np.float64) for eye in eyes), Extent())
        self._batches: list[Any] = []
        self._build()

    def draw(self, target: Any, view: Floats, projection: Floats) -> None:
        """Fill `target` with the room as seen by `view` and `projection`; from below, the floor is not drawn."""
        grown = self._extent.holding(eye_of(view))
        if grown is not self._extent:
            self._extent = grown
            self._build()
        self._ctx.enable_only(moderngl.CULL_FACE)
        self._ctx.front_face = "cw"  # row 0 is on top, see `skinned_mesh`
        target.clear(*(value / 255 for value in UNDER_THE_FLOOR))
        upload(self._ctx, self._program["clip_from_world"], target_clip(view, projection))
        for texture, batch in zip(self._textures, self._batches, strict=True):
            texture.use(0)
            batch.render()

    def _build(self) -> None:
        mesh = room_mesh(self._extent)
        for batch in self._batches:
            batch.release()
        vertices = uploaded_buffer(self._ctx, mesh.vertices.tobytes())
        content = [(vertices, "3f 2f 3f", "position", "uv", "light")]
        parts = (mesh.floor, mesh.boards, mesh.paint)
        indices = [uploaded_buffer(self._ctx, part.tobytes()) for part in parts]
        self._batches = [self._ctx.vertex_array(self._program, content, index) for index in indices]


class PicturePainter:
    """Draws a background picture of the output's size, (h,w,3) uint8."""

    def __init__(self, ctx: Any, shape: tuple[int, int]) -> None:
        self._ctx = ctx
        self._program = build_program(ctx, "whole_screen.vert", "picture.frag")
        self._screen = ctx.vertex_array(self._program, [])
        self._texture = ctx.texture(shape[::-1], 3, alignment=1)

    def upload(self, picture: U8) -> None:
        """Write `picture` (h,w,3) to the GPU; `draw` shows it from now on."""
        upload(self._ctx, self._texture, picture, alignment=1)

    def draw(self) -> None:
        """Copy the picture to the target in use."""
        self._ctx.enable_only(moderngl.NOTHING)
        self._texture.use(0)
        self._screen.render(vertices=3)


class ShadowPainter:
    """Draws contact shadows: up to `blobs` soft discs on the floor."""

    def __init__(self, ctx: Any, blobs: int) -> None:
        self._ctx, self._count = ctx, blobs
        self._program = build_program(ctx, "shadow.vert", "shadow.frag", BLOBS=blobs)
        self._discs = ctx.vertex_array(self._program, [])

    def draw(self, view: Floats, projection: Floats, blobs: F32) -> None:
        """Darken the target in use.

        `blobs` (N,4) float32: x, z, radius in metres, strength 0..1.
        """
        if not len(blobs) or eye_of(view)[1] <= 0:
            return
        self._ctx.enable_only(moderngl.BLEND)
        self._ctx.blend_func = moderngl.ZERO, moderngl.ONE_MINUS_SRC_ALPHA
        upload(self._ctx, self._program["clip_from_world"], target_clip(view, projection))
        padded = np.zeros((self._count, 4), np.float32)
        padded[: len(blobs)] = blobs
        upload(self._ctx, self._program["blob"], padded)
        with opengl.srgb_target():
            self._discs.render(vertices=6 * len(blobs))


class AvatarPainter:
    """Draws the network's picture: uploaded once a frame, then drawn avatar by avatar at their crop rectangles."""

    def __init__(self, ctx: Any, shapes: list[tuple[int, int]]) -> None:
        self._ctx = ctx
        self._premultiply = build_program(ctx, "whole_screen.vert", "premultiply.frag")
        self._screen = ctx.vertex_array(self._premultiply, [])
        programs = [build_program(ctx, "avatar.vert", "avatar.frag", TAPS=taps) for taps in range(1, MAX_TAPS + 1)]
        self._parts = ctx.buffer(reserve=max(-(-height // BAND) for height, _ in shapes) * WHOLE.nbytes, dynamic=True)
        self._quads = [(made, ctx.vertex_array(made, [(self._parts, "4f/i", "part")])) for made in programs]
        self._shown: Mask = np.zeros((0, 0), np.bool_)
        self._pictures = {shape: self._picture(shape) for shape in shapes}

    def upload(self, shape: tuple[int, int], image: U8) -> None:
        """Write `image` (h * w * 4,) uint8, sRGB with straight alpha, to the GPU as the picture of `shape`."""
        self._shown = image.reshape(*shape, 4)[:, :, 3] > 0
        straight, target, _ = self._pictures[shape]
        upload(self._ctx, straight, image)
        counter_of(self._ctx).read += self._shown.nbytes + image.nbytes
        target.use()
        self._ctx.enable_only(moderngl.NOTHING)
        straight.use(0)
        self._screen.render(vertices=3)

    def draw(
        self, target: Any, shape: tuple[int, int], rect: tuple[float, ...], tensor_rect: tuple[int, int, int, int]
    ) -> None:
        """Blend one avatar's part of the picture over `target`.

        `target`: framebuffer.
        `shape`: (height, width) of the picture that was uploaded.
        `rect`: rectangle of the avatar on the screen, x0, y0, x1, y1 in normalised device coordinates.
        `tensor_rect`: its part of the picture: top, left, height, width.
        """
        top, left, height, width = tensor_rect
        rows, columns = (rect[3] - rect[1]) / 2 * target.height, (rect[2] - rect[0]) / 2 * target.width
        density, taps = _density((height, width), (rows, columns)), taps_of((height, width), (rows, columns))
        parts = WHOLE
        if rows * columns >= WORTH_CUTTING_PX:
            parts = spans(self._shown[top : top + height, left : left + width], math.ceil(density / 2) + 1)
        if not len(parts):
            return
        upload(self._ctx, self._parts, parts)
        program, quad = self._quads[taps - 1]
        size = np.array([shape[1], shape[0]] * 2)
        edge = np.array([left, top, left + width, top + height])
        target.use()
        self._ctx.enable_only(moderngl.BLEND)
        self._ctx.blend_func = moderngl.ONE, moderngl.ONE_MINUS_SRC_ALPHA
        program["rect"].value = tuple(float(side) for side in rect)
        program["source"].value = tuple(edge / size)
        program["inside"].value = tuple((edge + HALF_TEXEL_INWARD) / size)
        self._pictures[shape][2].use(0)
        with opengl.srgb_target():
            quad.render(moderngl.TRIANGLE_STRIP, vertices=4, instances=len(parts))

    def _picture(self, shape: tuple[int, int]) -> tuple[Any, Any, Any]:
        straight = self._ctx.texture(shape[::-1], 4, internal_format=opengl.SRGB8_ALPHA8)
        premultiplied = self._ctx.texture(shape[::-1], 4, dtype="f2")
        premultiplied.filter = (moderngl.LINEAR, moderngl.LINEAR)
        premultiplied.repeat_x = premultiplied.repeat_y = False
        return straight, self._ctx.framebuffer([premultiplied]), premultiplied


def taps_of(cell: tuple[int, int], pixels: tuple[float, float]) -> int:
    """Return how many reads along a side a screen pixel is the mean of, when `cell` of a picture fills `pixels`.

    Both are (height, width).
    """
    return int(np.clip(np.ceil(_density(cell, pixels) - 0.25), 1, MAX_TAPS))


def _density(cell: tuple[int, int], pixels: tuple[float, float]) -> float:
    return max(side / max(length, 1e-6) for side, length in zip(cell, pixels, strict=True))


def _detail(ctx: Any, image: U8, minify: int, magnify: int) -> Any:
    texture = ctx.texture((image.shape[1], image.shape[0]), 4, image.tobytes())
    texture.build_mipmaps()
    texture.filter = (minify, magnify)
    return texture


UPRIGHT = 0.9  # a plane whose unit normal has |y| above this is aligned with the world's x, any other with its y


class PlanePainter:
    """Draws `planes` (at least one) into the target in use."""

    def __init__(self, ctx: Any, planes: Sequence[PlaneSpec]) -> None:
        self._ctx, self._count = ctx, len(planes)
        self._program = build_program(ctx, "plane.vert", "plane.frag", PLANES=len(planes))
        self._sheets = ctx.vertex_array(self._program, [])
        sides = [half_sides(plane) for plane in planes]
        self._program["centre"].write(np.array([plane.centre for plane in planes], np.float32))
        self._program["across"].write(np.array([across for across, _ in sides], np.float32))
        self._program["along"].write(np.array([along for _, along in sides], np.float32))

    def draw(self, view: Floats, projection: Floats) -> None:
        """Blend the planes over the target, as seen by `view` and `projection`."""
        self._ctx.enable_only(moderngl.BLEND)
        self._ctx.blend_func = moderngl.SRC_ALPHA, moderngl.ONE_MINUS_SRC_ALPHA
        upload(self._ctx, self._program["clip_from_world"], target_clip(view, projection))
        with opengl.srgb_target():
            self._sheets.render(vertices=6 * self._count)


def half_sides(plane: PlaneSpec) -> tuple[F32, F32]:
    """Return half of each side of `plane` as a vector (3,), metres.

    The vectors are at right angles to each other and to the normal.
    """
    normal = np.asarray(plane.normal, np.float64) / np.linalg.norm(plane.normal)
    towards = np.array([1.0, 0.0, 0.0]) if abs(normal[1]) > UPRIGHT else np.array([0.0, 1.0, 0.0])
    along = np.cross(normal, towards)
    along /= np.linalg.norm(along)
    across = np.cross(along, normal)
    turn = np.radians(plane.turn_deg)
    across, along = np.cos(turn) * across + np.sin(turn) * along, np.cos(turn) * along - np.sin(turn) * across
    return (plane.width_m / 2 * across).astype(np.float32), (plane.depth_m / 2 * along).astype(np.float32)
