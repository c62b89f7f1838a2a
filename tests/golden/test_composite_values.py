"""The composite's painters on targets of a few pixels: every pixel against the formula in float64 NumPy.

Rule: bytes are one off at most, what a driver's own rounding of sRGB may do; two where two layers are blended.
"""

from __future__ import annotations

from typing import Any

import moderngl
import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from support.small_pipeline import packet, without_bytes
from trilane.arrays import F64, U8
from trilane.bench.lib import float_raster
from trilane.scene.crop import Rect, lay_out_at
from trilane.scene.schema import PlaneSpec
from trilane.stages.gpu import composite, composite_painters, opengl
from trilane.stages.gpu.composite import CompositeStage
from trilane.stages.gpu.composite_painters import (
    AvatarPainter,
    Extent,
    PicturePainter,
    PlanePainter,
    RoomPainter,
    ShadowPainter,
    half_sides,
    room_mesh,
)

SHAPE = (20, 27)
EYE = np.eye(4)
STILL = np.tile(np.eye(3, 4), (55, 1, 1))


def linear(code: Any) -> F64:
    """sRGB bytes to linear light 0..1, IEC 61966-2-1."""
    share = np.asarray(code, float) / 255
    return np.where(share <= 0.04045, share / 12.92, ((share + 0.055) / 1.055) ** 2.4)


def code(light: F64) -> F64:
    """Linear light 0..1 to sRGB, 0..255, not rounded."""
    light = np.clip(light, 0, 1)
    return 255 * np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)


def noise(shape: tuple[int, int], channels: int = 3, seed: int = 0) -> U8:
    return np.random.default_rng(seed).integers(0, 256, (*shape, channels), dtype=np.uint8)


class Canvas:
    """An sRGB target of `shape` that shows `picture`, as the composite stage's does."""

    def __init__(self, gl: Any, picture: U8) -> None:
        self.shape = picture.shape[:2]
        texture = gl.texture(self.shape[::-1], 4, internal_format=opengl.SRGB8_ALPHA8)
        self.target = gl.framebuffer([texture])
        self.target.use()
        painter = PicturePainter(gl, self.shape)
        painter.upload(picture)
        painter.draw()

    def read(self) -> NDArray[np.int64]:
        rows = np.frombuffer(self.target.read(components=3, alignment=1), np.uint8)
        return rows.reshape(*self.shape, 3).astype(np.int64)


def ndc(shape: tuple[int, int]) -> tuple[F64, F64]:
    """Normalised device coordinates of every pixel, y up: row 0 is the top one."""
    row, column = (np.indices(shape) + 0.5) / np.array(shape)[:, None, None]
    return 2 * column - 1, 1 - 2 * row


def floor_hit(view: F64, projection: F64, shape: tuple[int, int]) -> tuple[F64, F64]:
    """x and z where the ray of each pixel meets y = 0; NaN where it does not, in front of the camera."""
    x, y = ndc(shape)
    back = np.linalg.inv(projection @ view)
    near, far = (np.stack([x, y, np.full_like(x, z), np.ones_like(x)], axis=-1) @ back.T for z in (-1, 1))
    near, far = near[..., :3] / near[..., 3:], far[..., :3] / far[..., 3:]
    share = near[..., 1] / (near[..., 1] - far[..., 1])
    place = near + np.where((share > 0) & (share < 1), share, np.nan)[..., None] * (far - near)
    return place[..., 0], place[..., 2]


def test_a_picture_is_copied_to_the_byte_and_replaced(gl: Any) -> None:
    first, second = noise((7, 5)), noise((7, 5), seed=1)
    assert np.array_equal(Canvas(gl, first).read(), first)
    canvas, painter = Canvas(gl, first), PicturePainter(gl, (7, 5))
    painter.upload(second)
    canvas.target.use()
    painter.draw()
    assert np.array_equal(canvas.read(), second)


