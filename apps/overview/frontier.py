"""Which entries nobody beats in both: the frontier of frame time against error.

Rule: one entry beats another when it is at least as quick and at least as near to the truth, and better in one of both.
Entries are compared with those of their own clock, machine and scene, and of the same kind of error; one without a
speed or an error is on no frontier.
"""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from typing import Protocol


class Scored(Protocol):
    """`frame_ms`: less is better; `psnr_db`: more is better; `group`: whom it is compared with."""

    @property
    def frame_ms(self) -> float | None: ...
    @property
    def psnr_db(self) -> float | None: ...
    @property
    def group(self) -> Hashable: ...


def frontier(entries: Sequence[Scored]) -> list[bool]:
    """Of each entry, whether no other one beats it. Equal ones do not beat each other."""
    on = [False] * len(entries)
    for group in {entry.group for entry in entries}:
        rows = [
            (entry.frame_ms, -entry.psnr_db, number)
            for number, entry in enumerate(entries)
            if entry.group == group and entry.frame_ms is not None and entry.psnr_db is not None
        ]
        least = (float("inf"), float("inf"))  # the smallest error so far, and the frame time that it came with
        for frame_ms, error, number in sorted(rows):
            if error < least[0]:
                least = error, frame_ms
            on[number] = (error, frame_ms) == least
    return on
