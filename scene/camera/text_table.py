"""Reads text tables of camera poses: one pose per line, numbers separated by blanks or commas, `#` for comments.

Rule: every line has the same count of numbers; the error names the first line that has not. An empty field between two
commas is no number (NaN), at the end of a line it is nothing. Column names in a comment or in the first line are read.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from itertools import islice
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from trilane.errors import BadInputError
from trilane.files import read_text
from trilane.scene.camera.untimed import FILM_RATE_HZ

MAX_ROWS = 1_000_000
#: Rows by which it is told what columns hold.
HEAD = 3000
#: With a median step above this, times are in nanoseconds, else in seconds.
LEAST_STEP_NS = 1e3
#: A time above this is in nanoseconds whatever the steps are: in seconds it would be 30 million years.
LEAST_TIME_NS = 1e15
#: Lines of numbers by which a table's layout is told.
LOOKED_AT = 20
#: Whole numbers below this that mostly grow by 1, in this share of the steps at least, number frames.
MOST_FRAMES, LEAST_GROWING = 1e7, 0.75
#: Unit of a first column that numbers frames.
FRAMES = "frames"
#: What is left out of a column's name: its unit, the frames of EuRoC's symbols, and all but letters and digits.
UNIT, SYMBOLS, OTHER = re.compile(r"\[[^\[\]]*\]"), re.compile(r"_rs(_r)?_"), re.compile(r"[^a-z0-9]")
#: A column's name -> what it holds.
KNOWN = {
    **{name: "time" for name in ("timestamp", "time", "t", "timestamps", "timestampns")},
    **{name: axis for axis in "xyz" for name in (axis, f"t{axis}", f"p{axis}", f"pos{axis}")},
    **{name: f"q{part}" for part in "wxyz" for name in (f"q{part}", f"rot{part}")},
    **{name: name for name in ("frame", "fx", "fy", "cx", "cy")},
}
POSE = ("time", "x", "y", "z", "qw", "qx", "qy", "qz")


class Table(NamedTuple):
    """`numbers` (N, columns): of each pose. `lines` (N,): in which it stands, from 1 on."""

    numbers: NDArray[np.float64]
    lines: NDArray[np.int64]

    def place_of(self, index: int) -> str:
        """Where pose `index` stands in the file."""
        return f"line {self.lines[index]}"


class Layout(NamedTuple):
    """How the first line of a table with numbers looks.

    `columns`: how many there are. `names`: what each holds, by KNOWN, "" for others; none without column names.
    `has_commas`: whether they part the numbers. `is_ns`: whether the first column has times in nanoseconds.
    """

    columns: int
    names: tuple[str, ...]
    has_commas: bool
    is_ns: bool

    @property
    def has_pose(self) -> bool:
        """Whether the names say where time, place and quaternion are."""
        return all(name in self.names for name in POSE)


def read_table(path: Path, columns: int, expected: str) -> Table:
    """The poses of `path`, at least one; `nan` and `inf` stay. Raises BadInputError with the line."""
    rows, lines = [], []
    for number, words in _rows(path, expected):
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


def head_of(path: Path, columns: int, expected: str) -> NDArray[np.float64]:
    """The numbers (N, columns) of the first rows that have as many; N may be 0. Raises BadInputError."""
    rows = (words for _, words in islice(_rows(path, expected), HEAD))
    numbers = ([value for word in words for value in _number(word)] for words in rows)
    return np.array([row for row in numbers if len(row) == columns]).reshape(-1, columns)


def layout_of(path: Path, expected: str) -> Layout:
    """Of the first line that is neither comment nor column names; no columns without one. Raises BadInputError."""
    names: tuple[str, ...] = ()
    first: list[str] = []
    times: list[float] = []
    has_commas = False
    for line in read_text(path, expected).splitlines():
        words = words_of(line)
        if found := names_in(line):
            names = names if times else found
        elif words:
            first, has_commas = first or words, has_commas or "," in line
            times += _number(words[0])
        if len(times) == LOOKED_AT:
            break
    with np.errstate(over="ignore"):
        is_ns = bool(times) and (elapsed(np.array(times))[1] > LEAST_STEP_NS or abs(times[0]) > LEAST_TIME_NS)
    return Layout(len(first), names, has_commas, is_ns)


def _number(word: str) -> list[float]:
    """`word` as a number, if it is a finite one."""
    try:
        return [float(word)] if np.isfinite(float(word)) else []
    except ValueError:
        return []


def names_in(line: str) -> tuple[str, ...]:
    """What the columns hold, if `line`, which may be a comment, names four or more that are known; else nothing."""
    text = UNIT.sub("", line.strip().lstrip("#"))
    words = text.split(",") if "," in text else text.split()
    plain = (OTHER.sub("", SYMBOLS.sub("", word.strip().lower())) for word in words)
    names = tuple(KNOWN.get(word, "") for word in plain)
    return names if len({*names} - {""}) >= 4 else ()


def elapsed(times: NDArray[np.float64]) -> tuple[NDArray[np.float64], float]:
    """Times (N,) since the first finite one, and the median of their steps, 0 with fewer than two. NaNs stay NaN."""
    finite = times[np.isfinite(times)]
    if len(finite) < 2:
        return times - times[0], 0.0
    return times - finite[0], float(np.median(np.diff(finite)))


def in_seconds(times: NDArray[np.float64]) -> tuple[NDArray[np.float64], float, str]:
    """As `elapsed`, in seconds, and the unit of `times` (N,): `ns` or `s`, by the size of their steps."""
    since, step = elapsed(times)
    unit, scale = ("ns", 1e-9) if step > LEAST_STEP_NS else ("s", 1.0)
    return since * scale, step * scale, unit


class Times(NamedTuple):
    """`since_s` (N,): since the first finite one. `unit`: of the column, `s`, `ns` or `frames`.

    `rate`: how many a second, for notes, such as `, 30/s`; empty where it is unknown.
    """

    since_s: NDArray[np.float64]
    unit: str
    rate: str


def times_of(column: NDArray[np.float64], rate_hz: float | None, usual_hz: float = FILM_RATE_HZ) -> Times:
    """What the first column of a table says: times, or numbers of frames, of which `rate_hz` (of the scene) tells the
    rate, else `usual_hz`.
    """
    if is_index(column):
        rate = rate_hz or usual_hz
        return Times(elapsed(column)[0] / rate, FRAMES, f", {rate:g} a second {'as given' if rate_hz else 'assumed'}")
    since, step, unit = in_seconds(column)
    return Times(since, unit, f", {1 / step:.4g}/s" if step > 0 else "")


def is_index(column: NDArray[np.float64]) -> bool:
    """Whether a column (N,) numbers frames, some of which may be missing."""
    finite = column[np.isfinite(column)]
    if len(finite) < 2 or not ((finite % 1 == 0) & (finite >= 0) & (finite < MOST_FRAMES)).all():
        return False
    steps = np.diff(finite)
    return bool(np.median(steps) == 1 and (steps >= 1).mean() >= LEAST_GROWING)


def words_of(line: str) -> list[str]:
    """The fields of a line without its comment."""
    text = line.split("#", 1)[0]
    if "," not in text:
        return text.split()
    fields = [word for field in text.split(",") for word in field.split() or ["nan"]]
    while fields and text.rstrip().endswith(",") and fields[-1] == "nan":
        fields.pop()
        text = text.rstrip()[:-1]
    return fields


def _rows(path: Path, expected: str) -> Iterator[tuple[int, list[str]]]:
    is_first = True
    for number, line in enumerate(read_text(path, expected).splitlines(), 1):
        words = words_of(line)
        if words and not (is_first and names_in(" ".join(words))):
            yield number, words
        is_first = is_first and not words
