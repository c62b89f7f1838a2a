"""Recorded cameras: points at pixels worked out by hand, in every format, axis system and scale."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from support.camera_files import HEIGHT, LENS, RATE_HZ, VIDEO_LENS, WRITERS, load, pixel, rows_of
from trilane.arrays import F64
from trilane.body.body import ShapedBody
from trilane.errors import BadInputError
from trilane.scene.camera.files import load_camera
from trilane.scene.camera.path import CameraPath, one_lens
from trilane.scene.camera.recorded import (
    MAP_M,
    OF_FIRST,
    OPENGL_FROM_OPTICAL,
    UP,
    RawCamera,
    find_upright,
    near_origin,
    path_from_recording,
)
from trilane.scene.camera_placement import PlacedCamera, _from_the_middle, place_camera
from trilane.scene.lens import Lens, of_fov_y
from trilane.scene.motion.builtin import BUILTIN
from trilane.scene.motion.motion import Wrap
from trilane.scene.mover import make_mover
from trilane.scene.rotations import about, matrix_from_quat, matrix_from_rotvec, shortest_turn
from trilane.scene.schema import AvatarSpec, CameraSpec, Scene

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


@pytest.mark.parametrize(
    ("first", "step", "step_s", "note"),
    [
        (5.5, 0.001, 0.001, "1000/s, time in s"),
        (5.5, 2.5, 2.5, "0.4/s, time in s"),
        (5.0, 1001.0, 0.0, None),
        (5.0, 3001.0, 3.001e-3, "333.2/s, time in us"),
        (5.0, 999e3, 0.999, "1.001/s, time in us"),
        (5.0, 1.001e6, 0.0, None),
        (5.0, 3.001e6, 3.001e-3, "333.2/s, time in ns"),
        (1.7e9, 30.0, 30.0, None),
        (1.7e9, 2.0, 2.0, "0.5/s, time in s"),
        (1.7e12, 33.0, 0.033, "30.3/s, time in ms"),
        (1.7e15, 2.5e6, 2.5, "0.4/s, time in us"),
        (1.7e18, 2.5e9, 2.5, "0.4/s, time in ns"),
        (1.1e12, 16e6, 0.016, "62.5/s, time in ns"),
        (0.0, 33.0, 0.033, None),
        (0.5, 33.3, 0.0333, None),
        (5.0, 0.0005, 0.0, None),
    ],
)
def test_units_of_times_follow_from_their_steps_and_the_calendar(
    tmp_path: Path, first: float, step: float, step_s: float, note: str | None
) -> None:
    """Cameras take 1 to 300 poses a second, or one in 3 s at least by a clock since 1970 (1.7e9 s is in 2023).

    In seconds they may take 1000, as no longer unit has such steps. 1.1e12 ns are 18 minutes after a device was
    switched on; they are no ms of 2004. Others are asked about.
    """
    rows = [LOOKS_ALONG_X.format(x=k, y=0, z=0) for k in range(4)]
    (tmp_path / "a.txt").write_text(arkit_rows(*(f"{first + k * step!r} {row}" for k, row in enumerate(rows))))
    if note is None:
        with pytest.raises(BadInputError, match=r"camera\.time_unit"):
            load(tmp_path / "a.txt")
        return
    camera = load(tmp_path / "a.txt")
    assert camera.times_s == pytest.approx(step_s * np.arange(4), rel=1e-3)
    assert camera.notes[0] == f"ARKit log, 4 poses, {note}, camera to world"
    assert [place[0] for place in camera.places] == [0, 1, 2, 3]


def test_a_tum_pose_puts_points_at_their_pixels(tmp_path: Path) -> None:
    """Optical axes, Z up; turned about the world's x by -90 degrees: it looks along +Y, x is right, z is up."""
    h = math.sqrt(0.5)
    (tmp_path / "a.txt").write_text(f"10 1 2 3 {-h} 0 0 {h}\n10.5 1 2 4 {-2 * h} 0 0 {2 * h}\n")
    camera = load(tmp_path / "a.txt", format="tum")
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
        "taken for TUM trajectory: as given",
    )
    assert OPENGL_FROM_OPTICAL.tolist() == [[1, 0, 0], [0, -1, 0], [0, 0, -1]]


