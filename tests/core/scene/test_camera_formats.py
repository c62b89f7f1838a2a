"""Camera formats by value: lenses, order of columns, distortion, times, and files that are refused."""

from __future__ import annotations

import json
import math
import re
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from support.camera_files import (
    EUROC_NAMES,
    LENS,
    WRITERS,
    angle,
    load,
    nerf_text,
    pixel,
    pose_z_up,
    write_colmap_binary,
    write_colmap_text,
    write_kitti,
    write_record3d,
    write_stray,
)
from trilane.errors import BadInputError
from trilane.scene.camera.colmap import MODELS, checked_camera
from trilane.scene.camera.path import axes_towards
from trilane.scene.camera.pose_table import TableClock, read_pose_table
from trilane.scene.camera.recorded import LengthUnit, looked_at_from, metres_per_unit
from trilane.scene.camera.trajectories import TUM_NAMES
from trilane.scene.lens import Bent, Lens, distortion_note, largest_px
from trilane.scene.rotations import about, matrix_from_quat
from trilane.scene.schema import CameraSpec

TURNS = about(1, np.linspace(0.0, 0.8, 5)) @ about(0, -0.1)
PLACES = np.column_stack([np.linspace(0, 1, 5), np.full(5, 1.5), np.linspace(2, 3, 5)])
POINT = [0.1, 1.2, -1.5]  # in front of the first pose, in the world of TURNS and PLACES


def where_it_is(lens: Lens) -> tuple[float, float]:
    """Column and row at which the first pose sees POINT in a picture of 640x480: x = cx + fx X / Z."""
    x, y, z = TURNS[0].T @ (np.array(POINT) - PLACES[0])
    return lens.cx + lens.fx * x / -z, lens.cy - lens.fy * y / -z


@pytest.mark.parametrize("kind", ["nerf", "record3d", "stray", "colmap text", "colmap binary"])
def test_a_point_is_at_its_pixel(tmp_path: Path, kind: str) -> None:
    """Principal point and both focal lengths are the file's; the world keeps its origin with `place = "none"`."""
    path = WRITERS[kind](tmp_path, TURNS, PLACES)
    camera = load(path, up_axis="y", place="none")
    assert pixel(camera, POINT) == pytest.approx(where_it_is(LENS), abs=1e-6)


def test_each_view_has_its_own_lens(tmp_path: Path) -> None:
    """The second of two views has twice the focal length and another principal point; the rest is the file's."""
    matrix = pose_z_up(0).tolist()
    frames = [{"transform_matrix": matrix}, {"transform_matrix": matrix, "fl_x": 1000, "fl_y": 1000, "cx": 300}]
    content = {"fl_x": 500, "fl_y": 500, "w": 640, "h": 480, "frames": frames}
    (tmp_path / "a.json").write_text(json.dumps(content))
    camera = load(tmp_path / "a.json")
    assert camera.optics.lenses == (Lens(640, 480, 500, 500, 320, 240), Lens(640, 480, 1000, 1000, 300, 240))
    assert "field of view 26.99 to 51.28 degrees high, by `fl_x` and `fl_y`, frame by frame" in camera.notes
    between = camera.lens(0.5 / 30, (480, 640))
    assert (between.fx, between.cx) == pytest.approx((750, 310))
    content["frames"][1]["fl_x"] = -3
    (tmp_path / "a.json").write_text(json.dumps(content))
    with pytest.raises(BadInputError, match=r"frames\[1\]\.fl_x: found -3, expected a positive number"):
        load(tmp_path / "a.json")


def test_stray_scanner_without_a_lens_of_each_frame(tmp_path: Path) -> None:
    path = write_stray(tmp_path, TURNS, PLACES)
    old = [",".join(line.split(",")[:9]) for line in path.read_text().splitlines()]
    path.write_text("\n".join(old))
    assert "usual for a phone, as there is no camera_matrix.csv" in " ".join(load(path).notes)
    (tmp_path / "camera_matrix.csv").write_text("1400.0, 0.0, 970.0\n0.0, 1410.0, 715.0\n0.0, 0.0, 1.0")
    assert load(tmp_path).optics.lenses == (Lens(1920, 1440, 1400, 1410, 970, 715),)
    (tmp_path / "camera_matrix.csv").write_text("-1400.0, 0.0, 970.0\n0.0, 1410.0, 715.0\n0.0, 0.0, 1.0")
    with pytest.raises(BadInputError, match=r"camera_matrix\.csv: found a lens whose numbers are not all positive"):
        load(tmp_path)


def test_a_lens_of_stray_scanner_that_sees_nothing_is_refused(tmp_path: Path) -> None:
    path = write_stray(tmp_path, TURNS, PLACES)
    lines = path.read_text().splitlines()
    for lens, sentence in (
        ("1e-300, 1e-300", "a field of view of 180 degrees"),
        ("nan, 1500", "a lens whose number"),
    ):
        words = lines[2].split(", ")
        words[9:11] = lens.split(", ")
        path.write_text("\n".join([*lines[:2], ", ".join(words), *lines[3:]]))
        with pytest.raises(BadInputError, match=rf"odometry\.csv, line 3: found {sentence}"):
            load(path)


