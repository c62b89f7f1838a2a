"""A pinhole lens in pixels of its picture, and what scaling, cutting and turning the picture does to the lens.

When a picture is scaled, cut or turned, the lens's method `scaled`, `cropped` or `turned` changes the lens accordingly.
A point of the world then stays at the same place in the picture. Pixel coordinates start at the picture's top left
corner, x to the right and y down: the centre of the first pixel is (0.5, 0.5), as in COLMAP
(https://colmap.github.io/cameras.html). `of_opencv` is for formats that count from the centre of the first pixel.

Pictures are drawn without distortion. `distortion_note` says how far distortion would move points of the picture's
border, by the models of OpenCV and COLMAP. A person can then judge whether it matters.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from enum import Enum
from pathlib import Path
from typing import NamedTuple

import numpy as np

from trilane.arrays import F64, Shape
from trilane.errors import BadInputError

#: Assumed size of the picture if only an angle of the lens is known.
ASSUMED_WIDTH_PX, ASSUMED_HEIGHT_PX = 640.0, 480.0


class Known(Enum):
    """What is known of a lens: everything (ALL), or only the angle over one side of a picture of unknown shape.

    WIDTH, HEIGHT and LONG name this side; LONG is the longer side of the picture.
    """

    ALL = "all"
    WIDTH = "width"
    HEIGHT = "height"
    LONG = "long"


#: What is known of a lens after a quarter turn of its picture.
TURNED = {**{known: known for known in Known}, Known.WIDTH: Known.HEIGHT, Known.HEIGHT: Known.WIDTH}


class PictureCut(NamedTuple):
    """A way to cut a picture: scale it to `height` x `width`, then remove its first `top` rows and `left` columns."""

    height: int
    width: int
    top: int
    left: int


def cover(picture: Shape, output: Shape) -> PictureCut:
    """Return how `picture` is cut to cover `output`, both (height, width).

    The picture is scaled until it leaves no border; the overhang is cut equally at both ends.
    """
    scale = max(output[0] / picture[0], output[1] / picture[1])
    height, width = (max(side, round(full * scale)) for side, full in zip(output, picture, strict=True))
    return PictureCut(height, width, (height - output[0]) // 2, (width - output[1]) // 2)


@dataclass(frozen=True)
class Lens:
    """A lens without distortion: x = `cx` + `fx` X / Z, y = `cy` + `fy` Y / Z, with Y down and Z ahead.

    `width_px`, `height_px`: size of the picture. `fx`, `fy`: focal lengths, and `cx`, `cy`: principal point, pixels.
    `known`: what is known of the lens.
    """

    width_px: float
    height_px: float
    fx: float
    fy: float
    cx: float
    cy: float
    known: Known = Known.ALL

    def lies_across(self, picture: Shape) -> bool:
        """Return whether the lens's picture is upright and `picture` (height, width) is wide, or the reverse."""
        is_known = self.known in (Known.ALL, Known.LONG)
        return is_known and (self.height_px - self.width_px) * (picture[0] - picture[1]) < 0

    @property
    def fov_y_deg(self) -> float:
        """Field of view from the top to the bottom of the picture, degrees."""
        return math.degrees(math.atan(self.cy / self.fy) + math.atan((self.height_px - self.cy) / self.fy))

    @property
    def fov_x_deg(self) -> float:
        """Field of view from the left to the right of the picture, degrees."""
        return math.degrees(math.atan(self.cx / self.fx) + math.atan((self.width_px - self.cx) / self.fx))

    def scaled(self, width_px: float, height_px: float) -> Lens:
        """Return the lens after its picture is scaled to `width_px` x `height_px`."""
        x, y = width_px / self.width_px, height_px / self.height_px
        return replace(
            self,
            width_px=width_px,
            height_px=height_px,
            fx=self.fx * x,
            fy=self.fy * y,
            cx=self.cx * x,
            cy=self.cy * y,
        )

    def cropped(self, x: float, y: float, width_px: float, height_px: float) -> Lens:
        """Return the lens of a part of the picture, of `width_px` x `height_px` pixels.

        (`x`, `y`): top left corner of the part, which may be outside the picture.
        """
        return replace(self, width_px=width_px, height_px=height_px, cx=self.cx - x, cy=self.cy - y)

    def turned(self, quarters: int) -> Lens:
        """Return the lens after its picture is turned clockwise by `quarters` quarter turns."""
        lens = self
        for _ in range(quarters % 4):
            lens = Lens(
                lens.height_px, lens.width_px, lens.fy, lens.fx, lens.height_px - lens.cy, lens.cx, TURNED[lens.known]
            )
        return lens

    def onto(self, picture: Shape) -> Lens:
        """Return the lens in pixels of `picture` (height, width), which was made with this lens.

        If the picture has another shape than the lens's picture, it counts as cut equally at both sides. If the shape
        of the lens's picture is unknown, the lens takes over the shape of `picture`, with square pixels and the known
        angle.
        """
        height, width = float(picture[0]), float(picture[1])
        if self.known is not Known.ALL:
            focal = {
                Known.WIDTH: self.fx / self.width_px * width,
                Known.HEIGHT: self.fy / self.height_px * height,
                Known.LONG: self.fx / max(self.width_px, self.height_px) * max(width, height),
            }[self.known]
            return Lens(width, height, focal, focal, width / 2, height / 2)
        scale = max(width / self.width_px, height / self.height_px)
        whole = self.scaled(self.width_px * scale, self.height_px * scale)
        return whole.cropped((whole.width_px - width) / 2, (whole.height_px - height) / 2, width, height)

    def covering(self, output: Shape) -> Lens:
        """Return the lens after its picture is scaled and cut to cover `output` (height, width).

        The size of the lens's picture is rounded to whole pixels.
        """
        cut = cover((round(self.height_px), round(self.width_px)), output)
        return self.scaled(cut.width, cut.height).cropped(cut.left, cut.top, output[1], output[0])

    def filling_height(self, output: Shape) -> Lens:
        """Return the lens of a drawing of `output` (height, width) with the picture's vertical field of view.

        Its horizontal field of view may be wider or narrower than the picture's.
        """
        height, width = output
        scale = height / self.height_px
        whole = self.scaled(self.width_px * scale, height)
        return whole.cropped((whole.width_px - width) / 2, 0.0, width, height)

    def between(self, other: Lens, fraction: float) -> Lens:
        """Return the lens at `fraction`, 0 to 1, of the way to `other`, whose picture has the same size."""

        def mix(a: float, b: float) -> float:
            return a + (b - a) * fraction

        fx, fy = mix(self.fx, other.fx), mix(self.fy, other.fy)
        return replace(self, fx=fx, fy=fy, cx=mix(self.cx, other.cx), cy=mix(self.cy, other.cy))

    def projection(self, near_m: float, far_m: float) -> F64:
        """Return the OpenGL clip matrix (4, 4) of a camera with y up that looks along -Z.

        `near_m`, `far_m`: distances of the clip planes, metres. The matrix gives, in NDC:
        x / w = 2 (cx + fx X / -Z) / width - 1; y / w = 1 - 2 (cy - fy Y / -Z) / height.
        """
        depth = near_m - far_m
        return np.array(
            [
                [2 * self.fx / self.width_px, 0.0, 1 - 2 * self.cx / self.width_px, 0.0],
                [0.0, 2 * self.fy / self.height_px, 2 * self.cy / self.height_px - 1, 0.0],
                [0.0, 0.0, (far_m + near_m) / depth, 2 * far_m * near_m / depth],
                [0.0, 0.0, -1.0, 0.0],
            ]
        )


