"""Cameras by value: a point of the world must come out at a pixel worked out by hand, whatever the format."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from support.camera_files import HEIGHT, load, pixel, rows_of
from trilane.errors import BadInputError
from trilane.scene.camera.path import CameraPath, one_lens
from trilane.scene.camera.recorded import OPENGL_FROM_OPTICAL, RawCamera, path_from_recording
from trilane.scene.camera.upright import OF_FIRST
from trilane.scene.lens import Lens, of_fov_y
from trilane.scene.motion.motion import Wrap
from trilane.scene.schema import CameraSpec

SPEC = CameraSpec()
LENSES = (of_fov_y(36.0),)


def focal(fov_y_deg: float) -> float:
    return HEIGHT / 2 / math.tan(math.radians(fov_y_deg) / 2)


def fov_y(camera: CameraPath) -> float:
    return camera.lens(0.0, (480, 640)).fov_y_deg


def arkit_rows(*rows: str) -> str:
    return "\n".join(rows) + "\n"


# Camera axes as columns, written row by row: looks along world +X (so -z_camera = +X), up +Y, right = +Z.
LOOKS_ALONG_X = "0 0 -1 {x}  0 1 0 {y}  1 0 0 {z}"


def test_an_arkit_pose_puts_points_at_their_pixels(tmp_path: Path) -> None:
    """At (1, 2, 3), looking along +X: 4 m ahead, 0.5 m to its right (+Z) and 1 m up is at f/8 right and f/4 above."""
    (tmp_path / "a.txt").write_text("7.0 " + LOOKS_ALONG_X.format(x=1, y=2, z=3))
    camera = load(tmp_path / "a.txt")
    f = focal(36.0)
    assert pixel(camera, [5.0, 3.0, 3.5]) == pytest.approx((320 + f / 8, 240 - f / 4))
    assert fov_y(camera) == pytest.approx(36.0)
    assert camera.course == "one pose: held"
    assert (camera.optics.near_m, camera.optics.far_m, camera.optics.filmed) == (0.05, 100.0, ())
    assert camera.notes == (
        "ARKit log, 1 poses, time in s, camera to world",
        "Y up",
        "field of view 36 degrees high, usual for a phone",
        "taken for ARKit log: 13 columns: a time and a 3x4 matrix",
    )


#: A level picture's right (r) and up (u) after the device was turned by quarters: the columns of the matrix x, y.
#: The long side of a picture of 16:9 that is 36 degrees high: 60.02.
LONG_DEG = 2 * math.degrees(math.atan(math.tan(math.radians(18)) * 16 / 9))
HELD = {
    0: ("r", "u", 36.0),
    1: ("-u", "r", LONG_DEG),
    2: ("-r", "-u", 36.0),
    3: ("u", "-r", LONG_DEG),
}


@pytest.mark.parametrize("quarter", HELD)
def test_a_phone_held_upright_has_the_long_side_high(tmp_path: Path, quarter: int) -> None:
    """The device looks along -Z, its picture turned; the pixel of a point is that of the level camera."""
    vectors = {
        "r": np.array([1, 0, 0]),
        "u": np.array([0, 1, 0]),
        "-r": np.array([-1, 0, 0]),
        "-u": np.array([0, -1, 0]),
    }
    x, y, fov = HELD[quarter]
    axes = np.column_stack([vectors[x], vectors[y], [0, 0, 1], [0, 0, 0]])
    (tmp_path / "a.txt").write_text("0 " + " ".join(map(str, axes.ravel())))
    camera = load(tmp_path / "a.txt", format="arkit")
    assert fov_y(camera) == pytest.approx(fov)
    f = focal(fov)
    assert pixel(camera, [0.3, 0.2, -2.0]) == pytest.approx((320 + 0.15 * f, 240 - 0.1 * f))
    turned = f", device held so that the picture is turned by {quarter * 90} degrees" if quarter else ""
    assert camera.notes[1] == f"Y up{turned}"


def test_arkit_times_are_told_by_their_steps(tmp_path: Path) -> None:
    """A median step of 1000 is in seconds, one above it in nanoseconds."""
    rows = [LOOKS_ALONG_X.format(x=k, y=0, z=0) for k in range(3)]
    for step, seconds, note in ((1000.0, 1000.0, "0.001/s, time in s"), (1001.0, 1.001e-6, "9.99e+05/s, time in ns")):
        (tmp_path / "a.txt").write_text(arkit_rows(*(f"{5 + k * step} {row}" for k, row in enumerate(rows))))
        camera = load(tmp_path / "a.txt")
        assert camera.times_s == pytest.approx([0, seconds, 2 * seconds])
        assert camera.notes[0] == f"ARKit log, 3 poses, {note}, camera to world"
    assert [place[0] for place in camera.places] == [0, 1, 2]


def test_a_tum_pose_puts_points_at_their_pixels(tmp_path: Path) -> None:
    """Optical axes, Z up; turned about the world's x by -90 degrees: it looks along +Y, x is right, z is up."""
    h = math.sqrt(0.5)
    (tmp_path / "a.txt").write_text(f"10 1 2 3 {-h} 0 0 {h}\n10.5 1 2 4 {-2 * h} 0 0 {2 * h}\n")
    camera = load(tmp_path / "a.txt")
    assert camera.course == "0.50 s, then plays back and forth"
    assert replace(camera, repeat_s=2.0).course == "0.50 s, then starts again with the background"
    f = 517.0
    # 4 m ahead (+Y), 0.5 m right (+X), 1 m up (+Z): (1.5, 6, 4) of the recording; Y up world: (x, z, -y).
    assert pixel(camera, [1.5, 4.0, -6.0]) == pytest.approx((320 + f / 8, 240 - f / 4))
    assert pixel(camera, [1.5, 4.0, -6.0], 0.5) == pytest.approx((320 + f / 8, 240))
    assert camera.notes == (
        "TUM trajectory, 2 poses, 2/s, optical axes, camera to world",
        "Z up",
        "field of view 49.8 degrees high, usual for a Kinect",
        "taken for TUM trajectory: 8 columns: the quaternion's scalar is taken to be last",
    )
    assert OPENGL_FROM_OPTICAL.tolist() == [[1, 0, 0], [0, -1, 0], [0, 0, -1]]


