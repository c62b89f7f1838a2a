"""Axes of poses that a scene states: a file in any axes is the same camera as one in the axes of its format."""

from __future__ import annotations

from itertools import permutations, product
from pathlib import Path

import numpy as np
import pytest

from support.camera_files import OPTICAL, WRITERS, load
from trilane.errors import BadInputError
from trilane.scene.rotations import about, matrix_from_quat
from trilane.scene.schema import DIRECTIONS, axes_of, scene_from

#: Camera axes (OpenGL) of five poses that pan by 0.6 rad and look a little down, Y up.
TURNS = about(1, np.linspace(0.0, 0.6, 5)) @ about(0, -0.1)
PLACES = np.column_stack([np.linspace(0, 1, 5), np.full(5, 1.5), np.linspace(2, 3, 5)])
#: Where x, y and z of a pose point in a camera: x right, y up, z back; by hand.
BY_HAND = {
    "right-up-back": [[1, 0, 0], [0, 1, 0], [0, 0, 1]],
    "right-down-forward": [[1, 0, 0], [0, -1, 0], [0, 0, -1]],
    "forward-left-up": [[0, 0, -1], [-1, 0, 0], [0, 1, 0]],
    "forward-right-down": [[0, 0, -1], [1, 0, 0], [0, -1, 0]],
    "back-up-left": [[0, 0, 1], [0, 1, 0], [-1, 0, 0]],
}


@pytest.mark.parametrize("axes", BY_HAND)
@pytest.mark.parametrize("kind", WRITERS)
def test_a_file_in_stated_axes_is_the_same_camera(tmp_path: Path, kind: str, axes: str) -> None:
    """A writer turns OpenGL axes into those of its format; it is given poses that come out in the stated axes."""
    of_format = np.eye(3) if kind in ("arkit", "nerf", "record3d") else OPTICAL
    body = TURNS @ np.array(BY_HAND[axes], dtype=float).T  # columns: x, y and z of the pose in the world
    path = WRITERS[kind](tmp_path, body @ of_format.T, PLACES)
    camera = load(path, axes=axes, up_axis="y", place="none")
    assert matrix_from_quat(camera.quats) == pytest.approx(TURNS, abs=1e-9)
    assert camera.places == pytest.approx(PLACES, abs=1e-9)
    assert f"axes of a pose: {axes}, as given" in camera.notes


def test_a_robot_s_table_without_names_is_told_by_its_stated_axes(tmp_path: Path) -> None:
    """Forward-left-up poses in a world with Z up: as a camera's they lie on the side, so their order is in doubt.

    The robot turns far and goes where it looks. If it did not, the order would be in doubt with its axes too.
    """
    z_up = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    turns = about(1, np.linspace(0.0, 2.5, 60)) @ about(0, -0.1)
    body = z_up @ turns @ np.array(BY_HAND["forward-left-up"], dtype=float).T
    path = WRITERS["tum"](tmp_path, body @ OPTICAL.T, 0.3 * np.cumsum(body[:, :, 0], axis=0))
    path.write_text("".join(path.read_text().splitlines(keepends=True)[1:]))
    with pytest.raises(BadInputError, match="quaternions whose order does not follow"):
        load(path)
    camera = load(path, axes="forward-left-up")
    assert matrix_from_quat(camera.quats) == pytest.approx(turns, abs=1e-6)


def test_axes_are_right_handed_triples_of_directions() -> None:
    """Of 216 triples of six words 24 are right-handed axes, one for each rotation of a cube."""
    good = {"-".join(words) for words in product(DIRECTIONS, repeat=3) if axes_of("-".join(words))}
    assert len(good) == 24
    for text in good:
        assert np.linalg.det(np.array(axes_of(text))) == pytest.approx(1)
        swapped = {"-".join(words) for words in permutations(text.split("-"))}
        assert len(swapped & good) == 3  # the cyclic ones
    for text in ("forward-left", "forward-left-up-up", "forward-left-down", "left-right-up", "", "north-east-down"):
        assert axes_of(text) is None
        with pytest.raises(BadInputError, match=r"camera\.axes: found .*expected auto, or directions of x, y and z"):
            scene_from("a.toml", {"camera": {"axes": text}})


@pytest.mark.parametrize("pitch_deg", [-40.0, -60.0])
def test_poses_of_a_drone_s_body_ask_for_the_axes(tmp_path: Path, pitch_deg: float) -> None:
    """As a camera's they need a turned picture and a view up at once; stated axes and a phone need no question."""
    z_up = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    turns = about(1, np.linspace(0.0, 2.0, 30)) @ about(0, np.radians(pitch_deg))
    body = z_up @ turns @ np.array(BY_HAND["forward-left-up"], dtype=float).T
    path = WRITERS["tum"](tmp_path, body @ OPTICAL.T, np.zeros((30, 3)))
    with pytest.raises(BadInputError, match=r'camera\.axes to "forward-left-up" if .* or to "right-down-forward"'):
        load(path)
    assert matrix_from_quat(load(path, axes="forward-left-up").quats) == pytest.approx(turns, abs=1e-6)
    assert load(path, axes="right-down-forward").quarter == 1


@pytest.mark.parametrize("quarter", range(4))
@pytest.mark.parametrize("pitch_deg", [-60.0, -30.0, 0.0, 15.0])
def test_a_hand_held_camera_is_not_asked_for_its_axes(tmp_path: Path, quarter: int, pitch_deg: float) -> None:
    z_up = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    turns = about(1, np.linspace(0.0, 2.0, 30)) @ about(0, np.radians(pitch_deg)) @ about(2, quarter * np.pi / 2)
    load(WRITERS["tum"](tmp_path, z_up @ turns, np.zeros((30, 3))))