def test_shadows_take_light_away_where_the_discs_lie(gl: Any, camera: Any) -> None:
    """Light times 1 - strength (1 - r²)², one disc after the other; a place that is not used draws none."""
    picture, discs = noise(SHAPE), np.array([(0.3, -0.2, 1.1, 0.7), (-0.5, 0.4, 0.9, 0.45)], np.float32)
    view, projection = camera((0.3, 2.1, 1.8), (0, 0, 0), 60, SHAPE[1] / SHAPE[0])
    canvas = Canvas(gl, picture)
    ShadowPainter(gl, 3).draw(view, projection, discs)
    x, z = floor_hit(view, projection, SHAPE)
    light = linear(picture)
    for at_x, at_z, radius, strength in discs.astype(float):
        left = np.maximum(1 - ((x - at_x) ** 2 + (z - at_z) ** 2) / radius**2, 0)
        light = light * (1 - strength * np.nan_to_num(left) ** 2)[..., None]
    assert np.abs(canvas.read() - code(light)).max() <= 2
    assert (np.abs(code(light) - picture).max(axis=-1) > 20).sum() > 50


@pytest.mark.parametrize(("height", "count"), [(-0.5, 1), (0.0, 1), (2.0, 0)])
def test_no_shadow_from_below_and_without_discs(gl: Any, camera: Any, height: float, count: int) -> None:
    picture, disc = noise(SHAPE), np.array([(0.0, 0, 5, 1)], np.float32)
    canvas = Canvas(gl, picture)
    ShadowPainter(gl, 1).draw(*camera((0.1, height, 2), (0, 2 * height - 0.5, 0), 90), disc[:count])
    assert np.array_equal(canvas.read(), picture)


PLACES = {
    "enlarged": (-0.83, -0.71, 0.9, 0.88),
    "as it is": (-0.501, -0.403, 0.499, 0.602),
    "a little smaller": (-0.41, -0.33, 0.39, 0.5),
    "half": (-0.2, -0.3, 0.3, 0.27),
    "a fifth, over an edge": (-1.07, 0.9, -0.87, 1.1),
    "a tenth": (0.2, 0.2, 0.3, 0.31),
}


@pytest.mark.parametrize("name", PLACES)
def test_an_avatar_is_blended_at_its_rectangle(gl: Any, name: str) -> None:
    """Premultiplied in linear light, averaged over the pixel, read no further than its own part, then blended.

    So many reads a side as texels lie under a pixel, a quarter of one more or less; from 1 to 8.
    """
    shape, part, rect = (18, 26), (3, 5, 10, 14), np.array(PLACES[name])
    picture, image = noise(SHAPE), noise(shape, 4, seed=2)
    canvas, painter = Canvas(gl, picture), AvatarPainter(gl, [shape, (4, 4)])
    painter.upload(shape, image.reshape(-1))
    painter.draw(canvas.target, shape, tuple(rect), part)
    top, left, height, width = part
    pixels = (rect[2:] - rect[:2]) / 2 * SHAPE[::-1]
    ratio = max(width / pixels[0], height / pixels[1])
    taps = next(n for n in range(1, 9) if ratio - 0.25 <= n or n == 8)
    alpha = image[..., 3:] / 255
    texels = np.concatenate([linear(image[..., :3]) * alpha, alpha], axis=-1)
    x, y = ndc(SHAPE)
    column = left + width * (x - rect[0]) / (rect[2] - rect[0])
    row = top + height * (rect[3] - y) / (rect[3] - rect[1])
    inside = (column > left) & (column < left + width) & (row > top) & (row < top + height)
    shown = np.zeros((*SHAPE, 4))
    for down in ((np.arange(taps) + 0.5) / taps - 0.5) * height / pixels[1]:
        for right in ((np.arange(taps) + 0.5) / taps - 0.5) * width / pixels[0]:
            u = np.clip(column + right, left + 0.5, left + width - 0.5) / shape[1]
            v = np.clip(row + down, top + 0.5, top + height - 0.5) / shape[0]
            shown += float_raster.sample(texels, np.stack([u, v], axis=-1)) / taps**2
    light = shown[..., :3] + (1 - shown[..., 3:]) * linear(picture)
    expected = np.where(inside[..., None], code(light), picture)
    assert inside.any()
    assert np.abs(canvas.read() - expected).max() <= 1.5  # FP16 keeps 0.05 % of the light: less than half a code


