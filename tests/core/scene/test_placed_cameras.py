"""Recorded cameras of all formats against a slow search: the person is whole where any place shows the person whole.

Forty cameras with random floors, headings, axes and scales, held by hand, in orbits, on drones, on cars, and lost. The
slow search, `support.person_search`, shares no code with the product's and judges the places of both.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from support.camera_files import OPTICAL, WRITERS
from support.person_search import PersonSearch, outermost, skinned
from trilane.arrays import F64
from trilane.avatars.bundle import bundle_folder
from trilane.body.body import ShapedBody, load_body
from trilane.errors import BadInputError
from trilane.scene.camera.path import axes_towards
from trilane.scene.missing_person import require_person
from trilane.scene.motion.files import load_motion
from trilane.scene.mover import make_mover
from trilane.scene.rotations import about
from trilane.scene.schema import AvatarSpec, CameraSpec, Scene, axes_of
from trilane.scene.staging import stage_scene

COUNT = 40
POSES = 90
#: Moments of the check, other than those that the product looks at.
MOMENTS: F64 = np.linspace(0.0, 10.0, 61)
#: Turn of a world with Y up into that of the format, and axes of a pose that a scene may state.
Z_UP: F64 = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
UP_OF = {"tum": Z_UP, "euroc": Z_UP, "nerf": Z_UP, "kitti": OPTICAL, "colmap text": OPTICAL, "colmap binary": OPTICAL}
AXES = ("forward-left-up", "forward-right-down", "right-up-back")
OPENGL = ("arkit", "nerf", "record3d")


@dataclass(frozen=True)
class Made:
    """A made camera: the file's format, the way it goes, and the scene that films with it."""

    kind: str
    way: str
    scale: float
    highest_m: float
    scene: Scene


def hand(random: np.random.Generator, t: F64) -> tuple[F64, F64]:
    places = np.stack([0.2 * np.sin(5 * t), 1.5 + 0.05 * np.sin(9 * t), 3.5 + 0.2 * np.cos(4 * t)], axis=1)
    return places, places * [0, 0, 0] + [0.1, random.uniform(0.6, 1.2), 0.0]


def orbit(random: np.random.Generator, t: F64) -> tuple[F64, F64]:
    angle = random.uniform(1.0, 5.5) * t
    places = np.stack([3 * np.sin(angle), np.full(len(t), random.uniform(0.8, 3.0)), 3 * np.cos(angle)], axis=1)
    return places, places * 0 + [0, 0.9, 0]


def drone(random: np.random.Generator, t: F64) -> tuple[F64, F64]:
    places = np.stack([4 * np.sin(2 * t), 0.5 + 3 * t, 2 + random.uniform(1, 4) * t], axis=1)
    return places, places * 0 + [0.3, 0.0, 0.2]


def flight(random: np.random.Generator, t: F64) -> tuple[F64, F64]:
    places = np.stack([0.3 * np.sin(3 * t), 3 + 0.1 * np.cos(7 * t), -random.uniform(0.5, 2.5) * t], axis=1)
    return places, places + np.array([0.0, -random.uniform(0.4, 1.4), -1.0])


def car(random: np.random.Generator, t: F64) -> tuple[F64, F64]:
    places = np.stack([0.3 * t**2, np.full(len(t), random.uniform(1.4, 2.0)), -4 * t], axis=1)
    return places, places + np.stack([0.6 * t, np.full(len(t), -0.02), -np.ones(len(t))], axis=1)


def lost(random: np.random.Generator, t: F64) -> tuple[F64, F64]:
    places = np.stack([0.1 * t, np.full(len(t), random.uniform(1.0, 2.0)), 0.1 * t], axis=1)
    return places, places + np.stack([np.sin(6.3 * t), 0 * t, np.cos(6.3 * t)], axis=1)


WAYS = (hand, orbit, drone, flight, car, lost)