def test_a_camera_that_looks_straight_down_keeps_its_picture() -> None:
    """No turn of the picture has its up near the usual one: up is the axis nearest to the picture's own up.

    A level camera of another world has the same pose, so a note names the usual axis.
    """
    down = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])  # x right, up = -Z, looks along -Y
    raw = RawCamera(np.zeros(1), down[None], np.zeros((1, 3)), "y", LENSES, "usual", ())
    camera = path_from_recording(raw, "here", SPEC)
    assert camera.notes[0] == (
        "-Z up, as the camera is held (not Y, usual for the format); "
        "Y up fits if it looks straight down: camera.up_axis decides"
    )
    assert camera.pose(0.0)[0][:, 1] == pytest.approx([0, 1, 0], abs=1e-12)
    assert fov_y(camera) == pytest.approx(36.0)


@pytest.mark.parametrize(("cosine", "turned"), [(0.31, True), (0.29, False)])
def test_the_usual_up_holds_above_a_cosine_of_0_3(cosine: float, turned: bool) -> None:
    sine = math.sqrt(1 - cosine**2)
    pitched = np.array([[1.0, 0, 0], [0, cosine, -sine], [0, sine, cosine]])  # up (0, cos, sin): looks up steeply
    raw = RawCamera(np.zeros(1), pitched[None], np.zeros((1, 3)), "y", LENSES, "usual", (), is_levelled=True)
    note = path_from_recording(raw, "here", SPEC).notes[0]
    assert note.split(";")[0] == ("Y up" if turned else "Z up, as the camera is held (not Y, usual for the format)")


@pytest.mark.parametrize("usual", ["y", "z", "-y"])
@pytest.mark.parametrize("off_deg", [0.0, 3.0])
def test_a_drone_that_looks_straight_down_keeps_the_usual_axis(usual: str, off_deg: float) -> None:
    """Its heading wanders by 30 degrees about one that is 10 degrees off the map's axes, so no other axis is level."""
    headings = math.radians(10.0) + np.radians(30.0) * np.sin(np.linspace(0, 7, 60))
    down = about(1, headings) @ about(0, math.radians(-90.0 + off_deg))
    world = shortest_turn(np.array(UP["y"]), np.array(UP[usual]))
    found = find_upright(world @ down, usual, is_levelled=False)
    assert (found.up.tolist(), found.quarter) == (list(UP[usual]), 0), found.note
    assert found.note == f"{usual.upper()} up, usual for the format, as the camera looks straight down"


@pytest.mark.parametrize("pitch", [-74.0, -80.0, -90.0])
def test_gravity_tells_up_where_a_phone_looks_straight_down(pitch: float) -> None:
    """A levelled world has Y up by definition, so a still view down is no level view of another world."""
    found = find_upright(about(0, math.radians(pitch))[None], "y", is_levelled=True)
    assert (found.up.tolist(), found.quarter) == (list(UP["y"]), 0), found.note


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
        "1 gap, the longest 2000 ms, interpolated across",
    )


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


OPTICAL = np.diag([1.0, -1.0, -1.0])


def pan(degrees: float, pitch_deg: float, roll_deg: float = 0.0, count: int = 31) -> np.ndarray:
    """Level cameras (N, 3, 3) in a Y-up world that turn by `degrees` to either side; their pictures rolled."""
    headings = np.radians(degrees) * np.linspace(-1, 1, count)
    return about(1, headings) @ about(0, math.radians(pitch_deg)) @ about(2, math.radians(roll_deg))