def test_a_tensor_of_the_pictures_density_is_copied_pixel_by_pixel(gl: Any) -> None:
    """An opaque picture of 12x8 at a rectangle of the planner in a frame of 20x27: no pixel is resampled."""
    shape = (12, 8)
    mesh = Rect(-0.3, -0.4, 0.1, 0.5)
    dense = lay_out_at([mesh], SHAPE, shape)
    assert dense is not None
    assert dense.density == 1.0
    ((rect, cell),) = dense.layout.crops
    image = noise(shape, 4, seed=5)
    image[..., 3] = 255
    picture = noise(SHAPE)
    canvas, painter = Canvas(gl, picture), AvatarPainter(gl, [shape])
    painter.upload(shape, image.reshape(-1))
    painter.draw(canvas.target, shape, tuple(rect), cell)
    left, top = round((rect.x0 + 1) / 2 * SHAPE[1]), round((1 - rect.y1) / 2 * SHAPE[0])
    expected = picture.astype(int)
    expected[top : top + 12, left : left + 8] = image[..., :3]
    assert np.abs(canvas.read().astype(int) - expected).max() <= 1  # FP16 in linear light, to a byte and back


@pytest.mark.parametrize("eye", [(0.5, 1.4, 2.5), (6.5, 3.4, -1.0)], ids=["inside", "where it must grow"])
def test_the_room_is_texture_times_light(gl: Any, camera: Any, monkeypatch: pytest.MonkeyPatch, eye: Any) -> None:
    """With textures of one colour each, a pixel is that colour times the light of its vertices, as float64 draws it."""
    colours = np.array([(100, 150, 200), (210, 120, 60), (130, 220, 90)])
    textures = [np.tile(np.append(c, 255).astype(np.uint8), (4, 4, 1)) for c in colours]
    monkeypatch.setattr(composite_painters, "room_textures", lambda: tuple(textures))
    shape = (48, 64)
    view, projection = camera(eye, (-0.8, 0.9, -0.5), 85, shape[1] / shape[0])
    canvas, painter = Canvas(gl, noise(shape)), RoomPainter(gl)
    painter.draw(canvas.target, view, projection)
    mesh = room_mesh(Extent().holding(np.array(eye)))
    position, light = mesh.vertices[:, :3].astype(float), mesh.vertices[:, 5:].astype(float)
    triangles = np.concatenate([mesh.floor, mesh.boards, mesh.paint])
    first, second = (
        float_raster.rasterise(position, triangles, pair, projection @ view, shape, cull=True)
        for pair in (light[:, :2], light[:, 1:])
    )
    lit = np.concatenate([first.uv[..., :1], second.uv], axis=-1)
    part = np.repeat([0, 1, 2], [len(mesh.floor), len(mesh.boards), len(mesh.paint)])[first.triangle]
    expected = colours[part] * lit
    off = np.abs(canvas.read() - np.clip(expected, 0, 255)).max(axis=-1)
    assert {0, 1, 2} == set(part.ravel().tolist())
    assert first.coverage.all()
    assert (off > 1).sum() <= 0.01 * off.size  # pixels on an edge of the room may fall to the other side
    assert lit.min() < 0.7 and (expected > 255).sum() == 0


