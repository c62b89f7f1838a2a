"""The painters of the composite, one class per layer of the frame: room, picture, planes, contact shadows, avatars.

The room is the built-in background: a wooden floor at y = 0 and walls, as a mesh and three textures. Rule: mesh and
textures are computed from constants and a fixed seed, and the room always contains the camera.

Background bytes are copied unchanged, as sRGB; all other layers are blended over them in linear light. Only shadows are
blended on sRGB numbers, by a formula with the same result (`shadow.frag`). The planes come from the scene file; nothing
is detected here. A contact shadow is a disc under a joint, which grows and fades with the joint's height above the
floor.

A body fills about half of its rectangle, and a software driver takes as long for a transparent pixel as for any other.
Therefore the network's picture is drawn in bands of rows. Each band has only the columns from its first to its last
texel that is not transparent. A margin is added, because a screen pixel reads several texels.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import reduce
from typing import Any

import moderngl
import numpy as np
from numpy.typing import NDArray

from trilane.arrays import F32, F64, U8, Floats, Mask
from trilane.body.joints import JOINT_INDEX
from trilane.cache import cached_arrays
from trilane.scene.schema import PlaneSpec
from trilane.stages.gpu import opengl
from trilane.stages.gpu.opengl import build_program, counter_of, eye_of, target_clip, upload, uploaded_buffer

FLOOR_PERIOD_M = 2.4
FLOOR_SIDE = 1024
PLANKS = 16  # number across one period
PLANK_ROWS = 2  # number of plank lengths in one period
WALL_PERIOD_M = 2.0
WALL_TEXTURE_M = 4.0  # height of the wall that the texture covers; above it the paint repeats
WALL_SHAPE = (1024, 256)
SKIRTING_M = 0.11
SHADE_M = 0.1  # height above the skirting board within which its shade fades
MARGIN_M = 0.6
GRID = np.array([0, 0.04, 0.12, 0.5, 0.88, 0.96, 1])
SEED = 7
VERSION = "room textures 2"  # raise it when the textures change


@dataclass(frozen=True)
class Extent:
    """The inside of the room. `low`, `high`: opposite corners (x, y, z), metres; the floor is y = 0."""

    low: tuple[float, float, float] = (-4.0, 0.0, -4.0)
    high: tuple[float, float, float] = (4.0, 3.0, 4.0)

    def holding(self, eye: F64) -> Extent:
        """Return this room if it contains a camera; otherwise a larger room that does.

        Walls and ceiling are at least MARGIN_M from the camera. `eye`: position of the camera (3,), metres.
        """
        low = (min(self.low[0], eye[0] - MARGIN_M), self.low[1], min(self.low[2], eye[2] - MARGIN_M))
        high = tuple(max(side, float(at) + MARGIN_M) for side, at in zip(self.high, eye, strict=True))
        grown = Extent((float(low[0]), low[1], float(low[2])), (high[0], high[1], high[2]))
        return self if grown == self else grown


@dataclass(frozen=True)
class RoomMesh:
    """The mesh of the room.

    All triangles face inwards; they are indices of vertices (M,3) uint32.
    `vertices`: position (3), uv (2), light (3) of each vertex (N,8) float32.
    `floor`: triangles of the floor.
    `boards`: triangles of the walls with the skirting board and its shade.
    `paint`: triangles of the walls and the ceiling that are only painted.
    """

    vertices: F32
    floor: NDArray[np.uint32]
    boards: NDArray[np.uint32]
    paint: NDArray[np.uint32]


def room_mesh(extent: Extent) -> RoomMesh:
    """Return the mesh of a room. Its baked light is dim in corners and brighter towards the windows (-x, +z)."""
    low, high = np.array(extent.low), np.array(extent.high)
    sides = [_side(low, high, axis, end) for axis in (1, 0, 2) for end in (0, 1)]
    count = GRID.size**2
    floor, *others = ((_triangles(turned) + n * count).astype(np.uint32) for n, (_, turned) in enumerate(sides))
    vertices, rest = np.concatenate([vertices for vertices, _ in sides]).astype(np.float32), np.concatenate(others)
    has_board = vertices[rest, 1].min(axis=1) < SKIRTING_M + SHADE_M
    return RoomMesh(vertices, floor, rest[has_board], rest[~has_board])


def room_textures() -> tuple[U8, U8, U8]:
    """Return the textures of (floor, boards, paint), from the cache, because their noise takes long to compute."""
    made = {"floor": floor_texture, "boards": wall_texture, "paint": paint_texture}
    stored = cached_arrays(VERSION, (), lambda: {name: make() for name, make in made.items()})
    return stored["floor"], stored["boards"], stored["paint"]


def floor_texture() -> U8:
    """Return a texture of oak planks (1024,1024,4), uint8 sRGB, which repeats in both directions."""
    rng = np.random.default_rng(SEED)
    row, column = np.indices((FLOOR_SIDE, FLOOR_SIDE)) / FLOOR_SIDE
    plank = np.floor(column * PLANKS).astype(int)
    along = row * PLANK_ROWS + rng.random(PLANKS)[plank]
    length = np.floor(along).astype(int) % PLANK_ROWS
    tone = np.clip(rng.normal(0, 0.05, (PLANKS, PLANK_ROWS)), -0.09, 0.09)[plank, length]
    shift = rng.integers(0, FLOOR_SIDE, (PLANKS, PLANK_ROWS))[plank, length]
    grain = _noise(rng, (FLOOR_SIDE, FLOOR_SIDE), (2.0, 90.0))
    streak = grain[(np.indices(grain.shape)[0] + shift) % FLOOR_SIDE, np.indices(grain.shape)[1]]
    cross = np.abs((column * PLANKS) % 1 - 0.5) * 2
    end = np.abs(along % 1 - 0.5) * 2
    seam = np.clip((cross - 0.955) / 0.03, 0, 1) + np.clip((end - 0.995) / 0.003, 0, 1)
    value = (1 + tone + 0.05 * streak) * (1 - 0.42 * np.clip(seam, 0, 1))
    colour = np.array([176, 134, 96]) + np.array([7, 2, -3]) * (tone / 0.05)[..., None]
    return _bytes(colour * value[..., None])


def wall_texture() -> U8:
    """Return a texture of a painted wall with a skirting board (1024,256,4), uint8 sRGB; row 0 is at the floor."""
    height = (np.arange(WALL_SHAPE[0]) + 0.5) / WALL_SHAPE[0] * WALL_TEXTURE_M
    board = np.array([243, 241, 236]) * (1 - 0.25 * np.clip((height - SKIRTING_M + 0.012) / 0.012, 0, 1))[:, None]
    board[height < 0.012] *= 0.6
    is_board = (height < SKIRTING_M)[:, None, None]
    shade = 1 - 0.12 * np.exp(-np.clip(height - SKIRTING_M, 0, None) / 0.02)
    return _bytes(np.where(is_board, board[:, None, :], _paint() * shade[:, None, None]))


def paint_texture() -> U8:
    """Return a texture of the wall's paint (512,128,4), uint8 sRGB, which repeats in both directions.

    Half of the wall's resolution is enough, because the paint is so smooth that no texel shows.
    """
    rows, columns = WALL_SHAPE
    return _bytes(_paint().reshape(rows // 2, 2, columns // 2, 2, 3).mean(axis=(1, 3)))


def _paint() -> F64:
    noise = _noise(np.random.default_rng(SEED + 1), WALL_SHAPE, (12.0, 12.0))
    return np.asarray(np.array([218, 213, 201]) * (1 + 0.007 * noise)[..., None])


def _side(low: F64, high: F64, axis: int, end: int) -> tuple[F64, bool]:
    first, second = (k for k in range(3) if k != axis)
    place = np.empty((GRID.size, GRID.size, 3))
    place[..., axis] = (low, high)[end][axis]
    place[..., first] = (low[first] + GRID * (high - low)[first])[:, None]
    place[..., second] = (low[second] + GRID * (high - low)[second])[None, :]
    points = place.reshape(-1, 3)
    vertices = np.concatenate([points, _uv(points, axis, end), _light(points, low, high, axis)], axis=1)
    return vertices, (axis == 1) != bool(end)


def _uv(points: F64, axis: int, end: int) -> F64:
    if axis == 1 and end == 0:
        return np.asarray(points[:, [0, 2]] / FLOOR_PERIOD_M)
    if axis == 1:
        return np.full((len(points), 2), (0.3, 0.7))
    along = points[:, 2 - axis] / WALL_PERIOD_M
    return np.stack([along, points[:, 1] / WALL_TEXTURE_M], axis=1)


def _light(points: F64, low: F64, high: F64, axis: int) -> F64:
    dim = np.ones(len(points))
    for other in range(3):
        if other != axis:
            for distance in (points[:, other] - low[other], high[other] - points[:, other]):
                dim *= 1 - 0.26 * np.exp(-distance / 0.45)
    share = (points - low) / (high - low)
    window = 0.5 * (1 - share[:, 0]) + 0.5 * share[:, 2]
    strength = dim * (0.86 + 0.20 * window) * (1.0 if axis != 1 else 0.97)
    colour = np.array([1.0, 0.985, 0.955]) + window[:, None] * np.array([-0.02, 0.0, 0.035])
    return np.asarray(strength[:, None] * colour)


def _triangles(turned: bool) -> NDArray[np.int64]:
    number = np.arange(GRID.size**2).reshape(GRID.size, GRID.size)
    a, b, c, d = (part.ravel() for part in (number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:]))
    triangles = np.concatenate([np.stack([a, b, c], -1), np.stack([a, c, d], -1)])
    return triangles[:, ::-1] if turned else triangles


def _noise(rng: np.random.Generator, shape: tuple[int, int], length: tuple[float, float]) -> F64:
    """Return periodic noise of `shape` with mean 0 and standard deviation 1.

    `length`: correlation lengths in texels, horizontal and vertical.
    """
    frequency = [np.fft.fftfreq(n)[:, None] if k == 0 else np.fft.fftfreq(n)[None] for k, n in enumerate(shape)]
    spread = (frequency[0] * length[1]) ** 2 + (frequency[1] * length[0]) ** 2
    field = np.fft.ifft2(np.fft.fft2(rng.normal(size=shape)) * np.exp(-2 * np.pi**2 * spread / 4)).real
    return np.asarray((field - field.mean()) / field.std())


def _bytes(colour: F64) -> U8:
    pixels = np.full((*colour.shape[:2], 4), 255, np.uint8)
    pixels[..., :3] = np.clip(np.rint(colour), 0, 255)
    return pixels


BAND = 16  # rows of a band
WHOLE: F32 = np.array([[0, 0, 1, 1]], np.float32)


def spans(shown: Mask, margin: int) -> F32:
    """Return the parts of a picture to draw: left, top, right, bottom of each, as shares of its sides (N,4) float32.

    `shown`: mask of the pixels that are not transparent (h,w).
    `margin`: number of texels that a screen pixel reads on each side of its centre.
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


