"""The content of a `.npy`, `.npz` or `.pkl` file as plain values: dicts, lists, numbers, text and arrays.

Rule: sizes are checked before memory is allocated. Nothing in a file is executed (`pickled.py`). Only requested arrays
of an archive are read. Values may contain themselves, so a search goes only a few levels deep.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from trilane.arrays import F64
from trilane.errors import BadInputError
from trilane.files import (
    ARRAYS,
    PICKLE,
    as_numbers,
    npy_pickle,
    npz_names,
    npz_pickles,
    read_bytes,
    read_npy,
    read_npz,
    refuse_other,
)
from trilane.scene.motion.pickled import MAX_BYTES, Foreign, StoredArray, printable, values_of
from trilane.unexpected_value import UnexpectedValue

DEEPEST = 4
MOST_TABLES = 200_000
MOST_NAMED = 12


def npy_values(path: Path, expected: str) -> Any:
    """Return the array or object in a `.npy` file. `expected`: content in words. Raises BadInputError."""
    pickled = npy_pickle(path, MAX_BYTES, expected)
    return read_npy(path, expected) if pickled is None else _values(path, pickled)


def npz_values(path: Path, keys: Collection[str], expected: str) -> dict[str, Any]:
    """Return, by name, the arrays of an `.npz` file whose names are in `keys`, and all pickled objects.

    `expected`: expected content in words, for messages. Raises BadInputError.
    """
    names = npz_names(path, expected)
    pickles = npz_pickles(path, names, MAX_BYTES, expected)
    arrays = read_npz(path, [key for key in keys if key in names and key not in pickles], expected)
    return {**arrays, **{key: _values(f"{path}[{key}]", data) for key, data in pickles.items()}}


def pickle_values(path: Path, expected: str) -> Any:
    """Return the content of a pickle as plain values. `expected`: content in words. Raises BadInputError."""
    data = read_bytes(path, MAX_BYTES, expected)
    refuse_other(path, expected, PICKLE)
    return _values(path, data)


def _values(where: Path | str, data: bytes) -> Any:
    try:
        return plain(values_of(data))
    except UnexpectedValue as error:
        raise BadInputError.at(where, error) from None


def plain(value: Any) -> Any:
    """Return the content of `value` if it is a StoredArray, otherwise `value` itself.

    NumPy stores a single object as an array of one object. For such an array, the result is this object.
    """
    if isinstance(value, StoredArray) and isinstance(value.values, list) and len(value.values) == 1:
        return value.values[0]
    return value.values if isinstance(value, StoredArray) else value


def tables_in(value: Any) -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield (path, dict) for each dict in `value` once, from the outermost inwards, at most DEEPEST levels deep.

    The path consists of the keys and list indices that lead to the dict, joined by `.`.
    """
    seen: set[int] = set()
    level = [("", plain(value))]
    for _ in range(DEEPEST + 1):
        inner: list[tuple[str, Any]] = []
        for name, each in level:
            if id(each) in seen or len(seen) >= MOST_TABLES or not isinstance(each, dict | list):
                continue
            seen.add(id(each))
            if isinstance(each, dict):
                yield name, each
            pairs = each.items() if isinstance(each, dict) else enumerate(each)
            may_have = ((key, below) for key, below in pairs if isinstance(below, dict | list | StoredArray))
            inner += [(f"{name}.{key}".removeprefix("."), plain(below)) for key, below in may_have]
        level = inner


def array_of(value: Any) -> NDArray[Any] | None:
    """Return `value` as an array if it is an array, a number or a list of numbers; otherwise None."""
    value = plain(value)
    if isinstance(value, np.ndarray):
        return value
    numbers = value if isinstance(value, list) else [value]
    if not all(type(each) in (int, float) and abs(each) < 1e300 for each in numbers):
        return None
    return np.array(value, dtype=np.float64)


def contents(value: Any) -> str:
    """Describe `value` for messages: keys and shapes in its outermost dict that has arrays, or its type."""
    value = plain(value)
    for name, table in tables_in(value):
        arrays = {key: array_of(each) for key, each in table.items()}
        if any(array is not None for array in arrays.values()) or not table:
            listed = [
                f"{printable(key)} {array.shape if array is not None else ''}".strip() for key, array in arrays.items()
            ]
            more = f" and {len(listed) - MOST_NAMED} more" if len(listed) > MOST_NAMED else ""
            within = f" in {printable(name)}" if name else ""
            return f"{', '.join(listed[:MOST_NAMED]) or 'nothing'}{more}{within}"
    if isinstance(value, Foreign):
        return f"{printable(value.name)}, which is not built"
    array = array_of(value)
    return f"an array of shape {array.shape}" if array is not None else f"a {type(value).__name__}"


@dataclass(frozen=True)
class FoundTable:
    """A dict of a file.

    `where`: file and path of the dict, for messages.
    `name`: path of the dict in the file, "" for the outermost.
    `table`: the dict.
    """

    where: str
    name: str
    table: Mapping[str, Any]

    def has(self, key: str) -> bool:
        """Return whether `key` has a value that is not None."""
        return bool(key) and self.table.get(key) is not None

    def array(self, key: str) -> NDArray[Any]:
        """Return the value of `key` as an array. Raises BadInputError when the value is not an array of numbers."""
        value = self.table[key]
        array = array_of(value)
        if array is None:
            kind = printable(value.name) if isinstance(value, Foreign) else type(value).__name__
            kind = "an array of objects" if isinstance(value, StoredArray) else kind
            raise BadInputError(f"{self.where}[{key}]", kind, "an array of numbers", ARRAYS)
        return array

    def numbers(self, key: str) -> F64:
        """Return the array `key` in float64. Raises BadInputError when it does not hold numbers."""
        return as_numbers(f"{self.where}[{key}]", self.array(key), "numbers")