def test_the_numbers_of_a_tum_quaternion_are_x_y_z_w(tmp_path: Path) -> None:
    """R written out from Hamilton's product; its columns are right, down and ahead, in a Z-up world."""
    x, y, z, w = q = np.array([-0.62, 0.13, -0.21, 0.74]) / np.linalg.norm([-0.62, 0.13, -0.21, 0.74])
    r = np.array([
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ])  # fmt: skip
    (tmp_path / "a.txt").write_text("0 0 0 0 " + " ".join(str(value) for value in 1.01 * q))
    turn, _ = load(tmp_path / "a.txt", format="tum").pose(0.0)
    z_up = np.column_stack([r[:, 0], -r[:, 1], -r[:, 2]])
    assert turn == pytest.approx(np.stack([z_up[0], z_up[2], -z_up[1]]), abs=1e-9)


def test_a_kinect_held_upright_has_its_width_high(tmp_path: Path) -> None:
    """As above, then rolled by 90 degrees about the line of sight: the quaternions' product by hand."""
    (tmp_path / "a.txt").write_text("10 1 2 3 -0.5 0.5 0.5 0.5\n")  # (w, x, y, z) = ½ (1, -1, 1, 1)
    camera = load(tmp_path / "a.txt", up_axis="z", format="tum")
    assert fov_y(camera) == pytest.approx(2 * math.degrees(math.atan(320 / 517)))
    assert camera.notes[1] == "Z up, as given, device held so that the picture is turned by 90 degrees"
    assert camera.notes[0] == "TUM trajectory, 1 poses, optical axes, camera to world"


