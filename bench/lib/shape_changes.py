"""How much a picture changes where its tensor changes shape, beside how much it changes anyway.

Rule: frames are those that a run presents, one after the other; a difference is the root mean square of sRGB values, 0
to 1, over the avatars' boxes in both frames.
"""

from __future__ import annotations

from dataclasses import dataclass
from statistics import median
from typing import Any

import numpy as np

from trilane.arrays import U8
from trilane.bench.lib.cast import Cast
from trilane.bench.lib.layers import Box
from trilane.bench.lib.stage_chain import AvatarFrames

#: Frames before and after a change that say what steady motion is.
AROUND = 4


@dataclass(frozen=True)
class Change:
    """`difference`: at the change. `steady`: the median of those around it without a change."""

    frame: int
    before: str
    after: str
    difference: float
    steady: float

    @property
    def ratio(self) -> float:
        return self.difference / self.steady if self.steady else float("inf")


def shape_changes(frames: AvatarFrames, cast: Cast, count: int) -> list[Change]:
    """The changes of shape in the first `count` frames of a scene that somebody is seen in on both sides."""
    pictures: list[U8] = []
    steps: list[tuple[str, float]] = []
    for number in range(count):
        pictures = [*pictures[-1:], frames.frame(number)]
        boxes = [*cast.boxes(number), *cast.boxes(max(number - 1, 0))]
        steps.append((frames.tensor, difference(pictures[0], pictures[-1], boxes)))
    found = []
    for number in range(1, count):
        (before, _), (after, changed) = steps[number - 1 : number + 1]
        near = range(max(number - AROUND, 1), min(number + AROUND + 1, count))
        steady = [steps[k][1] for k in near if steps[k][0] == steps[k - 1][0] != "none"]
        if before != after and "none" not in (before, after) and steady:
            found.append(Change(number, before, after, changed, median(steady)))
    return found


def difference(first: U8, second: U8, boxes: list[Box]) -> float:
    """Between two frames (h,w,3), in `boxes`; 0 without any."""
    inside = np.zeros(first.shape[:2], bool)
    for box in boxes:
        inside[box.top : box.bottom, box.left : box.right] = True
    if not inside.any():
        return 0.0
    steps = (second[inside].astype(np.float64) - first[inside]) / 255.0
    return float(np.sqrt((steps**2).mean()))


def summed_up(changes: list[Change]) -> dict[str, Any]:
    """`count`; of the change with the largest ratio: `worst_ratio`, `frame`, `from`, `to`; `median_ratio`."""
    if not changes:
        return {"count": 0, "worst_ratio": None, "median_ratio": None, "frame": None, "from": None, "to": None}
    worst = max(changes, key=lambda change: change.ratio)
    return {
        "count": len(changes),
        "worst_ratio": worst.ratio,
        "median_ratio": median(change.ratio for change in changes),
        "frame": worst.frame,
        "from": worst.before,
        "to": worst.after,
    }
