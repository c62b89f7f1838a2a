"""How much of the tensor is wasted by the mesh's rectangle in shape buckets, and by a square around the joints?

Rule: every variant is compared with the same mesh on the same views. What lies outside the mesh's own rectangle is
wasted.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from trilane.arrays import F64
from trilane.avatars.bundle import bundle_folder
from trilane.bench.lib.views import everyday_pose, random_camera
from trilane.body.body import load_body
from trilane.body.kinematics import Skeleton
from trilane.errors import BadInputError
from trilane.scene.crop import Rect, choose_bucket
from trilane.shapes import Shape, shape_buckets
from trilane.stages.cpu.mesh_bounds import MeshBounds
from trilane.unexpected_value import UnexpectedValue


@dataclass(frozen=True)
class _View:
    """One pose from one camera.

    `mesh`, `joints`: rectangles (x0, y0, x1, y1) in pixels of the picture.
    `tensor_area`: of the rectangle that the tensor shows, in the same pixels.
    `rect_us`: microseconds that the mesh's rectangle took.
    """

    mesh: F64
    joints: F64
    tensor_area: float
    rect_us: float


def measure(views: int = 1000, size: str = "256", height: int = 480, width: int = 640) -> dict[str, Any]:
    """Wasted share of the tensor in random full-body views of an everyday range of poses.

    Keys: `rows`, one per variant: `way`, `wasted_median`, `wasted_p90`, `cuts_mesh` (share of the views in which part
    of the mesh falls outside); `rect_us` (time of a rectangle: best, median); `config`.

    Raises BadInputError.
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
    variants = {
        "mesh rectangle, shape buckets": (np.array([view.tensor_area for view in seen]), np.zeros(views)),
        "square around joints": (side**2, needed > side),
        "square around joints, widened for each view": (np.maximum(side, needed) ** 2, np.zeros(views)),
        f"square around joints, widened by {widest:.2f}": ((widest * side) ** 2, np.zeros(views)),
    }
    return {
        "rows": [_row(name, 1.0 - mesh_area / area, cuts) for name, (area, cuts) in variants.items()],
        "rect_us": {
            "best": min(view.rect_us for view in seen),
            "median": float(np.median([view.rect_us for view in seen])),
        },
        "config": {"views": views, "size": size, "output": [height, width], "buckets": [list(b) for b in buckets]},
    }


def _row(variant: str, wasted: F64, cuts: NDArray[Any]) -> dict[str, Any]:
    return {
        "way": variant,
        "wasted_median": float(np.median(wasted)),
        "wasted_p90": float(np.percentile(wasted, 90)),
        "cuts_mesh": float(np.mean(cuts)),
    }


def _area(rect: F64) -> float:
    return float(np.prod(rect[2:] - rect[:2]))


def _needed(view: _View) -> float:
    """Side of the smallest square around the middle of the joints' rectangle that holds the mesh."""
    middle = (view.joints[:2] + view.joints[2:]) / 2.0
    return float(2.0 * np.abs(view.mesh.reshape(2, 2) - middle).max())


def _views(count: int, output: Shape, buckets: list[Shape]) -> list[_View]:
    random = np.random.default_rng(0)
    body = load_body(bundle_folder("default") / "body.npz")
    shaped = body.shape()
    skeleton, bounds = Skeleton(shaped.joints, body.parents), MeshBounds(shaped)
    seen: list[_View] = []
    while len(seen) < count:
        posed, clip = skeleton.pose(everyday_pose(random)), random_camera(random, output)
        start = time.perf_counter()
        rect = bounds.rect(posed, clip)
        rect_us = (time.perf_counter() - start) * 1e6
        if rect is None or max(map(abs, rect)) >= 1.0:
            continue
        points = posed.joints @ clip[:, :3].T + clip[:, 3]
        places = points[:, :2] / points[:, 3:]
        around = Rect(*places.min(axis=0), *places.max(axis=0))
        _, grown = choose_bucket(rect, output, buckets)
        seen.append(_View(_pixels(rect, output), _pixels(around, output), _area(_pixels(grown, output)), rect_us))
    return seen


def _pixels(rect: Rect, output: Shape) -> F64:
    return np.asarray(np.array(rect) * np.array([output[1], output[0], output[1], output[0]]) / 2.0)