def test_from_below_the_floor_is_not_drawn(gl: Any, camera: Any) -> None:
    canvas = Canvas(gl, noise(SHAPE))
    RoomPainter(gl).draw(canvas.target, *camera((0.2, -1.0, 0.1), (0, -3, 0.0), 60))
    assert (canvas.read() == (70, 66, 60)).all()


def test_a_room_that_held_its_cameras_is_the_same_from_the_start(gl: Any, camera: Any) -> None:
    view, projection = camera((6.5, 3.4, -1.0), (0, 1, 0), 70)
    views = camera((0, 1, 3.0), (0, 1, 0), 70)
    told, grown, small = (Canvas(gl, noise(SHAPE)) for _ in range(3))
    RoomPainter(gl, [np.array([6.5, 3.4, -1.0])]).draw(told.target, *views)
    painter = RoomPainter(gl)
    painter.draw(small.target, *views)
    painter.draw(grown.target, view, projection)
    painter.draw(grown.target, *views)
    assert np.array_equal(told.read(), grown.read())
    assert not np.array_equal(told.read(), small.read())


def test_a_room_that_grows_keeps_no_old_buffer(gl: Any, camera: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    made: list[Any] = []
    upload = composite_painters.uploaded_buffer
    monkeypatch.setattr(composite_painters, "uploaded_buffer", lambda *what: made.append(upload(*what)) or made[-1])
    painter = RoomPainter(gl)
    painter.draw(Canvas(gl, noise(SHAPE)).target, *camera((6.5, 3.4, -1.0), (0, 1, 0), 70))
    is_released = [isinstance(buffer.mglo, moderngl.InvalidObject) for buffer in made]
    assert is_released == [True] * 4 + [False] * 4


def test_planes_are_blended_white_in_linear_light_inside_their_sides(gl: Any) -> None:
    """Two planes upright before the camera: their outline is that of the sides, a tenth of the light between lines."""
    shape = (80, 100)
    picture = np.full((*shape, 3), 90, np.uint8)
    planes = [
        PlaneSpec(centre=(-0.5, 0.1, 0), normal=(0, 0, 1), width_m=0.9, depth_m=0.6, turn_deg=20),
        PlaneSpec(centre=(0.62, -0.4, 0), normal=(0, 0, 1), width_m=0.4, depth_m=0.5),
    ]
    canvas = Canvas(gl, picture)
    PlanePainter(gl, planes).draw(EYE, np.diag([1.0, 1, -1, 1]))
    found = canvas.read()
    x, y = ndc(shape)
    expected = np.zeros(shape, int)
    for plane in planes:
        across, along = half_sides(plane)
        place = np.stack([x - plane.centre[0], y - plane.centre[1]], axis=-1)
        a, b = (np.abs(place @ side[:2]) / (side @ side) for side in (across, along))
        border = np.minimum(np.abs(a - 1), np.abs(b - 1)) < 0.02
        expected += np.where(border & (np.maximum(a, b) < 1.1), 100, (a < 1) & (b < 1))
        sides = [place @ side[:2] / np.linalg.norm(side) for side in (across, along)]
        apart = [np.abs(np.abs((side / 0.25) % 1 - 0.5) - 0.5) * 0.25 for side in sides]
        rims = [np.linalg.norm(side) - np.abs(at) for at, side in zip(sides, (across, along), strict=True)]
        bare = (np.minimum(*apart) > 0.05) & (np.minimum(*rims) > 0.05)
        assert bare.sum() > 30
        assert np.abs(found[bare] - code(0.9 * linear(90) + 0.1)).max() <= 1
        rim = (np.abs(np.minimum(*rims)) < 0.002) & (np.maximum(a, b) < 1)
        assert rim.any()
        assert np.abs(found[rim] - code(0.55 * linear(90) + 0.45)).max() <= 10  # the line falls 4.4 % over 0.002 m
    sure = expected < 100
    assert sure.mean() > 0.9
    assert np.array_equal((found != 90).any(axis=-1)[sure], expected[sure] > 0)


@pytest.mark.parametrize("shape", [(80, 250), (40, 100)], ids=["whole", "a part"])
def test_the_display_is_blended_at_its_corner(gl: Any, shape: tuple[int, int], monkeypatch: pytest.MonkeyPatch) -> None:
    """Bytes, not light: alpha over the picture, 8 pixels from the left and from below; the viewport is put back."""
    monkeypatch.setattr(composite.time, "monotonic_ns", lambda: 5_000_000_000)
    pose = packet(0).header
    pose["frame"], pose["tensor_shape"] = 3, (64, 32)
    picture = noise(shape)
    canvas = Canvas(gl, picture)
    composite.Hud(gl).draw(canvas.target, pose)
    lines = ["frame 3   0.00 s", "- fps   5000 ms from pose", "tensor 64x32   0 in view"]
    display = composite.hud_picture(lines, ImageFont.load_default(15)).astype(float)
    expected, bottom = picture.astype(float), shape[0] - 8
    rows, columns = slice(max(bottom - 62, 0), bottom), slice(8, min(8 + 232, shape[1]))
    part = display[62 - (rows.stop - rows.start) :, : columns.stop - columns.start]
    share = part[..., 3:] / 255
    expected[rows, columns] = share * part[..., :3] + (1 - share) * expected[rows, columns]
    assert np.abs(canvas.read() - expected).max() <= 1
    assert np.array_equal(canvas.read()[:, :8], picture[:, :8])
    assert canvas.target.viewport == (0, 0, shape[1], shape[0])
    sheet = Image.new("RGBA", (232, 62), (0, 0, 0, 150))
    text, font = "\n".join(lines), ImageFont.load_default(15)
    ImageDraw.Draw(sheet).multiline_text((8, 3), text, (255, 255, 255, 255), font, spacing=3)
    assert np.array_equal(display, np.asarray(sheet))
    assert display[..., :3].max() == 255 and display.shape == (62, 232, 4)


def test_the_display_renews_rate_and_age_four_times_a_second(gl: Any) -> None:
    """Frames every 100 ms, each 30 ms old: the line changes with the frames at 0, 300 and 600 ms."""
    display, pose = composite.Hud(gl), packet(0).header
    seen = []
    for frame in range(7):
        now = 10_000_000_000 + frame * 100_000_000
        pose["frame"], pose["t_sampled_ns"] = frame + 5, now - (30 + frame) * 1_000_000
        seen.append(display._lines(pose, now)[1])
    first, second, third = "- fps   30 ms from pose", "10.0 fps   33 ms from pose", "10.0 fps   36 ms from pose"
    assert seen == [first] * 3 + [second] * 3 + [third]
    pose["frame"] = 11
    assert display._lines(pose, now + 50_000_000)[1] == "- fps   86 ms from pose"
    now = 20_000_000_000
    for frame in range(100):  # a slow start is forgotten after 60 frames
        now += 500_000_000 if frame < 40 else 250_000_000
        pose["frame"] = 12 + frame
        line = display._lines(pose, now)[1]
    assert line.startswith("4.0 fps")


class Film:
    """A background that shows grey for what it is asked, and nothing new after 2 s."""

    def __init__(self) -> None:
        self.asked: list[float] = []
        self.closed = False

    def at(self, time_s: float) -> U8 | None:
        self.asked.append(time_s)
        return np.full((*SHAPE, 3), int(time_s * 100), np.uint8) if time_s <= 2 else None

    def close(self) -> None:
        self.closed = True


def two_avatars(nearer: int) -> NDArray[np.void]:
    """Two visible avatars at one place of the screen, red and blue; `nearer` is the one near the camera at +z."""
    pose = packet(0, 3).header
    pose["avatar_count"], pose["tensor_shape"], pose["media_time_s"] = 2, (8, 16), 0.9
    pose["view"], pose["projection"] = EYE, EYE
    for number in range(3):
        avatar = pose["avatars"][number]
        avatar["avatar"], avatar["visible"], avatar["rect"] = number, 1, (-0.5, -0.5, 0.5, 0.5)
        avatar["tensor_rect"] = (0, 8 * (number % 2), 8, 8)
        avatar["joints"] = STILL
        avatar["joints"][:, 2, 3] = -1.0 if number == nearer else -2.0
        avatar["joints"][:, 1, 3] = 50.0  # too high for shadows
    return pose


def halves() -> U8:
    """The network's picture for two avatars: red, and blue beside it, opaque."""
    image = np.zeros((8, 16, 4), np.uint8)
    image[:, :8], image[:, 8:] = (255, 0, 0, 255), (0, 0, 255, 255)
    return np.concatenate([image.reshape(-1), np.full(100, 77, np.uint8)])


def stage(gl: Any, **options: Any) -> CompositeStage:
    return CompositeStage(gl, SHAPE, [(8, 16), (16, 8)], [np.zeros((55, 3))] * 3, Film(), **options)


def frame_of(made: CompositeStage, pose: NDArray[np.void], image: U8) -> NDArray[np.int64]:
    """The frame that the stage writes for a packet."""
    source, target = packet(image.size, 3), packet(math_prod(SHAPE) + 5)
    source.header[...] = pose
    source.payload[:] = image
    made.bind([source], [target])
    assert set(without_bytes(made.run(0, 0, 0)).values()) == {0.0}
    assert not target.payload[math_prod(SHAPE) :].any()
    return target.payload[: math_prod(SHAPE)].reshape(*SHAPE, 3).astype(np.int64)


def math_prod(shape: tuple[int, int]) -> int:
    return shape[0] * shape[1] * 3


@pytest.mark.parametrize("nearer", [0, 1])
def test_the_nearer_avatar_hides_the_farther(gl: Any, nearer: int) -> None:
    """In whatever order they come; a third in the packet, past its count, is not drawn."""
    frame = frame_of(stage(gl), two_avatars(nearer), halves())
    x, y = ndc(SHAPE)
    inside = (np.abs(x) < 0.5) & (np.abs(y) < 0.5)
    assert (frame[inside] == ((255, 0, 0), (0, 0, 255))[nearer]).all()
    assert (frame[~inside] == 90).all()


def test_an_avatar_that_is_not_visible_leaves_no_trace(gl: Any) -> None:
    pose = two_avatars(0)
    pose["avatars"]["visible"][0] = 0
    assert (frame_of(stage(gl), pose, halves())[SHAPE[0] // 2, SHAPE[1] // 2] == (0, 0, 255)).all()
    pose["avatars"]["visible"][1] = 0
    made = stage(gl)
    assert (frame_of(made, pose, halves()) == 90).all()
    pose["media_time_s"] = 2.5  # nothing new: the last picture stays
    assert (frame_of(made, pose, halves()) == 90).all()
    assert made._background.asked == pytest.approx([0.9, 2.5])
    made.close()
    assert made._background.closed


def test_the_frame_after_a_change_of_size_shows_nothing_of_the_old_picture(gl: Any) -> None:
    """From twice the pixels to fewer and back, frame by frame: each frame is that of a stage which knew no other."""
    large, small = two_avatars(0), two_avatars(0)
    large["tensor_shape"], large["avatars"]["tensor_rect"] = (16, 8), (0, 0, 16, 8)
    sizes = [(large, noise((16, 8), 4, seed=3)), (small, noise((8, 16), 4, seed=4))]
    made = stage(gl)
    for number in range(6):
        pose, image = (each.copy() for each in sizes[number % 2])
        pose["picture"], pose["media_time_s"] = number, 0.9 + number / 30
        frame = frame_of(made, pose, image.reshape(-1))
        assert np.array_equal(frame, frame_of(stage(gl), pose, image.reshape(-1)))
