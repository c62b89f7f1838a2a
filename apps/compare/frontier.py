"""Finds the best entries: the frontier of frame time against PSNR, and its knee.

Rule: this module reads and writes no file. Pictures differ if their PSNRs differ by more than `SAME_DB`. A time is
surely shorter if its interval lies below the interval of the other time.
"""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections.abc import Hashable, Sequence
from itertools import accumulate
from typing import Final, NamedTuple, Protocol

#: PSNRs that differ by at most this count as equal: rounding in runtimes changes a PSNR that much (docs/networks.md).
SAME_DB: Final = 0.1
#: A frontier with fewer points has no knee.
LEAST_OF_A_KNEE: Final = 3


class Scored(Protocol):
    """An entry that can be on a frontier.

    `frame_ms`: mean frame time, less is better; None if it is unknown.
    `low_ms`, `high_ms`: ends of the interval of `frame_ms`, from scatter or a model; None if an end is unknown.
    `psnr_db`: PSNR of the pictures, more is better; None if it is unknown.
    `group`: key of the entry's group; only entries of one group are compared.
    """

    @property
    def frame_ms(self) -> float | None: ...
    @property
    def low_ms(self) -> float | None: ...
    @property
    def high_ms(self) -> float | None: ...
    @property
    def psnr_db(self) -> float | None: ...
    @property
    def group(self) -> Hashable: ...


class _Point(NamedTuple):
    """An entry with a known frame time and PSNR. `number`: index of the entry in the list of all entries."""

    frame_ms: float
    low_ms: float
    high_ms: float
    psnr_db: float
    number: int


def frontier(entries: Sequence[Scored]) -> list[bool]:
    """Return for each entry whether it is on the frontier: no other entry of its group beats it.

    Entry A beats entry B in either of two cases. In the first case, the PSNR of A is larger by more than `SAME_DB`, and
    its mean frame time is not larger. In the second case, the PSNR of A is larger or at most `SAME_DB` smaller, and its
    interval ends before the interval of B begins. An entry without a frame time or a PSNR is not on the frontier.
    """
    on = [False] * len(entries)
    for points in _groups(entries).values():
        by_mean, by_high = sorted(points), sorted(points, key=lambda point: point.high_ms)
        means, highs = [point.frame_ms for point in by_mean], [point.high_ms for point in by_high]
        best_by_mean = list(accumulate((point.psnr_db for point in by_mean), max))
        best_by_high = list(accumulate((point.psnr_db for point in by_high), max))
        for point in points:
            no_slower, quicker = bisect_right(means, point.frame_ms), bisect_left(highs, point.low_ms)
            beaten = best_by_mean[no_slower - 1] > point.psnr_db + SAME_DB
            beaten = beaten or (quicker > 0 and best_by_high[quicker - 1] >= point.psnr_db - SAME_DB)
            on[point.number] = not beaten
    return on


def knees(entries: Sequence[Scored]) -> dict[Hashable, int]:
    """Return the index of the entry at the knee, by group. Beyond a knee, more time improves pictures only a little.

    Only points with a better picture than all quicker points count. Both axes are scaled to 0..1. The knee is the point
    farthest above the straight line from the first point to the last. A group with fewer than `LEAST_OF_A_KNEE` such
    points, or without a point above the line, has no knee.
    Satopaa et al., "Finding a Kneedle in a Haystack", 2011.
    """
    found = {}
    for group, points in _groups(entries).items():
        edge: list[_Point] = []
        for point in sorted(points, key=lambda point: (point.frame_ms, -point.psnr_db)):
            if not edge or point.psnr_db > edge[-1].psnr_db:
                edge.append(point)
        if len(edge) < LEAST_OF_A_KNEE:
            continue
        first, last = edge[0], edge[-1]
        span_ms, span_db = last.frame_ms - first.frame_ms, last.psnr_db - first.psnr_db
        above = [(p.psnr_db - first.psnr_db) / span_db - (p.frame_ms - first.frame_ms) / span_ms for p in edge]
        if max(above) > 0:
            found[group] = edge[above.index(max(above))].number
    return found


def _groups(entries: Sequence[Scored]) -> dict[Hashable, list[_Point]]:
    """Return the points of each group. Groups are in the order of their first points."""
    found: dict[Hashable, list[_Point]] = {}
    for number, entry in enumerate(entries):
        mean, psnr_db = entry.frame_ms, entry.psnr_db
        if mean is not None and psnr_db is not None:
            low, high = (mean if end is None else end for end in (entry.low_ms, entry.high_ms))
            found.setdefault(entry.group, []).append(_Point(mean, low, high, psnr_db, number))
    return found
