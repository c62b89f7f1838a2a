"""A marker at a known place, photographed by each camera format, is where the drawn one is, whatever the cut.

Rule: the photo is painted by K [R | t] written out, as the format defines it; what is drawn there is a detected plane.
The centre of the one and that of the other lie within a pixel of the composed picture.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from PIL import ExifTags, Image

from support.camera_files import LENS, WRITERS, Writer, write_nerf
from trilane.arrays import F64, U8, Shape
from trilane.scene.camera.files import load_camera
from trilane.scene.footage import filmed
from trilane.scene.schema import CameraSpec, PlaneSpec
from trilane.stages.config import pose_dtype
from trilane.stages.gpu.background import open_background, survey
from trilane.stages.gpu.composite import CompositeStage

#: Of the camera in a world with Y up: x right, y down, z ahead (optical), and where it stands.
YAW, PITCH = 0.3, 0.12
PLACE = np.array([0.4, 1.5, 2.0])
MARK_M, DISC_PX = 0.12, 14.0
#: As the photos, which are half as large as those of the devices.
OUTPUTS = {"of 4:3": (240, 320), "upright": (320, 240), "810 of 1920 rows": (405, 540), "a strip": (64, 320)}


def optical_axes(roll: int = 0) -> F64:
    """Columns right, down, ahead of the camera, which is then turned clockwise about its line of sight by quarters."""
    c, s, cp, sp = math.cos(YAW), math.sin(YAW), math.cos(PITCH), math.sin(PITCH)
    ahead = np.array([-s * cp, -sp, -c * cp])
    right = np.array([c, 0.0, -s])
    down = np.cross(ahead, right)
    for _ in range(roll):
        right, down = down, -right
    return np.column_stack([right, down, ahead])


class Camera(NamedTuple):
    """One of a format: its lens in pixels of a photo `shape` as stored, counted from its corner; `roll` in quarters.

    `tag`: the photo's EXIF orientation.
    """

    shape: Shape
    fx: float
    fy: float
    cx: float
    cy: float
    roll: int = 0
    tag: int = 1


def mark_of(shown: F64) -> F64:
    """A place (3,) 3 m ahead, off the middle of the upright picture by `shown`, tangents right and down."""
    axes = optical_axes()
    return PLACE + axes @ np.array([3 * shown[0], 3 * shown[1], 3.0])


def paint(path: Path, camera: Camera, mark: F64) -> None:
    """The photo: black, with a red disc where the pinhole has `mark`."""
    x, y, z = optical_axes(camera.roll).T @ (mark - PLACE)
    column, row = camera.cx + camera.fx * x / z, camera.cy + camera.fy * y / z
    rows, columns = np.indices(camera.shape) + 0.5
    radius = DISC_PX * camera.shape[1] / 640
    cover = np.clip(radius + 0.5 - np.hypot(rows - row, columns - column), 0, 1)
    exif = Image.Exif()
    exif[ExifTags.Base.Orientation] = camera.tag
    Image.fromarray(np.stack([255 * cover, 0 * cover, 0 * cover], -1).round().astype(np.uint8)).save(path, exif=exif)


def z_up(vectors: F64) -> F64:
    """Of a world with Z up: x, -z, y of one with Y up, by rows."""
    return np.stack([vectors[0], -vectors[2], vectors[1]])


def poses(roll: int) -> tuple[F64, F64]:
    """Of a world with Z up, OpenGL axes (2, 3, 3) and places (2, 3), camera to world: the camera's, and one beside."""
    turn, place = z_up(optical_axes(roll) * (1, -1, -1)), z_up(PLACE)
    return np.stack([turn, turn]), np.stack([place, place + 0.1])


def nerf_writer(keys: Callable[[Camera], dict[str, Any]]) -> Callable[[Path, F64, F64], Path]:
    """A `transforms.json` with one lens of its own for all views."""

    def write(folder: Path, turns: F64, places: F64) -> Path:
        path = write_nerf(folder, turns, places)
        content = json.loads(path.read_text())
        frames = [{key: frame[key] for key in ("file_path", "transform_matrix")} for frame in content["frames"]]
        path.write_text(json.dumps({"frames": frames, **keys(NERF)}))
        return path

    return write


def whole_lens(camera: Camera) -> dict[str, Any]:
    height, width = camera.shape
    return {"w": width, "h": height, "fl_x": camera.fx, "fl_y": camera.fy, "cx": camera.cx, "cy": camera.cy}


