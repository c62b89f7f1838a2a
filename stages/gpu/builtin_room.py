"""The built-in background: a room with a wooden floor at y = 0, as a mesh and two textures.

Rule: mesh and textures are computed from constants and a fixed seed, and the room always holds the camera.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from trilane.arrays import F32, F64, U8
from trilane.cache import cached_arrays

FLOOR_PERIOD_M = 2.4
FLOOR_SIDE = 1024
PLANKS = 16  # number across one period
PLANK_ROWS = 2  # number of plank lengths in one period
WALL_PERIOD_M = 2.0
WALL_TEXTURE_M = 4.0  # height that the wall texture spans; the paint goes on above it
WALL_SHAPE = (1024, 256)
SKIRTING_M = 0.11
SHADE_M = 0.1  # height above the skirting board in which its shade fades
MARGIN_M = 0.6
GRID = np.array([0, 0.04, 0.12, 0.5, 0.88, 0.96, 1])
SEED = 7
VERSION = "room textures 2"  # raise it when the textures change


@dataclass(frozen=True)
class Extent:
    """Inside of the room in metres.

    `low`, `high`: corners (x, y, z). The floor is y = 0.
    """

    low: tuple[float, float, float] = (-4.0, 0.0, -4.0)
    high: tuple[float, float, float] = (4.0, 3.0, 4.0)

    def holding(self, eye: F64) -> Extent:
        """Return this room, or a larger one that holds the camera position `eye` (3,).

        Walls and ceiling are then at least MARGIN_M beyond it.
        """
        low = (min(self.low[0], eye[0] - MARGIN_M), self.low[1], min(self.low[2], eye[2] - MARGIN_M))
        high = tuple(max(side, float(at) + MARGIN_M) for side, at in zip(self.high, eye, strict=True))
        grown = Extent((float(low[0]), low[1], float(low[2])), (high[0], high[1], high[2]))
        return self if grown == self else grown


@dataclass(frozen=True)
class RoomMesh:
    """The mesh of the room.

    `vertices` (N,8) float32: position, uv, light. `floor`, `boards` and `paint` (M,3) uint32: triangles facing inwards.
    `boards` are the parts of the walls with the skirting board and its shade; `paint` is all that is only painted.
    """

    vertices: F32
    floor: NDArray[np.uint32]
    boards: NDArray[np.uint32]
    paint: NDArray[np.uint32]


def room_mesh(extent: Extent) -> RoomMesh:
    """Return the six sides of `extent`, light baked per vertex: dim corners, brighter towards the windows (-x, +z)."""
    low, high = np.array(extent.low), np.array(extent.high)
    sides = [_side(low, high, axis, end) for axis in (1, 0, 2) for end in (0, 1)]
    count = GRID.size**2
    floor, *others = ((_triangles(turned) + n * count).astype(np.uint32) for n, (_, turned) in enumerate(sides))
    vertices, rest = np.concatenate([vertices for vertices, _ in sides]).astype(np.float32), np.concatenate(others)
    has_board = vertices[rest, 1].min(axis=1) < SKIRTING_M + SHADE_M
    return RoomMesh(vertices, floor, rest[has_board], rest[~has_board])


def room_textures() -> tuple[U8, U8, U8]:
    """Return the textures of floor, boards and paint.

    They are cached, because their noise takes a good part of a second.
    """
    made = {"floor": floor_texture, "boards": wall_texture, "paint": paint_texture}
    stored = cached_arrays(VERSION, (), lambda: {name: make() for name, make in made.items()})
    return stored["floor"], stored["boards"], stored["paint"]


def floor_texture() -> U8:
    """Return planks of oak, (1024, 1024, 4) uint8 sRGB, repeating in both directions."""
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
    """Return a painted wall with a skirting board, (1024, 256, 4) uint8 sRGB; row 0 is the floor, u repeats."""
    height = (np.arange(WALL_SHAPE[0]) + 0.5) / WALL_SHAPE[0] * WALL_TEXTURE_M
    board = np.array([243, 241, 236]) * (1 - 0.25 * np.clip((height - SKIRTING_M + 0.012) / 0.012, 0, 1))[:, None]
    board[height < 0.012] *= 0.6
    is_board = (height < SKIRTING_M)[:, None, None]
    shade = 1 - 0.12 * np.exp(-np.clip(height - SKIRTING_M, 0, None) / 0.02)
    return _bytes(np.where(is_board, board[:, None, :], _paint() * shade[:, None, None]))


def paint_texture() -> U8:
    """Return the wall's paint alone, (512, 128, 4) uint8 sRGB, repeating in both directions.

    Half of the wall's resolution is enough for paint that is read texel by texel.
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
    """Return periodic noise of mean 0 and deviation 1.

    `length`: Gaussian correlation lengths, across columns and rows.
    """
    frequency = [np.fft.fftfreq(n)[:, None] if k == 0 else np.fft.fftfreq(n)[None] for k, n in enumerate(shape)]
    spread = (frequency[0] * length[1]) ** 2 + (frequency[1] * length[0]) ** 2
    field = np.fft.ifft2(np.fft.fft2(rng.normal(size=shape)) * np.exp(-2 * np.pi**2 * spread / 4)).real
    return np.asarray((field - field.mean()) / field.std())


def _bytes(colour: F64) -> U8:
    pixels = np.full((*colour.shape[:2], 4), 255, np.uint8)
    pixels[..., :3] = np.clip(np.rint(colour), 0, 255)
    return pixels
