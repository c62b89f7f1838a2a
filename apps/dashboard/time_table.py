"""Rows with a begin and an end, many more than memory should hold, found by their time.

Rule: rows lie in a temporary file without a name, in pieces; in memory is only where each piece lies, its earliest
begin and its latest end. Rows need not be in order, but those of about one time should be added together.
"""

from __future__ import annotations

import os
import tempfile
from typing import IO, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

PIECE_ROWS = 4096


class _Piece(NamedTuple):
    offset: int
    rows: int
    begin: float
    end: float


class TimeTable:
    """Rows of `dtype`, which has the fields `begin` and `end` in any unit of time."""

    def __init__(self, dtype: np.dtype[Any]) -> None:
        self._dtype = dtype
        self._file: IO[bytes] = tempfile.TemporaryFile(prefix="trilane-")  # noqa: SIM115 - `close` closes it
        self._fresh: list[tuple[Any, ...]] = []
        self._pieces: list[_Piece] = []

    def add(self, row: tuple[Any, ...]) -> None:
        self._fresh.append(row)
        if len(self._fresh) == PIECE_ROWS:
            self.complete()

    def complete(self) -> None:
        """What was added is found from now on."""
        if self._fresh:
            rows = np.array(self._fresh, self._dtype)
            offset = self._file.seek(0, os.SEEK_END)
            self._file.write(rows.tobytes())
            self._file.flush()
            self._pieces.append(_Piece(offset, len(rows), float(rows["begin"].min()), float(rows["end"].max())))
            self._fresh = []

    def near(self, time: float, reach: float, most: int) -> NDArray[Any]:
        """Rows that touch `time - reach` to `time + reach`, by their begins; of too many, the nearest `most`."""
        low, high = time - reach, time + reach
        touching = [piece for piece in self._pieces if piece.begin <= high and piece.end >= low]
        touching.sort(key=lambda piece: _away(time, piece.begin, piece.end))
        found = [np.empty(0, self._dtype)]
        for piece in touching:
            if sum(map(len, found)) >= most:
                break
            rows = self._read(piece)
            found.append(rows[(rows["begin"] <= high) & (rows["end"] >= low)])
        rows = np.concatenate(found)
        away = np.maximum(np.maximum(rows["begin"] - time, time - rows["end"]), 0)
        rows = rows[np.argsort(away, kind="stable")[:most]]
        return rows[np.argsort(rows["begin"], kind="stable")]

    def last_before(self, time: float) -> np.void | None:
        """Of the rows that have ended at `time` the one that ended last; None when there is none."""
        for piece in reversed(self._pieces):
            rows = self._read(piece)
            ended = rows[rows["end"] <= time]
            if len(ended):
                last: np.void = ended[int(ended["end"].argmax())]
                return last
        return None

    def close(self) -> None:
        """Nothing is found any more, and the file is gone."""
        self._file.close()

    def _read(self, piece: _Piece) -> NDArray[Any]:
        return np.frombuffer(
            os.pread(self._file.fileno(), piece.rows * self._dtype.itemsize, piece.offset), self._dtype
        )


def _away(time: float, begin: float, end: float) -> float:
    return max(begin - time, time - end, 0.0)
