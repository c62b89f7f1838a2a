"""Camera paths and lenses: formulas, projections and views by hand, and pictures that are changed with their lens."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from support.camera_files import load
from trilane.scene.camera.path import CameraPath, look_at, one_lens, projection_matrix, view_from_pose
from trilane.scene.lens import Known, Lens, PictureCut, centred, cover, of_fov_x, of_fov_y
from trilane.scene.motion.motion import Wrap

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
    assert (len(camera.times_s), camera.optics) == (round(period * 30) + 1, one_lens(40.0, 0.1, 50.0))
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
    assert load(f"builtin:{name}", fov_y_deg=33.5).optics.lenses == (of_fov_y(33.5),)


def test_a_camera_goes_from_above_down_to_the_floor() -> None:
    """3.9 m from (0, 0.9, 0): 80 degrees above it, after half of 12 s at a height of 0.12 m, between by a cosine."""
    camera = load("builtin:top-to-floor")
    low = math.degrees(math.asin((0.12 - 0.9) / 3.9))
    for t_s, degrees in ((0.0, 80.0), (3.0, (80 + low) / 2), (6.0, low), (9.0, (80 + low) / 2), (12.0, 80.0)):
        angle = math.radians(degrees)
        _, place = camera.pose(t_s)
        assert place == pytest.approx([0, 0.9 + 3.9 * math.sin(angle), 3.9 * math.cos(angle)], abs=1e-9)
        assert camera.sample(t_s) @ [0, 0.9, 0, 1] == pytest.approx([0, 0, -3.9, 1], abs=1e-9)
    assert camera.pose(6.0)[1][1] == pytest.approx(0.12)
    what = "whole person, from above down to the floor, 12 s a cycle"
    assert camera.notes == (f"built in: {what}, field of view 40 degrees high",)


def test_a_camera_stands_by_the_wayside() -> None:
    """The way, x = 0, is behind the camera from z = 1.9 on, and left of it."""
    camera = load("builtin:wayside")
    assert camera.notes == ("built in: beside the way of one who walks along z, fixed, field of view 40 degrees high",)
    assert camera.pose(0.0)[1] == pytest.approx([0.9, 1.45, 1.9]) == camera.pose(0.7)[1]
    far, past = (camera.sample(0.3) @ [0.0, 1.0, z, 1.0] for z in (-2.5, 2.5))
    assert far[2] < 0 < past[2] and abs(far[0] / far[2]) < 0.1
    distance = math.sqrt(1.0 + 0.4**2 + 4.4**2)
    assert camera.sample(0.0) @ [-0.1, 1.05, -2.5, 1] == pytest.approx([0, 0, -distance, 1], abs=1e-9)


def test_a_path_between_and_after_its_samples() -> None:
    """A quarter turn about +Y in 2 s while the camera moves 4 m along x."""
    h = math.sqrt(0.5)
    quats, places = np.array([[1.0, 0, 0, 0], [h, 0, h, 0]]), np.array([[0.0, 1, 0], [4.0, 1, 0]])
    bounce = CameraPath(np.array([0.0, 2.0]), quats, places, one_lens(90.0, 0.1, 10.0), ())
    loop = CameraPath(np.array([0.0, 2.0]), quats, places, one_lens(90.0, 0.1, 10.0), (), Wrap.LOOP)
    assert bounce.wrap is Wrap.BOUNCE and bounce.recorded and bounce.duration_s == 2.0
    for path, t_s, share in ((bounce, 0.5, 0.25), (bounce, 3.5, 0.25), (bounce, 4.5, 0.25), (loop, 3.5, 0.75)):
        turn, place = path.pose(t_s)
        a = share * math.pi / 2
        assert place == pytest.approx([4 * share, 1, 0])
        assert turn == pytest.approx(
            np.array([[math.cos(a), 0, math.sin(a)], [0, 1, 0], [-math.sin(a), 0, math.cos(a)]])
        )
        assert path.sample(t_s) @ [*place, 1.0] == pytest.approx([0, 0, 0, 1])
    assert bounce.projection(0.7, (100, 200)) == pytest.approx(projection_matrix(90.0, 2.0, 0.1, 10.0))


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


LENS = Lens(400.0, 300.0, 500.0, 480.0, 210.0, 140.0)


def pixel(lens: Lens, point: tuple[float, float, float]) -> np.ndarray:
    """Column and row of `point`, x right, y up, -z ahead, through the clip matrix."""
    x, y, _, w = lens.projection(0.1, 10.0) @ [*point, 1.0]
    return np.array([(x / w + 1) / 2 * lens.width_px, (1 - y / w) / 2 * lens.height_px])


def test_a_point_falls_on_its_pixel() -> None:
    """4 m ahead, 0.4 m right, 0.2 m up: 500 * 0.1 right of 210, 480 * 0.05 above 140."""
    assert pixel(LENS, (0.4, 0.2, -4.0)) == pytest.approx([260, 116])
    assert pixel(LENS, (0, 0, -1)) == pytest.approx([210, 140])


def test_each_change_by_hand() -> None:
    assert LENS.scaled(200, 600) == Lens(200, 600, 250, 960, 105, 280)
    assert LENS.cropped(10, -20, 50, 60) == Lens(50, 60, 500, 480, 200, 160)
    assert LENS.turned(1) == Lens(300, 400, 480, 500, 160, 210)
    assert LENS.turned(2) == Lens(400, 300, 500, 480, 190, 160)
    assert LENS.turned(-1) == LENS.turned(3) == Lens(300, 400, 480, 500, 140, 190)
    assert LENS.turned(4) == LENS == LENS.turned(0)
    other = Lens(400.0, 300.0, 600.0, 500.0, 200.0, 150.0)
    assert LENS.between(other, 0.25) == Lens(400, 300, 525, 485, 207.5, 142.5)


def test_a_photo_of_1080x1920_cut_to_810_rows() -> None:
    """The focal length stays in pixels, so the angle of the 810 rows is that of 810 pixels: not that of the 1920."""
    phone = centred(1080, 1920, 1662.77)
    shown = phone.onto((1920, 1080)).covering((810, 1080))
    assert shown == Lens(1080, 810, 1662.77, 1662.77, 540, 405)
    assert shown.fov_y_deg == pytest.approx(2 * math.degrees(math.atan(405 / 1662.77)))
    half = phone.onto((960, 540)).covering((406, 540))
    assert (half.fx, half.cy) == pytest.approx((1662.77 / 2, 203.0))


@pytest.mark.parametrize(
    ("picture", "output", "cut"),
    [
        ((1080, 1920), (480, 640), PictureCut(480, 853, 0, 106)),  # 853.3 columns
        ((1920, 1080), (480, 640), PictureCut(1138, 640, 329, 0)),  # 1137.8 rows
        ((480, 640), (480, 640), PictureCut(480, 640, 0, 0)),
        ((10, 10), (100, 30), PictureCut(100, 100, 0, 35)),
        ((3, 1000), (3, 3), PictureCut(3, 1000, 0, 498)),
    ],
)
def test_a_picture_covers_the_output(
    picture: tuple[int, int], output: tuple[int, int], cut: tuple[int, int, int, int]
) -> None:
    assert cover(picture, output) == cut


def test_a_picture_of_another_shape_is_a_cut_of_the_lens_s() -> None:
    """A sensor of 4:3 that films in 16:9 loses rows: 640x480 at f = 517 is 1280x720 at 1034."""
    kinect = Lens(640.0, 480.0, 517.0, 517.0, 320.0, 250.0)
    assert kinect.onto((720, 1280)) == Lens(1280, 720, 1034, 1034, 640, 380)


def test_an_angle_alone_takes_the_shape_of_the_picture() -> None:
    """NeRF's `camera_angle_x` of 90 degrees: f is half of the width, whatever the height; turned, of the height."""
    lens = of_fov_x(90.0)
    upright = centred(600, 800, 400)
    for found, wanted in (
        (lens.onto((800, 800)), centred(800, 800, 400)),
        (lens.onto((1000, 200)), centred(200, 1000, 100)),
        (lens.turned(1).onto((800, 600)), upright),
        (of_fov_y(90.0).onto((800, 600)), upright),
    ):
        assert (found.width_px, found.height_px, found.known) == (wanted.width_px, wanted.height_px, Known.ALL)
        assert (found.fx, found.fy, found.cx, found.cy) == pytest.approx((wanted.fx, wanted.fy, wanted.cx, wanted.cy))
    assert (lens.fov_x_deg, of_fov_y(33.0).fov_y_deg) == pytest.approx((90.0, 33.0))


