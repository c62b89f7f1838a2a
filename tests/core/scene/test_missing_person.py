"""A recorded camera that shows nobody is refused, and the key that would show the person is named."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from support.camera_files import OPTICAL, write_tum
from trilane.arrays import F64
from trilane.body.body import ShapedBody
from trilane.errors import BadInputError
from trilane.scene.camera.files import load_camera
from trilane.scene.camera.path import axes_towards
from trilane.scene.missing_person import require_person
from trilane.scene.rotations import about
from trilane.scene.schema import AvatarSpec, CameraSpec, Scene
from trilane.scene.staging import stage_scene

Z_UP: F64 = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
IDLE = (AvatarSpec(motion="builtin:idle"),)


def refused(source: Path, body: ShapedBody, frames: int = 300, **spec: Any) -> str:
    """What the refusal says; empty where the camera is taken."""
    camera = CameraSpec(source=str(source), **spec)
    scene = Scene(camera=camera, avatars=IDLE, background="film.mp4", frames=frames)
    staged = stage_scene(scene, [body], Path("/"))
    try:
        require_person(scene, staged, [body], Path("/"))
    except BadInputError as error:
        return str(error)
    return ""


def ring(radius: float) -> tuple[F64, F64]:
    """A whole circle that looks inwards, Y up."""
    angle = np.linspace(0, 2 * np.pi, 90)
    places = radius * np.stack([np.sin(angle), 0 * angle, np.cos(angle)], axis=1)
    return axes_towards(places, np.zeros(3)), places


def test_a_ring_in_the_wrong_unit_asks_for_the_unit(tmp_path: Path, body: ShapedBody) -> None:
    """A ring of 0.6 m has no place for a person of 1.7 m; one of 6 m has."""
    turns, places = ring(0.6)
    path = write_tum(tmp_path, Z_UP @ turns, places @ Z_UP.T)
    said = refused(path, body)
    assert said.startswith(f"camera {path}: found the whole person in the picture in ")
    assert "camera.metres_per_unit = 10 would show it in 100%, if it is true" in said
    assert said.endswith("--allow-empty runs it as it is")
    assert refused(path, body, metres_per_unit=10.0) == ""


def test_poses_of_a_robot_ask_for_the_axes(tmp_path: Path, body: ShapedBody) -> None:
    """A robot that goes round a person and faces the person: z is its up, so a camera with these axes sees the sky."""
    turns, places = ring(4.0)
    robot = turns @ np.array([[0.0, 0, -1], [-1, 0, 0], [0, 1, 0]]).T
    path = write_tum(tmp_path, Z_UP @ robot @ OPTICAL, places @ Z_UP.T)
    said = refused(path, body, up_axis="z")
    assert "in the picture in 0% of the run's frames at the best place" in said
    assert 'camera.axes = "forward-left-up" would show it in 100%' in said
    assert refused(path, body, up_axis="z", axes="forward-left-up") == ""


def test_a_camera_that_stays_is_asked_for_its_place(tmp_path: Path, body: ShapedBody) -> None:
    """Where it was recorded it is 30 m off and looks away; a part of a person in view is enough there."""
    looks = about(1, np.linspace(0.0, 0.2, 60))
    path = write_tum(tmp_path, Z_UP @ looks, np.tile([30.0, -7.0, 1.5], (60, 1)))
    said = refused(path, body, place="none")
    assert "found a part of the person in the picture in 0% of the run's frames where it was recorded" in said
    assert 'camera.place = "auto" would show it in 100%' in said
    near = write_tum(tmp_path, Z_UP @ looks, np.tile([0.0, -1.0, 1.4], (60, 1)))  # head and shoulders
    assert refused(near, body, place="none") == ""


def test_the_frames_of_the_run_are_judged(tmp_path: Path, body: ShapedBody) -> None:
    """A camera that looks away for a third of its time shows nobody in a run of that third."""
    turns = about(1, np.where(np.arange(90) < 30, np.pi, 0.0))
    path = write_tum(tmp_path, Z_UP @ turns, np.tile([0.0, -1.0, 1.4], (90, 1)))
    away_s = load_camera(CameraSpec(source=str(path)), Path("/")).times_s[29]
    assert "in 0% of the run's frames" in refused(path, body, int(away_s * 30), place="none")
    assert refused(path, body, int(away_s * 30 * 3), place="none") == ""


@pytest.mark.parametrize(("shown", "is_taken"), [(1, False), (2, True), (3, True)])
def test_half_of_the_frames_is_enough(shown: int, is_taken: bool, tmp_path: Path, body: ShapedBody) -> None:
    """Of four frames one, two or three look at the person, who stands 3.5 m ahead."""
    turns = about(1, np.where(np.arange(4) < shown, 0.0, np.pi))
    path = write_tum(tmp_path, Z_UP @ turns, np.tile([0.0, -3.5, 1.0], (4, 1)))
    assert (refused(path, body, 4, place="none") == "") == is_taken


def test_people_far_apart_are_shown_from_far_off(tmp_path: Path, body: ShapedBody) -> None:
    """Two people 250 m apart: no unit and no axes are wrong, the camera only has to stand far off."""
    path = write_tum(tmp_path, Z_UP @ np.tile(np.eye(3), (9, 1, 1)), np.zeros((9, 3)))
    people = tuple(AvatarSpec(motion="builtin:idle", position=(x, 0.0, 0.0)) for x in (-125.0, 125.0))
    scene = Scene(camera=CameraSpec(source=str(path)), avatars=people, background="film.mp4")
    staged = stage_scene(scene, [body, body], Path("/"))
    require_person(scene, staged, [body, body], Path("/"))
    assert any(note.startswith("camera: whole body in the picture in 100%") for note in staged.notes)


def test_a_built_in_camera_is_never_refused(body: ShapedBody) -> None:
    scene = Scene(avatars=(AvatarSpec(position=(500.0, 0.0, 0.0)),), camera=CameraSpec(place="none"))
    require_person(scene, stage_scene(scene, [body], Path("/")), [body], Path("/"))


def test_a_camera_that_turns_round_finds_no_key(tmp_path: Path, body: ShapedBody) -> None:
    turns = about(1, np.linspace(0, 4 * np.pi, 90))
    path = write_tum(tmp_path, Z_UP @ turns, np.zeros((90, 3)))
    assert "no single key would show it: check camera.axes, " in refused(path, body)
