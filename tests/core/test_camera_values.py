"""Cameras by value: a point of the world must come out at a pixel worked out by hand, whatever the format."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from trilane.errors import BadInputError
from trilane.scene.camera import nerf, text_table
from trilane.scene.camera.load import load_camera
from trilane.scene.camera.path import CameraPath, Lens, look_at, projection_matrix, view_from_pose
from trilane.scene.camera.recorded import OPENGL_FROM_OPTICAL, RawCamera, path_from_recording
from trilane.scene.camera.text_table import column_count, elapsed, read_table
from trilane.scene.motion.motion import Wrap
from trilane.scene.schema import CameraSpec
from trilane.testing.camera_files import HEIGHT, angle, load, nerf_text, pixel, pose_z_up, rows_of

SPEC = CameraSpec()


def focal(fov_y_deg: float) -> float:
    return HEIGHT / 2 / math.tan(math.radians(fov_y_deg) / 2)


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
    assert camera.lens == Lens(36.0, 0.05, 100.0)
    assert camera.notes == (
        "ARKit log, 1 poses, time in s, camera to world",
        "Y up",
        "field of view 36 degrees high, usual for a phone",
        "one pose: held",
    )


#: A level picture's right (r) and up (u) after the device was turned by quarters: the columns of the matrix x, y.
HELD = {
    0: ("r", "u", 36.0),
    1: ("-u", "r", 60.0),
    2: ("-r", "-u", 36.0),
    3: ("u", "-r", 60.0),
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
    camera = load(tmp_path / "a.txt")
    assert camera.lens.fov_y_deg == fov
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
    f = focal(49.8)
    # 4 m ahead (+Y), 0.5 m right (+X), 1 m up (+Z): (1.5, 6, 4) of the recording; Y up world: (x, z, -y).
    assert pixel(camera, [1.5, 4.0, -6.0]) == pytest.approx((320 + f / 8, 240 - f / 4))
    assert pixel(camera, [1.5, 4.0, -6.0], 0.5) == pytest.approx((320 + f / 8, 240))
    assert camera.notes == (
        "TUM trajectory, 2 poses, 2/s, optical axes, camera to world",
        "Z up",
        "field of view 49.8 degrees high, usual for a Kinect",
        "0.50 s, then plays back and forth",
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
    (tmp_path / "a.txt").write_text("0 0 0 0 " + " ".join(str(value) for value in 3 * q))
    turn, _ = load(tmp_path / "a.txt").pose(0.0)
    z_up = np.column_stack([r[:, 0], -r[:, 1], -r[:, 2]])
    assert turn == pytest.approx(np.stack([z_up[0], z_up[2], -z_up[1]]), abs=1e-9)


def test_a_kinect_held_upright_has_its_width_high(tmp_path: Path) -> None:
    """As above, then rolled by 90 degrees about the line of sight: the quaternions' product by hand."""
    (tmp_path / "a.txt").write_text("10 1 2 3 -0.5 0.5 0.5 0.5\n")  # (w, x, y, z) = ½ (1, -1, 1, 1)
    camera = load(tmp_path / "a.txt")
    assert camera.lens.fov_y_deg == 63.5
    assert camera.notes[1] == "Z up, device held so that the picture is turned by 90 degrees"
    assert camera.notes[0] == "TUM trajectory, 1 poses, optical axes, camera to world"


def test_a_camera_that_looks_straight_down_keeps_its_picture() -> None:
    """No turn of the picture has its up near the usual one: up is the axis nearest to the picture's own up."""
    down = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])  # x right, up = -Z, looks along -Y
    raw = RawCamera(np.zeros(1), down[None], np.zeros((1, 3)), "y", 36.0, 60.0, "usual", ())
    camera = path_from_recording(raw, "here", SPEC)
    assert camera.notes[0] == "-Z up, as the camera is held (not Y, usual for the format)"
    assert camera.pose(0.0)[0][:, 1] == pytest.approx([0, 1, 0], abs=1e-12)
    assert camera.lens.fov_y_deg == 36.0


