"""A shoe: horizontal slices of the foot, one over the other, each convex and a little wider than the foot.

Rule: a slice is the support function of the foot's vertices seen from above; the shoe is closed below and open at the
ankle.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from trilane.arrays import F64

ANGLES = 48
MARGIN_M = 0.009
TOP_M = 0.035  # over the ankle joint
SOLE_M = 0.010  # under the foot
WELT_M = 0.016  # how far the sole reaches up the foot
UPPER_STEP_M, FLANGE_M = 0.004, 0.005


def shoe(vertices: F64, ankle: F64, side: int, sole: bool) -> tuple[F64, NDArray[np.int64]]:
    """Vertices (N,3), metres, and faces (F,3) of one shoe's upper or of its sole.

    `vertices`: (V,3) the body at rest.
    `ankle`: (3,) the joint of the foot.
    `side`: 1 for the left foot, -1 for the right one.
    `sole`: the sole instead of the upper.
    """
    foot = vertices[(vertices[:, 0] * side > 0) & (vertices[:, 1] < ankle[1] + TOP_M + 0.02)]
    ground = foot[:, 1].min()
    if sole:
        heights = np.array([ground - SOLE_M, ground - SOLE_M + 0.002, ground, ground + WELT_M - 0.002, ground + WELT_M])
        margins = MARGIN_M + np.array([0.0, FLANGE_M, FLANGE_M, FLANGE_M, 0.0])
    else:
        heights = np.arange(ground + WELT_M - 0.004, ankle[1] + TOP_M, UPPER_STEP_M)
        margins = np.full(len(heights), MARGIN_M)
    rings = [
        _ring(foot[foot[:, 1] >= min(height - 0.008, ankle[1])], height, margin)
        for height, margin in zip(heights, margins, strict=True)
    ]
    points = np.vstack([*rings, rings[0].mean(axis=0, keepdims=True), rings[-1].mean(axis=0, keepdims=True)])
    return points, _stitch(len(rings), sole)


def _ring(foot: F64, height: float, margin: float) -> F64:
    """The slice (ANGLES,3) at `height`, `margin` wider than the vertices `foot` (N,3), metres."""
    flat = foot[:, [2, 0]]
    centre = 0.5 * (flat.min(axis=0) + flat.max(axis=0))
    angle = np.arange(ANGLES) * (2 * np.pi / ANGLES)
    towards = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    support = ((flat - centre) @ towards.T).max(axis=0) + margin
    facing = np.cos(angle[:, None] - angle[None])
    radius = np.where(facing > 0.05, support[None] / np.maximum(facing, 0.05), np.inf).min(axis=1)
    radius = 0.25 * np.roll(radius, 1) + 0.5 * radius + 0.25 * np.roll(radius, -1)
    flat = centre + radius[:, None] * towards
    return np.stack([flat[:, 1], np.full(ANGLES, height), flat[:, 0]], axis=1)


def _stitch(rings: int, capped: bool) -> NDArray[np.int64]:
    """Faces between consecutive rings, and a fan over the first one; when `capped`, also over the last one."""
    here = np.arange(ANGLES)
    after = (here + 1) % ANGLES
    faces = []
    for ring in range(rings - 1):
        low, high = ring * ANGLES, (ring + 1) * ANGLES
        faces += [
            np.stack([low + here, low + after, high + here], 1),
            np.stack([low + after, high + after, high + here], 1),
        ]
    bottom = np.full(ANGLES, rings * ANGLES)
    faces.append(np.stack([bottom, after, here], 1))
    if capped:
        last = (rings - 1) * ANGLES
        faces.append(np.stack([bottom + 1, last + here, last + after], 1))
    return np.vstack(faces)
