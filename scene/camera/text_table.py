"""Reads text tables of camera poses: one pose per line, numbers separated by blanks or commas, `#` for comments.

Rule: every line has the same count of numbers; the error names the first line that has not.
"""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from trilane.errors import BadInputError
from trilane.files import read_text

MAX_ROWS = 1_000_000


class Table(NamedTuple):
    """`numbers` (N, columns): of each pose. `lines` (N,): in which it stands, from 1 on."""

    numbers: NDArray[np.float64]
    lines: NDArray[np.int64]

    def place_of(self, index: int) -> str:
        """Where pose `index` stands in the file."""
        return f"line {self.lines[index]}"


def read_table(path: Path, columns: int, expected: str) -> Table:
    """The poses of `path`, at least one; `nan` and `inf` stay. Raises BadInputError with the line."""
    rows, lines = [], []
    for number, words in _lines(path, expected):
        if len(words) != columns:
            raise BadInputError(f"{path}, line {number}", f"{len(words)} columns", expected)
        try:
            rows.append([float(word) for word in words])
            lines.append(number)
        except ValueError as error:
            raise BadInputError(f"{path}, line {number}", str(error), expected) from None
    if not rows or len(rows) > MAX_ROWS:
        raise BadInputError(path, f"{len(rows)} poses", f"1 to {MAX_ROWS}; {expected}")
    return Table(np.array(rows), np.array(lines))


def column_count(path: Path, expected: str) -> int:
    """How many numbers the first line that is no comment has; 0 when there is no such line. Raises BadInputError."""
    return next((len(words) for _, words in _lines(path, expected)), 0)


def elapsed(times: NDArray[np.float64]) -> tuple[NDArray[np.float64], float]:
    """Times (N,) since the first finite one, and the median of their steps, 0 with fewer than two. NaNs stay NaN."""
    finite = times[np.isfinite(times)]
    if len(finite) < 2:
        return times - times[0], 0.0
    return times - finite[0], float(np.median(np.diff(finite)))


def _lines(path: Path, expected: str) -> list[tuple[int, list[str]]]:
    lines = enumerate(read_text(path, expected).splitlines(), 1)
    cut = ((number, line.split("#", 1)[0].replace(",", " ").split()) for number, line in lines)
    return [(number, words) for number, words in cut if words]
