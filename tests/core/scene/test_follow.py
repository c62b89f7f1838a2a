"""Built-in cameras that go along with a person: ways by a second smoothing, and what is seen with and without."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from trilane.arrays import F64
from trilane.body.body import ShapedBody
from trilane.body.kinematics import Skeleton
from trilane.scene.camera.path import load_builtin
from trilane.scene.camera_placement import place_camera
from trilane.scene.follow import SMOOTH_S, smoothed, way_of
from trilane.scene.motion.builtin import BUILTIN
from trilane.scene.motion.motion import Motion, Wrap, wrapped_time
from trilane.scene.mover import Mover, make_mover
from trilane.scene.schema import AvatarSpec, CameraSpec, Scene, find_scene, load_scene, scene_from
from trilane.scene.staging import Staged, stage_scene, staged_from_arrays, staged_to_arrays
from trilane.scene.visibility import seen_at

OUTPUT = (480, 640)


def run(speed_m_s: float, seconds: float = 6.0, wrap: Wrap = Wrap.BOUNCE) -> Motion:
    """The T pose, carried along x at a constant speed."""
    pose = BUILTIN["t-pose"]()
    times = np.linspace(0.0, seconds, 61)
    places = np.column_stack([speed_m_s * (times - seconds / 2), np.full(61, 0.95), np.zeros(61)])
    return Motion(times, np.repeat(pose.poses, 61, axis=0), places, None, (), wrap)


def filmed(motion: Motion, body: ShapedBody, **camera: str) -> tuple[Scene, Mover, Staged]:
    mover = make_mover(AvatarSpec(), motion, body)
    scene = Scene(camera=CameraSpec(**camera))
    path = load_builtin("orbit", scene.camera)
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
    assert staged.camera.notes[0].startswith("goes along with the person over the floor: whole body in the picture in ")
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


@pytest.mark.parametrize("motion", ["walk-wave-turn", "idle", "t-pose"])
def test_whoever_is_whole_throughout_is_not_followed(body: ShapedBody, motion: str) -> None:
    _, _, staged = filmed(BUILTIN[motion](), body)
    _, _, stays = filmed(BUILTIN[motion](), body, place="none")
    assert staged.camera.ways == () and staged.camera.notes == ()
    for t_s in (0.0, 1.7, 9.9):
        assert staged.camera.sample(t_s).tobytes() == stays.camera.sample(t_s).tobytes()


@pytest.mark.parametrize(
    "name", ["closeup", "crowd", "default", "far", "full-body", "pair", "portrait", "top-to-floor"]
)
def test_scenes_of_the_package_stay_as_they_are(body: ShapedBody, name: str) -> None:
    scene = scene_from(name, load_scene(find_scene(name)))
    staged = stage_scene(scene, [body] * len(scene.avatars), Path("/"))
    assert staged.camera.ways == ()