# (joint, radius in metres at height 0, strength at height 0, height in metres at which the strength has fallen to 1/e).
# `shadow.frag` takes strengths up to 0.72.
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
    """Return the contact shadows of a body: x, z, radius in metres, and strength 0 to 1 of each disc (N,4) float32.

    Discs that are not stronger than FAINTEST are left out.

    `joints`: skinning matrices (55,3,4), metres, world space.
    `rest`: rest joints (55,3), metres.
    """
    matrices = np.asarray(joints, np.float64)[_JOINT]
    place = np.einsum("nij,nj->ni", matrices[..., :3], rest[_JOINT]) + matrices[..., 3]
    height = np.maximum(place[:, 1], 0.0)
    strength = _STRENGTH * np.exp(-height / _FADE)
    discs = np.column_stack([place[:, 0], place[:, 2], _RADIUS + WIDENING * height, strength])
    return np.asarray(discs[strength > FAINTEST], np.float32)


MAX_TAPS = 8
#: Least number of screen pixels of an avatar for which finding transparent texels takes less time than it saves.
WORTH_CUTTING_PX = 60_000
HALF_TEXEL_INWARD = np.array([0.5, 0.5, -0.5, -0.5])
UNDER_THE_FLOOR = (70, 66, 60)


class RoomPainter:
    """Draws the built-in room. If a camera leaves the room, the room is made larger."""

    def __init__(self, ctx: Any, eyes: Sequence[Floats] = ()) -> None:
        """Make the room. `eyes`: camera positions (3,), metres, that the room contains from the beginning."""
        self._ctx = ctx
        self._program = build_program(ctx, "room.vert", "room.frag")
        floor, boards, paint = room_textures()
        self._textures = [
            _detail(ctx, floor, moderngl.LINEAR_MIPMAP_LINEAR, moderngl.LINEAR),
            # The boards are so smooth that no change of levels shows, and the paint so smooth that no texel shows.
            _detail(ctx, boards, moderngl.LINEAR_MIPMAP_NEAREST, moderngl.LINEAR),
            _detail(ctx, paint, moderngl.NEAREST, moderngl.NEAREST),
        ]
        self._extent = reduce(Extent.holding, (np.asarray(eye, np.float64) for eye in eyes), Extent())
        self._batches: list[Any] = []
        self._buffers: list[Any] = []
        self._build()

    def draw(self, target: Any, view: Floats, projection: Floats) -> None:
        """Fill `target` with the room; a camera below the floor does not see the floor.

        `view`, `projection`: OpenGL matrices (4,4).
        """
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
        for old in (*self._batches, *self._buffers):
            old.release()
        vertices = uploaded_buffer(self._ctx, mesh.vertices.tobytes())
        content = [(vertices, "3f 2f 3f", "position", "uv", "light")]
        parts = (mesh.floor, mesh.boards, mesh.paint)
        indices = [uploaded_buffer(self._ctx, part.tobytes()) for part in parts]
        self._batches = [self._ctx.vertex_array(self._program, content, index) for index in indices]
        self._buffers = [vertices, *indices]


