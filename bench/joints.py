"""What do the joint transforms of one frame cost?

Rule: the best of many short loops is the cost; what the others take longer is other work of the machine.
"""

from __future__ import annotations

import time
from typing import Any

import numpy as np

from trilane.avatars.bundle import bundle_folder
from trilane.body.body import load_body
from trilane.body.kinematics import Skeleton
from trilane.errors import BadInputError

LIMIT_US = 200.0
FRAMES_PER_LOOP = 20


def measure(repeats: int = 200) -> dict[str, Any]:
    """Microseconds from a pose (165,) to 55 skinning matrices, joints and pose feature, on one thread.

    Keys: `best_us`, `median_us`, `p90_us` over `repeats` loops, `limit_us`, `config`.

    Raises BadInputError.
    """
    if repeats < 1:
        raise BadInputError("--repeats", str(repeats), "at least 1")
    body = load_body(bundle_folder("default") / "body.npz")
    skeleton = Skeleton(body.shape().joints, body.parents)
    poses = np.random.default_rng(0).normal(0.0, 0.5, (FRAMES_PER_LOOP, 165))
    times_us = np.empty(repeats)
    for repeat in range(repeats):
        start = time.perf_counter()
        for pose in poses:
            skeleton.pose(pose)
        times_us[repeat] = (time.perf_counter() - start) / FRAMES_PER_LOOP * 1e6
    return {
        "best_us": float(times_us.min()),
        "median_us": float(np.median(times_us)),
        "p90_us": float(np.percentile(times_us, 90)),
        "limit_us": LIMIT_US,
        "config": {"repeats": repeats, "frames_per_loop": FRAMES_PER_LOOP, "joints": len(body.parents)},
    }
