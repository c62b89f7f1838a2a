"""Built-in cameras that go along with a person: ways by a second smoothing, and what is seen with and without."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from trilane.arrays import F64
from trilane.body.body import ShapedBody
from trilane.body.joints import JOINT_NAMES
from trilane.body.kinematics import Skeleton
from trilane.scene.camera.path import BUILTIN as CAMERAS
from trilane.scene.camera.path import load_builtin
from trilane.scene.camera_placement import place_camera
from trilane.scene.follow import SMOOTH_S, smoothed, way_of
from trilane.scene.motion.builtin import BUILTIN
from trilane.scene.motion.motion import Motion, Wrap, rest_leg_m, wrapped_time
from trilane.scene.mover import HEAD, Mover, make_mover
from trilane.scene.schema import AvatarSpec, CameraSpec, Scene, find_scene, load_scene, scene_from
from trilane.scene.staging import Staged, stage_scene, staged_from_arrays, staged_to_arrays
from trilane.scene.visibility import seen_at

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
    "name", ["closeup", "crowd", "default", "far", "full-body", "pair", "portrait", "strangers", "top-to-floor"]
)
def test_scenes_of_the_package_stay_as_they_are(body: ShapedBody, name: str) -> None:
    scene = scene_from(name, load_scene(find_scene(name)))
    staged = stage_scene(scene, [body] * len(scene.avatars), Path("/"))
    assert staged.camera.ways == ()