def centred(width_px: float, height_px: float, focal_px: float, known: Known = Known.ALL) -> Lens:
    """Return a lens with square pixels, whose principal point is the middle of its picture.

    `focal_px`: both focal lengths, pixels. The other parameters are as in `Lens`.
    """
    return Lens(width_px, height_px, focal_px, focal_px, width_px / 2, height_px / 2, known)


def of_opencv(width_px: float, height_px: float, fx: float, fy: float, cx: float, cy: float) -> Lens:
    """Return a lens from numbers of OpenCV or Kalibr, which count `cx` and `cy` from the centre of the first pixel.

    The other parameters are as in `Lens`.
    """
    return Lens(width_px, height_px, fx, fy, cx + 0.5, cy + 0.5)


def of_fov_y(fov_y_deg: float) -> Lens:
    """Return a lens with only one known number: the field of view over the picture's height, `fov_y_deg` degrees."""
    focal = ASSUMED_HEIGHT_PX / 2 / math.tan(math.radians(fov_y_deg) / 2)
    return centred(ASSUMED_WIDTH_PX, ASSUMED_HEIGHT_PX, focal, Known.HEIGHT)


def of_fov_x(fov_x_deg: float) -> Lens:
    """Return a lens with only one known number: the field of view over the picture's width, `fov_x_deg` degrees."""
    focal = ASSUMED_WIDTH_PX / 2 / math.tan(math.radians(fov_x_deg) / 2)
    return centred(ASSUMED_WIDTH_PX, ASSUMED_HEIGHT_PX, focal, Known.WIDTH)


LEAST_FOV_DEG, MOST_FOV_DEG = 1.0, 170.0
LEAST_SIDE_PX, MOST_SIDE_PX = 1.0, 1e6


