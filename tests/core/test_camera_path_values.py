"""Built-in cameras by their formulas, paths between samples, projections and views by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest

from support.camera_files import load
from trilane.scene.camera.path import CameraPath, look_at, one_lens, projection_matrix, view_from_pose
from trilane.scene.lens import of_fov_y
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