def make(number: int, folder: Path) -> Made:
    """Write camera `number` and return its scene; the same one every time."""
    random = np.random.default_rng(3300 + number)
    way, kind = WAYS[number % len(WAYS)], list(WRITERS)[number % len(WRITERS)]
    places, targets = way(random, np.linspace(0.0, 1.0, POSES))
    scale = float(np.exp(random.uniform(math.log(0.03), math.log(30.0))))
    scale = min(scale, 100.0 / float(places[:, 1].max()))  # heights to 100 m
    turns = np.concatenate([axes_towards(at[None], to) for at, to in zip(places, targets, strict=True)])
    turns = turns @ about(2, random.normal(0, 0.01, POSES))
    heading, floor = about(1, random.uniform(-math.pi, math.pi)), random.uniform([-50, -20, -50], [50, 20, 50])
    world = UP_OF.get(kind, np.eye(3)) @ heading
    turns, moved = world @ turns, scale * places @ world.T + UP_OF.get(kind, np.eye(3)) @ floor
    # A log without column names whose camera looks down may be KITTI's as well; the product asks, so the scene says it.
    spec: dict[str, Any] = {"format": "arkit"} if kind == "arkit" else {}
    if number % 3 == 2:
        spec["axes"] = AXES[number // 3 % len(AXES)]
        stated = np.array(axes_of(spec["axes"]), dtype=np.float64)
        turns = turns @ stated.T @ (np.eye(3) if kind in OPENGL else OPTICAL)
    folder.mkdir(exist_ok=True)
    path = WRITERS[kind](folder, turns, moved)
    camera = CameraSpec(source=str(path), **spec)
    background = "film.mp4" if number % 2 else "room"
    motion = ("builtin:idle", "builtin:walk-wave-turn")[number % 7 == 0]
    scene = Scene(camera=camera, background=background, avatars=(AvatarSpec(motion=motion),))
    return Made(kind, way.__name__, scale, scale * float(places[:, 1].max()), scene)


@functools.cache
def points_of(motion: str) -> F64:
    """The outermost points (F, P, 3) of the default body at MOMENTS in a motion, before the camera is placed."""
    body = load_body(bundle_folder("default") / "body.npz").shape()
    spec = AvatarSpec(motion=motion)
    mover = make_mover(spec, load_motion(spec, Path("/"), body.joints), body)
    return np.stack([outermost(skinned(body, mover, float(t_s))) for t_s in MOMENTS])


def figures(made: Made, body: ShapedBody, effort: tuple[int, int]) -> tuple[float, float, str]:
    """Return the share of moments with the whole person, the best that a slow search finds, and what a run says."""
    scene = made.scene
    staged = stage_scene(scene, [body], Path("/"))
    camera, points = staged.camera, points_of(scene.avatars[0].motion)
    output = (scene.output.height, scene.output.width)
    mounts = [np.eye(3)] + ([camera.mount] if (camera.mount != np.eye(3)).any() else [])
    searches = [PersonSearch(camera.path, mount, MOMENTS, points, output) for mount in mounts]
    ours = searches[-1].share(-camera.turn.T @ camera.shift)
    best = max(search.best(*effort)[0] for search in searches)
    try:
        require_person(scene, staged, [body], Path("/"))
    except BadInputError as error:
        return ours, best, str(error)
    return ours, best, ""


def check(number: int, folder: Path, body: ShapedBody, effort: tuple[int, int]) -> None:
    made = make(number, folder)
    ours, best, refused = figures(made, body, effort)
    line = f"{number:2d} {made.kind:13s} {made.way:6s} scale {made.scale:6.3f} to {made.highest_m:5.1f} m"
    print(f"{line} {made.scene.camera.axes:18s} whole {ours:6.1%} slow {best:6.1%} {refused[-150:]}")
    assert (ours >= 0.95 * best and not refused) or (best < 0.55 and refused)


#: Two orbits too close to hold a person all the time, and a drone with stated axes.
@pytest.mark.parametrize("number", [7, 31, 2])
def test_a_placed_camera_shows_the_person(number: int, tmp_path: Path, body: ShapedBody) -> None:
    check(number, tmp_path, body, (2000, 2000))


@pytest.mark.slow
@pytest.mark.parametrize("number", range(COUNT))
def test_forty_placed_cameras_show_the_person(number: int, tmp_path: Path, body: ShapedBody) -> None:
    check(number, tmp_path, body, (8000, 8000))
