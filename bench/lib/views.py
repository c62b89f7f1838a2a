"""Random poses and cameras for the benches. Rule: all of it comes from the generator that the caller seeded."""

from __future__ import annotations

import numpy as np

from trilane.arrays import F64
from trilane.body.joints import JOINT_INDEX
from trilane.body.kinematics import rodrigues
from trilane.shapes import Shape

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