class PicturePainter:
    """Draws a background picture. `shape`: (height, width) of the picture and of the target."""

    def __init__(self, ctx: Any, shape: tuple[int, int]) -> None:
        self._ctx = ctx
        self._program = build_program(ctx, "whole_screen.vert", "picture.frag")
        self._screen = ctx.vertex_array(self._program, [])
        self._texture = ctx.texture(shape[::-1], 3, alignment=1)

    def upload(self, picture: U8) -> None:
        """Write `picture` (h,w,3) uint8 to the GPU; `draw` draws it from now on."""
        upload(self._ctx, self._texture, picture, alignment=1)

    def draw(self) -> None:
        """Copy the picture to the current target."""
        self._ctx.enable_only(moderngl.NOTHING)
        self._texture.use(0)
        self._screen.render(vertices=3)


class ShadowPainter:
    """Draws contact shadows, soft discs on the floor. `blobs`: largest number of discs."""

    def __init__(self, ctx: Any, blobs: int) -> None:
        self._ctx, self._count = ctx, blobs
        self._program = build_program(ctx, "shadow.vert", "shadow.frag", BLOBS=blobs)
        self._discs = ctx.vertex_array(self._program, [])

    def draw(self, view: Floats, projection: Floats, blobs: F32) -> None:
        """Darken the current target with discs, which a camera below the floor does not see.

        `view`, `projection`: OpenGL matrices (4,4).
        `blobs`: x, z, radius in metres, and strength 0 to 0.72 of each disc (N,4) float32.
        """
        if not len(blobs) or eye_of(view)[1] <= 0:
            return
        self._ctx.enable_only(moderngl.BLEND)
        self._ctx.blend_func = moderngl.ONE, moderngl.SRC_ALPHA
        self._ctx.blend_equation = moderngl.FUNC_REVERSE_SUBTRACT
        upload(self._ctx, self._program["clip_from_world"], target_clip(view, projection))
        padded = np.zeros((self._count, 4), np.float32)
        padded[: len(blobs)] = blobs
        upload(self._ctx, self._program["blob"], padded)
        self._discs.render(vertices=6 * len(blobs))
        self._ctx.blend_equation = moderngl.FUNC_ADD


