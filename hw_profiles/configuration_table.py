"""Tables of network configurations as CSV, with or without measured times; lines that begin with `#` are comments.

Rule: a bad cell is a `BadInputError` that names file, line and column.
"""

from __future__ import annotations

import csv
from dataclasses import dataclass
from math import isfinite
from pathlib import Path

from trilane.errors import BadInputError
from trilane.hw_profiles.reference_networks import NetworkSpec
from trilane.shapes import parse_shape
from trilane.unexpected_value import UnexpectedValue

KEYS = ("encoder", "norm", "size", "channels", "layout")
MAX_BYTES, MAX_ROWS = 32_000_000, 100_000


@dataclass(frozen=True)
class Row:
    """One configuration. `place`: its file and line, for messages. `cells`: its text by column."""

    place: str
    cells: dict[str, str]
    spec: NetworkSpec

    def number(self, column: str) -> float | None:
        """The measured value, above 0; None where the cell is blank or the column absent. Raises BadInputError."""
        text = self.cells.get(column, "")
        if not text:
            return None
        value = _number(text)
        if value is None or value <= 0:
            raise BadInputError(f"{self.place}: {column}", repr(text), "a number above 0, or nothing")
        return value

    def range(self, column: str) -> tuple[float, float] | None:
        """The values of `column`_min and `column`_max; None when one of them is blank. Raises BadInputError."""
        low, high = self.number(f"{column}_min"), self.number(f"{column}_max")
        if low is None or high is None:
            return None
        if low > high:
            raise BadInputError(f"{self.place}: {column}_min", f"{low:g}", f"at most {column}_max, which is {high:g}")
        return low, high


def read_table(path: Path) -> list[Row]:
    """The rows of `path`. Raises BadInputError when it is unreadable or too large, or lacks a column of KEYS."""
    try:
        if path.stat().st_size > MAX_BYTES:
            raise BadInputError(path, f"{path.stat().st_size} bytes", f"at most {MAX_BYTES}")
        text = path.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError as error:
        raise BadInputError(path, str(error), "text in UTF-8") from None
    except OSError as error:
        raise BadInputError.of_os_error(path, error, "a file that can be read") from None
    lines = [(n, line) for n, line in enumerate(text.splitlines(), 1) if line.strip() and not line.startswith("#")]
    if len(lines) < 2:
        raise BadInputError(path, "no rows", "a header and at least one row")
    if len(lines) > MAX_ROWS:
        raise BadInputError(path, f"{len(lines)} rows", f"at most {MAX_ROWS}")
    header = [cell.strip() for cell in next(csv.reader([lines[0][1]]))]
    if repeated := [key for key in dict.fromkeys(header) if header.count(key) > 1]:
        raise BadInputError(f"{path}: line {lines[0][0]}", f"column {repeated[0]!r} twice", "every column once")
    missing = [key for key in KEYS if key not in header]
    if missing:
        raise BadInputError(f"{path}: line {lines[0][0]}", f"no column {', '.join(missing)}", ", ".join(KEYS))
    return [_row(f"{path}: line {n}", header, next(csv.reader([line]))) for n, line in lines[1:]]


def _row(place: str, header: list[str], cells: list[str]) -> Row:
    if len(cells) != len(header):
        raise BadInputError(place, f"{len(cells)} cells", f"{len(header)} as in the header")
    named = {key: cell.strip() for key, cell in zip(header, cells, strict=True)}
    return Row(place, named, spec_of(named, place))


def spec_of(cells: dict[str, str], place: str) -> NetworkSpec:
    """The network that the cells `KEYS` describe; `size` is one side or HEIGHTxWIDTH. Raises BadInputError."""
    size = cells["size"]
    try:
        height, width = parse_shape(size if "x" in size else f"{size}x{size}")
    except UnexpectedValue:
        raise BadInputError(f"{place}: size", repr(size), "a side such as 512, or HEIGHTxWIDTH") from None
    channels = cells["channels"]
    if not channels.isdecimal() or len(channels) > 4:
        raise BadInputError(f"{place}: channels", repr(channels), "1 to 16")
    try:
        return NetworkSpec(cells["encoder"], cells["norm"], height, width, int(channels), cells["layout"])
    except BadInputError as error:
        raise BadInputError(f"{place}: {error.where}", error.found, error.expected) from None


def _number(text: str) -> float | None:
    try:
        value = float(text)
    except ValueError:
        return None
    return value if isfinite(value) else None
