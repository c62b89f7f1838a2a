"""The packed pass beside the float64 reference, on random poses and views. Rule: all of them come from one seed."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from trilane.arrays import F64, Shape
from trilane.avatars.bundle import bundle_folder
from trilane.bench.lib import float_raster
from trilane.bench.lib.fixture import ENCODING, standing
from trilane.body.body import load_body
from trilane.body.joints import JOINT_INDEX, Skeleton, rodrigues
from trilane.stages.gpu.opengl import describe
from trilane.stages.gpu.raster import PackedAvatar, PackedPass, Placement
from trilane.stages.gpu.skinned_mesh import SkinnedMesh
from trilane.training.sample_renderer import UvRaster

CHANNELS = 16
EYE = np.eye(4)
NEAR, FAR = 0.05, 100.0


def everyday_pose(random: np.random.Generator) -> F64:
    """(165,) radians: arms from raised to hanging, elbows, hips and knees bent as people do, facing any direction."""
    pose = np.zeros((55, 3))
    pose[1:22] = random.normal(0.0, 0.15, (21, 3))
    pose[25:] = random.normal(0.0, 0.2, (30, 3))
    pose[0, 1] = random.uniform(-np.pi, np.pi)
    for side, sign in (("left", -1.0), ("right", 1.0)):
        arm = [random.normal(0, 0.4), random.normal(0, 0.3), sign * random.uniform(-0.5, 1.35)]
        pose[JOINT_INDEX[f"{side}_shoulder"]] = arm
        pose[JOINT_INDEX[f"{side}_elbow"], 1] = sign * random.uniform(0, 1.5)
        pose[JOINT_INDEX[f"{side}_hip"], 0] = random.uniform(-0.9, 0.4)
        pose[JOINT_INDEX[f"{side}_knee"], 0] = random.uniform(0, 1.2)
    return pose.ravel()


def random_camera(random: np.random.Generator, output: Shape) -> F64:
    """(4,4) clip matrix of a camera 2.2 to 6 m away, a little above or below, with a view of 30 to 60 degrees.

    `random`: seeded generator.
    `output`: (height, width) of the picture in pixels.
    """
    focal = 1.0 / np.tan(np.radians(random.uniform(30, 60)) / 2.0)
    projection = np.zeros((4, 4))
    projection[0, 0], projection[1, 1] = focal * output[0] / output[1], focal
    projection[2, 2:] = (FAR + NEAR) / (NEAR - FAR), 2.0 * FAR * NEAR / (NEAR - FAR)
    projection[3, 2] = -1.0
    view = np.eye(4)
    view[:3, :3] = rodrigues([random.normal(0, 0.15), 0, 0]) @ rodrigues([0, random.uniform(-np.pi, np.pi), 0])
    view[:3, 3] = [*random.uniform(-0.3, 0.3, 2), -random.uniform(2.2, 6.0)]
    return np.asarray(projection @ view)


def compare(ctx: Any, views: int, shape: tuple[int, int]) -> NDArray[np.int64]:
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