def test_the_angle_of_a_longer_side_takes_the_shape_of_the_picture() -> None:
    """A phone's 1920 of 1920x1080 at f = 960: half of the longer side, of a picture of 4:3 and of an upright one."""
    phone = centred(1920, 1080, 960, Known.LONG)
    assert phone.onto((300, 400)) == centred(400, 300, 200)
    assert phone.turned(1).onto((400, 300)) == centred(300, 400, 200)
    assert (phone.lies_across((300, 400)), phone.turned(1).lies_across((300, 400))) == (False, True)
    assert not of_fov_x(90).lies_across((400, 300)) and not centred(10, 10, 5).lies_across((400, 300))


def test_a_drawing_is_as_high_as_the_picture() -> None:
    """The principal point stays as far from the middle of the columns as it was, in the picture's own scale."""
    shown = LENS.filling_height((600, 1000))
    assert shown == Lens(1000, 600, 1000, 960, 520, 280)
    assert shown.fov_y_deg == pytest.approx(LENS.fov_y_deg)


SIDES = st.integers(8, 400)
CHANGES = st.lists(
    st.one_of(
        st.tuples(st.just("turn"), st.integers(-3, 5)),
        st.tuples(st.just("scale"), st.tuples(SIDES, SIDES)),
        st.tuples(st.just("crop"), st.tuples(SIDES, SIDES, SIDES, SIDES)),
        st.tuples(st.just("cover"), st.tuples(SIDES, SIDES)),
    ),
    max_size=6,
)


@settings(max_examples=60)
@given(CHANGES, st.tuples(st.floats(-0.3, 0.3), st.floats(-0.3, 0.3)))
def test_any_chain_of_changes_moves_a_point_as_it_moves_the_pixels(
    changes: list[tuple[str, object]], at: tuple[float, float]
) -> None:
    """A mark at the point's pixel, moved as an array's pixels move, stays where the changed lens has the point."""
    lens, point = LENS, (2 * at[0], 2 * at[1], -2.0)
    x, y = pixel(lens, point)
    for kind, how in changes:
        width, height = lens.width_px, lens.height_px
        if kind == "turn":
            for _ in range(how % 4):  # np.rot90(picture, -1): row y becomes column height - y
                x, y, width, height = height - y, x, height, width
                point = (point[1], -point[0], point[2])  # the camera's axes turn with its picture
            lens = lens.turned(how)
        elif kind == "scale":
            x, y = x * how[0] / width, y * how[1] / height
            lens = lens.scaled(*how)
        elif kind == "crop":
            x, y = x - how[0], y - how[1]
            lens = lens.cropped(*how)
        else:
            cut = cover((round(height), round(width)), how)
            x, y = x * cut.width / width - cut.left, y * cut.height / height - cut.top
            lens = lens.covering(how)
    assert pixel(lens, point) == pytest.approx([x, y], abs=1e-6)