class AvatarPainter:
    """Draws the parts of a network's picture into the avatars' crop rectangles. The picture is uploaded once a frame.

    `shapes`: shapes (height, width) of the pictures that may come.
    """

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
        """Write a picture to the GPU.

        `shape`: (height, width) of the picture.
        `image`: its bytes (h * w * 4,) uint8, sRGB with straight alpha.
        """
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
        `shape`: (height, width) of the uploaded picture.
        `rect`: crop rectangle of the avatar, x0, y0, x1, y1 in NDC.
        `tensor_rect`: the avatar's part of the picture: top, left, height, width in pixels.
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
    """Return the number of reads along a side that are averaged for a screen pixel, 1 to MAX_TAPS.

    `cell`: (height, width) of the part of the picture that is drawn.
    `pixels`: (height, width) on the screen.
    """
    return int(np.clip(np.ceil(_density(cell, pixels) - 0.25), 1, MAX_TAPS))


def _density(cell: tuple[int, int], pixels: tuple[float, float]) -> float:
    return max(side / max(length, 1e-6) for side, length in zip(cell, pixels, strict=True))


def _detail(ctx: Any, image: U8, minify: int, magnify: int) -> Any:
    texture = ctx.texture((image.shape[1], image.shape[0]), 4, image.tobytes())
    texture.build_mipmaps()
    texture.filter = (minify, magnify)
    return texture


