"""Cameras: extreme lenses and distances, one inside the body, crops of a pixel, and a day of media time.

Rule: the rectangle of a body is right when no vertex on the screen lies outside it; where one lands in float32 is held
against float64, with the roundings of the shader counted.

In the shader. With clip coordinates C = M [x, 1], M and x in float32, each coordinate is off by gamma_6 of |M| |x| in
float32 (four products, two roundings of the inputs), X / W by that of X plus X / W times that of W, over W, and a
rounding of the quotient. A pixel is half a tensor's side for each 1 of X / W.

A day of media time. Frame 5,000,000 shows what the same moment of the motion's period shows; the reference reduces the
frame's time by the period in fractions, which are exact. frame / fps rounds by U of itself, the remainder is exact, so
the moment is off by at most U t, and what is shown by that times the fastest that it moves between two samples, and by
a few roundings of what is shown.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from fractions import Fraction

import numpy as np

from trilane.apps.experiments.hard_numbers.hard_number import EXACT, HIGHAM, U32, HardNumber, U, gamma, worst
from trilane.apps.experiments.hard_numbers.rotations import random_pose
from trilane.arrays import F64
from trilane.body.body import ShapedBody
from trilane.body.joints import JOINTS
from trilane.body.kinematics import Posed, Skeleton, rodrigues
from trilane.body.skinning import CpuSkinner
from trilane.scene.camera.path import load_builtin, look_at, projection_matrix
from trilane.scene.crop import Rect, crop_projection
from trilane.scene.motion.builtin import walk_wave_turn
from trilane.scene.motion.motion import Wrap
from trilane.scene.schema import CameraSpec
from trilane.stages.cpu.mesh_bounds import MeshBounds

NEAR_M, FAR_M = 0.05, 1000.0
#: Field of view in degrees and distance in metres of the camera from the pelvis.
VIEWS = {
    "a lens of 1 degree at 60 m": (1.0, 60.0),
    "a lens of 10 degrees at 8 m": (10.0, 8.0),
    "a lens of 120 degrees at 0.8 m": (120.0, 0.8),
    "a lens of 170 degrees at 0.5 m": (170.0, 0.5),
    "0.2 m away": (60.0, 0.2),
    "1 m away": (60.0, 1.0),
    "20 m away": (60.0, 20.0),
    "200 m away": (60.0, 200.0),
    "inside the body": (90.0, 0.02),
    "the near plane through the body": (90.0, 0.12),
}
DRAWN = 6
SIDE = 512
#: Crops as parts of the screen's width.
CROPS = {"a whole screen": 2.0, "a tenth": 0.2, "a 4096th": 2 / 4096}
PROOF = "no vertex on the screen may be outside: 0, by the proof in stages/cpu/mesh_bounds.py"
FRAME = 5_000_000
RATES = (24.0, 30.0, 59.94)
SOURCE = "rounding of the frame's time, times the fastest that is shown"
Shown = Callable[[float], F64]


def camera_cases(shaped: ShapedBody) -> Iterator[HardNumber]:
    """Rows of rectangles, of crops and of vertices on the screen."""
    bounds, skinner = MeshBounds(shaped), CpuSkinner(shaped)
    skeleton = Skeleton(shaped.joints, shaped.body.parents)
    for name, (fov_deg, metres) in VIEWS.items():
        outside = [
            _outside(bounds, posed, skinner.vertices(posed), clip) for posed, clip in _drawn(skeleton, fov_deg, metres)
        ]
        found = float(np.max(outside))
        yield HardNumber(f"vertices outside the rectangle, {name}, {DRAWN} poses", found, 0.0, "NDC", PROOF)
    yield from _behind(bounds, skeleton)
    yield from _crops()
    yield from _on_screen(skinner, skeleton)


def _drawn(skeleton: Skeleton, fov_deg: float, metres: float) -> Iterator[tuple[Posed, F64]]:
    """Poses never trained, and a camera for each, (4, 4) to clip space."""
    rng = np.random.default_rng(round(1e3 * metres + fov_deg))
    for _ in range(DRAWN):
        posed = skeleton.pose(rng.normal(0, 0.6, (JOINTS, 3)))
        target = posed.joints[rng.integers(JOINTS)].copy()
        towards = rng.normal(size=3)
        eye = target + metres * towards / np.linalg.norm(towards)
        yield posed, projection_matrix(fov_deg, 1.0, min(NEAR_M, metres / 2), FAR_M) @ look_at(eye, target)


def _outside(bounds: MeshBounds, posed: Posed, vertices: F64, clip: F64) -> float:
    """How far the vertices in front of the near plane and on the screen reach over the rectangle; inf without one."""
    found = bounds.rect(posed, clip)
    x, y, z, w = clip @ np.concatenate([vertices, np.ones((len(vertices), 1))], axis=1).T
    seen = (w > 0) & (z > -w) & (np.abs(x) <= w) & (np.abs(y) <= w)
    if not seen.any():
        return 0.0
    if found is None:
        return float("inf")
    x, y = x[seen] / w[seen], y[seen] / w[seen]
    return float(max(0.0, found.x0 - x.min(), x.max() - found.x1, found.y0 - y.min(), y.max() - found.y1))


def _behind(bounds: MeshBounds, skeleton: Skeleton) -> Iterator[HardNumber]:
    posed = skeleton.pose(np.zeros((JOINTS, 3)))
    eye = posed.joints[0] + np.array([0.0, 0.0, 4.0])
    clip = projection_matrix(60.0, 1.0, NEAR_M, FAR_M) @ look_at(eye, eye + np.array([0.0, 0.0, 4.0]))
    found = 0.0 if bounds.rect(posed, clip) is None else 1.0
    yield HardNumber("rectangles of a body behind the camera", found, 0.0, "rectangles", EXACT)


def _crops() -> Iterator[HardNumber]:
    """The cropped projection beside the map of the rectangle after projection, in extended precision.

    X' = (2 X - (x0 + x1) W) / (x1 - x0) and W are sums of at most 8 products in float64, each of a size of at most
    2 (|X| + 2 |W|) / (x1 - x0) in sum.
    """
    rng = np.random.default_rng(3)
    points = np.concatenate([rng.uniform(-2, 2, (4000, 2)), rng.uniform(-9, -1, (4000, 1)), np.ones((4000, 1))], axis=1)
    whole = projection_matrix(50.0, 1.5, NEAR_M, FAR_M)
    for name, width in CROPS.items():
        rect = Rect(0.3 - width / 2, -0.1 - width / 2, 0.3 + width / 2, -0.1 + width / 2)
        cropped = points @ crop_projection(whole, rect).T
        x, w = (points.astype(np.longdouble) @ whole.astype(np.longdouble).T).T[[0, 3]]
        wanted = (2 * x / w - (np.longdouble(rect.x0) + np.longdouble(rect.x1))) / np.longdouble(rect.width)
        sizes = 2 * (np.abs(points) @ np.abs(whole).T)[:, [0, 3]] @ np.array([1.0, 2.0]) / width / w
        bounds = (gamma(12) * sizes + gamma(6) * np.abs(wanted)) * SIDE / 2
        errors = np.abs(cropped[:, 0] / cropped[:, 3] - wanted) * SIDE / 2
        yield HardNumber(f"a crop of {name} of the screen", *worst(errors, bounds), "pixels of 512", HIGHAM)


def _on_screen(skinner: CpuSkinner, skeleton: Skeleton) -> Iterator[HardNumber]:
    posed = skeleton.pose(random_pose(JOINTS))
    vertices = skinner.vertices(posed)
    for metres in (0.2, 2.0, 20.0, 200.0):
        target = vertices.mean(axis=0)
        eye = target + metres * np.array([0.6, 0.0, 0.8])
        fov_deg = float(np.degrees(2 * np.arctan(1.0 / max(metres, 0.5))))
        clip = projection_matrix(fov_deg, 1.0, NEAR_M, FAR_M) @ look_at(eye, target)
        points = np.concatenate([vertices, np.ones((len(vertices), 1))], axis=1)
        seen = points @ clip.T
        points = points[seen[:, 3] > NEAR_M]
        exact = points @ clip.T
        found = points.astype(np.float32) @ clip.astype(np.float32).T
        off = gamma(7, U32) * (np.abs(points) @ np.abs(clip).T)
        place = exact[:, :2] / exact[:, 3:]
        bounds = (off[:, :2] + np.abs(place) * off[:, 3:]) / (np.abs(exact[:, 3:]) - off[:, 3:]) + U32 * np.abs(place)
        errors = np.abs(found[:, :2] / found[:, 3:] - place) * SIDE / 2
        name = f"vertices on the screen in float32, {metres:g} m away"
        yield HardNumber(name, *worst(errors, bounds * SIDE / 2), "pixels of 512", HIGHAM)


def time_cases() -> Iterator[HardNumber]:
    """Rows of the built-in walk and camera at each rate."""
    motion, camera = walk_wave_turn(), load_builtin("orbit", CameraSpec())
    assert camera is not None
    shown: dict[str, tuple[Shown, F64, Wrap, str]] = {
        "turns of the walk": (lambda t: rodrigues(motion.sample(t)[0]), motion.times_s, motion.wrap, "entry of R"),
        "place of the walk": (lambda t: motion.sample(t)[1], motion.times_s, motion.wrap, "m"),
        "the orbiting camera": (camera.sample, camera.times_s, camera.wrap, "entry of the view"),
    }
    for name, (at, times_s, wrap, unit) in shown.items():
        speed = _fastest(at, times_s)
        for fps in RATES:
            reached = FRAME / fps
            error = float(np.abs(at(reached) - at(_moment(fps, times_s, wrap))).max())
            bound = 2 * U * reached * speed + 64 * U * (1 + np.pi)
            yield HardNumber(f"{name}, frame {FRAME:,} at {fps:g} a second", error, bound, unit, SOURCE)


def _moment(fps: float, times_s: F64, wrap: Wrap) -> float:
    """The time within one period of frame `FRAME`."""
    length = Fraction(float(times_s[-1])) * (1 if wrap is Wrap.LOOP else 2)
    phase = (Fraction(FRAME) / Fraction(fps)) % length
    return float(phase if wrap is Wrap.LOOP or phase <= length / 2 else length - phase)


def _fastest(at: Shown, times_s: F64) -> float:
    """The greatest change in a second of any number, between neighbouring samples."""
    values = np.array([at(float(t)).ravel() for t in times_s])
    return float(np.abs(np.diff(values, axis=0) / np.diff(times_s)[:, None]).max())
