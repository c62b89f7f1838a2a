"""The fixture that the GPU benches draw, its ground truth, and the timing of variants in interleaved rounds.

Rule: the default body fills the height of a square picture. Only the size and the numbers of channels and weights vary;
all other numbers are the same every time. Avatars and ground truth come from the same functions as in runs and in
training. As in a run, successive inputs differ and slots alternate, because caches would speed up repetitions.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from trilane.arrays import F32
from trilane.avatars.bundle import Bundle, bundle_folder, load_bundle
from trilane.bench.lib.interleaved_processes import INPUTS
from trilane.body.body import ShapedBody, load_body
from trilane.body.joints import JOINT_INDEX, Posed, Skeleton
from trilane.body.skinning import largest_weights
from trilane.errors import MissingPartError
from trilane.stages.avatar_assets import load_avatar
from trilane.stages.config import Quantisation
from trilane.stages.gpu.skinned_mesh import MeshArrays, avatar_mesh, mesh_arrays

TEXTURE_SIDE = 512
ENCODING = Quantisation(6 / 255, 128)
DISTANCE_M, HEIGHT_M, FRAME_M = 3.0, 0.9, 1.9
ARMS_DOWN_RAD = 1.1
ARMS_STEP_RAD = 0.07  # how much higher the arms are in each further pose
WARM_UP = 5


@dataclass(frozen=True)
class Fixture:
    """The body that a bench draws, with its neural texture and its camera.

    `shaped`: default body after its shape blend shapes.
    `poses`: posed joints of the body, for each of INPUTS poses.
    `arrays`: mesh of the body for the GPU.
    `view`, `projection`: matrices of the camera, (4,4) float64.
    `texture`: neural texture (512,512,C) float64, with the same numbers every time.
    """

    shaped: ShapedBody
    poses: tuple[Posed, ...]
    arrays: MeshArrays
    view: NDArray[np.float64]
    projection: NDArray[np.float64]
    texture: NDArray[np.float64]

    def joints(self, number: int) -> NDArray[np.float32]:
        """Return the skinning matrices (55,3,4) float32 of input `number`; the inputs repeat after INPUTS numbers."""
        return self.poses[number % INPUTS].matrices


def standing(channels: int, weights: int = 8) -> Fixture:
    """Return the fixture: a standing body whose arms are half down, and a little higher in each further pose.

    `channels`: number of channels of the texture. `weights`: number of skin weights of a vertex: 4, 8 or 12.
    """
    body = load_body(bundle_folder("default") / "body.npz")
    shaped = body.shape()
    top = largest_weights(body.weights, weights)
    low = float(shaped.vertices[:, 1].min())
    skeleton = Skeleton(shaped.joints, body.parents)

    def posed(number: int) -> Posed:
        pose, down = np.zeros((55, 3)), ARMS_DOWN_RAD - number * ARMS_STEP_RAD
        pose[JOINT_INDEX["left_shoulder"], 2], pose[JOINT_INDEX["right_shoulder"], 2] = -down, down
        found = skeleton.pose(pose.ravel(), translation=(0.0, -low, 0.0))
        return Posed(found.matrices.copy(), found.joints.copy(), found.feature.copy())

    view = np.eye(4)
    view[:3, 3] = (0.0, -HEIGHT_M, -DISTANCE_M)
    return Fixture(
        shaped=shaped,
        poses=tuple(map(posed, range(INPUTS))),
        arrays=mesh_arrays(shaped.vertices, body.faces, body.uv, body.uv_faces, top.joints, top.weights),
        view=view,
        projection=_projection(),
        texture=_texture(channels),
    )


def _projection() -> NDArray[np.float64]:
    near, far, zoom = 0.05, 100.0, 2 * DISTANCE_M / FRAME_M
    projection: NDArray[np.float64] = np.diag([zoom, zoom, -(far + near) / (far - near), 0.0])
    projection[2, 3], projection[3, 2] = -2 * far * near / (far - near), -1.0
    return projection


def _texture(channels: int) -> NDArray[Any]:
    rng = np.random.default_rng(0)
    row, column = np.indices((TEXTURE_SIDE, TEXTURE_SIDE)) * (2 * np.pi / TEXTURE_SIDE)
    waves = rng.integers(1, 40, (channels, 2))
    return np.stack([np.sin(waves[c, 0] * row + c) + np.cos(waves[c, 1] * column) for c in range(channels)], axis=-1)


@dataclass(frozen=True)
class Drawable:
    """The parts of an avatar that the GPU draws.

    `arrays`: mesh of the avatar for the GPU. `texture`: neural texture (H,W,C) float32. `quantisation`: scale and zero
    point of the network's input.
    """

    arrays: MeshArrays
    texture: F32
    quantisation: Quantisation


def load_drawable(name: str) -> Drawable:
    """Return the parts of the avatar `name` that the GPU draws. Raises BadInputError if the avatar cannot be read."""
    avatar = load_avatar(load_bundle(name))
    packed = avatar.bundle.manifest.network.input
    return Drawable(avatar_mesh(avatar.shaped), avatar.texture, Quantisation(packed.scale, packed.zero_point))


def ground_truth(bundle: Bundle) -> tuple[Any, Any]:
    """Return (renderer, function): what is needed to compare pictures of `bundle` with ground truth.

    The `SampleRenderer` draws the clothed body of the bundle. The function is `image_error` of training.
    Raises MissingPartError if a library for training is not installed.
    """
    try:
        from trilane.training.clothing import look_of
        from trilane.training.image_error import image_error
        from trilane.training.sample_renderer import SampleRenderer
    except ImportError as error:
        raise MissingPartError(f"ground truth needs {error.name}", extra="train") from None
    return SampleRenderer(bundle.shaped_body(), look=look_of(bundle.manifest.provenance)), image_error


def interleaved_ms(
    variants: Mapping[str, Callable[[int], object]],
    repeats: int,
    prepare: Callable[[int], object] = lambda _: None,
) -> dict[str, list[float]]:
    """Return the times of each variant in ms, one for each round after a warm-up, by variant.

    Each round runs every variant once.
    `variants`: functions of the round's number, by name. The number, from 0, selects the input and the slot.
    `repeats`: number of timed rounds. `prepare`: function that is called with the same number before each run; its time
    does not count.
    """
    times: dict[str, list[float]] = {name: [] for name in variants}
    for number in range(WARM_UP + repeats):
        for name, run in variants.items():
            prepare(number)
            start = time.perf_counter_ns()
            run(number)
            if number >= WARM_UP:
                times[name].append((time.perf_counter_ns() - start) / 1e6)
    return times


def summary_ms(times_ms: list[float]) -> dict[str, float]:
    """Return the median, the minimum and the 90th percentile: `median_ms`, `min_ms`, `p90_ms`."""
    return {
        "median_ms": float(np.median(times_ms)),
        "min_ms": float(np.min(times_ms)),
        "p90_ms": float(np.percentile(times_ms, 90)),
    }
