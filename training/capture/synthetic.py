"""Writes a synthetic capture of the clothed default body: any number of frames, in random poses, from all sides.

Rule: a frame depends only on the recipe and the frame's number. If fits and masks have noise, capture.toml states the
noise, and a second capture in the folder `truth` has the exact fits and masks.
"""

from __future__ import annotations

import io
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, ImageFilter

from trilane.arrays import F64, U8, Floats, Shape
from trilane.avatars.bundle import CAPTURE
from trilane.body.body import ShapedBody
from trilane.body.joints import JOINTS, LEFT_HAND, RIGHT_HAND, rodrigues
from trilane.scene.lens import Lens, centred
from trilane.scene.rotations import rotvec_from_matrix
from trilane.training.capture.capture_file import FAR_M, NEAR_M, OPENGL_FROM_OPENCV
from trilane.training.clothing import DEFAULT_NAME, look_named
from trilane.training.random_views import look_at, random_pose
from trilane.training.sample_renderer import SampleRenderer

TRUTH = "truth"
FOV_Y_DEG = 40.0
PITCH_DEG = (-12.0, 4.0, 30.0)
ROLL_DEG = 1.0
#: Cameras are evenly spaced about the body, and then turned at random. This is the largest such turn, as a share of the
#: angle between two cameras. It is small enough that four frames show all sides.
JITTER = 0.3
#: Largest share of the picture that the person fills along a side. The camera may be `MOST_FARTHER` times as far away.
FILLED = 0.94
MOST_FARTHER = 1.3
FAST_PNG = 1
#: Distance in pixels between the random values that move a mask's outline, and between the background's random values.
MASK_PATCH_PX, BACKGROUND_PATCH_PX = 24, 160
#: At this many standard deviations from a straight edge, a Gaussian blur has a tenth of the edge's height.
TENTH_AT = 1.2816


@dataclass(frozen=True)
class Recipe:
    """The content of a synthetic capture.

    `frames`: number of frames.
    `shape`: (height, width) of a frame.
    `seed`: seed of all random numbers.
    `fit_deg`: noise of fits: largest turn of each joint about a random axis, in degrees.
    `fit_mm`: noise of fits: largest move of the body along each axis, in millimetres.
    `mask_px`: noise of masks: largest move of the outline, in pixels.
    `look`: look of the person, a name of `LOOKS`.
    """

    frames: int
    shape: Shape
    seed: int = 1
    fit_deg: float = 0.0
    fit_mm: float = 0.0
    mask_px: float = 0.0
    look: str = DEFAULT_NAME

    @property
    def is_noisy(self) -> bool:
        return max(self.fit_deg, self.fit_mm, self.mask_px) > 0

    @property
    def betas(self) -> F64:
        """Shape coefficients (10,) of the look's body."""
        return np.array([*look_named(self.look).betas, *[0.0] * 10][:10])

    @property
    def lens(self) -> Lens:
        """Lens of the camera, which has square pixels."""
        height, width = self.shape
        return centred(width, height, height / 2 / np.tan(np.radians(FOV_Y_DEG) / 2))


@dataclass(frozen=True)
class SyntheticFrame:
    """One frame with its mask and its fit.

    `frame`: (h,w,3). `mask`: (h,w), 0 to 255.
    `pose` (55,3), `place` (3,): pose and place of the fit, as in `Fit`, in OpenCV camera axes.
    """

    frame: U8
    mask: U8
    pose: F64
    place: F64