def test_the_order_of_columns_is_that_of_their_names(tmp_path: Path) -> None:
    """The same turn with the scalar first and last, by names or by the format, in seconds and in nanoseconds."""
    w, x, y, z = 0.5, -0.5, 0.1, 0.7
    last, first = f"1 2 3 {x} {y} {z} {w}", f"1 2 3 {w} {x} {y} {z}"
    names = "timestamp tx ty tz"
    texts = {
        f"0.5 {last}\n1.5 {last}": ("TUM", "as given"),
        f"# {names} qx qy qz qw\n0.5 {last}\n1.5 {last}": ("TUM", "column names with the quaternion's scalar last"),
        f"{names} qw qx qy qz\n0.5 {first}\n1.5 {first}": ("TUM", "column names with the quaternion's scalar first"),
        f"0 {last}\n1000000000 {last}": ("TUM", "as given"),
        f"0,{first}\n1000000000,{first}".replace(" ", ","): ("EuRoC", "as given"),
        f"{EUROC_NAMES}0,{first} 0 0 0\n1000000000,{first} 0 0 0".replace(" 0 0 0", ",0,0,0").replace(
            first, first.replace(" ", ",")
        ): ("EuRoC", "column names with the quaternion's scalar first"),
    }
    turns = []
    for text, (name, reason) in texts.items():
        (tmp_path / "a.txt").write_text(text)
        camera = load(tmp_path / "a.txt", up_axis="z", format=name.lower() if reason == "as given" else "auto")
        assert camera.detected.format.startswith(name) and camera.detected.reason == reason
        assert camera.times_s == pytest.approx([0, 1]) and camera.places[0] == pytest.approx([1, 3, -2])
        turns.append(camera.quats[0])
    assert all(np.abs(turn @ turns[0]) == pytest.approx(1) for turn in turns)


def test_euroc_poses_of_the_body_are_brought_to_the_camera(tmp_path: Path) -> None:
    """The camera is 0.1 m along the body's x, its axes turned by 90 degrees about z: read from cam0/sensor.yaml."""
    folder = tmp_path / "mav0" / "state_groundtruth_estimate0"
    folder.mkdir(parents=True)
    (folder / "data.csv").write_text(f"{EUROC_NAMES}0,1,2,3,1,0,0,0,0,0,0\n5000000,1,2,3,1,0,0,0,0,0,0\n")
    plain = load(folder / "data.csv", up_axis="y")
    assert "the axes of the poses are taken for the camera's, as there is no cam0/sensor.yaml" in plain.notes
    sensor = tmp_path / "mav0" / "cam0" / "sensor.yaml"
    sensor.parent.mkdir()
    lines = [
        "sensor_type: camera # a comment: data: [1]",
        "T_BS:",
        "  cols: 4",
        "  rows: 4",
        "  data: [0.0, -1.0, 0.0, 0.1,",
        "         1.0, 0.0, 0.0, 0.0,",
        "         0.0, 0.0, 1.0, 0.0,",
        "         0.0, 0.0, 0.0, 1.0]",
        "resolution: [752, 480]",
        "intrinsics: [450.0, 455.0, 367.0, 248.0] # fu, fv, cu, cv",
        "distortion_coefficients: [-0.28, 0.07, 0.0002, 0.00002]",
    ]
    sensor.write_text("\n".join(lines))
    camera = load(folder / "data.csv", up_axis="y")
    shift = camera.places[0] - plain.places[0]
    assert shift == pytest.approx([0.1, 0.0, 0.0], abs=1e-9)
    assert any("distortion of the lens is left out: up to" in note for note in camera.notes)
    assert {lens.fx for lens in camera.optics.lenses} <= {450.0, 455.0}
    sensor.write_text("\n".join(lines[:-3]))
    with pytest.raises(BadInputError, match=r"sensor\.yaml: resolution: found 0 numbers, expected 2 finite numbers"):
        load(folder / "data.csv")


def test_record3d_without_times_and_lenses_of_frames(tmp_path: Path) -> None:
    path = write_record3d(tmp_path, TURNS, PLACES)
    content = json.loads(path.read_text())
    assert load(tmp_path).detected.reason == "metadata.json in the folder"
    del content["perFrameIntrinsicCoeffs"], content["frameTimestamps"]
    path.write_text(json.dumps({**content, "fps": 60}))
    camera = load(path)
    assert camera.times_s == pytest.approx(np.arange(5) / 60) and camera.optics.lenses == (LENS,)
    assert "Record3D, 5 poses, 60 a second by `fps`, camera to world" in camera.notes
    for key, value, sentence in (
        ("K", [1] * 8, "K: found shape (1, 8), expected rows of 9 numbers"),
        ("w", -1, "w: found -1, expected a side of the picture in pixels"),
        ("poses", [[1, 2]], "poses: found shape (1, 2), expected rows of 7 numbers"),
        ("poses", [], "poses: found shape (0,), expected rows of 7 numbers"),
        ("perFrameIntrinsicCoeffs", [[1, 2, 3, 4]], "perFrameIntrinsicCoeffs: found 1 rows, expected 5, one for each"),
        ("frameTimestamps", 3, "frameTimestamps: found shape (), expected rows of 1 numbers"),
        ("frameTimestamps", ["x"], "frameTimestamps: found something else than numbers"),
        ("frameTimestamps", [0, 1], "frameTimestamps: found 2 times, expected 5, one for each of `poses`; correct it"),
        ("fps", -3, "fps: found -3, expected a number from 0.001 to 1000; correct it, or set camera.rate_hz"),
        ("fps", True, "fps: found True, expected a number"),
    ):
        path.write_text(json.dumps({**content, key: value}))
        with pytest.raises(BadInputError, match=re.escape(f"{path}: {sentence}")):
            load(path)
        if key in ("frameTimestamps", "fps"):
            assert load(path, rate_hz=5).times_s == pytest.approx(np.arange(5) / 5)


