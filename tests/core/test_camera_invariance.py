"""A known camera path films the same pictures from every format, in each of the 24 axis systems, wherever the map's
origin is and whatever its scale.
"""

from __future__ import annotations

import itertools
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from support.camera_files import LENS, RATE_HZ, VIDEO_LENS, WRITERS
from trilane.arrays import F64
from trilane.body.body import ShapedBody
from trilane.scene.camera.load import load_camera
from trilane.scene.camera.path import CameraPath
from trilane.scene.camera.upright import UP
from trilane.scene.camera_placement import _from_the_middle, place_camera
from trilane.scene.motion.builtin import BUILTIN
from trilane.scene.mover import make_mover
from trilane.scene.placed_camera import PlacedCamera
from trilane.scene.rotations import about, matrix_from_quat
from trilane.scene.schema import AvatarSpec, CameraSpec, Scene

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


#: ARKit's world is levelled by its definition, so only its heading may differ.
LEVELLED = ("arkit", "record3d", "stray")


def systems_of(name: str) -> list[F64]:
    return [each for each in SYSTEMS if name not in LEVELLED or each[1, 1] > 0.5]


def loaded(folder: Path, name: str, system: F64, at: F64, scale: float = 1.0, **spec: Any) -> CameraPath:
    """The known path from a file in the axes of `system`, lengths times `scale`, the map's origin at `at`."""
    turns, places = known_path()
    path = WRITERS[name](folder, system @ turns, scale * places @ system.T + at)
    return load_camera(CameraSpec(source=str(path), **spec), folder)


def placed(path: CameraPath, body: ShapedBody) -> PlacedCamera:
    mover = make_mover(AvatarSpec(), BUILTIN["t-pose"](), body)
    return place_camera(path, Scene(frames=40), [mover], [body])


def random_map(rng: np.random.Generator, name: str) -> tuple[F64, float, dict[str, float]]:
    """Origin up to 1000 km off, scale, and what the scene has to say of it; COLMAP's maps have no unit anyway."""
    scale = float(10 ** rng.uniform(-1.5, 1.5))
    return rng.uniform(-1e6, 1e6, 3), scale, {} if name.startswith("colmap") else {"metres_per_unit": 1 / scale}


def views(camera: PlacedCamera) -> F64:
    return np.stack([camera.sample(t_s) for t_s in np.linspace(0, 1.3, 14)])


@pytest.mark.parametrize("name", WRITERS)
def test_all_axis_systems_origins_and_scales_give_the_same_path(tmp_path: Path, name: str) -> None:
    """Every pose about the middle of the path, as the camera is placed, against the known one; and the lens."""
    turns, places = known_path()
    rng = np.random.default_rng(18)
    size = 1.0
    if name.startswith("colmap"):
        reference = loaded(tmp_path, name, np.eye(3), np.zeros(3)).places
        size = float(np.ptp(reference[:, 0]) / np.ptp(places[:, 0]))
    for system in systems_of(name):
        at, scale, spec = random_map(rng, name)
        path, _, _ = _from_the_middle(loaded(tmp_path, name, system, at, scale, **spec))
        assert matrix_from_quat(path.quats) == pytest.approx(turns, abs=1e-6), path.notes
        assert path.places == pytest.approx(size * (places - places.mean(axis=0)), abs=1e-3), path.notes
        assert path.times_s == pytest.approx(np.arange(POSES) / RATE_HZ, abs=1e-6)
        if name in ("nerf", "record3d", "stray") or name.startswith("colmap"):
            assert set(path.optics.lenses) == {VIDEO_LENS if name == "stray" else LENS}


@pytest.mark.parametrize("name", ["tum", "colmap binary"])
def test_another_axis_system_films_the_same_views(tmp_path: Path, body: ShapedBody, name: str) -> None:
    check_views(tmp_path, name, body, [SYSTEMS[17]])


@pytest.mark.slow
@pytest.mark.parametrize("name", WRITERS)
def test_all_axis_systems_film_the_same_views(tmp_path: Path, body: ShapedBody, name: str) -> None:
    check_views(tmp_path, name, body, systems_of(name) * 2)


def check_views(folder: Path, name: str, body: ShapedBody, systems: list[F64]) -> None:
    """Every view is that of the file in the known path's own axes, and so is what the notes say of the body."""
    reference = placed(loaded(folder, name, np.eye(3), np.zeros(3)), body)
    rng = np.random.default_rng(19)
    for system in systems:
        at, scale, spec = random_map(rng, name)
        camera = placed(loaded(folder, name, system, at, scale, **spec), body)
        assert views(camera) == pytest.approx(views(reference), abs=2e-3), camera.path.notes
        assert camera.notes == reference.notes


@pytest.mark.parametrize("stated", UP)
def test_a_stated_axis_is_up(tmp_path: Path, stated: str) -> None:
    """An ARKit world is levelled by its definition; in another one the scene has to say what is up."""
    turns, _ = known_path()
    system = next(each for each in SYSTEMS if each[:, 1] == pytest.approx(UP[stated]))
    path = loaded(tmp_path, "arkit", system, np.zeros(3), up_axis=stated)
    assert matrix_from_quat(_from_the_middle(path)[0].quats) == pytest.approx(turns, abs=1e-6)
    assert path.notes[1] == f"{stated.upper()} up, as given"