@pytest.mark.parametrize("pitch", [-25.0, 0.0, 25.0])
@pytest.mark.parametrize("degrees", [5.0, 30.0, 170.0])
def test_first_camera_coordinates(degrees: float, pitch: float) -> None:
    """World axes are the first view's optical ones; up is -Y, or where the horizons are level if that was tilted."""
    turns = pan(degrees, pitch)
    first = turns[len(turns) // 2] @ OPTICAL  # columns: right, down, ahead
    found = find_upright(first.T @ turns, "z", is_levelled=False)
    assert found.quarter == 0
    true = first.T @ [0.0, 1.0, 0.0]
    allowed = 1e-6 if pitch == 0.0 or degrees == 170.0 else abs(math.radians(pitch)) + 1e-6
    assert math.acos(min(1.0, float(found.up @ true))) < allowed, found.note


def test_a_map_of_the_first_picture_that_does_not_tell_its_pitch_says_so() -> None:
    """It pans by 5 degrees, looking down by 20: the axes are taken for level, and nothing else is known."""
    turns = pan(5.0, -20.0)
    said = "; the axes are those of the first picture: if that looked down or up, the floor is tilted by as much"
    for axes, up in ((OPTICAL, "-Y"), (np.eye(3), "Y")):
        own = (turns[0] @ axes).T @ turns
        assert find_upright(own, "-y" if up == "-Y" else "y", is_levelled=False).note.removesuffix(said) == f"{up} up"
        assert find_upright(own, "-y", is_levelled=False).note.endswith(said)
        assert not find_upright(own, "y", is_levelled=True).note.endswith(said)  # gravity is known
        assert not find_upright(own[:1], "-y", is_levelled=False).note.endswith(said)  # one picture makes no map
    wide = pan(170.0, -20.0)
    assert not find_upright((wide[0] @ OPTICAL).T @ wide, "-y", is_levelled=False).note.endswith(
        said
    )  # the horizons tell it
    assert not find_upright(about(1, 0.01) @ wide[:2], "y", is_levelled=False).note.endswith(said)


@pytest.mark.parametrize(("degrees", "pitch"), [(0, 0), (0, -20), (5, -20), (15, -50), (45, -50), (120, -35), (170, 0)])
def test_up_is_found_in_every_axis_system(degrees: float, pitch: float) -> None:
    """Where the camera looks within 20 degrees of level, or pans by 15 either way; held by hand, 2 degrees off."""
    rng = np.random.default_rng(18)
    turns = pan(degrees, pitch) @ about(0, rng.normal(0, 0.035, 31)) @ about(2, rng.normal(0, 0.035, 31))
    for order, signs in itertools.product(itertools.permutations(range(3)), itertools.product((1.0, -1.0), repeat=3)):
        system = np.eye(3)[list(order)] * np.array(signs)[:, None]
        if np.linalg.det(system) < 0:
            continue
        for usual in ("y", "z", "-y"):
            found = find_upright(system @ turns, usual, is_levelled=False)
            assert found.quarter == 0 and found.up @ system[:, 1] == pytest.approx(1.0), found.note


@pytest.mark.parametrize("quarter", range(4))
def test_a_turned_device_is_believed_where_its_horizon_says_so(quarter: int) -> None:
    """A pan of 40 degrees either way; a picture on its head is rather one of a world with another up."""
    turns = pan(40.0, -10.0, roll_deg=-90.0 * quarter)
    for is_levelled in (True,) if quarter == 2 else (False, True):
        found = find_upright(turns, "y", is_levelled)
        assert (found.up.tolist(), found.quarter) == ([0.0, 1.0, 0.0], quarter), found.note


def test_a_turn_is_not_believed_before_every_axis() -> None:
    """One view that is turned by 90 degrees: in a world that may be any, its own up; in a levelled one the turn."""
    turns = pan(0.0, 0.0, roll_deg=-90.0, count=1)
    assert find_upright(turns, "y", is_levelled=False).note == (
        "X up, as the camera is held (not Y, usual for the format)"
    )
    assert (
        find_upright(turns, "y", is_levelled=True).note
        == "Y up, device held so that the picture is turned by 90 degrees"
    )


def test_horizons_decide_where_a_camera_looks_down() -> None:
    """50 degrees down, panning by 20 either way: -Z, the usual axis, is nearer to the pictures' up, but not level."""
    turns = pan(20.0, -50.0)
    assert (turns[:, :, 1] @ UP["-z"]).mean() > (turns[:, :, 1] @ UP["y"]).mean() > 0.6
    assert find_upright(turns, "-z", is_levelled=False).up.tolist() == list(UP["y"])


def test_a_near_rival_is_named() -> None:
    """Looking 59 degrees down, a still camera in a Z-up world and a level one in another look nearly alike."""
    turns = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]) @ pan(0.0, -59.0, count=1)
    note = find_upright(turns, "z", is_levelled=False).note
    assert "fits nearly as well: camera.up_axis decides" in note
    assert find_upright(turns, "z", is_levelled=False, stated="z").note == "Z up, as given"