@pytest.mark.parametrize(
    ("axis", "sign", "usual"), [(0, 1, "y"), (0, -1, "y"), (1, 1, "z"), (1, -1, "z"), (2, 1, "y"), (2, -1, "y")]
)
def test_up_is_the_axis_that_the_picture_shows_up(axis: int, sign: int, usual: str) -> None:
    """Cameras that look along the usual up: every axis of the picture is level, so its own up decides."""
    up, look = np.eye(3)[axis] * sign, np.eye(3)["xyz".index(usual)]
    turns = np.column_stack([np.cross(look, up), up, -look])
    raw = RawCamera(np.zeros(1), turns[None], np.ones((1, 3)), usual, 36.0, 60.0, "usual", ())
    camera = path_from_recording(raw, "here", SPEC)
    assert camera.notes[0].startswith(f"{'-' if sign < 0 else ''}{'XYZ'[axis]} up, as the camera is held")
    world = camera.pose(0.0)[0] @ turns.T
    assert world @ up == pytest.approx([0, 1, 0], abs=1e-12)
    assert camera.places[0] == pytest.approx(world @ np.ones(3), abs=1e-12)


@pytest.mark.parametrize(("cosine", "turned"), [(0.31, True), (0.29, False)])
def test_the_usual_up_holds_above_a_cosine_of_0_3(cosine: float, turned: bool) -> None:
    sine = math.sqrt(1 - cosine**2)
    pitched = np.array([[1.0, 0, 0], [0, cosine, sine], [0, -sine, cosine]])  # up (0, cos, -sin): looks down steeply
    raw = RawCamera(np.zeros(1), pitched[None], np.zeros((1, 3)), "y", 36.0, 60.0, "usual", ())
    note = path_from_recording(raw, "here", SPEC).notes[0]
    assert note == ("Y up" if turned else "-Z up, as the camera is held (not Y, usual for the format)")


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
        f"{tmp_path}/a.txt: found 1 samples that are not finite numbers or no rotation and 0 times that do not "
        "increase, of 1, expected at least half of the samples sound"
    )


def test_places_farther_than_100_km_are_left_out() -> None:
    turns = np.tile(np.eye(3), (3, 1, 1))
    for far, used in ((99_999.0, 3), (1e5, 2), (-1e5, 2), (np.nan, 2)):
        places = np.zeros((3, 3))
        places[1, 2] = far
        raw = RawCamera(np.arange(3.0), turns, places, "y", 36.0, 60.0, "usual", ())
        assert len(path_from_recording(raw, "here", SPEC).times_s) == used


def test_what_the_scene_says_of_the_lens_wins() -> None:
    raw = RawCamera(np.arange(2.0), np.tile(np.eye(3), (2, 1, 1)), np.zeros((2, 3)), "y", 36.0, 60.0, "usual", ("x",))
    camera = path_from_recording(raw, "here", CameraSpec(fov_y_deg=50.5, near_m=0.2, far_m=30.0))
    assert camera.lens == Lens(50.5, 0.2, 30.0)
    assert camera.notes == (
        "x",
        "Y up",
        "field of view 50.5 degrees high, as given",
        "1.00 s, then plays back and forth",
    )
    assert camera.recorded and camera.wrap is Wrap.BOUNCE
    holed = RawCamera(np.arange(5.0), np.tile(np.eye(3), (5, 1, 1)), np.zeros((5, 3)), "y", 36.0, 60.0, "usual", ())
    holed.places[2] = np.nan
    assert path_from_recording(holed, "here", SPEC).notes == (
        "Y up",
        "field of view 36 degrees high, usual",
        "1 samples not finite or no rotation (first: number 2), interpolated across",
        "1 gaps, the longest 2000 ms, interpolated across",
        "4.00 s, then plays back and forth",
    )


