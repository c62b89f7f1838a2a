"""Where a recorded camera is put, against plain loops, and how a person turns it, against one put there by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest

from trilane.arrays import F64
from trilane.body.body import ShapedBody
from trilane.scene import camera_placement as placement
from trilane.scene import rotations as rot
from trilane.scene.camera.path import CameraPath, look_at, one_lens
from trilane.scene.camera_placement import HIGHEST_DEG, LOWEST_DEG, PlacedCamera, steered
from trilane.scene.motion.builtin import BUILTIN
from trilane.scene.motion.motion import Wrap
from trilane.scene.mover import make_mover
from trilane.scene.schema import AvatarSpec, CameraSpec, Scene
from trilane.scene.visibility import seen_at


def path(turns: list[np.ndarray], places: list[list[float]], recorded: bool = True) -> CameraPath:
    quats = rot.quat_from_matrix(np.stack(turns))
    times = np.arange(len(turns)) / 30
    return CameraPath(
        times, quats, np.array(places, float), one_lens(60.0, 0.1, 50.0), ("path",), Wrap.BOUNCE, recorded
    )


@pytest.mark.parametrize(
    ("sights", "tilt"),
    [([-10, -20, 0], 0), ([-24.0], 0), ([-30.0], 6), ([5.0, 15.0, 7.0], -7), ([-80.0], 40), ([60.0], -40)],
)
def test_a_camera_that_looks_down_is_tilted_up(sights: list[float], tilt: float) -> None:
    """The median line of sight comes into -24 to 0 degrees, by at most 40."""
    cameras = path([rot.about(0, math.radians(sight)) for sight in sights], [[0, 0, 0]] * len(sights))
    assert placement._tilt_deg(cameras, cameras.times_s) == pytest.approx(tilt, abs=1e-9)


def test_a_camera_that_spins_over_the_person_is_not_tilted(body: ShapedBody) -> None:
    """It looks straight down and turns round: tilted by the 40 degrees that a room allows, it would look all about."""
    down = rot.about(0, math.radians(-90))
    camera = path([rot.about(1, angle) @ down for angle in np.linspace(0, 2 * math.pi, 60)], [[0.0, 9.0, 0.0]] * 60)
    mover = make_mover(AvatarSpec(), BUILTIN["t-pose"](), body)
    placed = placement.place_camera(camera, Scene(), [mover], [body])
    assert (placed.mount == np.eye(3)).all() and not any("tilted" in note for note in placed.notes)
    assert seen_at(camera.times_s, placed, [mover], [body], (480, 640)).whole.all()
    assert placement._tilt_deg(camera, camera.times_s) == pytest.approx(40)


@pytest.mark.parametrize(("away", "far_m"), [(200.0, 220.0), (91.0, 100.1), (90.0, 100.0)])
def test_the_far_plane_is_a_tenth_beyond_the_body(away: float, far_m: float) -> None:
    """100 m by default, and 1.1 times the distance of the farthest point where that is more."""
    points: F64 = np.array([[[0.0, 0.0, -away]], [[0.0, 0.0, -5.0]]])
    assert placement._far(np.zeros((1, 3)), points, CameraSpec())[0] == pytest.approx(far_m)


def test_a_built_in_camera_stays_and_a_placed_one_is_moved_with_its_path(body: ShapedBody) -> None:
    look = rot.about(0, 0.3) @ rot.about(1, 0.4)
    camera = path([look], [[1.0, 2.0, 3.0]])
    turn, mount, shift = rot.about(1, 0.7), rot.about(0, 0.1), np.array([0.5, 0.0, -1.0])
    placed = PlacedCamera(camera, turn, shift, mount, ())
    eye, axes = turn @ [1.0, 2.0, 3.0] + shift, turn @ look @ mount
    view = placed.sample(0.0)
    assert view[:3, :3] == pytest.approx(axes.T) and view[:3, 3] == pytest.approx(-axes.T @ eye)
    assert placed.projection(0.0, (240, 480)) == pytest.approx(camera.projection(0.0, (240, 480)))
    built_in = path([np.eye(3)], [[0, 0.9, 5]], recorded=False)
    mover = make_mover(AvatarSpec(), BUILTIN["t-pose"](), body)
    same = placement.place_camera(built_in, Scene(), [mover], [body])
    assert same.sample(0.0).tobytes() == built_in.sample(0.0).tobytes() and same.notes == ()
    same = placement.place_camera(camera, Scene(camera=CameraSpec(place="none")), [mover], [body])
    assert same.sample(0.0) == pytest.approx(camera.sample(0.0))
    assert same.notes == ()


def test_notes_of_a_placed_camera(body: ShapedBody) -> None:
    """A camera that looks 30 degrees down in a drawn room; its notes say what can be computed again."""
    camera = path([rot.about(0, math.radians(-30))] * 5, [[30.0, -7.0, 12.0]] * 5)
    mover = make_mover(AvatarSpec(), BUILTIN["t-pose"](), body)
    placed = placement.place_camera(camera, Scene(), [mover], [body])
    assert placed.mount == pytest.approx(rot.about(0, math.radians(6)))
    eye = placed.turn @ [30.0, -7.0, 12.0] + placed.shift
    assert placed.notes == (
        "camera tilted by +6 degrees on its mount",
        f"camera set down {math.hypot(eye[0], eye[2]):.1f} m from the avatar, {eye[1]:.1f} m over the floor on average",
    )
    seen = seen_at(camera.times_s, placed, [mover], [body], (480, 640))
    assert seen.whole.all()
    assert 0.6 < seen.height.min() < 0.97  # as large as the picture takes it, up to ENOUGH_SIZE and the finest step
    assert abs(eye[0]) < 1e-9 and 0.3 <= eye[1] <= 3.7


def test_the_reach_of_a_camera_is_where_it_ever_stands() -> None:
    """Three places, turned by a quarter about +Y, x to -z and z to x, and shifted."""
    camera = path([np.eye(3)] * 3, [[1, 2, 3], [-1, 5, 4], [0, 4, 9]])
    placed = PlacedCamera(camera, rot.about(1, math.pi / 2), np.array([10.0, 0.0, -1.0]), np.eye(3), ())
    low, high = placed.reach()
    assert low == pytest.approx([13, 2, -2]) and high == pytest.approx([19, 5, 0])
    for t_s in np.linspace(0, 0.3, 50):
        eye = np.linalg.inv(placed.sample(float(t_s)))[:3, 3]
        assert (eye >= low - 1e-9).all() and (eye <= high + 1e-9).all()


PIVOT: F64 = np.array([1.0, 0.9, -2.0])


def placed(azimuth_deg: float, elevation_deg: float, distance_m: float) -> F64:
    """A level camera that looks at the pivot from there; at 0, 0 from along +Z."""
    a, e = np.radians([azimuth_deg, elevation_deg])
    arm = np.array([np.cos(e) * np.sin(a), np.sin(e), np.cos(e) * np.cos(a)])
    return look_at(PIVOT + distance_m * arm, PIVOT)


@pytest.mark.parametrize(
    ("start", "turn", "zoom", "end"),
    [
        ((0, 0, 4), (90, 0), 1.0, (90, 0, 4)),
        ((30, 10, 4), (-75, 20), 1.0, (-45, 30, 4)),
        ((30, 10, 4), (0, 0), 2.0, (30, 10, 2)),
        ((-100, 40, 3), (200, -30), 0.5, (100, 10, 6)),
        ((20, 30, 4), (0, 500), 1.0, (20, HIGHEST_DEG, 4)),
        ((20, 30, 4), (5, -500), 1.0, (25, LOWEST_DEG, 4)),
        ((20, -30, 4), (0, -10), 1.0, (20, -30, 4)),
    ],
)
def test_a_camera_that_looks_at_the_pivot_is_where_it_would_be_put(
    start: tuple[float, float, float], turn: tuple[float, float], zoom: float, end: tuple[float, float, float]
) -> None:
    np.testing.assert_allclose(steered(placed(*start), PIVOT, *turn, zoom), placed(*end), atol=1e-12)


def test_without_a_turn_the_view_keeps_every_bit() -> None:
    view = placed(33, 7, 3.3)
    assert steered(view, PIVOT, 0.0, 0.0, 1.0).tobytes() == view.tobytes()


def test_a_camera_that_looks_past_the_pivot_keeps_it_at_the_same_place_of_the_picture() -> None:
    view = look_at(np.array([2.0, 1.5, 2.0]), np.array([0.0, 1.2, 0.5]))
    before = view[:3, :3] @ PIVOT + view[:3, 3]
    turned = steered(view, PIVOT, 40.0, 15.0, 1.0)
    np.testing.assert_allclose(turned[:3, :3] @ PIVOT + turned[:3, 3], before, atol=1e-12)
    nearer = steered(view, PIVOT, 40.0, 15.0, 3.0)
    np.testing.assert_allclose(nearer[:3, :3] @ PIVOT + nearer[:3, 3], before / 3, atol=1e-12)
    np.testing.assert_allclose(turned[:3, :3] @ turned[:3, :3].T, np.eye(3), atol=1e-12)


def test_a_camera_over_the_pivot_turns_about_the_vertical_alone() -> None:
    view = np.eye(4)
    view[:3, :3] = [[1, 0, 0], [0, 0, -1], [0, 1, 0]]  # looks down
    view[:3, 3] = -view[:3, :3] @ (PIVOT + np.array([0, 3, 0]))
    turned = steered(view, PIVOT, 90.0, 20.0, 1.0)
    np.testing.assert_allclose(turned[:3, :3] @ PIVOT + turned[:3, 3], [0, 0, -3], atol=1e-12)
    assert np.isfinite(turned).all()