PHONE_F = 270 / math.tan(math.radians(18))
NERF = Camera((540, 960), 750, 700, 500, 250)
WRITTEN = Camera((480, 640), LENS.fx, LENS.fy, LENS.cx, LENS.cy)  # by the writers that take a lens
#: Name: camera, what writes its file, and the name of its photo.
FORMATS: dict[str, tuple[Camera, Writer, str]] = {
    "arkit": (Camera((540, 960), PHONE_F, PHONE_F, 480, 270), WRITERS["arkit"], "a"),
    "arkit upright": (Camera((540, 960), PHONE_F, PHONE_F, 480, 270, roll=1, tag=6), WRITERS["arkit"], "a"),
    "arkit of 4:3": (Camera((720, 960), PHONE_F, PHONE_F, 480, 360), WRITERS["arkit"], "a"),
    "tum": (Camera((480, 640), 517, 517, 320, 240), WRITERS["tum"], "a"),
    "tum of half the pixels": (Camera((240, 320), 258.5, 258.5, 160, 120), WRITERS["tum"], "a"),
    # OpenCV's principal points: the centre of the first pixel is 0.
    "euroc": (Camera((480, 752), 458.654, 457.296, 367.215 + 0.5, 248.375 + 0.5), WRITERS["euroc"], "a"),
    "kitti": (Camera((376, 1241), 718.856, 718.856, 607.1928 + 0.5, 185.2157 + 0.5), WRITERS["kitti"], "a"),
    "stray": (Camera((480, 640), LENS.fx, LENS.fy, LENS.cx, LENS.cy), WRITERS["stray"], "a"),
    "nerf": (NERF, nerf_writer(whole_lens), "frame_00000"),
    "nerf upright": (NERF._replace(roll=1), nerf_writer(whole_lens), "frame_00000"),
    "nerf by its angle": (
        Camera((400, 500), 450, 450, 250, 200),
        nerf_writer(lambda _camera: {"camera_angle_x": 2 * math.atan(250 / 450)}),
        "frame_00000",
    ),
    "nerf view by view": (WRITTEN, WRITERS["nerf"], "frame_00000"),
    "record3d, upright": (WRITTEN._replace(roll=1), WRITERS["record3d"], "a"),
    "colmap text": (WRITTEN, WRITERS["colmap text"], "view 0"),
    "colmap binary, upright": (WRITTEN._replace(roll=1), WRITERS["colmap binary"], "view 0"),
}


def composed(gl: Any, output: Shape, background: Any, pose: Any, planes: list[PlaneSpec]) -> U8:
    stage = CompositeStage(gl, output, [(8, 8)], [np.zeros((55, 3))], background, planes=planes)
    stage.draw(pose, np.zeros(8 * 8 * 4, np.uint8))
    read = np.frombuffer(stage._target.read(components=3, alignment=1), np.uint8)
    return read.reshape(*output, 3)


def centre(weights: F64) -> F64:
    """Column and row of the middle of what is there; the centre of the first pixel is at (0.5, 0.5)."""
    assert weights.sum() > 0
    rows, columns = np.indices(weights.shape) + 0.5
    return np.array([(columns * weights).sum(), (rows * weights).sum()]) / weights.sum()


#: Two formats in all cuts, the others in two that differ in which side is cut; the rest of all is slow.
ALL_CUTS, CUTS = {"nerf", "arkit upright"}, {"upright", "a strip"}
CASES = [
    pytest.param(name, cut, marks=() if name in ALL_CUTS or cut in CUTS else pytest.mark.slow)
    for name in FORMATS
    for cut in OUTPUTS
]


@pytest.mark.parametrize(("name", "cut"), CASES)
def test_the_drawn_marker_lies_on_the_photographed_one(gl: Any, tmp_path: Path, name: str, cut: str) -> None:
    output = OUTPUTS[cut]
    camera, write, photo_name = FORMATS[name]
    (tmp_path / "images").mkdir()
    mark = mark_of(np.array([0.06, 0.012]))
    paint(tmp_path / "images" / f"{photo_name}.png", camera, mark)
    spec = CameraSpec(source=str(write(tmp_path, *poses(camera.roll))), place="none", up_axis="z")
    footage = survey(tmp_path / "images", 30.0)
    path, notes = filmed(load_camera(spec, Path()), footage, output)
    background = open_background(tmp_path / "images", output, 30.0, path)
    pose = np.zeros(1, pose_dtype(1))[0]
    pose["view"], pose["projection"] = path.sample(0.0), path.projection(0.0, output)
    ahead = optical_axes()[:, 2]
    plane = PlaneSpec(centre=tuple(mark), normal=tuple(-ahead), width_m=MARK_M, depth_m=MARK_M)
    photo = composed(gl, output, background, pose, []).astype(np.float64)
    background = open_background(tmp_path / "images", output, 30.0, path)
    both = composed(gl, output, background, pose, [plane]).astype(np.float64)
    photographed, drawn = centre(photo[..., 0]), centre((both - photo)[..., 2])
    assert np.abs(photographed - drawn).max() < 1.0, (photographed, drawn, notes)
    x, y, _, w = pose["projection"] @ pose["view"] @ [*mark, 1.0]
    computed = np.array([(x / w + 1) / 2 * output[1], (1 - y / w) / 2 * output[0]])
    assert np.abs(photographed - computed).max() < 0.1  # what is drawn has edges on whole pixels, a number has none