@pytest.mark.parametrize("seed", range(5))
def test_a_tilted_world_is_levelled_by_its_horizons(seed: int) -> None:
    """Photos round an object, in a world that is turned anyhow: up is found within the noise of the horizons."""
    rng = np.random.default_rng(seed)
    system = matrix_from_rotvec(rng.uniform(-2, 2, 3))
    turns = pan(120.0, -20.0) @ about(2, rng.normal(0, 0.03, 31))
    found = find_upright(system @ turns, "-y", is_levelled=False)
    assert math.degrees(math.acos(found.up @ (system @ [0.0, 1.0, 0.0]))) < 2.0
    assert "where the pictures' horizons are level" in found.note


def test_the_offset_of_a_map_is_taken_off_and_said() -> None:
    places = np.array([[500_010.0, 5_400_020.0, 300.0], [500_012.4, 5_400_020.0, 300.0], [np.nan, 0, 0]])
    near, notes = near_origin(places)
    assert near[1] - near[0] == pytest.approx([2.4, 0, 0]) and np.abs(near[:2]).max() < 2.0
    assert notes == ("origin of the map moved: (500011, 5400020, 300) subtracted from all places",)
    for kept in (np.full((3, 3), MAP_M), np.full((2, 3), np.nan)):
        assert near_origin(kept)[1] == () and near_origin(kept)[0] is kept


POSES = 41


def axis_systems() -> list[F64]:
    """The 24 turns (3, 3) that bring axes onto axes."""
    signed = (
        np.eye(3)[list(order)] * np.array(signs)[:, None]
        for order in itertools.permutations(range(3))
        for signs in itertools.product((1.0, -1.0), repeat=3)
    )
    return [matrix for matrix in signed if np.linalg.det(matrix) > 0]


SYSTEMS = axis_systems()


def known_path() -> tuple[F64, F64]:
    """Axes (N, 3, 3), OpenGL, and places (N, 3) of somebody who walks a third of the way round what she films, Y up."""
    phase = np.linspace(0, 1, POSES)
    heading, pitch, roll = 1.8 * phase, -0.15 + 0.05 * np.sin(9 * phase), 0.02 * np.cos(7 * phase)
    turns = about(1, heading) @ about(0, pitch) @ about(2, roll)
    places = np.column_stack([2.5 * np.sin(heading), 1.5 + 0.03 * np.sin(20 * phase), 2.5 * np.cos(heading)])
    return turns, places


#: ARKit's world is levelled by its definition, so only its heading may differ.
LEVELLED = ("arkit", "record3d", "stray")


def systems_of(name: str) -> list[F64]:
    return [each for each in SYSTEMS if name not in LEVELLED or each[1, 1] > 0.5]


def loaded(folder: Path, name: str, system: F64, at: F64, scale: float = 1.0, **spec: Any) -> CameraPath:
    """The known path from a file in the axes of `system`, lengths times `scale`, the map's origin at `at`."""
    turns, places = known_path()
    path = WRITERS[name](folder, system @ turns, scale * places @ system.T + at)
    return load_camera(CameraSpec(source=str(path), **spec), folder)


