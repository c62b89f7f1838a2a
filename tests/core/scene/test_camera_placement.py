"""Where cameras are put: recorded ones against plain loops, built-in ones along ways; turned by a person, or not."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from trilane.arrays import F64
from trilane.body.body import ShapedBody
from trilane.body.joints import JOINT_NAMES, Skeleton
from trilane.scene import camera_placement as placement
from trilane.scene import rotations as rot
from trilane.scene.camera.path import BUILTIN as CAMERAS
from trilane.scene.camera.path import CameraPath, load_builtin, look_at, one_lens
from trilane.scene.camera_placement import (
    HIGHEST_DEG,
    LOWEST_DEG,
    SMOOTH_S,
    PlacedCamera,
    place_camera,
    smoothed,
    steered,
    way_of,
)
from trilane.scene.motion.builtin import BUILTIN
from trilane.scene.motion.motion import Motion, Wrap, rest_leg_m, wrapped_time
from trilane.scene.mover import HEAD, Mover, make_mover
from trilane.scene.schema import AvatarSpec, CameraSpec, Scene, find_scene, load_scene, scene_from
from trilane.scene.staging import Staged, stage_scene, staged_from_arrays, staged_to_arrays
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


OUTPUT = (480, 640)


def run(speed_m_s: float, seconds: float = 6.0, wrap: Wrap = Wrap.BOUNCE, leg_m: float | None = None) -> Motion:
    """The T pose, carried along x at a constant speed."""
    times = np.linspace(0.0, seconds, 61)
    return carried(times, speed_m_s * (times - seconds / 2), wrap, leg_m)


def carried(times: F64, along: F64, wrap: Wrap, leg_m: float | None = None) -> Motion:
    """The T pose, carried to places `along` x at `times`."""
    poses = np.repeat(BUILTIN["t-pose"]().poses, len(times), axis=0)
    places = np.column_stack([along, np.full(len(times), 0.95), 0 * along])
    return Motion(times, poses, places, None, (), wrap, leg_m)


def filmed(motion: Motion, body: ShapedBody, name: str = "orbit", **camera: str) -> tuple[Scene, Mover, Staged]:
    mover = make_mover(AvatarSpec(), motion, body)
    scene = Scene(camera=CameraSpec(**camera))
    path = load_builtin(name, scene.camera)
    assert path is not None
    return scene, mover, Staged((mover,), place_camera(path, scene, [mover], [body]), ())


@pytest.mark.parametrize("wrap", Wrap)
def test_a_way_is_smoothed_across_its_ends(wrap: Wrap) -> None:
    """Against a sum over the endless way, sample by sample."""
    random = np.random.default_rng(4)
    places: F64 = np.cumsum(random.normal(size=(40, 3)), axis=0)
    if wrap is Wrap.LOOP:
        places[-1] = places[0]
    step, length = 0.1, 3.9
    smooth = smoothed(places, step, wrap)
    for k in (0, 3, 20, 38, 39):
        steps = np.arange(-9, 10)  # three standard deviations
        weights = np.exp(-((steps * step) ** 2) / (2 * SMOOTH_S**2))
        ahead = 0.0 if wrap is Wrap.HOLD else 10 * length  # whole cycles, so that no time is below 0
        at = [round(wrapped_time(ahead + (k + j) * step + 1e-9, length, wrap) / step) for j in steps]
        assert smooth[k] == pytest.approx((weights[:, None] * places[at]).sum(axis=0) / weights.sum(), abs=1e-9)


def test_a_way_is_that_of_the_pelvis_over_the_floor(body: ShapedBody) -> None:
    """In the middle of a straight way the smoothed place is the place; heading and position are the avatar's."""
    mover = make_mover(AvatarSpec(position=(1.0, 0.0, -2.0), heading_deg=90.0), run(2.0), body)
    way = way_of(mover, body)
    for t_s in (2.0, 3.0, 4.0):
        pose, place = mover.sample(t_s)
        pelvis = Skeleton(body.joints, body.body.parents).pose(pose, place, mover.world).joints[0]
        assert way.at(t_s) == pytest.approx([pelvis[0], 0.0, pelvis[2]], abs=1e-3)
        assert way.at(12.0 - t_s) == pytest.approx(way.at(t_s)) and way.at(12.0 + t_s) == pytest.approx(way.at(t_s))


