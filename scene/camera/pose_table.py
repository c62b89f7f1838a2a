"""Text tables of camera poses: one pose per line, numbers separated by blanks or commas, `#` for comments.

All lines must have the same number of columns; the error names the first line that differs. An empty field between two
commas is NaN; empty fields at the end of a line are ignored. Column names, in a comment or in the first line, override
the order of the format. A table whose quaternions mostly have another length than 1 is refused: its columns are in
another order, which would give a camera that looks in arbitrary directions.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from trilane.arrays import F64
from trilane.errors import BadInputError
from trilane.files import read_text
from trilane.scene.camera.recorded import AUTO, FILM_RATE_HZ, LENGTH_UNITS, are_rotations
from trilane.scene.recordings import EARLIEST_S, LATEST_S
from trilane.scene.rotations import matrix_from_quat, normalised

MAX_ROWS = 1_000_000
#: Number of first rows from which the content of columns is found.
HEAD = 3000
#: Units of times in seconds, the longest first. Poses are less than 1 s and at least LEAST_STEP_S apart, so the size of
#: a step fits only one unit. A step up to FAST_STEP_S is doubtful, as few programs save 300 poses a second: it may also
#: be a step between key frames in a longer unit.
SECONDS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
LEAST_STEP_S, FAST_STEP_S = 0.9e-3, 3e-3
#: Times since 1970, or times with fractions, keep their unit for steps up to SURE_STEP_S, such as those between key
#: frames. For steps up to LONGEST_STEP_S, another unit is as likely.
SURE_STEP_S, LONGEST_STEP_S = 3.0, 60.0
#: Number of lines of numbers from which a table's layout is found.
LOOKED_AT = 20
#: Whole numbers below MOST_FRAMES are frame numbers if their median step is 1. Also, at least the share LEAST_GROWING
#: of the steps must be 1 or more.
MOST_FRAMES, LEAST_GROWING = 1e7, 0.75
#: Unit of a first column that holds frame numbers.
FRAMES = "frames"
#: Units of times that column names may state, in seconds; and the spellings of units of times and lengths.
TIME_UNITS = {**SECONDS, "min": 60.0}
SPELLINGS = {
    **{unit: unit for unit in (*TIME_UNITS, *LENGTH_UNITS)},
    **dict.fromkeys(("sec", "secs", "second", "seconds"), "s"),
    **dict.fromkeys(("msec", "millisecond", "milliseconds"), "ms"),
    **dict.fromkeys(("usec", "\u00b5s", "\u03bcs", "microsecond", "microseconds"), "us"),
    **dict.fromkeys(("nsec", "nanosecond", "nanoseconds"), "ns"),
    **dict.fromkeys(("mins", "minute", "minutes"), "min"),
    **dict.fromkeys(("meter", "metre", "meters", "metres"), "m"),
    **dict.fromkeys(("centimeter", "centimetre", "centimeters", "centimetres"), "cm"),
    **dict.fromkeys(("millimeter", "millimetre", "millimeters", "millimetres"), "mm"),
    **dict.fromkeys(("kilometer", "kilometre", "kilometers", "kilometres"), "km"),
    **dict.fromkeys(("foot", "feet"), "ft"),
    **dict.fromkeys(("inch", "inches"), "in"),
}
#: Parts of a column's name: a unit in brackets; a unit at the end; a unit at the end of a name of times.
UNIT, AT_END = re.compile(r"\[[^\[\]]*\]|\([^()]*\)"), re.compile(r"[_ ](s|ms|us|ns|min|m|cm|mm|km|ft|in)$")
OF_TIMES = re.compile(r"^(?:timestamp|time|t|timestamps)(ns|us|ms)$")
#: Texts in brackets that state no unit; EuRoC's symbols of coordinate frames; everything but letters and digits.
NO_UNIT = ("", "-", "1")
SYMBOLS, OTHER = re.compile(r"_rs(_r)?_"), re.compile(r"[^a-z0-9]")
#: Content of a column, by its plain name.
KNOWN = {
    **{name + unit: "time" for name in ("timestamp", "time", "t", "timestamps") for unit in ("", "ns", "us", "ms")},
    **{name: axis for axis in "xyz" for name in (axis, f"t{axis}", f"p{axis}", f"pos{axis}")},
    **{name: f"q{part}" for part in "wxyz" for name in (f"q{part}", f"rot{part}")},
    **{name: name for name in ("frame", "fx", "fy", "cx", "cy")},
}
POSE = ("time", "x", "y", "z", "qw", "qx", "qy", "qz")


class NumberTable(NamedTuple):
    """The numbers of a table.

    `numbers` (N, columns): one row per pose. `lines` (N,): line of each pose in the file, from 1.
    """

    numbers: NDArray[np.float64]
    lines: NDArray[np.int64]

    def place_of(self, index: int) -> str:
        """Return the place of pose `index` in the file, for messages."""
        return f"line {self.lines[index]}"


class TableLayout(NamedTuple):
    """The layout of a table, by its column names and its first lines of numbers.

    `columns`: number of columns in the first line of numbers.
    `names`: content of each named column, a value of KNOWN or ""; empty without column names.
    `has_commas`: whether commas separate the numbers.
    `is_ns`: whether the first column has times in nanoseconds.
    `unit`: unit of the times by the column names; `auto` if they state no unit.
    `lengths`: unit of the positions by the column names; "" if they state no unit.
    """

    columns: int
    names: tuple[str, ...]
    has_commas: bool
    is_ns: bool
    unit: str = AUTO
    lengths: str = ""

    @property
    def has_pose(self) -> bool:
        """Whether the column names say which columns hold time, position and quaternion."""
        return all(name in self.names for name in POSE)


def read_table(path: Path, columns: int, expected: str) -> NumberTable:
    """Return the numbers of the table `path`, with at least one row; `nan` and `inf` are kept.

    `columns`: required number of columns. `expected`: expected content in words. Raises BadInputError with the line.
    """
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
    return NumberTable(np.array(rows), np.array(lines))


def head_of(path: Path, columns: int, expected: str) -> NDArray[np.float64]:
    """Return the numbers (N, `columns`) of the usable rows among the first HEAD rows; N may be 0.

    Rows with another number of columns, or with NaN or infinity, are left out. Raises BadInputError when the file is
    unreadable.
    """
    rows = (words for _, words in islice(_rows(path, expected), HEAD))
    numbers = ([value for word in words for value in _number(word)] for words in rows)
    return np.array([row for row in numbers if len(row) == columns]).reshape(-1, columns)


def layout_of(path: Path, expected: str) -> TableLayout:
    """Return the layout of the table `path`; it has 0 columns if the file has no line of numbers.

    `expected`: content in words. Raises BadInputError for column names that are contradictory or have unknown units.
    """
    named: tuple[ColumnName, ...] = ()
    first: list[str] = []
    times: list[float] = []
    has_commas = False
    for line in read_text(path, expected).splitlines():
        words = words_of(line)
        if found := columns_in(line):
            named = named if times else found
        elif words:
            first, has_commas = first or words, has_commas or "," in _parted(line)
            times += _number(words[0])
        if len(times) == LOOKED_AT:
            break
    names = tuple(column.holds for column in named)
    unit, lengths = AUTO, ""
    if set(POSE) <= set(names) or len(names) == len(first):
        _require_one_of_each(path, named)
        unit = _unit_of(path, named, ("time",), TIME_UNITS, "camera.time_unit") or AUTO
        lengths = _unit_of(path, named, ("x", "y", "z"), LENGTH_UNITS, "camera.metres_per_unit")
    with np.errstate(over="ignore"):
        is_ns = "ns" in (units_of(np.array(times)) if unit == AUTO else (unit,))
    return TableLayout(len(first), names, has_commas, is_ns, unit, lengths)


def _require_one_of_each(path: Path, columns: Sequence[ColumnName]) -> None:
    """Raise BadInputError if two columns have names with the same meaning, as either column may be meant."""
    named: dict[str, str] = {}
    for column in columns:
        if column.holds in named:
            found = f"two columns of {column.holds}, `{named[column.holds]}` and `{column.text}`"
            raise BadInputError(path, found, "one column of each", "rename or remove the one that is not meant")
        if column.holds:
            named[column.holds] = column.text


def _number(word: str) -> list[float]:
    """Return [number] if `word` is a finite number, otherwise []."""
    try:
        return [float(word)] if np.isfinite(float(word)) else []
    except ValueError:
        return []


class ColumnName(NamedTuple):
    """The name of a column.

    `text`: name as written. `holds`: content of the column, a value of KNOWN or "".
    `unit`: unit as written; "" if the name has no unit.
    """

    text: str
    holds: str
    unit: str


def columns_in(line: str) -> tuple[ColumnName, ...]:
    """Return the column names in `line`, which may be a comment; () for fewer than four different known names."""
    text = UNIT.sub(lambda unit: re.sub(r"[\s,]+", "_", unit[0]), _parted(line.strip().lstrip("#")))
    text = re.sub(r"(?<!\s)\s+(?=[\[(])", "", text)  # a unit in brackets belongs to the name before it
    columns = tuple(map(_named, text.split(",") if "," in text else text.split()))
    return columns if len({column.holds for column in columns} - {""}) >= 4 else ()


def _named(word: str) -> ColumnName:
    text = word.strip().strip("\"'")
    bare = UNIT.sub("", text).strip().lower()
    in_brackets = UNIT.search(text)
    plain = _plain(bare)
    at_end = None if plain in KNOWN else AT_END.search(bare)
    if at_end:
        plain = _plain(bare[: at_end.start()])
    of_times = OF_TIMES.search(plain)
    unit = in_brackets[0][1:-1].strip("_ ") if in_brackets else ""
    unit = unit or (at_end[1] if at_end else "") or (of_times[1] if of_times else "")
    text = re.sub(r"(?<=\w)(?=[\[(])", " ", text)
    return ColumnName(text, KNOWN.get(plain, ""), "" if unit in NO_UNIT else unit)


def _plain(name: str) -> str:
    return OTHER.sub("", SYMBOLS.sub("", name))


def _unit_of(
    path: Path, columns: tuple[ColumnName, ...], holding: tuple[str, ...], units: Mapping[str, float], key: str
) -> str:
    """Return the unit that column names state, a key of `units`; "" if they state none.

    `holding`: contents of the columns that count. `key`: key of the scene that states the unit, for messages.
    Raises BadInputError for unknown or different units.
    """
    of = [column for column in columns if column.holds in holding]
    found = [SPELLINGS.get(column.unit.lower(), column.unit) for column in of]
    for column, unit in zip(of, found, strict=True):
        if unit and unit not in units:
            known = f"a unit that is one of {', '.join(units)}"
            raise BadInputError(
                path, f"the column name `{column.text}`", known, f"remove the unit there, and set {key}"
            )
    if len(set(found)) > 1:
        other = next(column for column, unit in zip(of, found, strict=True) if unit != found[0])
        both = f"`{of[0].text}` and `{other.text}`"
        raise BadInputError(path, f"the column names {both}", "one unit for all three", f"remove them, and set {key}")
    return found[0] if found else ""


def elapsed(times: NDArray[np.float64]) -> tuple[NDArray[np.float64], float]:
    """Return (times (N,) since the first finite time, median step between finite times), in the unit of `times`.

    NaN stays NaN. The step is 0 if there are fewer than two finite times.
    """
    finite = times[np.isfinite(times)]
    if not len(finite):
        return times, 0.0
    return times - finite[0], float(np.median(np.diff(finite))) if len(finite) > 1 else 0.0


def units_of(column: NDArray[np.float64]) -> tuple[str, ...]:
    """Return the units that the times in `column` (N,) may have; FRAMES stands for frame numbers.

    There are several units if the times do not decide.
    """
    if is_index(column):
        return (FRAMES,)
    finite = column[np.isfinite(column)]
    step, middle = elapsed(finite)[1], float(np.median(finite)) if len(finite) else 0.0
    film = next((unit for unit, second in SECONDS.items() if step * second < 1), "ns")
    clock = next((unit for unit in SECONDS if _since_1970(middle, unit) and step * SECONDS[unit] < LONGEST_STEP_S), "")
    if clock:
        return (clock,) if clock == film or step * SECONDS[clock] <= SURE_STEP_S else (clock, film)
    if film != "ms":
        longer = {"us": "ms", "ns": "us"}.get(film, "") if step * SECONDS[film] <= FAST_STEP_S else ""
        return (longer, film) if longer else (film,)
    if (finite % 1 == 0).all() and finite.min() >= 0 and finite.max() < MOST_FRAMES:
        return ("s", "ms", FRAMES)
    return ("s",) if step <= SURE_STEP_S else ("s", "ms")


def _since_1970(time: float, unit: str) -> bool:
    return EARLIEST_S < time * TIME_UNITS[unit] < LATEST_S


class TableClock(NamedTuple):
    """What the scene and the format say about a table's times.

    `rate_hz`: frames a second by the scene; None if the scene does not say.
    `unit`: unit of the times; FRAMES for frame numbers, `auto` to find it from the times.
    `usual_hz`: frames a second by the format.
    """

    rate_hz: float | None = None
    unit: str = AUTO
    usual_hz: float = FILM_RATE_HZ

    def stated(self, path: Path, unit: str) -> TableClock:
        """Return this clock with the `unit` that column names state, unless the scene states a unit itself.

        Raises BadInputError when the scene states another unit of time. Frame numbers may have names with any unit.
        """
        if unit != AUTO and self.unit not in (AUTO, FRAMES, unit):
            found = f'column names with times in {unit} and camera.time_unit = "{self.unit}"'
            raise BadInputError(path, found, "one unit", "remove the wrong one")
        return self if self.unit != AUTO else self._replace(unit=unit)


class ColumnTimes(NamedTuple):
    """The times of a column.

    `since_s` (N,): seconds since the first finite time.
    `unit`: unit of the column, a key of TIME_UNITS or FRAMES.
    `rate`: rate for notes, such as `, 30/s`; "" when unknown.
    """

    since_s: NDArray[np.float64]
    unit: str
    rate: str


def times_of(where: str | Path, column: NDArray[np.float64], clock: TableClock) -> ColumnTimes:
    """Return `ColumnTimes` of the times or frame numbers in `column` (N,): seconds since the first finite time.

    `where`: table, for messages. `clock`: what the scene and the format say about the times.
    Raises BadInputError if the times may have several units. Raises it also if the median step is above 0 and below
    LEAST_STEP_S in the chosen unit of time. Other units are not tried, and frame numbers are not checked.
    """
    units = units_of(column) if clock.unit == AUTO else (clock.unit,)
    since, step = elapsed(column)
    if len(units) > 1:
        found = f"times that follow each other by {step:.4g}"
        either = " or ".join(f'"{unit}"' for unit in units)
        raise BadInputError(where, found, "a unit that follows from them", f"set camera.time_unit to {either}")
    unit = units[0]
    if unit == FRAMES:
        rate = clock.rate_hz or clock.usual_hz
        how = "as given" if clock.rate_hz else "assumed"
        return ColumnTimes(since / rate, FRAMES, f", {rate:g} a second {how}")
    step *= TIME_UNITS[unit]
    if 0 < step < LEAST_STEP_S:
        found = f"poses that follow each other by {step:.3g} s, if their times are in {unit}"
        raise BadInputError(where, found, "1000 a second at most", "camera.time_unit states the unit")
    return ColumnTimes(since * TIME_UNITS[unit], unit, f", {1 / step:.4g}/s" if step > 0 else "")


def is_index(column: NDArray[np.float64]) -> bool:
    """Return whether `column` (N,) holds frame numbers; some numbers may be missing."""
    finite = column[np.isfinite(column)]
    if len(finite) < 2 or not ((finite % 1 == 0) & (finite >= 0) & (finite < MOST_FRAMES)).all():
        return False
    steps = np.diff(finite)
    return bool(np.median(steps) == 1 and (steps >= 1).mean() >= LEAST_GROWING)


def _parted(text: str) -> str:
    """Return `text` with its fields separated by commas or blanks, and with decimal points.

    If it has semicolons, they separate the fields, and its commas are decimal commas.
    """
    return text.replace(",", ".").replace(";", ",") if ";" in text else text


def words_of(line: str) -> list[str]:
    """Return the fields of a line without its comment."""
    text = _parted(line.split("#", 1)[0])
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
        if words and not (is_first and columns_in(line.split("#", 1)[0])):
            yield number, words
        is_first = is_first and not words


USUAL = "as usual"
SAY_ORDER = "say the order in a first line, such as `timestamp qx qy qz qw tx ty tz`"
#: Number of columns of a 3x4 matrix, and the order of its numbers in a line.
MATRIX = 12
ROW_ORDER = "the order r11 r12 r13 tx r21 r22 r23 ty r31 r32 r33 tz"
#: Largest deviation of a quaternion's length from 1; rounding to two decimal places changes the length by 0.01 at most.
MOST_OFF = 0.02
#: A column is a clock if all steps differ from their median by less than the share EVEN. A column is no clock if more
#: than BAD_STEPS of them, and more than the share BAD_SHARE, differ by UNEVEN or more. A bad time makes two such steps.
#: A column is judged only if it has LEAST_OF_A_CLOCK rows.
EVEN, UNEVEN, BAD_STEPS, BAD_SHARE, LEAST_OF_A_CLOCK = 0.01, 0.5, 2, 0.05, 8


@dataclass(frozen=True)
class PoseTable:
    """The poses of a table with quaternions.

    `turns` (N, 3, 3), `places` (N, 3): rotations and positions, with the file's axes and unit.
    `order`: source of the order of columns, in words.
    `names`: content of each column of `table`.
    `began_s`: time 0 in seconds since 1970; None if the file's times are no plausible dates.
    `lengths`: unit of the positions by the column names; "" if they state no unit.
    """

    times: ColumnTimes
    turns: F64
    places: F64
    order: str
    names: Sequence[str]
    table: NumberTable
    began_s: float | None
    lengths: str = ""

    def column(self, name: str) -> F64:
        """Return the numbers (N,) of the column with the content `name`."""
        return self.table.numbers[:, self.names.index(name)]


def read_pose_table(
    path: Path, clock: TableClock, usual: Sequence[str], expected: str, may_have_more: bool = False
) -> PoseTable:
    """Return the poses of `path`.

    `clock`: what the scene says about the times.
    `usual`: content of each column by the format.
    `expected`: expected content in words.
    `may_have_more`: whether further columns may follow.
    Raises BadInputError with the line.
    """
    layout = layout_of(path, expected)
    names = layout.names if layout.has_pose else tuple(usual)
    order = USUAL if names[: len(usual)] == tuple(usual) else "by the file's column names"
    if may_have_more or layout.has_pose:
        fitting = (*names, *[""] * (layout.columns - len(names)))[: layout.columns]
        names = fitting if set(POSE) <= set(fitting) else names
    table = read_table(path, len(names), expected)
    time, x, y, z, qw, qx, qy, qz = (table.numbers[:, names.index(name)] for name in POSE)
    times = times_of(path, time, clock.stated(path, layout.unit))
    quats = np.column_stack([qw, qx, qy, qz])
    _require_quats(path, quats, table)
    turns, places = matrix_from_quat(normalised(quats)), np.column_stack([x, y, z])
    if not layout.has_pose:
        _require_times(path, time, places)
    return PoseTable(times, turns, places, order, names, table, _began(time, times.unit), layout.lengths)


class MatrixTable(NamedTuple):
    """The poses of a table with matrices.

    `times`: times of the poses; None if the table has neither times nor frame numbers.
    `turns` (N, 3, 3), `places` (N, 3): rotations and positions, with the file's axes and unit.
    `lengths`: unit of the positions by the column names; "" if they state no unit.
    """

    times: ColumnTimes | None
    turns: F64
    places: F64
    table: NumberTable
    lengths: str = ""


def read_matrix_table(path: Path, clock: TableClock, expected: str) -> MatrixTable:
    """Return the poses of `path`: a 3x4 matrix per line, row by row, perhaps after a time or a frame number.

    `clock`: what the scene says about the times. `expected`: content in words. Raises BadInputError with the line.
    """
    layout = layout_of(path, expected)
    columns = MATRIX if layout.columns == MATRIX else MATRIX + 1
    table = read_table(path, columns, expected)
    first = times_of(path, table.numbers[:, 0], clock.stated(path, layout.unit)) if columns > MATRIX else None
    _require_row_order(path, table)
    matrices = table.numbers[:, -MATRIX:].reshape(-1, 3, 4)
    return MatrixTable(first, matrices[:, :, :3], matrices[:, :, 3], table, layout.lengths)


def _require_row_order(path: Path, table: NumberTable) -> None:
    """Raise BadInputError if most poses are rotations only when their first nine numbers are taken as the 3x3 matrix.

    Such a table has each position after its rotation, or each matrix column by column.
    """
    numbers = np.nan_to_num(table.numbers[:, -MATRIX:])
    by_row = are_rotations(numbers.reshape(-1, 3, 4)[:, :, :3])
    by_nine = are_rotations(numbers[:, :9].reshape(-1, 3, 3)) & ~by_row
    if 2 * np.count_nonzero(by_nine) > len(numbers):
        where = f"{path}, {table.place_of(int(np.flatnonzero(by_nine)[0]))}"
        found = "a matrix whose first nine numbers are a rotation"
        remedy = "write each matrix row by row, with its place in the last column"
        raise BadInputError(where, found, ROW_ORDER, remedy)


def _require_times(path: Path, times: F64, places: F64) -> None:
    """Raise BadInputError if `times` (N,) do not look like a clock, but a column of `places` (N, 3) does.

    The steps of a clock are equal. No camera moves so evenly along an axis while it is sampled at uneven times.
    """
    if len(times) < LEAST_OF_A_CLOCK or _steps_off(times, UNEVEN) <= max(BAD_STEPS, BAD_SHARE * len(times)):
        return
    even = [name for name, column in zip("xyz", places.T, strict=True) if not _steps_off(column, EVEN)]
    if even:
        found = f"times that do not grow by equal steps, and in the place of {even[0]} numbers that do"
        raise BadInputError(path, found, "the times in the column of times", SAY_ORDER)


def _steps_off(column: F64, share: float) -> int:
    """Return the number of steps of `column` (N,) that differ from their median by `share` of it or more.

    All steps count if the median is not above 0.
    """
    since, median = elapsed(column)
    return int(np.count_nonzero(~(np.abs(np.diff(since) - median) < share * median)))


def _began(times: F64, unit: str) -> float | None:
    """Return the first finite time of `times` (N,), in `unit`, as seconds since 1970.

    The result is None if no time is finite, or if the first finite time is no plausible date.
    """
    finite = times[np.isfinite(times)]
    if unit not in TIME_UNITS or not len(finite) or not _since_1970(float(finite[0]), unit):
        return None
    return float(finite[0]) * TIME_UNITS[unit]


def _require_quats(path: Path, quats: F64, table: NumberTable) -> None:
    """Raise BadInputError if most of `quats` (N, 4) have another length than 1. `table`: their table, for messages."""
    off = is_off(quats)
    if 2 * np.count_nonzero(off) <= len(off):
        return
    first = int(np.flatnonzero(off)[0])
    others = [k for k in range(table.numbers.shape[1] - 3) if not is_off(table.numbers[:, k : k + 4]).any()]
    remedy = SAY_ORDER
    if others:
        remedy = f"columns {others[0] + 1} to {others[0] + 4} have length 1: {SAY_ORDER}"
    found = f"a quaternion of length {np.linalg.norm(quats[first]):.3g}"
    raise BadInputError(f"{path}, {table.place_of(first)}", found, "length 1", remedy)


def is_off(quats: F64, most: float = MOST_OFF) -> NDArray[np.bool_]:
    """Return a mask (N,) of the quaternions `quats` (N, 4) whose length differs from 1 by more than `most`.

    A quaternion that is 0 or not finite does not count as off.
    """
    with np.errstate(over="ignore", invalid="ignore"):
        length = np.linalg.norm(quats, axis=1)
        return np.asarray(np.isfinite(length) & (length > 0) & (np.abs(length - 1) > most))
