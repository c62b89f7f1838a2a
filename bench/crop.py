"""How much of the tensor is wasted by the mesh's rectangle in shape buckets, and by a square around the joints?

Rule: every way is judged by the same mesh on the same views. Wasted is what lies outside the mesh's own rectangle.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from trilane.arrays import F64
from trilane.body.body import load_body
from trilane.body.joints import JOINT_INDEX
from trilane.body.kinematics import Skeleton, rodrigues
from trilane.errors import BadInputError
from trilane.shapes import Shape, shape_buckets
from trilane.stages.cpu.crop import Rect, choose_bucket
from trilane.stages.cpu.mesh_bounds import MeshBounds
from trilane.unexpected import UnexpectedValue

BODY = Path(__file__).resolve().parents[1] / "avatars" / "default" / "body.npz"
NEAR, FAR = 0.05, 100.0


@dataclass(frozen=True)
class _View:
    """The mesh's rectangle in output pixels (x0, y0, x1, y1), that of the joints, and the tensor's area in pixels."""

    mesh: F64
    joints: F64
    tensor_area: float
    rect_us: float


def measure(views: int = 1000, size: str = "256", height: int = 480, width: int = 640) -> dict[str, Any]:
    """Wasted share of the tensor in random full-body views of an everyday range of poses.

    Keys: `rows`, one per way: `way`, `wasted_median`, `wasted_p90`, `cuts_mesh` (share of the views in which part of
    the mesh falls outside); `rect_us` (best, median); `config`. Raises BadInputError.
    """
    if views < 1:
        raise BadInputError("--views", str(views), "at least 1")
    try:
        buckets = shape_buckets(size)
    except UnexpectedValue as error:
        raise BadInputError.at("--size", error) from error
    seen = _views(views, (height, width), buckets)
    mesh_area = np.array([_area(view.mesh) for view in seen])
    side = np.array([(view.joints[2:] - view.joints[:2]).max() for view in seen])
    needed = np.array([_needed(view) for view in seen])
    widest = float(np.maximum(needed / side, 1.0).max())
    ways = {
        "mesh rectangle, shape buckets": (np.array([view.tensor_area for view in seen]), np.zeros(views)),
        "square around joints": (side**2, needed > side),
        "square around joints, widened for each view": (np.maximum(side, needed) ** 2, np.zeros(views)),
        f"square around joints, widened by {widest:.2f}": ((widest * side) ** 2, np.zeros(views)),
    }
    return {
        "rows": [_row(way, 1.0 - mesh_area / area, cuts) for way, (area, cuts) in ways.items()],
        "rect_us": {
            "best": min(view.rect_us for view in seen),
            "median": float(np.median([view.rect_us for view in seen])),
        },
        "config": {"views": views, "size": size, "output": [height, width], "buckets": [list(b) for b in buckets]},
    }


def _row(way: str, wasted: F64, cuts: NDArray[Any]) -> dict[str, Any]:
    return {
        "way": way,
        "wasted_median": float(np.median(wasted)),
        "wasted_p90": float(np.percentile(wasted, 90)),
        "cuts_mesh": float(np.mean(cuts)),
    }


def _area(rect: F64) -> float:
    return float(np.prod(rect[2:] - rect[:2]))


def _needed(view: _View) -> float:
    """Side of the smallest square about the middle of the joints' rectangle that holds the mesh's."""
    middle = (view.joints[:2] + view.joints[2:]) / 2.0
    return float(2.0 * max((view.mesh[2:] - middle).max(), (middle - view.mesh[:2]).max()))


def _views(count: int, output: Shape, buckets: list[Shape]) -> list[_View]:
    random = np.random.default_rng(0)
    body = load_body(BODY)
    shaped = body.shape()
    skeleton, bounds = Skeleton(shaped.joints, body.parents), MeshBounds(shaped)
    seen: list[_View] = []
    while len(seen) < count:
        posed, clip = skeleton.pose(everyday_pose(random)), random_camera(random, output)
        start = time.perf_counter()
        rect = bounds.rect(posed, clip)
        taken = (time.perf_counter() - start) * 1e6
        if rect is None or max(-rect.x0, -rect.y0, rect.x1, rect.y1) >= 1.0:
            continue
        points = posed.joints @ clip[:, :3].T + clip[:, 3]
        places = points[:, :2] / points[:, 3:]
        around = Rect(*places.min(axis=0), *places.max(axis=0))
        _, grown = choose_bucket(rect, output, buckets)
        seen.append(_View(_pixels(rect, output), _pixels(around, output), _area(_pixels(grown, output)), taken))
    return seen


def _pixels(rect: Rect, output: Shape) -> F64:
    return np.asarray(np.array(rect) * np.array([output[1], output[0], output[1], output[0]]) / 2.0)


def everyday_pose(random: np.random.Generator) -> F64:
    """(165,): arms from raised to hanging, elbows, hips and knees bent as people bend them, turned any way."""
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
    """(4,4) clip matrix of a camera 2.2 to 6 m away, a little above or below, with 30 to 60 degrees of view."""
    focal = 1.0 / np.tan(np.radians(random.uniform(30, 60)) / 2.0)
    projection = np.zeros((4, 4))
    projection[0, 0], projection[1, 1] = focal * output[0] / output[1], focal
    projection[2, 2:] = (FAR + NEAR) / (NEAR - FAR), 2.0 * FAR * NEAR / (NEAR - FAR)
    projection[3, 2] = -1.0
    view = np.eye(4)
    view[:3, :3] = rodrigues([random.normal(0, 0.15), 0, 0]) @ rodrigues([0, random.uniform(-np.pi, np.pi), 0])
    view[:3, 3] = [*random.uniform(-0.3, 0.3, 2), -random.uniform(2.2, 6.0)]
    return np.asarray(projection @ view)
