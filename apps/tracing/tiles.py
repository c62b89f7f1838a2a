"""The slices of one track in order. Rule: they follow each other without overlap, whatever the order they come in.

A unit's time is a job or idle at any moment, so that a slice can be written once those before it reach up to it. One
that begins within the time that is written already is cut: two slices of one unit never lie over each other.
"""

from __future__ import annotations

from collections.abc import Iterator
from heapq import heappop, heappush
from typing import Final, Generic, TypeVar

#: Slices that may wait for one before them; where a piece of time has none, what follows is written after so many.
MOST_WAITING: Final = 256
Item = TypeVar("Item")


class Tiles(Generic[Item]):
    """Fed the slices of one track as they become known, in any order; told when the track's time starts."""

    def __init__(self) -> None:
        self._until_ns: int | None = None
        self._waiting: list[tuple[int, int, int, Item]] = []
        self._count = 0

    def add(self, begin_ns: int, end_ns: int, item: Item) -> None:
        """A slice of the track."""
        self._count += 1
        heappush(self._waiting, (begin_ns, end_ns, self._count, item))

    def start(self, at_ns: int) -> None:
        """The track's time begins."""
        self._until_ns = at_ns

    def take(self, *, rest: bool = False) -> Iterator[tuple[int, int, Item]]:
        """(begin, end, item) of those that can be written now; with `rest`, of all."""
        waiting = self._waiting
        while waiting and (rest or len(waiting) > MOST_WAITING or self._reaches(waiting[0][0])):
            begin_ns, end_ns, _, item = heappop(waiting)
            begin_ns = max(begin_ns, self._until_ns or begin_ns)
            if end_ns >= begin_ns:
                self._until_ns = end_ns
                yield begin_ns, end_ns, item

    def _reaches(self, at_ns: int) -> bool:
        return self._until_ns is not None and self._until_ns >= at_ns


class Lanes:
    """Slices that may lie over each other, each in a lane where it does not; lanes are numbered from 0.

    At most `most`; where more lie over each other, one's begin is cut.
    """

    def __init__(self, most: int) -> None:
        self._most = most
        self._until_ns: list[int] = []

    def place(self, begin_ns: int, end_ns: int) -> tuple[int, int]:
        """The lane of a slice, and where it begins in it."""
        for lane, until_ns in enumerate(self._until_ns):
            if until_ns <= begin_ns:
                self._until_ns[lane] = end_ns
                return lane, begin_ns
        if len(self._until_ns) < self._most:
            self._until_ns.append(end_ns)
            return len(self._until_ns) - 1, begin_ns
        lane = min(range(self._most), key=self._until_ns.__getitem__)
        begin_ns = min(self._until_ns[lane], end_ns)
        self._until_ns[lane] = max(end_ns, self._until_ns[lane])
        return lane, begin_ns
