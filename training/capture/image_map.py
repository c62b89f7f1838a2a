"""Affine maps from a frame to a tensor's picture, and the same maps applied to the camera: camera-space augmentation.

Rule: one map, in pixels, resamples the ground truth from its full resolution and, brought into clip space, moves the
camera that rasterises the body. So both agree for any camera matrix, any turn, scale, flip and shift, and pictures of
any aspect; the body is rasterised anew and never resampled.

The thesis (section 3.3, formulas 3.18 to 3.20) turns and scales the extrinsics and moves the principal point, which is
the same for lenses with fx = fy alone. After projection the map is exact for every lens.

Pixels: x to the right, y down, from the picture's corner; the middle of the first pixel is (0.5, 0.5).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from PIL import Image

from trilane.arrays import F64, U8, Mask
from trilane.shapes import Shape

NO_FLIP = (False, False)


@dataclass(frozen=True)
class Augmentation:
    """What is done to a frame.

    `centre` (x, y): the point of the frame, in its pixels, that comes to the middle of the target. `turn_rad`: about
    it, clockwise as the picture is seen. `scale` (x, y): pixels of the target for a pixel of the frame, along its rows
    and columns, before it is turned. `flip` (left-right, upside-down): before it is turned. `shift` (x, y): afterwards,
    in pixels of the target.
    """

    centre: tuple[float, float]
    turn_rad: float
    scale: tuple[float, float]
    flip: tuple[bool, bool] = NO_FLIP
    shift: tuple[float, float] = (0.0, 0.0)


def image_map(augmentation: Augmentation, target: Shape) -> F64:
    """(3,3): from pixels of the frame to pixels of a target of shape (height, width)."""
    c, s = np.cos(augmentation.turn_rad), np.sin(augmentation.turn_rad)
    signed = np.where(augmentation.flip, -1.0, 1.0) * augmentation.scale
    result = np.eye(3)
    result[:2, :2] = np.array([[c, -s], [s, c]]) * signed
    middle = np.array([target[1] / 2, target[0] / 2]) + augmentation.shift
    result[:2, 2] = middle - result[:2, :2] @ np.asarray(augmentation.centre)
    return result


def moved(points: ArrayLike, by: F64) -> F64:
    """`points` (..., 2) in pixels, moved by the map `by` (3,3)."""
    return np.asarray(points, np.float64) @ by[:2, :2].T + by[:2, 2]


def augmented_projection(projection: ArrayLike, by: F64, frame: Shape, target: Shape) -> F64:
    """(4,4): the camera's `projection` (4,4), which draws pictures of shape `frame`, moved by `by` (3,3) to `target`.

    Depth and the sense in which nothing but a flip turns triangles stay as they are.
    """
    plane = _ndc_from_pixels(target) @ by @ np.linalg.inv(_ndc_from_pixels(frame))
    after = np.eye(4)
    after[:2, :2], after[:2, 3] = plane[:2, :2], plane[:2, 2]
    return np.asarray(after @ np.asarray(projection, np.float64))


def map_between(before: ArrayLike, after: ArrayLike, frame: Shape, target: Shape) -> F64:
    """(3,3): the map of which `augmented_projection` makes `after` (4,4) from `before` (4,4): its inverse."""
    clip = np.asarray(after, np.float64) @ _inverse(np.asarray(before, np.float64))
    plane = np.eye(3)
    plane[:2, :2], plane[:2, 2] = clip[:2, :2], clip[:2, 3]
    return np.asarray(_inverse(_ndc_from_pixels(target)) @ plane @ _ndc_from_pixels(frame))


def projected(points: ArrayLike, clip: F64, shape: Shape) -> F64:
    """(..., 2): pixels of a picture of `shape` at which `points` (..., 3) lie, by `clip` (4,4), projection @ view."""
    homogeneous = np.asarray(points, np.float64) @ clip[:, :3].T + clip[:, 3]
    ndc = homogeneous[..., :2] / homogeneous[..., 3:]
    return moved(ndc, _inverse(_ndc_from_pixels(shape)))


def unmirrored(by: F64, target: Shape) -> tuple[F64, bool]:
    """`by` without its mirroring, and whether the columns of what is drawn with it must be reversed afterwards.

    A mirrored camera would turn triangles over, and rasters leave out those that face away. Pixels' middles lie
    symmetrically, so reversing the columns is exact.
    """
    if np.linalg.det(by[:2, :2]) > 0:
        return by, False
    reverse = np.array([[-1.0, 0.0, target[1]], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
    return reverse @ by, True


def seen_of_frame(by: F64, frame: Shape, target: Shape) -> Mask:
    """(h,w): which pixels of the target have their middle inside the frame: of the others nothing is known."""
    rows, columns = np.mgrid[: target[0], : target[1]] + 0.5
    x, y = np.moveaxis(moved(np.stack([columns, rows], axis=-1), _inverse(by)), -1, 0)
    return np.asarray((x >= 0) & (x < frame[1]) & (y >= 0) & (y < frame[0]))


def resampled(rgba: U8, by: F64, target: Shape) -> U8:
    """The picture (h,w,4) of shape `target` that `by` (3,3) makes of `rgba` (H,W,4), both with straight alpha.

    Each side is shrunk by the greatest whole number that the map allows, as the mean of its pixels, then the picture
    is read bilinearly once; outside of `rgba` it is 0, 0, 0, 0. Colours are weighted by alpha.
    """
    whole = Image.fromarray(rgba, "RGBA").convert("RGBa")
    columns, rows = (max(1, int(1 / length)) for length in np.linalg.norm(by[:2, :2], axis=0))
    small = whole.reduce((columns, rows)) if (columns, rows) != (1, 1) else whole
    back = np.linalg.inv(by @ np.diag([columns, rows, 1.0]))
    picture = small.transform(target[::-1], Image.Transform.AFFINE, tuple(back[:2].ravel()), Image.Resampling.BILINEAR)
    return np.array(picture.convert("RGBA"))


def _ndc_from_pixels(shape: Shape) -> F64:
    """(3,3): from pixels of a picture of `shape`, y down, to normalised device coordinates, y up."""
    return np.array([[2.0 / shape[1], 0.0, -1.0], [0.0, -2.0 / shape[0], 1.0], [0.0, 0.0, 1.0]])


def _inverse(matrix: F64) -> F64:
    return np.asarray(np.linalg.inv(matrix), np.float64)