def test_kitti_times(tmp_path: Path) -> None:
    """By times.txt, else by the scene, else 10 a second; other times than poses are refused."""
    path = write_kitti(tmp_path, TURNS, PLACES)
    assert load(path).times_s == pytest.approx(np.arange(5) / 30)
    for count in (2, 4, 6):
        (tmp_path / "times.txt").write_text("".join(f"{k}\n" for k in range(count)))
        assert load(path, rate_hz=5).times_s == pytest.approx(np.arange(5) / 5)
        with pytest.raises(BadInputError) as refused:
            load(path)
        found = f"found {count} times, expected 5, one for each pose of 00.txt; correct it, or set camera.rate_hz"
        assert str(refused.value) == f"{tmp_path}/times.txt: {found}"
    (tmp_path / "times.txt").unlink()
    camera = load(path, format="kitti")
    assert camera.times_s == pytest.approx(np.arange(5) / 10)
    assert "10 a second assumed, as the file has no times" in camera.notes[0]


def test_colmap_text_and_binary_say_the_same(tmp_path: Path) -> None:
    (tmp_path / "a").mkdir()
    text = load(write_colmap_text(tmp_path / "a", TURNS, PLACES))
    binary = load(write_colmap_binary(tmp_path, TURNS, PLACES))
    assert text.quats == pytest.approx(binary.quats, abs=1e-12)
    assert text.places == pytest.approx(binary.places, abs=1e-9)
    assert text.pictures == binary.pictures == tuple(f"view {k}.jpg" for k in range(5))
    assert text.optics == binary.optics
    project = tmp_path / "project"
    (project / "sparse").mkdir(parents=True)
    (tmp_path / "a").rename(project / "sparse" / "0")
    assert load(project).pictures == text.pictures
    (project / "sparse" / "0").rename(tmp_path / "a")
    for file in ("cameras.txt", "images.txt"):
        assert load(tmp_path / "a" / file).detected.reason == "a file of a COLMAP model"


def test_colmap_photos_are_in_the_order_of_their_numbers(tmp_path: Path) -> None:
    (tmp_path / "cameras.txt").write_text("1 SIMPLE_PINHOLE 640 480 500 320 240\n")
    names = ["img10.jpg", "img9.jpg", "img100.jpg"]
    (tmp_path / "images.txt").write_text("".join(f"{k} 1 0 0 0 0 0 {k} 1 {name}\n" for k, name in enumerate(names)))
    assert load(tmp_path).pictures == ("img9.jpg", "img10.jpg", "img100.jpg")


#: Model, parameters, and a displacement worked out by hand: at the corner of 200x200 with f = 100, r² = 2.
BENT: list[tuple[str, list[float], float]] = [
    ("SIMPLE_RADIAL", [100, 100, 100, 0.1], math.sqrt(2) * 0.2 * 100),
    ("RADIAL", [100, 100, 100, 0.0, 0.05], math.sqrt(2) * 0.2 * 100),
    ("OPENCV", [100, 100, 100, 100, 0.1, 0, 0, 0], math.sqrt(2) * 0.2 * 100),
    ("OPENCV", [100, 100, 100, 100, 0, 0, 0.01, 0], math.hypot(2 * 0.01, 0.01 * 4) * 100),
    ("OPENCV", [100, 100, 100, 100, 0, 0, 0, 0.01], math.hypot(0.01 * 4, 2 * 0.01) * 100),
    ("FULL_OPENCV", [100, 100, 100, 100, 0, 0, 0, 0, 0, 0.5, 0, 0], math.sqrt(2) * 0.5 * 100),
    ("OPENCV_FISHEYE", [100, 100, 100, 100, 0, 0, 0, 0], (math.sqrt(2) - math.atan(math.sqrt(2))) * 100),
]


@pytest.mark.parametrize(("model", "values", "most"), BENT)
def test_the_distortion_that_is_left_out(model: str, values: list[float], most: float) -> None:
    kind = next(each for each in MODELS.values() if each.name == model)
    camera = checked_camera("here", kind, (200.0, 200.0), values)
    assert largest_px(*camera.bent()) == pytest.approx(most)
    straight = Bent(LENS, {"k1": 1e-3})
    (note,) = distortion_note([straight, camera.bent(), straight])
    assert f"up to {most:.0f} px of 200x200; undistort the pictures" in note


def test_straight_lenses_have_no_note() -> None:
    assert distortion_note([]) == () == distortion_note([Bent(LENS, {"k1": 0.0}), Bent(LENS, {"k1": 1e-6})])