class SyntheticCapture:
    """Draws the frames of a recipe, with an OpenGL context of its own."""

    def __init__(self, shaped: ShapedBody, recipe: Recipe) -> None:
        """Open the context, and put clothes on `shaped`, a body with the shape of the recipe's look.

        Raises MissingPartError without OpenGL.
        """
        self._recipe, self._root = recipe, shaped.joints[0]
        self._renderer = SampleRenderer(shaped, look=look_named(recipe.look))
        self._projection = recipe.lens.projection(NEAR_M, FAR_M)
        self._background = _patches(np.random.default_rng((recipe.seed, 4)), recipe.shape, BACKGROUND_PATCH_PX, 3)

    def frame(self, number: int) -> SyntheticFrame:
        """Return frame `number`, without noise."""
        recipe, renderer = self._recipe, self._renderer
        rng = np.random.default_rng((recipe.seed, 3, number))
        pose = random_pose(rng)
        posed = renderer.skeleton.pose(pose)
        yaw = 2 * np.pi * (number + JITTER * rng.uniform(-1, 1)) / recipe.frames
        view = framing_view(rng, yaw, renderer.surface.posed(posed), self._projection)
        rgba = renderer.clothed_body.render(posed.matrices, view, self._projection, recipe.shape)
        share = rgba[..., 3:] / 255
        ground = 96 + 64 * self._background
        frame = np.round(rgba[..., :3] * share + ground * (1 - share)).astype(np.uint8)
        return SyntheticFrame(frame, rgba[..., 3].copy(), *in_camera(pose, self._root, view))

    def noisy(self, number: int, exact: SyntheticFrame) -> SyntheticFrame:
        """Return frame `number` with the recipe's noise on fit and mask. `exact`: the same frame without noise."""
        recipe = self._recipe
        rng = np.random.default_rng((recipe.seed, 5, number))
        pose = turned_at_random(rng, exact.pose, recipe.fit_deg)
        place = exact.place + rng.uniform(-1, 1, 3) * recipe.fit_mm / 1000
        mask = moved_outline(rng, exact.mask, recipe.mask_px) if recipe.mask_px else exact.mask
        return SyntheticFrame(exact.frame, mask, pose, place)


def framing_view(rng: np.random.Generator, yaw: float, points: F64, projection: F64) -> F64:
    """Return the view matrix (4,4) of a camera whose picture is nearly filled by `points` (N,3).

    The camera aims at the middle of the points' bounding box. Let (x, y, z) be a point relative to this aim, in camera
    axes, and t the tangent of half the field of view. The point is in the picture if the camera is at least |x| / t + z
    away from the aim (and the same for y).

    `yaw`: direction of the camera about the body, in radians: 0 is in front (+Z), pi / 2 on the body's left (+X).
    `projection`: matrix (4,4) of the camera.
    """
    aim = (points.min(axis=0) + points.max(axis=0)) / 2
    pitch = np.radians(rng.triangular(*PITCH_DEG))
    back = np.array([np.sin(yaw) * np.cos(pitch), np.sin(pitch), np.cos(yaw) * np.cos(pitch)])
    roll = np.radians(ROLL_DEG) * rng.standard_normal()
    near = look_at(aim + back, aim, roll)
    x, y, z = near[:3, :3] @ (points - aim).T
    tangents = FILLED / np.array([projection[0, 0], projection[1, 1]])
    distance = max((np.abs(x) / tangents[0] + z).max(), (np.abs(y) / tangents[1] + z).max())
    return look_at(aim + back * distance * rng.uniform(1.0, MOST_FARTHER), aim, roll)


def in_camera(pose: F64, root: F64, view: F64) -> tuple[F64, F64]:
    """Return (pose (55,3), place (3,)) of a body in OpenCV camera axes.

    `pose`: pose (55,3) of the body in world axes. The body's place in the world is (0, 0, 0).
    `root`: root joint (3,) at rest, about which the body turns.
    `view`: matrix (4,4) from the world to the OpenGL camera.
    """
    to_camera = OPENGL_FROM_OPENCV @ view[:3]  # the matrix is its own inverse
    turned = pose.copy()
    turned[0] = rotvec_from_matrix(to_camera[:, :3] @ rodrigues(pose[0]))
    return turned, to_camera[:, :3] @ root + to_camera[:, 3] - root


def turned_at_random(rng: np.random.Generator, pose: F64, most_deg: float) -> F64:
    """Return `pose` (55,3) with each joint turned about a random axis by a random angle up to `most_deg`."""
    axes = rng.standard_normal((JOINTS, 3))
    turns = axes / np.linalg.norm(axes, axis=1, keepdims=True) * np.radians(rng.uniform(0, most_deg, (JOINTS, 1)))
    return np.asarray(rotvec_from_matrix(rodrigues(turns) @ rodrigues(pose)))


def moved_outline(rng: np.random.Generator, mask: U8, most_px: float) -> U8:
    """Return `mask` (h,w) as 255 and 0, with its outline moved in or out by up to `most_px` pixels.

    The mask is blurred, and pixels above a level become 255. The level, 0.1 to 0.9, varies smoothly over the picture.
    """
    blurred = np.asarray(Image.fromarray(mask).filter(ImageFilter.GaussianBlur(most_px / TENTH_AT)), np.float64) / 255
    level = 0.5 + 0.4 * _patches(rng, (mask.shape[0], mask.shape[1]), MASK_PATCH_PX, 1)[..., 0]
    return np.where(blurred > level, 255, 0).astype(np.uint8)


