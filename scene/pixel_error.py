"""From metres to pixels: how far on the picture a vertex can be that is wrong by so many metres. Rule: a proved bound.

For a vertex whose clip coordinates are X, Y, W, an error of e metres changes X by at most e |r_x|, with r_x the first
three numbers of the clip matrix's row of X, and so on. With x = X / W between -1 and 1,

    |x' - x| = |dX - x dW| / |W + dW| <= e (|r_x| + |r_w|) / (W - e |r_w|),

so the error is at most that, times half the picture's side, for every vertex that is seen. W is the least of the body:
a skinned vertex is a mean of points that lie no further from the centre of joint j than at rest (`DetailBounds.reach`).
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from trilane.arrays import F64
from trilane.body.kinematics import Posed
from trilane.shapes import Shape


def least_w(posed: Posed, clip: F64, reach: F64, blend_m: float = 0.0) -> float:
    """The least W of clip space that a vertex can have, 0 or less when it may lie behind the camera.

    `clip` (4,4): projection @ view. `reach` (55,): of `DetailBounds`. `blend_m`: how far pose blend shapes
    move a vertex.
    """
    centres = posed.joints @ clip[3, :3] + clip[3, 3]
    return float((centres - (reach + blend_m) * np.linalg.norm(clip[3, :3]))[reach > 0].min())


def error_px(metres: float, clip: ArrayLike, w: float, output: Shape) -> float:
    """Pixels of a picture of `output` (height, width) by which a vertex can be wrong that is wrong by `metres`.

    `clip` (4,4): projection @ view. `w`: the least of its clip space. Infinite when a vertex may be behind the camera.
    """
    if metres == 0.0:
        return 0.0
    rows = np.linalg.norm(np.asarray(clip, np.float64)[:, :3], axis=1)
    left = w - metres * rows[3]
    if left <= 0.0:
        return math.inf
    x, y = (metres * (rows[axis] + rows[3]) / left * side / 2.0 for axis, side in ((0, output[1]), (1, output[0])))
    return math.hypot(x, y)


def cheapest_within(errors_px: Sequence[float], budget_px: float) -> int:
    """Index of the first level, from the least work to all of it, whose error is within the budget; else the last."""
    return next((level for level, error in enumerate(errors_px) if error <= budget_px), len(errors_px) - 1)