def checked_lens(where: str | Path, lens: Lens) -> Lens:
    """Return `lens` if its picture and its angles are plausible. Raises BadInputError about `where` otherwise.

    Each side has LEAST_SIDE_PX to MOST_SIDE_PX pixels and spans LEAST_FOV_DEG to MOST_FOV_DEG degrees.
    """
    if not LEAST_SIDE_PX <= min(lens.width_px, lens.height_px) <= max(lens.width_px, lens.height_px) <= MOST_SIDE_PX:
        found = f"a picture of {lens.width_px:.4g}x{lens.height_px:.4g} pixels"
        raise BadInputError(where, found, f"sides of {LEAST_SIDE_PX:g} to {MOST_SIDE_PX:g} pixels")
    for side, angle in (("height", lens.fov_y_deg), ("width", lens.fov_x_deg)):
        if not LEAST_FOV_DEG < angle < MOST_FOV_DEG:
            expected = f"{LEAST_FOV_DEG:g} to {MOST_FOV_DEG:g}"
            raise BadInputError(where, f"a field of view of {angle:.4g} degrees over the {side}", expected)
    return lens


#: Number of points along each side of the border.
BORDER_STEPS = 9
#: Displacements below this, pixels, are not worth a note.
LEAST_BEND_PX = 0.5


def measured_lens(where: str | Path, width_px: float, height_px: float, numbers: F64) -> Lens:
    """Return the lens of a file. `numbers` (4,): fx, fy, cx, cy in pixels of a picture of `width_px` x `height_px`.

    Raises BadInputError about `where` unless the numbers are positive and `checked_lens` accepts them.
    """
    if not (np.isfinite(numbers).all() and (numbers > 0).all()):
        raise BadInputError(where, "a lens whose numbers are not all positive", "fx, fy, cx and cy in pixels")
    fx, fy, cx, cy = (float(value) for value in numbers)
    return checked_lens(where, Lens(width_px, height_px, fx, fy, cx, cy))


class Bent(NamedTuple):
    """A lens with distortion. `parameters`: values of k1 to k6, p1 and p2, by name; missing parameters are 0.

    `is_fisheye`: whether distortion follows OpenCV's fisheye model.
    """

    lens: Lens
    parameters: Mapping[str, float]
    is_fisheye: bool = False


def distortion_note(lenses: Iterable[Bent]) -> tuple[str, ...]:
    """Return a note on the largest distortion of `lenses`, which pictures leave out; empty below LEAST_BEND_PX."""
    bent = [each for each in lenses if each.is_fisheye or any(each.parameters.values())]
    most, worst = max(((largest_px(*each), k) for k, each in enumerate(bent)), default=(0.0, 0))
    if most < LEAST_BEND_PX:
        return ()
    lens, _, is_fisheye = bent[worst]
    kind = "a fisheye lens is drawn as a pinhole" if is_fisheye else "distortion of the lens is left out"
    return (f"{kind}: up to {most:.0f} px of {lens.width_px:.0f}x{lens.height_px:.0f}; undistort the pictures",)


def largest_px(lens: Lens, parameters: Mapping[str, float], is_fisheye: bool = False) -> float:
    """Return the largest distance, pixels, by which distortion moves a point on the picture's border.

    `parameters`, `is_fisheye`: as in `Bent`.
    """
    part = np.linspace(0.0, 1.0, BORDER_STEPS)
    zero, one = np.zeros(BORDER_STEPS), np.ones(BORDER_STEPS)
    border = np.column_stack([np.concatenate([part, part, zero, one]), np.concatenate([zero, one, part, part])])
    focal, middle = np.array([lens.fx, lens.fy]), np.array([lens.cx, lens.cy])
    points = (border * [lens.width_px, lens.height_px] - middle) / focal
    drawn = (_fisheye if is_fisheye else _polynomial)(points, parameters)
    moved = np.linalg.norm((drawn - points) * focal, axis=1)
    return float(np.nanmax(moved, initial=0.0))


def _polynomial(points: F64, parameters: Mapping[str, float]) -> F64:
    """Return `points` (N, 2), X / Z and Y / Z, after OpenCV's radial and tangential distortion."""
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
    """Return `points` (N, 2), X / Z and Y / Z, after OpenCV's fisheye distortion.

    The model replaces the tangent of the angle from the axis by a polynomial of that angle.
    """
    k1, k2, k3, k4 = (parameters.get(key, 0.0) for key in ("k1", "k2", "k3", "k4"))
    radius = np.linalg.norm(points, axis=1)
    angle = np.arctan(radius)
    square = angle * angle
    drawn = angle * (1 + square * (k1 + square * (k2 + square * (k3 + square * k4))))
    return np.asarray(points * (drawn / np.where(radius > 0, radius, 1.0))[:, None])