def test_a_camera_that_looks_straight_down_keeps_its_picture() -> None:
    """No turn of the picture has its up near the usual one: up is the axis nearest to the picture's own up."""
    down = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])  # x right, up = -Z, looks along -Y
    raw = RawCamera(np.zeros(1), down[None], np.zeros((1, 3)), "y", LENSES, "usual", ())
    camera = path_from_recording(raw, "here", SPEC)
    assert camera.notes[0] == "-Z up, as the camera is held (not Y, usual for the format)"
    assert camera.pose(0.0)[0][:, 1] == pytest.approx([0, 1, 0], abs=1e-12)
    assert fov_y(camera) == pytest.approx(36.0)


@pytest.mark.parametrize(
    ("axis", "sign", "usual"), [(0, 1, "y"), (0, -1, "y"), (1, 1, "z"), (1, -1, "z"), (2, 1, "y"), (2, -1, "y")]
)
def test_up_is_the_axis_that_the_picture_shows_up(axis: int, sign: int, usual: str) -> None:
    """Cameras that look along the usual up: every axis of the picture is level, so its own up decides."""
    up, look = np.eye(3)[axis] * sign, np.eye(3)["xyz".index(usual)]
    turns = np.column_stack([np.cross(look, up), up, -look])
    raw = RawCamera(np.zeros(1), turns[None], np.ones((1, 3)), usual, LENSES, "usual", ())
    camera = path_from_recording(raw, "here", SPEC)
    assert camera.notes[0].startswith(f"{'-' if sign < 0 else ''}{'XYZ'[axis]} up, as the camera is held")
    world = camera.pose(0.0)[0] @ turns.T
    assert world @ up == pytest.approx([0, 1, 0], abs=1e-12)
    assert camera.places[0] == pytest.approx(world @ np.ones(3), abs=1e-12)


@pytest.mark.parametrize(("cosine", "turned"), [(0.31, True), (0.29, False)])
def test_the_usual_up_holds_above_a_cosine_of_0_3(cosine: float, turned: bool) -> None:
    sine = math.sqrt(1 - cosine**2)
    pitched = np.array([[1.0, 0, 0], [0, cosine, sine], [0, -sine, cosine]])  # up (0, cos, -sin): looks down steeply
    raw = RawCamera(np.zeros(1), pitched[None], np.zeros((1, 3)), "y", LENSES, "usual", (), is_levelled=True)
    note = path_from_recording(raw, "here", SPEC).notes[0]
    assert note.split(";")[0] == ("Y up" if turned else "-Z up, as the camera is held (not Y, usual for the format)")


@pytest.mark.parametrize(
    ("matrix", "fine"),
    [
        (np.diag([-1.0, 1.0, 1.0]), False),  # mirrored
        (np.diag([1.0, 1.0, -1.0]), False),
        (np.diag([-1.0, -1.0, -1.0]), False),
        (np.diag([0.0, 1.0, 1.0]), False),
        (np.diag([1.024, 1.0, 1.0]), True),  # 1.024² - 1 = 0.0486
        (np.diag([1.0, 1.0, 0.976]), True),
        (np.diag([1.025, 1.0, 1.0]), False),  # 0.0506
        (np.array([[1.0, 0.049, 0], [0, 1, 0], [0, 0, 1]]), True),
        (np.array([[1.0, 0.051, 0], [0, 1, 0], [0, 0, 1]]), False),
    ],
)
def test_only_rotations_are_taken_for_cameras(tmp_path: Path, matrix: np.ndarray, fine: bool) -> None:
    (tmp_path / "a.txt").write_text(rows_of(matrix))
    if fine:
        load(tmp_path / "a.txt")
        return
    with pytest.raises(BadInputError) as raised:
        load(tmp_path / "a.txt")
    assert str(raised.value) == (
        f"{tmp_path}/a.txt: found 1 samples that are no rotation (first: line 1) and 0 times that do not "
        "increase, of 1, expected at least half of the samples sound"
    )


