"""A known camera path, written in each of the 24 axis systems with a random origin, films the same pictures."""

from __future__ import annotations

import itertools
import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from trilane.arrays import F64
from trilane.body.body import ShapedBody
from trilane.scene.camera.load import load_camera
from trilane.scene.camera.path import CameraPath
from trilane.scene.camera.upright import UP
from trilane.scene.camera_placement import _from_the_middle, place_camera
from trilane.scene.motion.builtin import BUILTIN
from trilane.scene.mover import make_mover
from trilane.scene.placed_camera import PlacedCamera
from trilane.scene.rotations import about, matrix_from_quat, quat_from_matrix
from trilane.scene.schema import AvatarSpec, CameraSpec, Scene

OPTICAL = np.diag([1.0, -1.0, -1.0])
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


def tum_text(turns: F64, places: F64) -> str:
    quats = quat_from_matrix(turns @ OPTICAL)[:, [1, 2, 3, 0]]
    rows = np.column_stack([np.arange(len(turns)) / 30, places, quats])
    return "\n".join(" ".join(f"{value:.12g}" for value in row) for row in rows)


def nerf_text(turns: F64, places: F64) -> str:
    matrices = np.tile(np.eye(4), (len(turns), 1, 1))
    matrices[:, :3, :3], matrices[:, :3, 3] = turns, places
    frames = [{"transform_matrix": matrix.tolist()} for matrix in matrices]
    return json.dumps({"fl_x": 500, "fl_y": 500, "w": 640, "h": 480, "frames": frames})


FORMATS: dict[str, Callable[[F64, F64], str]] = {"tum.txt": tum_text, "transforms.json": nerf_text}


def origin() -> F64:
    """Of a map: up to 1000 km off."""
    return np.random.default_rng(18).uniform(-1e6, 1e6, 3)


def loaded(folder: Path, name: str, system: F64, at: F64) -> CameraPath:
    """The known path from a file in the axes of `system`, the map's origin at `at`."""
    turns, places = known_path()
    (folder / name).write_text(FORMATS[name](system @ turns, places @ system.T + at))
    return load_camera(CameraSpec(source=name), folder)


def placed(path: CameraPath, body: ShapedBody) -> PlacedCamera:
    mover = make_mover(AvatarSpec(), BUILTIN["t-pose"](), body)
    return place_camera(path, Scene(frames=40), [mover], [body])


def views(camera: PlacedCamera) -> F64:
    return np.stack([camera.sample(t_s) for t_s in np.linspace(0, 1.3, 14)])


@pytest.mark.parametrize("name", FORMATS)
def test_all_axis_systems_give_the_same_path(tmp_path: Path, name: str) -> None:
    """Every pose about the middle of the path, as the camera is placed, against the known one."""
    turns, places = known_path()
    for system in SYSTEMS:
        path, _, _ = _from_the_middle(loaded(tmp_path, name, system, origin()))
        assert matrix_from_quat(path.quats) == pytest.approx(turns, abs=1e-6), path.notes
        assert path.places == pytest.approx(places - places.mean(axis=0), abs=1e-3)


@pytest.mark.parametrize("name", FORMATS)
def test_another_axis_system_films_the_same_views(tmp_path: Path, body: ShapedBody, name: str) -> None:
    check_views(tmp_path, name, body, [SYSTEMS[17]])


@pytest.mark.slow
@pytest.mark.parametrize("name", FORMATS)
def test_all_axis_systems_film_the_same_views(tmp_path: Path, body: ShapedBody, name: str) -> None:
    check_views(tmp_path, name, body, SYSTEMS)


def check_views(folder: Path, name: str, body: ShapedBody, systems: list[F64]) -> None:
    """The body is whole in all frames, and every view is that of the file in the known path's own axes."""
    expected = views(placed(loaded(folder, name, np.eye(3), np.zeros(3)), body))
    for system in systems:
        camera = placed(loaded(folder, name, system, origin()), body)
        assert views(camera) == pytest.approx(expected, abs=1e-3), camera.path.notes
        assert camera.notes[-1].startswith("whole body in the picture in 100% of the frames")


@pytest.mark.parametrize("stated", UP)
def test_a_stated_axis_is_up(tmp_path: Path, stated: str) -> None:
    """An ARKit world is levelled by its definition; in another one the scene has to say what is up."""
    turns, places = known_path()
    system = next(each for each in SYSTEMS if each[:, 1] == pytest.approx(UP[stated]))
    rows = np.column_stack([np.arange(POSES) / 30, np.dstack([system @ turns, places @ system.T]).reshape(POSES, 12)])
    (tmp_path / "a.txt").write_text("\n".join(" ".join(f"{value:.12g}" for value in row) for row in rows))
    path = load_camera(CameraSpec(source="a.txt", up_axis=stated), tmp_path)
    assert matrix_from_quat(_from_the_middle(path)[0].quats) == pytest.approx(turns, abs=1e-6)
    assert path.notes[1] == f"{stated.upper()} up, as given"