def placed(path: CameraPath, body: ShapedBody) -> PlacedCamera:
    mover = make_mover(AvatarSpec(), BUILTIN["t-pose"](), body)
    return place_camera(path, Scene(frames=40), [mover], [body])


def random_map(rng: np.random.Generator, name: str) -> tuple[F64, float, dict[str, float]]:
    """Origin up to 1000 km off, scale, and what the scene has to say of it; COLMAP's maps have no unit anyway."""
    scale = float(10 ** rng.uniform(-1.5, 1.5))
    return rng.uniform(-1e6, 1e6, 3), scale, {} if name.startswith("colmap") else {"metres_per_unit": 1 / scale}


def views(camera: PlacedCamera) -> F64:
    return np.stack([camera.sample(t_s) for t_s in np.linspace(0, 1.3, 14)])


@pytest.mark.parametrize("name", WRITERS)
def test_all_axis_systems_origins_and_scales_give_the_same_path(tmp_path: Path, name: str) -> None:
    """Every pose about the middle of the path, as the camera is placed, against the known one; and the lens."""
    turns, places = known_path()
    rng = np.random.default_rng(18)
    size = 1.0
    if name.startswith("colmap"):
        reference = loaded(tmp_path, name, np.eye(3), np.zeros(3)).places
        size = float(np.ptp(reference[:, 0]) / np.ptp(places[:, 0]))
    for system in systems_of(name):
        at, scale, spec = random_map(rng, name)
        path, _, _ = _from_the_middle(loaded(tmp_path, name, system, at, scale, **spec))
        assert matrix_from_quat(path.quats) == pytest.approx(turns, abs=1e-6), path.notes
        assert path.places == pytest.approx(size * (places - places.mean(axis=0)), abs=1e-3), path.notes
        assert path.times_s == pytest.approx(np.arange(POSES) / RATE_HZ, abs=1e-6)
        if name in ("nerf", "record3d", "stray") or name.startswith("colmap"):
            assert set(path.optics.lenses) == {VIDEO_LENS if name == "stray" else LENS}


@pytest.mark.parametrize("name", ["tum", "colmap binary"])
def test_another_axis_system_films_the_same_views(tmp_path: Path, body: ShapedBody, name: str) -> None:
    check_views(tmp_path, name, body, [SYSTEMS[17]])


@pytest.mark.slow
@pytest.mark.parametrize("name", WRITERS)
def test_all_axis_systems_film_the_same_views(tmp_path: Path, body: ShapedBody, name: str) -> None:
    check_views(tmp_path, name, body, systems_of(name) * 2)


def check_views(folder: Path, name: str, body: ShapedBody, systems: list[F64]) -> None:
    """Every view is that of the file in the known path's own axes, and so is what the notes say of the body."""
    reference = placed(loaded(folder, name, np.eye(3), np.zeros(3)), body)
    rng = np.random.default_rng(19)
    for system in systems:
        at, scale, spec = random_map(rng, name)
        camera = placed(loaded(folder, name, system, at, scale, **spec), body)
        assert views(camera) == pytest.approx(views(reference), abs=2e-3), camera.path.notes
        assert camera.notes == reference.notes


@pytest.mark.parametrize("stated", UP)
def test_a_stated_axis_is_up(tmp_path: Path, stated: str) -> None:
    """An ARKit world is levelled by its definition; in another one the scene has to say what is up."""
    turns, _ = known_path()
    system = next(each for each in SYSTEMS if each[:, 1] == pytest.approx(UP[stated]))
    path = loaded(tmp_path, "arkit", system, np.zeros(3), up_axis=stated)
    assert matrix_from_quat(_from_the_middle(path)[0].quats) == pytest.approx(turns, abs=1e-6)
    assert path.notes[1] == f"{stated.upper()} up, as given"
