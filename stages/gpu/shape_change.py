"""What softens a change of the tensor's size: for some frames the last picture of the old size is blended in.

Rule: the old picture is moved and scaled with the avatar's pelvis, so that it lies where the avatar is now; it is
blended in only where its frame came shortly before, and where an avatar has clearly more or fewer pixels than then:
between shapes of about the same density there is nothing to soften, and the old pose would be seen
(docs/decisions/planner.md has the figures).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from trilane.arrays import F64
from trilane.scene.tensor_layout import Cell
from trilane.shapes import Shape

#: Frames after a change in which the old picture is seen, each time less of it.
FRAMES = 3
#: The old picture is at most so many frames older than the first one of the new shape; a policy may have dropped some.
MOST_GAP = 3
#: And at most so many seconds of the scene: at a low rate the body is elsewhere.
MOST_GAP_S = 0.2
#: Of the pixels along a side that an avatar has, from one shape to the other.
LEAST_CHANGE = 1.2


class Blend(NamedTuple):
    """How much of the old picture an avatar gets (`share`), and which part of it, in pixels of the two pictures.

    `scale`, `offset` (x, y): old = new * scale + offset.
    """

    shape: Shape
    cell: Cell
    part: Cell
    scale: tuple[float, float]
    offset: tuple[float, float]
    share: float


class ShapeChange:
    """Remembers the last frame of the shape before. `rest`: rest joints (55,3) of each avatar of the scene."""

    def __init__(self, rest: Sequence[F64]) -> None:
        self._rest = rest
        self._before: NDArray[np.void] | None = None
        self._first = 0

    def note(self, held: NDArray[np.void] | None, pose: NDArray[np.void]) -> None:
        """The full frame of header `pose` comes after that of `held`, if there was one."""
        if held is None or not _shortly_before(held, pose):
            self._before = None if held is None or int(pose["picture"]) != int(held["picture"]) else self._before
        elif pose["tensor_shape"].tolist() != held["tensor_shape"].tolist():
            self._before, self._first = held, int(pose["picture"])

    def blends(self, pose: NDArray[np.void]) -> Iterator[Blend]:
        """Of the avatars that are seen in `pose` and were seen before the change; none when that is long ago."""
        since = int(pose["picture"]) - self._first
        if self._before is None or since >= FRAMES:
            self._before = None
            return
        share = 1 - (since + 1) / (FRAMES + 1)
        before = self._before
        for now, old in zip(pose["avatars"], before["avatars"], strict=True):
            if now["visible"] and old["visible"]:
                found = self._blend(pose, now, before, old, share)
                if found is not None:
                    yield found

    def _blend(self, pose: Any, now: Any, before: Any, old: Any, share: float) -> Blend | None:
        pelvis = self._rest[int(now["avatar"])][0]
        (x, y, w), (old_x, old_y, old_w) = _place(pose, now, pelvis), _place(before, old, pelvis)
        if min(w, old_w) <= 0:
            return None
        grown = old_w / w
        across = _axis(now, old, (0, 1), (x, old_x), grown)
        down = _axis(now, old, (1, -1), (y, old_y), grown)
        if max(max(scale, 1 / scale) for scale, _ in (across, down)) < LEAST_CHANGE:
            return None
        cell, part = (_cell(avatar) for avatar in (now, old))
        shape = (int(before["tensor_shape"][0]), int(before["tensor_shape"][1]))
        return Blend(shape, cell, part, (across[0], down[0]), (across[1], down[1]), share)


def _shortly_before(held: NDArray[np.void], pose: NDArray[np.void]) -> bool:
    frames = int(pose["picture"]) - int(held["picture"])
    return 0 < frames <= MOST_GAP and float(pose["media_time_s"]) - float(held["media_time_s"]) <= MOST_GAP_S


def _cell(avatar: Any) -> Cell:
    top, left, height, width = (int(side) for side in avatar["tensor_rect"])
    return top, left, height, width


def _place(pose: Any, avatar: Any, pelvis: F64) -> tuple[float, float, float]:
    """Of the pelvis, x and y in normalised device coordinates, and W of clip space."""
    world = avatar["joints"][0].astype(np.float64) @ np.append(pelvis, 1.0)
    x, y, _, w = pose["projection"].astype(np.float64) @ (pose["view"].astype(np.float64) @ np.append(world, 1.0))
    return x / w, y / w, w


def _axis(now: Any, old: Any, axis: tuple[int, int], centres: tuple[float, float], grown: float) -> tuple[float, float]:
    """Scale and offset from pixels of the new cell to those of the old one, along x (0, 1) or, downwards, y (1, -1).

    `centres`: of the avatar now and then, in normalised device coordinates. `grown`: by which it is larger now.
    """
    which, sign = axis
    new_start, new_length = _interval(now, which, sign)
    old_start, old_length = _interval(old, which, sign)
    new_first, new_pixels = float(now["tensor_rect"][1 - which]), float(now["tensor_rect"][3 - which])
    old_first, old_pixels = float(old["tensor_rect"][1 - which]), float(old["tensor_rect"][3 - which])
    per_pixel, pixels = new_length / new_pixels, old_pixels / old_length
    scale = per_pixel / grown * pixels
    ndc = centres[1] + (new_start - centres[0]) / grown  # where the new cell's first edge was before
    return scale, old_first + (ndc - old_start) * pixels - new_first * scale


def _interval(avatar: Any, which: int, sign: int) -> tuple[float, float]:
    """Where the crop begins along x, or y from the top, and its signed length."""
    low, high = float(avatar["rect"][which]), float(avatar["rect"][which + 2])
    return (low, high - low) if sign > 0 else (high, low - high)