def test_a_runner_stays_in_the_picture(body: ShapedBody) -> None:
    """36 m in twelve seconds: without going along nobody is seen most of the time."""
    _, mover, staged = filmed(run(6.0), body)
    _, _, stays = filmed(run(6.0), body, place="none")
    times = np.arange(0.0, 24.0, 0.1)
    along, left = (seen_at(times, one.camera, [mover], [body], OUTPUT) for one in (staged, stays))
    assert left.nobody.mean() > 0.5 and stays.camera.notes == ()
    assert along.nobody.mean() == 0 and along.whole.mean() > 0.9
    assert staged.camera.notes == (
        "goes along with the person over the floor: whole body in the picture in 96% of the time; without that in 5%, "
        "and no part of it in 86%",
    )
    low, high = staged.camera.reach()
    for t_s in times:
        eye = np.linalg.inv(staged.camera.sample(float(t_s)))[:3, 3]
        person = mover.sample(float(t_s))[1] + body.joints[0]
        assert (np.minimum(eye, person)[[0, 2]] >= low[[0, 2]] - 1e-6).all()
        assert (np.maximum(eye, person)[[0, 2]] <= high[[0, 2]] + 1e-6).all()


def test_the_same_picture_in_other_processes(body: ShapedBody) -> None:
    _, _, staged = filmed(run(6.0), body)
    again = staged_from_arrays(staged_to_arrays(staged))
    for t_s in np.linspace(0.0, 30.0, 77):
        assert again.camera.sample(float(t_s)).tobytes() == staged.camera.sample(float(t_s)).tobytes()


def test_the_way_of_a_body_of_another_size(body: ShapedBody) -> None:
    """Legs half as long as the avatar's went 2 m/s, so the avatar goes 4 m/s; its pelvis is where the skeleton says."""
    motion = run(2.0, leg_m=rest_leg_m(body.joints) / 2)
    mover = make_mover(AvatarSpec(), motion, body)
    way = way_of(mover, body)
    assert way.at(4.0)[0] - way.at(2.0)[0] == pytest.approx(8.0, abs=1e-3)
    pose, place = mover.sample(4.0)
    pelvis = Skeleton(body.joints, body.body.parents).pose(pose, place, mover.world).joints[0]
    assert way.at(4.0) == pytest.approx([pelvis[0], 0.0, pelvis[2]], abs=1e-3)


@pytest.mark.parametrize("wrap", Wrap)
def test_who_sets_off_late_is_followed(body: ShapedBody, wrap: Wrap) -> None:
    """Five minutes at the origin, then 40 m in 20 s: nobody would be in the picture at the end, 3 % of the cycle."""
    motion = carried(np.array([0.0, 300.0, 320.0]), np.array([0.0, 0.0, 40.0]), wrap)
    _, mover, staged = filmed(motion, body)
    _, _, stays = filmed(motion, body, place="none")
    times = np.arange(305.0, 319.0, 0.5)
    along, left = (seen_at(times, one.camera, [mover], [body], OUTPUT) for one in (staged, stays))
    assert left.nobody.mean() > 0.7 and along.whole.all()


def test_who_ends_elsewhere_and_stays_there_is_followed(body: ShapedBody) -> None:
    """Half a minute at the origin, then a second's run to where the motion holds its end."""
    motion = carried(np.array([0.0, 30.0, 30.2]), np.array([0.0, 0.0, 4.0]), Wrap.HOLD)
    _, _, staged = filmed(motion, body)
    assert len(staged.camera.ways) == 1


