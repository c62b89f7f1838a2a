"""Renders the samples that the avatar is trained and judged on: UV images and pictures of the dressed body.

Rule: the crop, the shape bucket and both rasters are the pipeline's; a sample is a function of its seed alone.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from trilane.arrays import F64
from trilane.body.body import ShapedBody, load_body
from trilane.body.kinematics import Skeleton
from trilane.body.skinning import largest_weights
from trilane.scene.motion.motion import Motion
from trilane.shapes import Shape, shape_buckets
from trilane.stages.gpu.avatar_mesh import enough_weights
from trilane.stages.gpu.context import open_context
from trilane.stages.gpu.mesh import SkinnedMesh, mesh_arrays
from trilane.training.clothing.clothing import Wardrobe
from trilane.training.clothing.landmarks import find_landmarks
from trilane.training.clothing.layers import BodyArrays, dress
from trilane.training.crops import Crop, Cropper
from trilane.training.data import U16, create_group, open_groups
from trilane.training.poses import random_pose
from trilane.training.uv_image import UvRaster
from trilane.training.views import BANDS, View, random_view

BAND_NAMES = tuple(BANDS)
ANYWHERE = len(BAND_NAMES)
#: Share of each band in training; `anywhere` is last.
TRAINING_SHARE = {"far": 0.16, "full_body": 0.34, "upper_body": 0.22, "face": 0.16, "anywhere": 0.12}
#: Tensor sizes of training: mostly the default's buckets, some of half the side for avatars far away.
SIZES = {"256": 0.85, "128": 0.15}
LEAST_PIXELS = 200
PART = 50

PoseSource = Callable[[np.random.Generator], F64]


@dataclass(frozen=True)
class Sample:
    """What to render. `pose` (55,3) radians, `band` index into BAND_NAMES or ANYWHERE."""

    pose: F64
    view: View
    crop: Crop
    band: int


class Studio:
    """The default body, dressed, with both rasters. `samples`: of the ground truth along each side of a pixel."""

    def __init__(self, shaped: ShapedBody, threads: int | None = None, samples: int = 2) -> None:
        body = shaped.body
        arrays = body_arrays(shaped)
        top = largest_weights(body.weights, enough_weights(body))
        mesh = mesh_arrays(shaped.vertices, body.faces, body.uv, body.uv_faces, top.joints, top.weights)
        found = find_landmarks(arrays.vertices, arrays.joints, arrays.weights)
        self.skeleton = Skeleton(shaped.joints, body.parents)
        self.cropper = Cropper(shaped)
        self.ctx = open_context(threads)
        self.mesh = SkinnedMesh(self.ctx, mesh)
        self._uv = UvRaster(self.ctx, self.mesh)
        self.wardrobe = Wardrobe(self.ctx, dress(arrays, found), found, samples)

    def plan(self, seed: Sequence[int], source: PoseSource, band: str, size: str) -> Sample:
        """The sample of `seed`: tries views until enough of the body is on screen."""
        rng = np.random.default_rng(seed)
        pose = source(rng)
        posed = self.skeleton.pose(pose)
        while True:
            view = random_view(rng, band, posed.joints)
            crop = self.cropper.crop(posed, view, shape_buckets(size))
            if crop is not None and crop.pixels >= LEAST_PIXELS:
                return Sample(pose, view, crop, BAND_NAMES.index(band) if band in BANDS else ANYWHERE)

    def render(self, sample: Sample) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
        """UV image (h,w,3): u, v, coverage; and ground truth (h,w,4) uint8, straight alpha."""
        joints = self.skeleton.pose(sample.pose).matrices
        crop = sample.crop
        uv = self._uv.render(joints, sample.view.view, crop.projection, crop.shape)
        rgba = self.wardrobe.render(joints, sample.view.view, crop.projection, crop.shape)
        return uv, rgba


def body_arrays(shaped: ShapedBody) -> BodyArrays:
    """The arrays that dressing needs."""
    body = shaped.body
    return BodyArrays(
        vertices=shaped.vertices.astype(np.float64),
        faces=body.faces.astype(np.int64),
        uv=body.uv.astype(np.float64),
        uv_faces=body.uv_faces.astype(np.int64),
        weights=body.weights.astype(np.float64),
        joints=shaped.joints,
    )


def motion_poses(motions: Sequence[Motion]) -> PoseSource:
    """Poses at random times of random ones of `motions`."""

    def draw(rng: np.random.Generator) -> F64:
        motion = motions[int(rng.integers(len(motions)))]
        return motion.sample(float(rng.uniform(0, motion.duration_s)))[0]

    return draw


def plan_training(studio: Studio, count: int, seed: int, track: Callable[[Any], Any] = iter) -> list[Sample]:
    """`count` samples of random poses, views and sizes."""
    rng = np.random.default_rng((seed, 0))
    bands = rng.choice(list(TRAINING_SHARE), count, p=list(TRAINING_SHARE.values()))
    sizes = rng.choice(list(SIZES), count, p=list(SIZES.values()))
    return [
        studio.plan((seed, 1, number), random_pose, str(band), str(size))
        for number, (band, size) in enumerate(track(list(zip(bands, sizes, strict=True))))
    ]


def plan_validation(studio: Studio, per_band: int, seed: int, motions: Sequence[Motion]) -> list[Sample]:
    """`per_band` samples of each band, of poses from `motions`, which training never sees."""
    source = motion_poses(motions)
    return [
        studio.plan((seed, 2, number, index), source, band, "256")
        for index, band in enumerate(BAND_NAMES)
        for number in range(per_band)
    ]


def write_dataset(
    body: Path, samples: list[Sample], folder: Path, processes: int, track: Callable[[Any], Any] = iter
) -> None:
    """Render `samples` of the body in file `body` into `folder`, grouped by tensor shape, in `processes` processes."""
    by_shape: dict[Shape, list[Sample]] = {}
    for sample in samples:
        by_shape.setdefault(sample.crop.shape, []).append(sample)
    for shape, some in by_shape.items():
        create_group(folder, shape, np.array([sample.band for sample in some], np.int8))
    places = [(shape, place, sample) for shape, some in by_shape.items() for place, sample in enumerate(some)]
    parts = [places[start : start + PART] for start in range(0, len(places), PART)]
    with ProcessPoolExecutor(processes, get_context("spawn"), _open_studio, (body,)) as pool:
        waiting = [pool.submit(_render_part, folder, part) for part in parts]
        for done in track(waiting):
            done.result()


_studio: list[Studio] = []


def _open_studio(body: Path) -> None:
    _studio.append(Studio(load_body(body).shape(), threads=1))


def _render_part(folder: Path, part: list[tuple[Shape, int, Sample]]) -> None:
    groups = {group.shape: group for group in open_groups(folder, writable=True)}
    for shape, place, sample in part:
        uv, rgba = _studio[0].render(sample)
        group = groups[shape]
        group.uv[place] = np.round(np.clip(uv[..., :2], 0, 1) * U16)
        group.covered[place] = uv[..., 2] > 0
        group.rgba[place] = rgba
