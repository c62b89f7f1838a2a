"""The number of pixels that a frame's tensor may have, and the largest density of the avatars in it.

Rule: measured figures decide where there are any. Without them, an avatar has the pixels for which its network was
trained, or as many as the picture shows if that is more. Fixed limits apply (docs/decisions/planner.md).
"""

from __future__ import annotations

import math
from bisect import bisect_left
from collections.abc import Sequence
from dataclasses import dataclass, replace

from trilane.arrays import BUCKET_STEP, Shape
from trilane.scene.crop import Rect, covered, tight_shape
from trilane.units import ALL_WORK

#: Pairs (pixels of the picture that a body covers, pixels of the tensor for such a body), ascending, at least one.
Curve = tuple[tuple[int, int], ...]
#: Largest density, tensor pixels per picture pixel along a side: with more, the picture is no nearer to the truth.
MOST_DENSITY = 2.25
#: Most pixels of an avatar, as a multiple of those for which its network was trained: sides of 5/4.
MOST_GROWTH = 25 / 16


@dataclass(frozen=True)
class TensorBudget:
    """The number of pixels that a tensor may have.

    `own`: pixels for which the network was trained, per avatar.
    `most`: most pixels of all avatars together.
    `work`: thousandths of these pixels that are allowed.
    `curves`: measured curve of each avatar; empty if one of them was not measured.
    """

    own: int
    most: int
    work: int = ALL_WORK
    curves: tuple[Curve, ...] = ()

    def scaled(self, work: int) -> TensorBudget:
        """Return this budget with `work` thousandths of the pixels allowed."""
        return replace(self, work=work)

    def most_of(self, avatars: int) -> int:
        """Return the most pixels for `avatars` visible avatars, whatever their size on the picture."""
        measured = max((tensor for curve in self.curves for _, tensor in curve), default=0)
        return self._allowed(avatars * max(self.own * MOST_GROWTH, measured))

    def of(self, rects: Sequence[Rect], output: Shape) -> int:
        """Return the pixels for the avatars at `rects` on a picture of `output` (height, width).

        They get the pixels of the measured curve. Several avatars get more, for the background between them. Without a
        curve, they get the pixels for which the network was trained, or as many as the picture shows if that is more.
        The result is limited by `most_of` and `work`.
        """
        if not self.curves:
            wanted = float(max(len(rects) * self.own, area(tight_shape(rects, output))))
        elif len(rects) == 1:
            wanted = self._measured(covered(rects[0], output))
        else:
            wanted = area(tight_shape(rects, output, self.density(rects, output)))
        return min(self._allowed(wanted), self.most_of(len(rects)))

    def density(self, rects: Sequence[Rect], output: Shape) -> float:
        """Return the largest density of the avatars at `rects`, however large the tensor is.

        This is the density of the measured curve, or `MOST_DENSITY` without a curve. Bodies below the curve's range
        have at most the density at its start, or `MOST_DENSITY` if that is more.
        """
        if not self.curves:
            return MOST_DENSITY
        seen = [covered(rect, output) for rect in rects]
        start = max(tensor / picture for (picture, tensor), *_ in self.curves)
        return min(math.sqrt(sum(map(self._measured, seen)) / sum(seen)), max(MOST_DENSITY, math.sqrt(start)))

    def _measured(self, picture: int) -> float:
        """Return the pixels for a body that covers `picture` pixels, by the curve that gives the most."""
        return max(pixels_at(curve, picture, self.own * MOST_GROWTH) for curve in self.curves)

    def _allowed(self, pixels: float) -> int:
        return max(int(min(pixels, self.most)) * self.work // ALL_WORK, BUCKET_STEP**2)


def pixels_at(curve: Curve, picture: int, limit: float) -> float:
    """Return the tensor pixels of `curve` for a body that covers `picture` pixels, interpolated in their logarithms.

    A body smaller than all of the curve's bodies has as many pixels as the smallest. A body larger than all of them has
    the density of the largest.
    `limit`: most pixels of such a larger body, unless the curve itself ends with more.
    """
    at = bisect_left(curve, picture, key=lambda knot: knot[0])
    if at == 0:
        return curve[0][1]
    if at == len(curve):
        return min(curve[-1][1] * picture / curve[-1][0], max(limit, curve[-1][1]))
    (least, low), (most, high) = curve[at - 1 : at + 1]
    return float(low * (high / low) ** (math.log(picture / least) / math.log(most / least)))


def area(shape: Shape) -> int:
    """Return the number of pixels of a tensor of `shape`."""
    return shape[0] * shape[1]