def test_who_is_away_for_a_moment_of_an_hour_is_followed(body: ShapedBody) -> None:
    """Away for 4 s of 3600, between two of the moments at which an hour is judged, 7.5 s apart."""
    motion = carried(np.array([0.0, 1801.0, 1803.0, 1805.0, 3600.0]), np.array([0.0, 0, 9, 0, 0]), Wrap.LOOP)
    _, _, staged = filmed(motion, body)
    assert len(staged.camera.ways) == 1


@pytest.mark.parametrize(("name", "is_worth_it"), [("orbit", True), ("static", False)])
def test_two_percent_more_of_a_body_are_worth_it(body: ShapedBody, name: str, is_worth_it: bool) -> None:
    """A slow walk takes a hand out of both pictures and never a whole body: 3 % of its points, or less than 0.1 %."""
    _, mover, staged = filmed(run(0.3), body, name)
    _, _, stays = filmed(run(0.3), body, name, place="none")
    seen = seen_at(np.arange(0.0, 20.0, 0.25), stays.camera, [mover], [body], OUTPUT)
    assert seen.nobody.sum() == 0 and not seen.whole.all() and (seen.share.mean() < 0.98) == is_worth_it
    assert (len(staged.camera.ways) == 1) == is_worth_it


def test_a_close_up_follows_a_head(body: ShapedBody) -> None:
    """A head is in the picture or not, whatever is seen of the rest: arms in a T reach far into it."""
    _, mover, staged = filmed(run(0.3), body, "closeup")
    _, _, stays = filmed(run(0.3), body, "closeup", place="none")
    times = np.arange(0.0, 12.0, 0.1)
    along, left = (seen_at(times, one.camera, [mover], [body], OUTPUT, HEAD) for one in (staged, stays))
    assert left.nobody.mean() > 0.3 and along.whole.all()
    assert "whole head in the picture in 100% of the time; without that in 44%, and no part" in staged.camera.notes[0]
    whole = [seen_at(times, one.camera, [mover], [body], OUTPUT) for one in (staged, stays)]
    assert whole[1].nobody.mean() == 0 and whole[1].share.mean() > whole[0].share.mean() + 0.1


@pytest.mark.parametrize("name", sorted(CAMERAS))
@pytest.mark.parametrize("motion", ["there-and-back", "walk-wave-turn"])
def test_going_along_never_shows_fewer_whole_bodies(body: ShapedBody, name: str, motion: str) -> None:
    """Of the wayside camera, 0 % would be left of 33 %: it stays, and says why."""
    _, mover, staged = filmed(BUILTIN[motion](), body, name)
    _, _, stays = filmed(BUILTIN[motion](), body, name, place="none")
    times = np.arange(0.0, 40.0, 0.5)
    joints = HEAD if name == "closeup" else JOINT_NAMES
    now, before = (seen_at(times, one.camera, [mover], [body], OUTPUT, joints) for one in (staged, stays))
    assert now.whole.sum() >= before.whole.sum()
    if (name, motion) == ("wayside", "there-and-back"):
        assert staged.camera.ways == () and staged.camera.notes == (
            "does not go along with the person over the floor: whole body in the picture in 33% of the time; "
            "along with the person in 0%",
        )


@pytest.mark.parametrize("motion", ["walk-wave-turn", "idle", "t-pose"])
def test_whoever_is_whole_throughout_is_not_followed(body: ShapedBody, motion: str) -> None:
    _, _, staged = filmed(BUILTIN[motion](), body)
    _, _, stays = filmed(BUILTIN[motion](), body, place="none")
    assert staged.camera.ways == () and staged.camera.notes == ()
    for t_s in (0.0, 1.7, 9.9):
        assert staged.camera.sample(t_s).tobytes() == stays.camera.sample(t_s).tobytes()


@pytest.mark.parametrize(
    "name", ["closeup", "crowd", "default", "far", "full-body", "pair", "people", "portrait", "top-to-floor"]
)
def test_scenes_of_the_package_stay_as_they_are(body: ShapedBody, name: str) -> None:
    scene = scene_from(name, load_scene(find_scene(name)))
    staged = stage_scene(scene, [body] * len(scene.avatars), Path("/"))
    assert staged.camera.ways == ()
