"""How far is the packed pass from the float64 reference?

Rule: poses and views come from one seed; every figure is over all of them, and the worst view stands beside it.
"""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

import numpy as np
from numpy.typing import NDArray

from trilane.avatars.bundle import bundle_folder
from trilane.bench.lib import float_raster
from trilane.bench.lib.fixture import ENCODING, standing
from trilane.bench.lib.views import everyday_pose, random_camera
from trilane.body.body import load_body
from trilane.body.kinematics import Skeleton
from trilane.errors import BadInputError
from trilane.stages.gpu.opengl import describe, open_context
from trilane.stages.gpu.packed_pass import PackedAvatar, PackedPass, Placement
from trilane.stages.gpu.skinned_mesh import SkinnedMesh
from trilane.training.sample_renderer import UvRaster

CHANNELS = 16
MAX_SIDE = 2048
EYE = np.eye(4)
BOUNDS = {"coverage_differs": 1e-3, "within_one_step": 0.999, "background_bytes_wrong": 0}


def measure(views: int = 100, size: int = 512) -> dict[str, Any]:
    """Compare `views` random poses and views at `size` x `size`, 16 channels, with the reference rasteriser.

    Keys: `pixels` (of the reference's mesh), `coverage_differs` (share of them), `within_one_step` (share of the values
    where both cover), `background_bytes_wrong`, the worst view's `worst_coverage` and `worst_within_one`, `bounds`,
    `driver`, `config`.

    Raises BadInputError, MissingPartError.
    """
    if views < 1:
        raise BadInputError("--views", str(views), "at least 1")
    if not 1 <= size <= MAX_SIDE:
        raise BadInputError("--size", str(size), f"1 to {MAX_SIDE}")
    ctx = open_context()
    seen = _compare(ctx, views, (size, size))
    pixels, uncovered, values, near, wrong = seen.sum(axis=0)
    return {
        "pixels": int(pixels),
        "coverage_differs": float(uncovered / max(pixels, 1)),
        "within_one_step": float(near / max(values, 1)),
        "background_bytes_wrong": int(wrong),
        "worst_coverage": float((seen[:, 1] / np.maximum(seen[:, 0], 1)).max()),
        "worst_within_one": float((seen[:, 3] / np.maximum(seen[:, 2], 1)).min()),
        "bounds": BOUNDS,
        "driver": asdict(describe(ctx)),
        "config": {"views": views, "size": size, "channels": CHANNELS},
    }


def _compare(ctx: Any, views: int, shape: tuple[int, int]) -> NDArray[np.int64]:
    """A row for each view: mesh pixels, pixels that only one covers, values, those within one step, wrong bytes."""
    random = np.random.default_rng(0)
    fixture = standing(CHANNELS)
    arrays = fixture.arrays
    texture = fixture.texture.astype(np.float16).astype(np.float64)
    mesh = SkinnedMesh(ctx, arrays)
    packed = PackedPass(ctx, CHANNELS, ENCODING, deferred=not describe(ctx).hardware)
    avatar, coverage = PackedAvatar(packed, mesh, texture), UvRaster(ctx, mesh)
    body = load_body(bundle_folder("default") / "body.npz")
    skeleton = Skeleton(body.shape().joints, body.parents)
    tensor = np.zeros((*shape, CHANNELS), np.uint8)
    rows = []
    for _ in range(views):
        joints, clip = skeleton.pose(everyday_pose(random)).matrices.copy(), random_camera(random, shape)
        avatar.draw(packed.begin(shape), EYE, Placement(joints, clip, (0, 0, *shape)))
        packed.read_into(shape, tensor.reshape(-1))
        covered = coverage.render(joints, EYE, clip, shape)[..., 2] > 0
        world = float_raster.skin(arrays, joints)
        image = float_raster.rasterise(world, arrays.triangles, arrays.uv, clip, shape, arrays.closed)
        expected = float_raster.tensor(image, texture, ENCODING.scale, ENCODING.zero_point)
        steps = np.abs(tensor.astype(np.int16) - expected)[covered & image.coverage]
        wrong = (tensor[~covered] != ENCODING.zero_point).sum()
        differs = (covered != image.coverage).sum()
        rows.append((image.coverage.sum(), differs, steps.size, (steps <= 1).sum(), wrong))
    return np.array(rows, np.int64)
