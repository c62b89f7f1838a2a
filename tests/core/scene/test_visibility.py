"""How much of a person a camera shows: shares and notes, worked out by hand for a person in the T pose."""

from __future__ import annotations

import math

import numpy as np
import pytest

from trilane.arrays import F64
from trilane.body.body import ShapedBody
from trilane.body.joints import Skeleton
from trilane.scene import rotations as rot
from trilane.scene.camera.path import CameraPath, one_lens
from trilane.scene.camera_placement import place_camera
from trilane.scene.motion.builtin import BUILTIN
from trilane.scene.motion.motion import Motion, Wrap
from trilane.scene.mover import Mover, make_mover, outline
from trilane.scene.schema import AvatarSpec, CameraSpec, Scene
from trilane.scene.visibility import seen_at, seen_notes


def standing(body: ShapedBody, **spec: float) -> Mover:
    return make_mover(AvatarSpec(**spec), BUILTIN["t-pose"](), body)


def walking(body: ShapedBody, speed: float) -> Mover:
    """To the side, 20 seconds long; speed in m/s."""
    places = np.array([[0.0, 0.0, 0.0], [20 * speed, 0.0, 0.0]])
    motion = Motion(np.array([0.0, 20.0]), np.zeros((2, 55, 3)), places, None, (), Wrap.HOLD)
    return make_mover(AvatarSpec(), motion, body)


def film(turns: list[F64], places: list[list[float]]) -> CameraPath:
    """One pose a frame, 30 a second, 60 degrees high."""
    quats = rot.quat_from_matrix(np.stack(turns))
    return CameraPath(
        np.arange(len(turns)) / 30, quats, np.array(places, float), one_lens(60.0, 0.1, 50.0), (), Wrap.HOLD
    )


def notes_of(path: CameraPath, frames: int, body: ShapedBody) -> tuple[str, ...]:
    scene, mover = Scene(frames=frames, camera=CameraSpec(place="none")), standing(body)
    return seen_notes(place_camera(path, scene, [mover], [body]), scene, [mover], [body])


@pytest.mark.parametrize("distance", [4.0, 6.0, 12.0])
def test_half_as_near_half_as_large(body: ShapedBody, distance: float) -> None:
    """A level lens of 60 degrees at 0.9 m: a point h above it and d before it is at h / (d tan 30 degrees)."""
    mover, path = standing(body), film([np.eye(3)], [[0.0, 0.9, distance]])
    pose, place = mover.sample(0.0)
    points = outline(body).posed(Skeleton(body.joints, body.body.parents).pose(pose, place, mover.world).matrices)
    heights = (points[:, 1] - 0.9) / (distance - points[:, 2]) / math.tan(math.radians(30))
    share = (heights.max() - heights.min()) / 2
    assert notes_of(path, 5, body) == (
        f"whole body in the picture in 100% of the 5 frames, {share:.0%} of its height on average",
    )


@pytest.mark.parametrize(("distance", "hint"), [(18.0, False), (20.0, True)])
def test_a_person_of_a_twelfth_of_the_height_gets_a_hint(body: ShapedBody, distance: float, hint: bool) -> None:
    """1.7 m are 8 % of the height of this lens 18.4 m off. Only a camera from a file that was placed has a unit."""
    mover, path = standing(body), film([np.eye(3)], [[0.0, 0.9, distance]])
    camera = place_camera(path, Scene(camera=CameraSpec(place="none")), [mover], [body])
    for spec, said in ((CameraSpec(source="a.txt"), hint), (CameraSpec(), False)):
        notes = seen_notes(camera, Scene(camera=spec), [mover], [body])
        assert any("camera.metres_per_unit" in note for note in notes) == said
    unplaced = Scene(camera=CameraSpec(source="a.txt", place="none"))
    assert len(seen_notes(camera, unplaced, [mover], [body])) == 1


@pytest.mark.parametrize(("speed", "walk"), [(1.0, False), (1.2, True)])
def test_a_person_who_is_small_because_they_walk_far_gets_another_hint(
    body: ShapedBody, speed: float, walk: bool
) -> None:
    """In 300 frames at 30 a second 9.97 s pass: 9.97 m at 1 m/s, 11.96 m at 1.2 m/s."""
    mover, path = walking(body, speed), film([np.eye(3)], [[0.0, 0.9, 40.0]])
    camera = place_camera(path, Scene(camera=CameraSpec(place="none")), [mover], [body])
    notes = seen_notes(camera, Scene(camera=CameraSpec(source="a.txt")), [mover], [body])
    assert any("a walk of 12 m; start_s" in note for note in notes) == walk
    assert any("camera.metres_per_unit" in note for note in notes) != walk


def test_all_frames_of_the_run_count(body: ShapedBody) -> None:
    """Of ten frames four look at the person, three past the feet, and three the other way."""
    away, down, ahead = rot.about(1, math.pi), rot.about(0, math.radians(35)), np.eye(3)
    path = film([ahead] * 4 + [down] * 3 + [away] * 3, [[0.0, 0.9, 5.0]] * 10)
    (note,) = notes_of(path, 10, body)
    assert note.startswith("whole body in the picture in 40% of the 10 frames, a part of it in 30%, nobody in 30%, ")
    (note,) = notes_of(path, 4, body)
    assert note.startswith("whole body in the picture in 100% of the 4 frames, ")


def test_a_long_run_is_looked_at_evenly(body: ShapedBody) -> None:
    """Held from frame 10 on: the person is in view in the first of 300 of the 60,000 frames alone."""
    path = film([np.eye(3)] * 10 + [rot.about(1, math.pi)], [[0.0, 0.9, 5.0]] * 11)
    (note,) = notes_of(path, 60_000, body)
    assert note.startswith("whole body in the picture in 0% of 300 of the 60000 frames, evenly spread, nobody in 100%")


def test_clip_planes_and_the_camera_within_the_body(body: ShapedBody) -> None:
    """Beyond the far plane nobody is seen; through the chest the near plane cuts, and a part is seen."""
    path = film([np.eye(3)] * 3, [[0.0, 0.9, 52.0], [0.0, 1.2, 0.0], [0.0, 0.9, 5.0]])
    mover = standing(body)
    camera = place_camera(path, Scene(camera=CameraSpec(place="none")), [mover], [body])
    seen = seen_at(path.times_s, camera, [mover], [body], (480, 640))
    assert seen.nobody.tolist() == [1, 0, 0]
    assert seen.whole.tolist() == [0, 0, 1]


def test_one_of_two_persons_is_not_enough(body: ShapedBody) -> None:
    """Whole means all bodies, nobody means none."""
    path = film([np.eye(3)], [[0.0, 0.9, 5.0]])
    movers = [standing(body), make_mover(AvatarSpec(position=(50.0, 0.0, 0.0)), BUILTIN["t-pose"](), body)]
    camera = place_camera(path, Scene(camera=CameraSpec(place="none")), movers, [body, body])
    seen = seen_at(path.times_s, camera, movers, [body, body], (480, 640))
    assert (seen.whole.tolist(), seen.nobody.tolist()) == ([0], [0])
