"""How far a lens's distortion moves points of its picture, for people: pictures are drawn without it.

Rule: the models are those of OpenCV and COLMAP (https://colmap.github.io/cameras.html), with the names of their
parameters. The largest displacement over the picture's border is reported, so that a person can judge it.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import NamedTuple

import numpy as np

from trilane.arrays import F64
from trilane.scene.lens import Lens

#: Points along each side of the border.
STEPS = 9
#: Displacements below this are not worth a note.
LEAST_PX = 0.5


class Bent(NamedTuple):
    """A lens with the `parameters` k1 to k6, p1 and p2 of its distortion."""

    lens: Lens
    parameters: Mapping[str, float]
    is_fisheye: bool = False


def distortion_note(lenses: Iterable[Bent]) -> tuple[str, ...]:
    """What is left out of the lens that is distorted the most; nothing where it is nothing."""
    bent = [each for each in lenses if each.is_fisheye or any(each.parameters.values())]
    most, worst = max(((largest_px(*each), k) for k, each in enumerate(bent)), default=(0.0, 0))
    if most < LEAST_PX:
        return ()
    lens, _, is_fisheye = bent[worst]
    kind = "a fisheye lens is drawn as a pinhole" if is_fisheye else "distortion of the lens is left out"
    return (f"{kind}: up to {most:.0f} px of {lens.width_px:.0f}x{lens.height_px:.0f}; undistort the pictures",)


def largest_px(lens: Lens, parameters: Mapping[str, float], is_fisheye: bool = False) -> float:
    """The farthest that a point of the pinhole picture's border is from where the lens draws it, pixels."""
    part = np.linspace(0.0, 1.0, STEPS)
    zero, one = np.zeros(STEPS), np.ones(STEPS)
    border = np.column_stack([np.concatenate([part, part, zero, one]), np.concatenate([zero, one, part, part])])
    focal, middle = np.array([lens.fx, lens.fy]), np.array([lens.cx, lens.cy])
    points = (border * [lens.width_px, lens.height_px] - middle) / focal
    drawn = (_fisheye if is_fisheye else _polynomial)(points, parameters)
    moved = np.linalg.norm((drawn - points) * focal, axis=1)
    return float(np.nanmax(moved, initial=0.0))


def _polynomial(points: F64, parameters: Mapping[str, float]) -> F64:
    """OpenCV's radial and tangential model of `points` (N, 2), X / Z and Y / Z."""
    k1, k2, k3, k4, k5, k6, p1, p2 = (
        parameters.get(key, 0.0) for key in ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2")
    )
    x, y = points.T
    square = x * x + y * y
    radial = (1 + square * (k1 + square * (k2 + square * k3))) / (1 + square * (k4 + square * (k5 + square * k6)))
    return np.column_stack([
        x * radial + 2 * p1 * x * y + p2 * (square + 2 * x * x),
        y * radial + p1 * (square + 2 * y * y) + 2 * p2 * x * y,
    ])  # fmt: skip


def _fisheye(points: F64, parameters: Mapping[str, float]) -> F64:
    """OpenCV's fisheye model: the distance from the middle goes with the angle, not with its tangent."""
    k1, k2, k3, k4 = (parameters.get(key, 0.0) for key in ("k1", "k2", "k3", "k4"))
    radius = np.linalg.norm(points, axis=1)
    angle = np.arctan(radius)
    square = angle * angle
    drawn = angle * (1 + square * (k1 + square * (k2 + square * (k3 + square * k4))))
    return np.asarray(points * (drawn / np.where(radius > 0, radius, 1.0))[:, None])