def test_places_farther_than_100_km_are_left_out() -> None:
    turns = np.tile(np.eye(3), (3, 1, 1))
    for far, used in ((99_999.0, 3), (1e5, 2), (-1e5, 2), (np.nan, 2)):
        places = np.zeros((3, 3))
        places[1, 2] = far
        raw = RawCamera(np.arange(3.0), turns, places, "y", LENSES, "usual", ())
        assert len(path_from_recording(raw, "here", SPEC).times_s) == used


def test_what_the_scene_says_of_the_lens_wins() -> None:
    raw = RawCamera(np.arange(2.0), np.tile(np.eye(3), (2, 1, 1)), np.zeros((2, 3)), "y", LENSES, "usual", ("x",))
    camera = path_from_recording(raw, "here", CameraSpec(fov_y_deg=50.5, near_m=0.2, far_m=30.0))
    assert camera.optics == one_lens(50.5, 0.2, 30.0)
    assert camera.notes == (
        "x",
        f"Y up{OF_FIRST}",
        "field of view 50.5 degrees high, as given",
    )
    assert camera.recorded and camera.wrap is Wrap.BOUNCE
    holed = RawCamera(np.arange(5.0), np.tile(np.eye(3), (5, 1, 1)), np.zeros((5, 3)), "y", LENSES, "usual", ())
    holed.places[2] = np.nan
    assert path_from_recording(holed, "here", SPEC).notes == (
        f"Y up{OF_FIRST}",
        "field of view 36 degrees high, usual",
        "1 samples not finite (first: number 2), interpolated across",
        "1 gaps, the longest 2000 ms, interpolated across",
    )


def test_times_too_far_apart_for_a_number_are_left_out(tmp_path: Path) -> None:
    row = LOOKS_ALONG_X.format(x=0, y=0, z=0)
    (tmp_path / "a.txt").write_text(arkit_rows(f"-1.7e308 {row}", f"1.7e308 {row}"))
    assert load(tmp_path / "a.txt").times_s.tolist() == [0.0]


def test_each_pose_may_have_a_lens_of_its_own() -> None:
    """Half way from f = 400 to 600 of 480 rows it is 500; a pose that is left out takes its lens and photo along."""
    lenses = tuple(Lens(640.0, 480.0, f, f, c, 240.0) for f, c in ((400.0, 320.0), (9.0, 0.0), (600.0, 330.0)))
    raw = RawCamera(
        np.arange(3.0), np.tile(np.eye(3), (3, 1, 1)), np.zeros((3, 3)), "y", lenses, "by the file", (),
        pictures=("a", "b", "c"),
    )  # fmt: skip
    raw.places[1] = np.nan
    camera = path_from_recording(raw, "here", SPEC)
    assert camera.pictures == ("a", "c")
    assert camera.lens(1.0, (480, 640)) == Lens(640, 480, 500, 500, 325, 240)
    x, y = pixel(camera, [0.2, 0.1, -1.0], 1.0)
    assert (x, y) == pytest.approx((325 + 100, 240 - 50))
    assert camera.notes[1] == "field of view 43.6 to 61.93 degrees high, by the file"


def test_a_principal_point_turns_with_the_device() -> None:
    """The camera's x axis points down: its picture is turned clockwise, and column cx becomes row cx."""
    held = np.column_stack([[0, -1, 0], [1, 0, 0], [0, 0, 1]])
    lens = Lens(640.0, 480.0, 500.0, 480.0, 300.0, 200.0)
    raw = RawCamera(
        np.zeros(1), held[None].astype(float), np.zeros((1, 3)), "y", (lens,), "by the file", (), is_levelled=True
    )
    camera = path_from_recording(raw, "here", SPEC)
    assert camera.optics.lenses == (Lens(480.0, 640.0, 480.0, 500.0, 280.0, 300.0),)