UPRIGHT = 0.9  # a plane whose unit normal has a larger |y| is aligned with the world's x axis, others with its y axis


class PlanePainter:
    """Draws planes into the current target. `planes`: at least one."""

    def __init__(self, ctx: Any, planes: Sequence[PlaneSpec]) -> None:
        self._ctx, self._count = ctx, len(planes)
        self._program = build_program(ctx, "plane.vert", "plane.frag", PLANES=len(planes))
        self._sheets = ctx.vertex_array(self._program, [])
        sides = [half_sides(plane) for plane in planes]
        self._program["centre"].write(np.array([plane.centre for plane in planes], np.float32))
        self._program["across"].write(np.array([across for across, _ in sides], np.float32))
        self._program["along"].write(np.array([along for _, along in sides], np.float32))

    def draw(self, view: Floats, projection: Floats) -> None:
        """Blend the planes over the current target. `view`, `projection`: OpenGL matrices (4,4)."""
        self._ctx.enable_only(moderngl.BLEND)
        self._ctx.blend_func = moderngl.SRC_ALPHA, moderngl.ONE_MINUS_SRC_ALPHA
        upload(self._ctx, self._program["clip_from_world"], target_clip(view, projection))
        with opengl.srgb_target():
            self._sheets.render(vertices=6 * self._count)


def half_sides(plane: PlaneSpec) -> tuple[F32, F32]:
    """Return the two half sides of `plane` as vectors (3,), metres: half its width, and half its depth.

    The vectors are at right angles to each other and to the plane's normal.
    """
    normal = np.asarray(plane.normal, np.float64) / np.linalg.norm(plane.normal)
    towards = np.array([1.0, 0.0, 0.0]) if abs(normal[1]) > UPRIGHT else np.array([0.0, 1.0, 0.0])
    along = np.cross(normal, towards)
    along /= np.linalg.norm(along)
    across = np.cross(along, normal)
    turn = np.radians(plane.turn_deg)
    across, along = np.cos(turn) * across + np.sin(turn) * along, np.cos(turn) * along - np.sin(turn) * across
    return (plane.width_m / 2 * across).astype(np.float32), (plane.depth_m / 2 * along).astype(np.float32)
