"""Recorded cameras of all formats against a slow search: the person is whole where any place shows the person whole.

Forty cameras with random floors, headings, axes and scales, held by hand, in orbits, on drones, on cars, and lost. And
twenty that were missing among them: cars that turn, cameras beside the origin of the body that carries them, surveys
straight down, and cameras that see a person about half of the time. The slow search, `support.person_search`, shares no
code with the product's and judges the places of both.
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
from trilane.scene.motion.files import load_motion
from trilane.scene.mover import make_mover
from trilane.scene.rotations import about
from trilane.scene.schema import AvatarSpec, CameraSpec, Scene, axes_of
from trilane.scene.staging import require_person, stage_scene

COUNT, MORE = 40, 20
POSES = 90
#: Moments of the check, other than those that the product looks at.
MOMENTS: F64 = np.linspace(0.0, 10.0, 61)
#: Turn of a world with Y up into that of the format, and axes of a pose that a scene may state.
Z_UP: F64 = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
UP_OF = {
    "tum": Z_UP,
    "euroc": Z_UP,
    "body": Z_UP,
    "nerf": Z_UP,
    "kitti": OPTICAL,
    "colmap text": OPTICAL,
    "colmap binary": OPTICAL,
}
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


def bend(random: np.random.Generator, t: F64) -> tuple[F64, F64]:
    """A car that drives 15 to 40 m and turns left or right by up to a right angle."""
    heading = random.choice([-1, 1]) * random.uniform(0.6, 1.6) * np.clip(2 * t - 0.5, 0, 1)
    ahead = np.stack([np.sin(heading), np.zeros(len(t)), -np.cos(heading)], axis=1)
    places = np.cumsum(ahead, axis=0) * random.uniform(15, 40) / len(t) + [0, 1.65, 0]
    return places, places + ahead + [0, -0.03, 0]


def survey(random: np.random.Generator, t: F64) -> tuple[F64, F64]:
    """A drone that flies lanes and looks straight down, the top of its pictures to the north."""
    length = random.uniform(1, 12)
    lane = np.abs((3 * t) % 2 - 1)
    places = np.stack([length * (lane - 0.5), 10 + 0.02 * np.sin(40 * t), -length * t / 2], axis=1)
    return places, places + np.array([0.0, -1.0, -1e-3])


def half(random: np.random.Generator, t: F64) -> tuple[F64, F64]:
    """Somebody looks at a person for 46 to 58 % of the time, and then the other way."""
    places = np.stack([0.1 * np.sin(7 * t), 1.5 + 0.03 * np.cos(5 * t), 4 + 0.1 * t], axis=1)
    away = np.pi * np.clip((t - random.uniform(0.46, 0.58)) / 0.02, 0, 1)
    return places, places + np.stack([np.sin(away), np.full(len(t), -0.15), -np.cos(away)], axis=1)


WAYS = (hand, orbit, drone, flight, car, lost)
OTHER_WAYS = (bend, hand, survey, half, orbit)
#: From the first camera to the body of EuRoC's drone, `T_BS` of `cam0/sensor.yaml`, to four digits and made a rotation.
TO_BODY: F64 = about(2, np.pi / 2 - 0.015) @ about(0, 0.0037) @ about(1, 0.0258)
CAMERA_AT: F64 = np.array([-0.0216, -0.0647, 0.0098])
SENSOR = """\
T_BS:
  data: [{}]
resolution: [640, 480]
intrinsics: [510.0, 500.0, 330.0, 228.0]
distortion_coefficients: [0.0, 0.0, 0.0, 0.0]
"""


def write_on_a_body(folder: Path, turns: F64, places: F64) -> Path:
    """EuRoC's poses of a body that carries the camera 10 times as far off its origin as EuRoC's drone does."""
    to_body = np.eye(4)
    to_body[:3, :3], to_body[:3, 3] = TO_BODY, 10 * CAMERA_AT
    body_turns = turns @ OPTICAL @ TO_BODY.T  # body to world
    body_places = places - body_turns @ to_body[:3, 3]
    for name in ("cam0", "state_groundtruth_estimate0"):
        (folder / name).mkdir()
    numbers = ", ".join(f"{value:.17g}" for value in to_body.ravel())
    (folder / "cam0" / "sensor.yaml").write_text(SENSOR.format(numbers))
    return WRITERS["euroc"](folder / "state_groundtruth_estimate0", body_turns @ OPTICAL, body_places)


#: Format of each of the OTHER_WAYS in turn; a drone's camera that looks straight down shows no horizon, so its scene
#: says what is up.
KINDS_OF = {
    "bend": ("kitti", "tum"),
    "hand": ("body",),
    "survey": ("tum", "nerf", "colmap text", "kitti"),
    "half": tuple(WRITERS),
    "orbit": ("body",),
}
UP_AXIS_OF = {"tum": "z", "nerf": "z", "colmap text": "-y", "kitti": "-y"}


def make(number: int, folder: Path) -> Made:
    """Write camera `number` and return its scene; the same one every time."""
    random = np.random.default_rng(3300 + number)
    way, kind = WAYS[number % len(WAYS)], list(WRITERS)[number % len(WRITERS)]
    if number >= COUNT:
        way = OTHER_WAYS[number % len(OTHER_WAYS)]
        kind = KINDS_OF[way.__name__][number // len(OTHER_WAYS) % len(KINDS_OF[way.__name__])]
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
    if way is survey:
        spec["up_axis"] = UP_AXIS_OF[kind]
    if number % 3 == 2 and kind != "body":
        spec["axes"] = AXES[number // 3 % len(AXES)]
        stated = np.array(axes_of(spec["axes"]), dtype=np.float64)
        turns = turns @ stated.T @ (np.eye(3) if kind in OPENGL else OPTICAL)
    folder.mkdir(exist_ok=True)
    path = (write_on_a_body if kind == "body" else WRITERS[kind])(folder, turns, moved)
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
@pytest.mark.parametrize("number", range(COUNT + MORE))
def test_placed_cameras_show_the_person(number: int, tmp_path: Path, body: ShapedBody) -> None:
    check(number, tmp_path, body, (8000, 8000))