def _patches(rng: np.random.Generator, shape: Shape, side: int, channels: int) -> F64:
    """Return random values (h,w,channels) in -1..1 that vary smoothly. `side`: pixels between independent values."""
    coarse = rng.uniform(-1, 1, (channels, shape[0] // side + 2, shape[1] // side + 2)).astype(np.float32)
    planes = [np.asarray(Image.fromarray(plane).resize(shape[::-1], Image.Resampling.BILINEAR)) for plane in coarse]
    return np.stack(planes, axis=-1).astype(np.float64)


def write_capture(folder: Path, capture: SyntheticCapture, recipe: Recipe) -> Iterator[int]:
    """Write the capture of `recipe` to the empty `folder`, and yield the number of each written frame."""
    for part in ("frames", "masks", "fits", *((f"{TRUTH}/masks", f"{TRUTH}/fits") if recipe.is_noisy else ())):
        (folder / part).mkdir(parents=True)
    (folder / CAPTURE).write_text(capture_text(recipe, "frames"), encoding="utf-8")
    if recipe.is_noisy:
        (folder / TRUTH / CAPTURE).write_text(capture_text(recipe, "../frames"), encoding="utf-8")
    for number in range(recipe.frames):
        exact = capture.frame(number)
        Image.fromarray(exact.frame).save(folder / "frames" / f"{number:06}.png", compress_level=FAST_PNG)
        _write_shot(folder, number, capture.noisy(number, exact), recipe)
        if recipe.is_noisy:
            _write_shot(folder / TRUTH, number, exact, recipe)
        yield number


def _write_shot(folder: Path, number: int, shot: SyntheticFrame, recipe: Recipe) -> None:
    Image.fromarray(shot.mask).save(folder / "masks" / f"{number:06}.png", compress_level=FAST_PNG)
    np.savez(folder / "fits" / f"{number:06}.npz", **fit_arrays(shot.pose, shot.place, recipe.betas))


def fit_arrays(pose: F64, place: F64, betas: F64) -> dict[str, Any]:
    """Return the float32 arrays of a fit by their SMPL-X names. `pose` (55,3), `place` (3,), `betas` (10,): the fit."""
    row = pose.reshape(-1)
    parts: dict[str, Floats] = {
        "global_orient": row[:3],
        "body_pose": row[3:66],
        "jaw_pose": row[66:69],
        "leye_pose": row[69:72],
        "reye_pose": row[72:75],
        "left_hand_pose": row[LEFT_HAND],
        "right_hand_pose": row[RIGHT_HAND],
        "transl": place,
        "betas": betas,
    }
    return {name: part.astype(np.float32) for name, part in parts.items()}


def capture_text(recipe: Recipe, frames: str) -> str:
    """Return the text of `capture.toml`. `frames`: folder of the frames, relative to the file's folder."""
    lens = recipe.lens
    noise = f"fits up to {recipe.fit_deg:g} degrees and {recipe.fit_mm:g} mm, masks up to {recipe.mask_px:g} pixels off"
    return f"""\
# The default body, clothed, drawn by `trilane avatar create-data`: {recipe.frames} frames, seed {recipe.seed}.
# Look: {recipe.look}.
# Noise: {noise if recipe.is_noisy and frames == "frames" else "none"}.
schema = 1
body = "default"
frames = "{frames}"
masks = "masks"
fits = "fits"

[camera]
width = {recipe.shape[1]}
height = {recipe.shape[0]}
fx = {float(lens.fx)!r}
fy = {float(lens.fy)!r}
cx = {float(lens.cx)!r}
cy = {float(lens.cy)!r}
"""


@dataclass(frozen=True)
class DrawingCost:
    """The measured cost of a frame. `seconds`: time to draw and encode it. `disk_bytes`: size of its files."""

    seconds: float
    disk_bytes: int


def measured_cost(capture: SyntheticCapture, recipe: Recipe) -> DrawingCost:
    """Return the cost of a frame of `recipe`: draw one frame to warm up, then draw and encode another in memory."""
    capture.frame(0)
    start = time.monotonic()
    exact = capture.frame(recipe.frames // 2)
    shots = [capture.noisy(recipe.frames // 2, exact), *([exact] if recipe.is_noisy else [])]
    file = io.BytesIO()
    for picture in (exact.frame, *(shot.mask for shot in shots)):
        Image.fromarray(picture).save(file, "png", compress_level=FAST_PNG)
    for shot in shots:
        np.savez(file, **fit_arrays(shot.pose, shot.place, recipe.betas))
    return DrawingCost(time.monotonic() - start, file.tell())