def test_times_too_far_apart_for_a_number_are_left_out(tmp_path: Path) -> None:
    row = LOOKS_ALONG_X.format(x=0, y=0, z=0)
    (tmp_path / "a.txt").write_text(arkit_rows(f"-1.7e308 {row}", f"1.7e308 {row}"))
    assert load(tmp_path / "a.txt").times_s.tolist() == [0.0]


# --- NeRF ---


def test_a_nerf_view_puts_points_at_their_pixels(tmp_path: Path) -> None:
    """fl_y = 600 of 480 rows: at (1, 2, 3), 4 m along +Y, 0.5 m right (+X), 1 m up (+Z) is at 75 right, 150 above."""
    (tmp_path / "a.json").write_text(nerf_text(pose_z_up(0, (1, 2, 3)), fl_y=600, h=480, fl_x=300, w=640))
    assert pixel(load(tmp_path / "a.json"), [1.5, 4.0, -6.0]) == pytest.approx((395, 90))
    (tmp_path / "a.json").write_text(nerf_text(pose_z_up(0, (1, 2, 3))[:3]))  # 3x4 is enough
    load(tmp_path / "a.json")


#: Keys of the file -> field of view of height and width (by tangents of their halves), and where they come from.
LENSES: list[tuple[dict[str, float], float, float, str]] = [
    ({"fl_y": 400, "h": 480, "w": 640}, 0.6, 0.8, "by `fl_y`"),
    ({"fl_y": 400, "h": 480}, 0.6, 0.8, "by `fl_y`"),  # the usual aspect, 4:3
    ({"fl_y": 400, "h": 480, "w": 640, "fl_x": 800, "camera_angle_x": 1.0}, 0.6, 0.8, "by `fl_y`"),
    ({"fl_x": 500, "w": 800, "h": 400}, 0.4, 0.8, "by `fl_x`"),
    ({"fl_x": 500, "w": 800}, 0.6, 0.8, "by `fl_x`"),
    ({"fl_x": 500, "w": 800, "h": 400, "fl_y": 100}, 2.0, 4.0, "by `fl_y`"),
    ({"fl_y": 500, "w": 800, "camera_angle_x": math.pi / 2}, 0.75, 1.0, "by `camera_angle_x`"),  # no `h`
    ({"fl_x": 500, "h": 800, "camera_angle_x": math.pi / 2}, 0.75, 1.0, "by `camera_angle_x`"),  # no `w`
    ({"camera_angle_x": math.pi / 2, "w": 1000, "h": 500}, 0.5, 1.0, "by `camera_angle_x`"),
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
        camera = load(tmp_path / "a.json")
        assert camera.lens.fov_y_deg == pytest.approx(angle(tangent))
        assert camera.notes[2] == f"field of view {angle(tangent):.4g} degrees high, {note}"


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
    assert nerf.MAX_FRAMES == 100_000


ONE = pose_z_up(0).tolist()
REFUSED: dict[str, tuple[Any, str]] = {
    "list": (
        [],
        ": found no list `frames`, expected a NeRF transforms.json: `frames`, each with a 4x4 `transform_matrix`",
    ),
    "frames": ({"frames": {}}, ": found no list `frames`, expected"),
    "none": ({"frames": []}, ": frames: found 0 frames, expected 1 to 100000"),
    "number": ({"frames": [3]}, ": frames[0].transform_matrix: found shape (), expected a 4x4 matrix"),
    "text": (
        {"frames": [{"transform_matrix": ONE}, {"transform_matrix": "x"}]},
        ": frames[1].transform_matrix: found something else than numbers, expected a 4x4 matrix",
    ),
    "shape": (
        {"frames": [{"transform_matrix": [[1] * 4] * 5}]},
        ": frames[0].transform_matrix: found shape (5, 4), exp",
    ),
    "true": ({"frames": [{"transform_matrix": ONE}], "w": True}, ": w: found True, expected a positive number"),
    "zero": ({"frames": [{"transform_matrix": ONE}], "h": 0}, ": h: found 0, expected a positive number"),
    "words": (
        {"frames": [{"transform_matrix": ONE}], "fl_x": "x" * 50},
        f": fl_x: found '{'x' * 39}, expected a positive",
    ),
    "infinite": (
        {"frames": [{"transform_matrix": ONE}], "fl_y": math.inf},
        ": fl_y: found inf, expected a positive nu",
    ),
    "pi": (
        {"frames": [{"transform_matrix": ONE}], "camera_angle_x": math.pi},
        ": camera_angle_x: found 3.14159, expected an angle in radians below pi",
    ),
    "wide": (
        {"frames": [{"transform_matrix": ONE}], "fl_y": 1, "h": 24, "w": 24},
        ": found a field of view of 170.5 degrees over the height, expected 1 to 170",
    ),
    "narrow": (
        {"frames": [{"transform_matrix": ONE}], "fl_y": 60, "h": 1, "w": 60},
        ": found a field of view of 0.9549 degrees over the height, expected 1 to 170",
    ),
    "wide only across": (
        {"frames": [{"transform_matrix": ONE}], "fl_y": 1, "h": 2, "w": 24},
        ": found a field of view of 170.5 degrees over the width, expected 1 to 170",
    ),
}


@pytest.mark.parametrize("case", REFUSED)
def test_a_wrong_nerf_file_is_refused_in_one_sentence(tmp_path: Path, case: str) -> None:
    content, sentence = REFUSED[case]
    path = tmp_path / "a.json"
    path.write_text(json.dumps(content))
    with pytest.raises(BadInputError) as raised:
        load(path)
    assert f"{path}{sentence}" in str(raised.value)


def test_fields_of_view_just_inside_the_range_are_read(tmp_path: Path) -> None:
    for degrees in (1.1, 169.0):
        tangent = math.tan(math.radians(degrees / 2))
        (tmp_path / "a.json").write_text(nerf_text(pose_z_up(0), fl_y=1.0, h=2 * tangent, w=2 * tangent))
        assert load(tmp_path / "a.json").lens.fov_y_deg == pytest.approx(degrees)


def test_a_nerf_file_may_have_so_many_views(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(nerf, "MAX_FRAMES", 2)
    (tmp_path / "a.json").write_text(nerf_text(*[pose_z_up(0)] * 2))
    load(tmp_path / "a.json")
    (tmp_path / "a.json").write_text(nerf_text(*[pose_z_up(0)] * 3))
    with pytest.raises(BadInputError, match="found 3 frames, expected 1 to 2"):
        load(tmp_path / "a.json")


# --- text tables ---


def test_a_table_has_comments_commas_and_blank_lines(tmp_path: Path) -> None:
    path = tmp_path / "a.txt"
    path.write_text("# 9 9 9\n\n1, 2,3 # not 4\n  4 5\tnan\n")
    assert read_table(path, 3, "three") == pytest.approx(np.array([[1, 2, 3], [4, 5, np.nan]]), nan_ok=True)
    assert column_count(path, "three") == 3
    path.write_text("# only this\n")
    assert column_count(path, "three") == 0
    path.write_text("1 2 3\n# x\n1 2\n")
    with pytest.raises(BadInputError) as raised:
        read_table(path, 3, "three numbers")
    assert str(raised.value) == f"{path}, line 3: found 2 columns, expected three numbers"
    path.write_text("1 2 3\n1 2 x\n")
    with pytest.raises(BadInputError) as raised:
        read_table(path, 3, "three numbers")
    assert str(raised.value) == f"{path}, line 2: found could not convert string to float: 'x', expected three numbers"


def test_a_table_may_have_a_million_rows(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert text_table.MAX_ROWS == 1_000_000
    monkeypatch.setattr(text_table, "MAX_ROWS", 2)
    path = tmp_path / "a.txt"
    path.write_text("1\n2\n")
    assert len(read_table(path, 1, "one")) == 2
    for text, count in (("1\n2\n3\n", 3), ("# 1\n", 0)):
        path.write_text(text)
        with pytest.raises(BadInputError, match=f"found {count} poses, expected 1 to 2; one"):
            read_table(path, 1, "one")


def test_elapsed_times_by_hand() -> None:
    times, step = elapsed(np.array([np.nan, 5.0, 6.0, 8.0, 8.5]))
    assert times == pytest.approx([np.nan, 0, 1, 3, 3.5], nan_ok=True)
    assert step == 1.0
    times, step = elapsed(np.array([4.0, np.nan]))
    assert (times[0], step) == (0.0, 0.0)
    times, step = elapsed(np.array([4.0, 6.0]))
    assert (times.tolist(), step) == ([0.0, 2.0], 2.0)


# --- which reader ---


def test_the_format_is_told_by_columns_or_given(tmp_path: Path) -> None:
    tum, ark, other = "0 0 0 0 0 0 0 1\n", rows_of(np.eye(3)), "1 2 3 4\n"
    for text, note in ((tum, "TUM trajectory, 1 poses"), (ark, "ARKit log, 1 poses")):
        (tmp_path / "a.log").write_text(text)
        assert load(tmp_path / "a.log").notes[0].startswith(note)
    (tmp_path / "a.JSON").write_text(nerf_text(pose_z_up(0)))
    assert load(tmp_path / "a.JSON").notes[0].startswith("NeRF")
    (tmp_path / "a.txt").write_text(nerf_text(pose_z_up(0)))
    assert load(tmp_path / "a.txt", format="nerf").notes[0].startswith("NeRF")
    for text, kind, sentence in (
        (other, "auto", "found 4 columns, expected 13 (ARKit) or 8 (TUM)"),
        (
            tum,
            "arkit",
            ", line 1: found 8 columns, expected an ARKit log: time and the 12 numbers of a 3x4 matrix a line",
        ),
        (ark, "tum", ", line 1: found 13 columns, expected a TUM trajectory: time, tx ty tz, qx qy qz qw a line"),
        (tum, "nerf", "expected a NeRF transforms.json: `frames`, each with a 4x4 `transform_matrix`"),
    ):
        (tmp_path / "a.txt").write_text(text)
        with pytest.raises(BadInputError) as raised:
            load(tmp_path / "a.txt", format=kind)
        assert f"{tmp_path}/a.txt" in str(raised.value) and str(raised.value).endswith(sentence)
    with pytest.raises(BadInputError) as raised:
        load("builtin:drone")
    assert str(raised.value) == (
        "camera: found 'builtin:drone', expected builtin:{orbit, static, closeup, far} or a file"
    )
    with pytest.raises(BadInputError) as raised:
        load(tmp_path / "nowhere.txt")
    assert str(raised.value) == (
        f"{tmp_path}/nowhere.txt: found no such file, expected a camera file: an ARKit log, a TUM trajectory or a NeRF "
        "transforms.json"
    )


def test_a_relative_path_starts_at_the_base(tmp_path: Path) -> None:
    (tmp_path / "a.txt").write_text("0 0 0 0 0 0 0 1\n")
    assert load_camera(CameraSpec(source="a.txt"), tmp_path).recorded


# --- built-in cameras: name, target height, eye height, farthest, nearest, swing in degrees, period in seconds ---

BUILT_IN = [
    ("orbit", 0.93, 1.35, 3.9, 3.4, 28.0, 20.0, "whole person, going round, coming nearer"),
    ("static", 0.93, 1.30, 3.8, 3.8, 0.0, 20.0, "whole person, standing still"),
    ("closeup", 1.50, 1.58, 1.15, 0.95, 16.0, 12.0, "head and shoulders"),
    ("far", 1.00, 1.60, 10.0, 8.0, 10.0, 20.0, "whole person, far off"),
]


@pytest.mark.parametrize(("name", "target", "eye", "far", "near", "swing", "period", "what"), BUILT_IN)
def test_a_built_in_camera_is_where_its_formula_says(
    name: str, target: float, eye: float, far: float, near: float, swing: float, period: float, what: str
) -> None:
    """Farthest at 0, nearest at half the period; the swing is a sine that is 0.6 rad late."""
    camera = load(f"builtin:{name}", near_m=0.1, far_m=50.0)
    assert (camera.duration_s, camera.wrap, camera.recorded) == (period, Wrap.LOOP, False)
    assert (len(camera.times_s), camera.lens) == (round(period * 30) + 1, Lens(40.0, 0.1, 50.0))
    assert camera.notes == (f"built in: {what}, {period:g} s a cycle, field of view 40 degrees high",)
    for share, distance in ((0.0, far), (0.25, (far + near) / 2), (0.5, near), (0.75, (far + near) / 2)):
        angle = math.radians(swing) * math.sin(2 * math.pi * share - 0.6)
        place = np.array([distance * math.sin(angle), eye, distance * math.cos(angle)])
        turn, found = camera.pose(share * period)
        assert found == pytest.approx(place, abs=1e-9)
        back = (place - [0, target, 0]) / np.linalg.norm(place - [0, target, 0])
        right = np.array([back[2], 0, -back[0]]) / math.hypot(back[0], back[2])
        assert turn == pytest.approx(np.column_stack([right, np.cross(back, right), back]), abs=1e-9)
        assert turn[1, 1] > 0
    assert load(f"builtin:{name}", fov_y_deg=33.5).lens.fov_y_deg == 33.5


# --- paths and lenses ---


def test_a_path_between_and_after_its_samples() -> None:
    """A quarter turn about +Y in 2 s while the camera moves 4 m along x."""
    h = math.sqrt(0.5)
    quats, places = np.array([[1.0, 0, 0, 0], [h, 0, h, 0]]), np.array([[0.0, 1, 0], [4.0, 1, 0]])
    bounce = CameraPath(np.array([0.0, 2.0]), quats, places, Lens(90.0, 0.1, 10.0), ())
    loop = CameraPath(np.array([0.0, 2.0]), quats, places, Lens(90.0, 0.1, 10.0), (), Wrap.LOOP)
    assert bounce.wrap is Wrap.BOUNCE and bounce.recorded and bounce.duration_s == 2.0
    for path, t_s, share in ((bounce, 0.5, 0.25), (bounce, 3.5, 0.25), (bounce, 4.5, 0.25), (loop, 3.5, 0.75)):
        turn, place = path.pose(t_s)
        a = share * math.pi / 2
        assert place == pytest.approx([4 * share, 1, 0])
        assert turn == pytest.approx(
            np.array([[math.cos(a), 0, math.sin(a)], [0, 1, 0], [-math.sin(a), 0, math.cos(a)]])
        )
        assert path.sample(t_s) @ [*place, 1.0] == pytest.approx([0, 0, 0, 1])
    assert bounce.projection(2.0) == pytest.approx(projection_matrix(90.0, 2.0, 0.1, 10.0))


def test_a_projection_by_hand() -> None:
    """90 degrees high, twice as wide as high, from 2 m to 6 m: depth = (-2 z - 6) / -z, written out."""
    assert projection_matrix(90.0, 2.0, 2.0, 6.0) == pytest.approx(
        np.array([[0.5, 0, 0, 0], [0, 1, 0, 0], [0, 0, -2, -6], [0, 0, -1, 0]])
    )


def test_views_by_hand() -> None:
    quarter = np.array([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]])  # about +Y by 90 degrees: looks along -X
    view = view_from_pose(quarter, np.array([1.0, 2.0, 3.0]))
    assert view == pytest.approx(np.array([[0, 0, -1, 3], [0, 1, 0, -2], [1, 0, 0, -1], [0, 0, 0, 1]]))
    assert look_at(np.array([5.0, 0.0, 0.0]), np.zeros(3)) == pytest.approx(
        np.array([[0, 0, -1, 0], [0, 1, 0, 0], [1, 0, 0, -5], [0, 0, 0, 1]])
    )