def test_a_map_without_unit_is_scaled_by_where_its_cameras_look() -> None:
    """Cameras 5 units round a point: at 60 degrees a person of 1.7 m takes 75 % of the height at 1.963 m."""
    angles = np.linspace(0, 2, 9)
    places = np.array([10.0, 0, 0]) + 5 * np.column_stack([np.sin(angles), np.zeros(9), np.cos(angles)])
    turns = axes_towards(places, np.array([10.0, 0, 0]))
    assert looked_at_from(turns, places) == pytest.approx(5.0)
    times, spec = np.arange(9.0), CameraSpec()
    scale, notes = metres_per_unit(turns, places, times, 60.0, LengthUnit.NONE, spec)
    assert scale == pytest.approx(1.7 / 0.75 / (2 * math.tan(math.radians(30))) / 5)
    assert "the file has no unit: 1 unit is taken for 0.3926 m" in notes[0]
    outwards = axes_towards(places, np.array([10.0, 0, 0])) @ about(1, math.pi)
    assert looked_at_from(outwards, places) is None
    scale, _ = metres_per_unit(outwards, places, times, 60.0, LengthUnit.NONE, spec)
    assert scale == pytest.approx(2.0 / np.linalg.norm(np.ptp(places, axis=0)))
    for unit in (LengthUnit.METRES, LengthUnit.USUALLY_M):
        assert metres_per_unit(turns, places, times, 60.0, unit, spec) == (1.0, ())
    fast = metres_per_unit(turns, 100 * places, times, 60.0, LengthUnit.USUALLY_M, spec)
    assert fast[0] == pytest.approx(0.01 * 1.7 / 0.75 / (2 * math.tan(math.radians(30))) / 5)
    assert "at 125 m/s its unit can be no metre" in fast[1][0]
    kept = metres_per_unit(turns, places, times, 60.0, LengthUnit.NONE, CameraSpec(place="none"))
    assert kept[0] == 1.0 and "as camera.place is none" in kept[1][0]
    given = CameraSpec(source="a.txt", metres_per_unit=0.25)
    given_ = metres_per_unit(turns, places, times, 60.0, LengthUnit.NONE, given)
    assert given_ == (0.25, ("1 unit of the file is 0.25 m, as given",))
    still = metres_per_unit(turns[:1], places[:1], times[:1], 60.0, LengthUnit.NONE, spec)
    assert still[0] == 1.0


@pytest.mark.parametrize(("radius", "scale"), [(0.6, 3.271), (1.4, 1.402), (1.5, 1.0), (30.0, 1.0)])
def test_nerf_s_unit_is_a_metre_where_a_person_fits(tmp_path: Path, radius: float, scale: float) -> None:
    """At 60 degrees, 1.7 m are the picture's height at 1.472 m, and 75 % of it at 1.963 m. A note says either."""
    angles = np.linspace(0, 2, 9)
    places = radius * np.column_stack([np.sin(angles), np.zeros(9), np.cos(angles)])
    views = np.tile(np.eye(4), (9, 1, 1))
    views[:, :3, :3], views[:, :3, 3] = axes_towards(places, np.zeros(3)), places
    (tmp_path / "a.json").write_text(nerf_text(*views, w=800, h=600, fl_y=300 / math.tan(math.radians(30))))
    camera = load(tmp_path / "a.json")
    length, own = (np.linalg.norm(np.ptp(one, axis=0)) for one in (camera.places, places))
    assert length / own == pytest.approx(scale, rel=1e-3)
    (note,) = (note for note in camera.notes if "camera.metres_per_unit decides" in note)
    assert note.startswith("the file has no unit")
    assert ("1 unit is taken for 1 m;" in note) == (scale == 1.0)
    assert camera.detected.unit == note


ONE_CAMERA = struct.pack("<QiiQQ3d", 1, 1, 0, 640, 480, 500.0, 320.0, 240.0)
ONE_IMAGE = struct.pack("<Qi7di", 1, 1, 1, 0, 0, 0, 0, 0, 0, 1)
#: cameras.bin, images.bin, what is said of which of them.
BROKEN: dict[str, tuple[bytes, bytes, str]] = {
    "cameras empty": (b"", ONE_IMAGE, "cameras.bin: found an empty file"),
    "cameras short": (b"\1\0", ONE_IMAGE, "cameras.bin: found 2 bytes, truncated, expected 8 bytes of the count of"),
    "cameras bomb": (struct.pack("<Q", 1 << 60), ONE_IMAGE, f"cameras.bin: found {1 << 60} cameras, expected at most"),
    "cameras fewer": (struct.pack("<Q", 9) + ONE_CAMERA[8:], ONE_IMAGE, "found 48 bytes, truncated, expected 216 byt"),
    "parameters": (ONE_CAMERA[:-8], ONE_IMAGE, "cameras.bin: found 16 bytes, truncated, expected 24 bytes of param"),
    "model": (struct.pack("<QiiQQ", 1, 1, 99, 640, 480), ONE_IMAGE, "camera 1: found the camera model 99, expected 0"),
    "picture": (struct.pack("<QiiQQ3d", 1, 1, 0, 1 << 40, 1, 5, 3, 2), ONE_IMAGE, "camera 1: found a picture of 1.09"),
    "focal": (
        struct.pack("<QiiQQ3d", 1, 1, 0, 640, 480, 0, 3, 2),
        ONE_IMAGE,
        "found parameters that are not finite or",
    ),
    "images bomb": (ONE_CAMERA, struct.pack("<Q", 1 << 50), f"images.bin: found {1 << 50} images, expected at most"),
    "name": (ONE_CAMERA, ONE_IMAGE + b"x" * 9000, "images.bin: found a name without end"),
    "points bomb": (ONE_CAMERA, ONE_IMAGE + b"a\0" + struct.pack("<Q", 1 << 63), "found 0 bytes, truncated, expected"),
    "no points": (ONE_CAMERA, ONE_IMAGE + b"a\0" + bytes(7), "found 7 bytes, truncated, expected 8 bytes of the count"),
    "no camera": (
        ONE_CAMERA,
        struct.pack("<Qi7di", 1, 1, 1, 0, 0, 0, 0, 0, 0, 8) + b"a\0" + bytes(8),
        "images.bin: a: found camera 8, expected a camera of the model",
    ),
    "none": (ONE_CAMERA, struct.pack("<Q", 0), "images.bin: found 0 images, expected 1 to 100000"),
    "no rotation": (
        ONE_CAMERA,
        struct.pack("<Qi7di", 1, 1, 0, 0, 0, 0, 0, 0, 0, 1) + b"a\0" + bytes(8),
        "found 1 samples that are not finite (first: a)",
    ),
}


@pytest.mark.parametrize("case", BROKEN)
def test_broken_binary_models_are_refused_before_they_are_read(tmp_path: Path, case: str) -> None:
    cameras, images, sentence = BROKEN[case]
    (tmp_path / "cameras.bin").write_bytes(cameras)
    (tmp_path / "images.bin").write_bytes(images)
    with pytest.raises(BadInputError) as raised:
        load(tmp_path)
    assert sentence in str(raised.value) and str(tmp_path) in str(raised.value)


PINHOLE = "1 SIMPLE_PINHOLE 640 480 500 320 240\n"
VIEW = "1 1 0 0 0 0 0 0 1 a.jpg\n"
#: cameras.txt, images.txt, what is said.
BROKEN_TEXT: dict[str, tuple[str, str, str]] = {
    "model": ("1 PINHOL 640 480 5 5 5 5\n", VIEW, "cameras.txt, line 1: found the camera model 'PINHOL'"),
    "count": (
        "1 PINHOLE 640 480 500 320 240\n",
        VIEW,
        "cameras.txt, line 1: found 3 parameters, expected 4 of PINHOLE",
    ),
    "twice": (PINHOLE * 2, VIEW, "cameras.txt, line 2: found a second camera 1, expected one line for each camera"),
    "word": ("1 SIMPLE_PINHOLE 640 480 500 x 240\n", VIEW, "cameras.txt, line 1: found could not convert"),
    "wide": ("1 SIMPLE_PINHOLE 640 480 1 320 240\n", VIEW, "cameras.txt, line 1: found a field of view of"),
    "name": (
        PINHOLE,
        VIEW.replace("a.jpg", "a" * 257),
        "line 1: found a name of 257 letters, expected at most",
    ),
    "quaternion": (PINHOLE, "1 1 0 y 0 0 0 0 1 a.jpg\n", "images.txt, line 1: found could not convert"),
    "camera": (PINHOLE, "1 1 0 0 0 0 0 0 x a.jpg\n", "images.txt, line 1: found invalid literal"),
    "prose": (PINHOLE, "hello\n" + VIEW, "images.txt, line 1: found 'hello'"),
    "nothing": (PINHOLE, "# none\n", "images.txt: found 0 images"),
}


@pytest.mark.parametrize("case", BROKEN_TEXT)
def test_broken_text_models_are_refused(tmp_path: Path, case: str) -> None:
    cameras, images, sentence = BROKEN_TEXT[case]
    (tmp_path / "cameras.txt").write_text(cameras)
    (tmp_path / "images.txt").write_text(images)
    with pytest.raises(BadInputError, match=re.escape(sentence)):
        load(tmp_path)


#: Name of a file -> its text, what is said.
REFUSED: dict[str, tuple[str, str]] = {
    "names.csv": ("timestamp, frame, x, y, z, qx, qy, qz, qw\n1, 2, 3\n", "line 2: found 3 columns"),
    "short.csv": ("timestamp tx ty tz qx qy qz qw\n0 0 0 0 0 0 1\n", "line 2: found 7 columns, expected"),
    "four.txt": ("1 2 3 4\n", "found 4 columns, expected 8 (TUM, EuRoC), 12 (KITTI) or 13 (ARKit), or column names"),
    "ragged.txt": ("0 0 0 0 0 0 0 1\n0 0 0 0 0 0 0\n", "line 2: found 7 columns"),
    "k.json": (nerf_text(pose_z_up(0), k1="x"), "k1: found 'x', expected a number"),
    "comments.txt": ("# nothing\n", "found 0 columns"),
    "empty.txt": ("", "found an empty file"),
    "not.json": ("{", "found no valid JSON"),
    "no matrix.json": ('{"frames": [{}]}', "frames[0].transform_matrix"),
    "m.json": ('{"frames": [{"transform_matrix": 3, "fl_x": 5}]}', "frames[0].transform_matrix: found shape ()"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_files_that_are_none_of_these_are_refused(tmp_path: Path, name: str) -> None:
    text, sentence = REFUSED[name]
    (tmp_path / name).write_text(text)
    with pytest.raises(BadInputError) as raised:
        load(tmp_path / name)
    assert sentence in str(raised.value) and str(tmp_path) in str(raised.value)


def test_a_folder_without_a_camera(tmp_path: Path) -> None:
    with pytest.raises(BadInputError, match=r"a folder without transforms\.json, .*metadata\.json and COLMAP's files"):
        load(tmp_path)
    for kind in ("colmap", "nerf", "record3d", "stray", "tum"):
        with pytest.raises(BadInputError):
            load(tmp_path, format=kind)


@given(st.text(max_size=200))
@settings(max_examples=60)
def test_any_text_is_read_or_refused(tmp_path_factory: pytest.TempPathFactory, text: str) -> None:
    path = tmp_path_factory.mktemp("any") / "a.txt"
    path.write_text(text, encoding="utf-8")
    for kind in ("auto", "arkit", "tum", "nerf"):
        try:
            load(path, format=kind)
        except BadInputError as error:
            assert "a.txt" in str(error)


def test_real_logs_are_what_they_are(shared_data: Path) -> None:
    arkit = load(shared_data / "camera" / "arkit_camera_pose.txt")
    assert "Y up, device held so that the picture is turned by 90 degrees" in arkit.notes
    assert any("1 gap, the longest 33 ms" in note for note in arkit.notes)
    tum = load(shared_data / "camera" / "tum_freiburg1_xyz.txt")
    assert "Z up" in tum.notes and any("1 gap, the longest 110 ms" in note for note in tum.notes)
    for camera in (arkit, tum):
        assert np.median(matrix_from_quat(camera.quats)[:, 1, 1]) > 0.6


def test_columns_that_hold_no_quaternion_are_refused_with_those_that_may(tmp_path: Path) -> None:
    """A TUM table whose quaternion comes before its place; with names in the first line it is right."""
    rows = "".join(f"{k} 0.5 -0.5 0.1 0.7 {k + 1} 2 3\n" for k in range(3))
    (tmp_path / "a.txt").write_text(rows)
    with pytest.raises(BadInputError) as refused:
        load(tmp_path / "a.txt")
    # of line 1: 0.7 1 2 3, whose squares add up to 14.49
    assert (refused.value.where, refused.value.found) == (
        f"{tmp_path / 'a.txt'}, line 1",
        "a quaternion of length 3.81",
    )
    assert refused.value.remedy.startswith("columns 2 to 5 have length 1: ")
    (tmp_path / "a.txt").write_text(f"timestamp qx qy qz qw tx ty tz\n{rows}")
    assert load(tmp_path / "a.txt", up_axis="y").places[2] - load(tmp_path / "a.txt", up_axis="y").places[
        0
    ] == pytest.approx([2, 0, 0])


@pytest.mark.parametrize(
    ("columns", "way"), [(1, "commas"), (7, "as TUM has them"), (16, "KITTI's 12"), (17, "0 0 0 1")]
)
def test_tables_of_others_are_refused_with_a_way(tmp_path: Path, columns: int, way: str) -> None:
    (tmp_path / "a.txt").write_text("1 " * columns + "\n" + "2 " * columns + "\n")
    with pytest.raises(BadInputError) as refused:
        load(tmp_path / "a.txt")
    assert way in refused.value.remedy


#: Keys of the file -> field of view of height and width (by tangents of their halves), and where they come from.
LENSES: list[tuple[dict[str, float], float, float, str]] = [
    ({"fl_y": 400, "h": 480, "w": 640}, 0.6, 0.8, "by `fl_y`"),
    ({"fl_y": 400, "h": 480}, 0.6, 0.8, "by `fl_y`"),  # the usual aspect, 4:3
    ({"fl_y": 400, "h": 480, "w": 640, "fl_x": 800, "camera_angle_x": 1.0}, 0.6, 0.4, "by `fl_x` and `fl_y`"),
    ({"fl_x": 500, "w": 800, "h": 400}, 0.4, 0.8, "by `fl_x`"),
    ({"fl_x": 500, "w": 800}, 0.6, 0.8, "by `fl_x`"),
    ({"fl_x": 500, "w": 800, "h": 400, "fl_y": 100}, 2.0, 0.8, "by `fl_x` and `fl_y`"),
    ({"fl_y": 500, "w": 800, "camera_angle_x": math.pi / 2}, 0.75, 1.0, "by `camera_angle_x`"),  # no `h`
    ({"fl_x": 500, "h": 800, "camera_angle_x": math.pi / 2}, 0.75, 1.0, "by `camera_angle_x`"),  # no `w`
    ({"camera_angle_x": math.pi / 2, "w": 1000, "h": 500}, 0.5, 1.0, "by `camera_angle_x`"),
    ({"camera_angle_y": math.pi / 2}, 1.0, 4 / 3, "by `camera_angle_y`"),  # the usual aspect
    ({"camera_angle_y": math.pi / 2, "w": 1000, "h": 500}, 1.0, 2.0, "by `camera_angle_y`"),
    (
        {"camera_angle_x": math.pi / 2, "camera_angle_y": 2 * math.atan(0.4), "w": 1000, "h": 500},
        0.4,
        1.0,
        "by `camera_angle_x` and `camera_angle_y`",
    ),
    ({"camera_angle_x": math.pi / 2, "camera_angle_y": 1.0}, 0.75, 1.0, "by `camera_angle_x`"),  # square pixels
    (
        {"fl_x": 500, "cx": 400, "cy": 300},
        math.tan(math.radians(25)) * 0.75,
        math.tan(math.radians(25)),
        "usual, as focal lengths in pixels need `w` and `h`",
    ),
    ({"w": 1000, "h": 500}, math.tan(math.radians(25)) / 2, math.tan(math.radians(25)), "usual, as the file has none"),
]


@pytest.mark.parametrize(("keys", "tan_y", "tan_x", "note"), LENSES)
def test_the_lens_of_height_and_of_width(
    tmp_path: Path, keys: dict[str, float], tan_y: float, tan_x: float, note: str
) -> None:
    """Held upright, the picture's width becomes its height: a level and a rolled view tell the two apart."""
    roll = np.eye(4)
    roll[:2, :2] = [[0, -1], [1, 0]]
    for matrix, tangent in ((pose_z_up(0), tan_y), (pose_z_up(0) @ roll, tan_x)):
        (tmp_path / "a.json").write_text(nerf_text(matrix, **keys))
        camera = load(tmp_path / "a.json", up_axis="z")
        assert camera.lens(0.0, (480, 640)).fov_y_deg == pytest.approx(angle(tangent))
        assert camera.notes[3] == f"field of view {angle(tangent):.4g} degrees high, {note}"


def test_the_principal_point_counts_where_only_an_angle_is_known(tmp_path: Path) -> None:
    """f is 320 px of 640x480 at 90 degrees; at (1, 2, 3), 4 m along +Y, 0.5 m right is 40 px, 1 m up 80."""
    lens = {"camera_angle_x": math.pi / 2, "w": 640, "h": 480, "cx": 192, "cy": 336}
    (tmp_path / "a.json").write_text(nerf_text(pose_z_up(0, (1, 2, 3)), **lens))
    assert pixel(load(tmp_path / "a.json"), [1.5, 4.0, -6.0]) == pytest.approx((192 + 40, 336 - 80))


@pytest.mark.parametrize("model", ["EQUIRECTANGULAR", "OMNIDIRECTIONALSTEREO_L", "VR180_R", "ORTHOPHOTO"])
def test_pictures_that_no_lens_makes_are_refused(tmp_path: Path, model: str) -> None:
    text = json.loads(nerf_text(pose_z_up(0), fl_x=500, w=800, h=400))
    for table in (text, text["frames"][0]):
        table["camera_model"] = model
        (tmp_path / "a.json").write_text(json.dumps(text))
        del table["camera_model"]
        with pytest.raises(BadInputError, match=f"camera_model: found {model}, .*; cut the pictures into perspective"):
            load(tmp_path / "a.json")


def test_views_a_step_apart_are_a_film_or_stills(tmp_path: Path) -> None:
    for step, times, note in (
        (5.9, [0, 1 / 30, 2 / 30], "30 a second assumed"),
        (6.1, [0, 1, 2], "stills 6 degrees apart, 1 a second"),
        (90.0, [0, 1, 2], "stills 90 degrees apart, 1 a second"),
    ):
        (tmp_path / "a.json").write_text(nerf_text(*(pose_z_up(k * step) for k in range(3))))
        camera = load(tmp_path / "a.json")
        assert camera.times_s == pytest.approx(times)
        assert camera.notes[0] == f"NeRF transforms, 3 views, no times: {note}, camera to world"


ONE = pose_z_up(0).tolist()


REFUSED_KEYS: dict[str, tuple[Any, str]] = {
    "list": (
        [],
        ": found no list `frames`, expected a NeRF transforms.json: `frames`, each with a 4x4 `transform_matrix`",
    ),
    "none": ({"frames": []}, ": frames: found 0 frames, expected 1 to 100000"),
    "text": (
        {"frames": [{"transform_matrix": ONE}, {"transform_matrix": "x"}]},
        ": frames[1].transform_matrix: found something else than numbers, expected a 4x4 matrix",
    ),
    "true in a matrix": (
        {"frames": [{"transform_matrix": [[True, 0, 0, 0], *ONE[1:]]}]},
        ": frames[0].transform_matrix: found something else than numbers, expected a 4x4 matrix",
    ),
    "quotes in a matrix": (
        {"frames": [{"transform_matrix": [["3", 0, 0, 0], *ONE[1:]]}]},
        ": frames[0].transform_matrix: found something else than numbers, expected a 4x4 matrix",
    ),
    "rows in a matrix": (
        {"frames": [{"transform_matrix": [[1, 0, 0], *ONE[1:]]}]},
        ": frames[0].transform_matrix: found something else than numbers, expected a 4x4 matrix",
    ),
    "shape": (
        {"frames": [{"transform_matrix": [[1] * 4] * 5}]},
        ": frames[0].transform_matrix: found shape (5, 4), exp",
    ),
    "no directions": (
        {"frames": [{"transform_matrix": ONE}] * 3 + [{"transform_matrix": [[0] * 4] * 4}]},
        ": frames[3].transform_matrix: found a matrix without an inverse, expected a 4x4 matrix, camera to world; "
        "leave this view out",
    ),
    "no rotation": (
        {"frames": [{"transform_matrix": [[2, 0, 0, 5], [0, 1, 0, 5], [0, 0, 1, 5], [0, 0, 0, 1]]}]},
        ": found 1 samples that are no rotation (first: frames[0].transform_matrix) and 0 times",
    ),
    "true": ({"frames": [{"transform_matrix": ONE}], "w": True}, ": w: found True, expected a positive number"),
    "pi": (
        {"frames": [{"transform_matrix": ONE}], "camera_angle_x": math.pi},
        ": camera_angle_x: found 3.14159, expected an angle in radians below pi",
    ),
    "wide": (
        {"frames": [{"transform_matrix": ONE}], "fl_y": 1, "h": 24, "w": 24},
        ": found a field of view of 170.5 degrees over the height, expected 1 to 170",
    ),
    "wide only across": (
        {"frames": [{"transform_matrix": ONE}], "fl_y": 1, "h": 2, "w": 24},
        ": found a field of view of 170.5 degrees over the width, expected 1 to 170",
    ),
}


@pytest.mark.parametrize("case", REFUSED_KEYS)
def test_a_wrong_nerf_file_is_refused_in_one_sentence(tmp_path: Path, case: str) -> None:
    content, sentence = REFUSED_KEYS[case]
    path = tmp_path / "a.json"
    path.write_text(json.dumps(content))
    with pytest.raises(BadInputError, match=re.escape(f"{path}{sentence}")):
        load(path)


def _pushed_in(rows: int = 40) -> tuple[np.ndarray, np.ndarray]:
    """Times at 30 a second, and poses x y z qx qy qz qw of a camera that slows down as it comes nearer."""
    times = np.arange(rows) / 30
    places = np.column_stack([2 * np.sin(times), np.full(rows, 1.5), 4 - times**2])
    return times, np.column_stack([places, np.tile([1.0, 0, 0, 0], (rows, 1))])


def test_fields_may_be_parted_by_semicolons_with_decimal_commas(tmp_path: Path) -> None:
    times, poses = _pushed_in()
    rows = [";".join(f"{value:.6f}" for value in row) for row in np.column_stack([times, poses])]
    head = "timestamp;tx;ty;tz;qx;qy;qz;qw"
    found = []
    for name, lines in {"points": rows, "commas": [row.replace(".", ",") for row in rows]}.items():
        file = tmp_path / f"{name}.csv"
        file.write_bytes("\r\n".join(["\ufeff" + head, *lines]).encode())
        found.append(read_pose_table(file, TableClock(None, "auto"), TUM_NAMES, "a table"))
    np.testing.assert_allclose(found[0].times.since_s, times, atol=1e-6)
    np.testing.assert_allclose(found[0].places, poses[:, :3], atol=1e-6)
    assert np.array_equal(found[0].places, found[1].places)


@pytest.mark.parametrize("column", [1, 3])
def test_times_in_a_column_of_places_are_refused(tmp_path: Path, column: int) -> None:
    times, poses = _pushed_in()
    table = np.column_stack([times, poses])
    table[:, [0, column]] = table[:, [column, 0]] * (1 if column == 1 else -1)
    table[:, column] = times
    file = tmp_path / "swapped.txt"
    np.savetxt(file, table, fmt="%.6f")
    with pytest.raises(BadInputError, match=f"in the place of {'xyz'[column - 1]} numbers that do"):
        read_pose_table(file, TableClock(None, "auto"), TUM_NAMES, "a table")
    np.savetxt(file, np.column_stack([times, poses]), fmt="%.6f")
    assert len(read_pose_table(file, TableClock(None, "auto"), TUM_NAMES, "a table").turns) == len(times)


@pytest.mark.parametrize("rows", [10, 100])
@pytest.mark.parametrize(
    ("bad", "note"),
    [
        (np.nan, "1 samples not finite"),
        (4 / 30, "1 samples with repeated or decreasing times"),
        (1 / 30, "1 samples with repeated or decreasing times"),
    ],
)
def test_a_bad_time_leaves_out_its_own_pose_of_a_camera_that_moves_evenly(
    tmp_path: Path, rows: int, bad: float, note: str
) -> None:
    table = np.zeros((rows, 8))
    table[:, 0], table[:, 1], table[:, 7] = np.arange(rows) / 30, 0.1 * np.arange(rows), 1
    table[5, 0] = bad
    np.savetxt(tmp_path / "a.txt", table)
    camera = load(tmp_path / "a.txt", format="tum", up_axis="y")
    assert len(camera.times_s) == rows - 1 and any(text.startswith(note) for text in camera.notes)
    table[:, 0] = np.arange(rows) / 30 + 0.5 * (np.arange(rows) > 5)
    np.savetxt(tmp_path / "a.txt", table)
    assert len(load(tmp_path / "a.txt", format="tum", up_axis="y").times_s) == rows
    table[:, 0] = -np.arange(rows)
    np.savetxt(tmp_path / "a.txt", table)
    with pytest.raises(BadInputError, match="times that do not grow by equal steps, and in the place of x numbers"):
        load(tmp_path / "a.txt", format="tum", up_axis="y")
