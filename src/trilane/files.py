"""Input files opened with suspicion: sizes are read from headers before memory is taken, nothing is unpickled.

Rule: whatever is wrong with a file becomes one BadInputError that names it.
"""

from __future__ import annotations

import errno
import math
import tokenize
import warnings
import zipfile
import zlib
from collections.abc import Collection
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from trilane.errors import BadInputError, reason
from trilane.file_signatures import ARCHIVE, ARRAY, signature_of

MAX_ARRAY_BYTES = 1 << 30
MAX_TEXT_BYTES = 256 << 20
LONGEST_WHOLE = 300  # digits; floats have up to 309

#: What NumPy and zipfile raise on damaged files.
DAMAGED = (
    OSError,
    ValueError,
    EOFError,
    tokenize.TokenError,
    zipfile.BadZipFile,
    zlib.error,
    NotImplementedError,
    RuntimeError,
)
NPY = b"\x93NUMPY"
_HEADERS = {
    (1, 0): np.lib.format.read_array_header_1_0,
    (2, 0): np.lib.format.read_array_header_2_0,
}


def require_file(path: Path, expected: str, if_empty: str = "") -> int:
    """Size of a regular, non-empty file in bytes. Raises BadInputError, of an empty one with the remedy `if_empty`."""
    try:
        if not path.is_file():
            raise BadInputError(path, instead_of_file(path), expected)
        size = path.stat().st_size
    except (OSError, ValueError) as error:
        raise BadInputError(path, f"a file that cannot be read ({reason(error)})", expected) from error
    if size == 0:
        raise BadInputError(path, "an empty file", expected, if_empty)
    return size


def instead_of_file(path: Path) -> str:
    """What `path` is, which is no regular file."""
    if path.is_dir():
        return "a folder"
    try:
        path.stat()
    except OSError as error:
        if error.errno == errno.ELOOP:
            return "a link that leads back to itself"
        return f"a link to {path.readlink()}, which is not there" if path.is_symlink() else "no such file"
    return "a device, a pipe or a socket"


def read_text(path: Path, expected: str) -> str:
    """The file as text. Raises BadInputError when it is missing, empty, over 256 MiB, not UTF-8 or not text."""
    size = require_file(path, expected)
    if size > MAX_TEXT_BYTES:
        raise BadInputError(path, f"{size} bytes", f"at most {MAX_TEXT_BYTES}")
    try:
        refuse_other(path, expected)
        text = path.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError as error:
        found = f"a file that cannot be read as text ({reason(error)})"
        raise BadInputError(path, found, expected, "if it is text, save it as UTF-8") from error
    except OSError as error:
        raise BadInputError(path, f"a file that cannot be read ({reason(error)})", expected) from error
    if "\0" in text:
        line = text.count("\n", 0, text.index("\0")) + 1
        raise BadInputError(f"{path}, line {line}", "a NUL byte, as no text has", expected)
    return text


def refuse_other(path: Path, expected: str, *groups: str) -> None:
    """Raises BadInputError for a file whose head is that of a known format, unless it is of one of `groups`."""
    try:
        signature = signature_of(path)
    except OSError as error:
        raise BadInputError.of_os_error(path, error, expected) from None
    if signature is not None and signature.group not in groups:
        raise BadInputError(path, signature.name, expected, signature.remedy)


def read_npy(path: Path, expected: str) -> NDArray[Any]:
    """The array of a `.npy` file. Raises BadInputError; pickled, truncated and huge files are refused unread."""
    size = require_file(path, expected)
    try:
        refuse_other(path, expected, ARRAY)
        with path.open("rb") as file:
            wanted = _checked_bytes(path, file, expected)
            if size - file.tell() < wanted:
                raise BadInputError(path, f"{size} bytes, truncated", f"{file.tell() + wanted} by its own header")
            file.seek(0)
            return _read_array(file)
    except DAMAGED as error:
        raise BadInputError(path, f"no readable NumPy array ({reason(error)})", expected) from error


def read_npz(path: Path, keys: Collection[str], expected: str) -> dict[str, NDArray[Any]]:
    """Those of `keys` that the `.npz` file has; other members are not opened. Raises BadInputError.

    All together have at most MAX_ARRAY_BYTES and a header each.
    """
    require_file(path, expected)
    try:
        refuse_other(path, expected, ARRAY, ARCHIVE)
        with zipfile.ZipFile(path) as archive:
            names = {info.filename: info for info in archive.infolist()}
            wanted = {key: names[f"{key}.npy"] for key in keys if f"{key}.npy" in names}
            total = sum(info.file_size for info in wanted.values())
            if len(wanted) > 1 and total > MAX_ARRAY_BYTES:
                raise BadInputError(path, f"{total} bytes of arrays", f"at most {MAX_ARRAY_BYTES}")
            return {key: _member(path, archive, info) for key, info in wanted.items()}
    except DAMAGED as error:
        raise BadInputError(path, f"no readable .npz archive ({reason(error)})", expected) from error


def npz_names(path: Path, expected: str) -> list[str]:
    """The names of the arrays of an `.npz` file, in its order; none is opened. Raises BadInputError."""
    require_file(path, expected)
    try:
        refuse_other(path, expected, ARRAY, ARCHIVE)
        with zipfile.ZipFile(path) as archive:
            return [name.removesuffix(".npy") for name in archive.namelist() if name.endswith(".npy")]
    except DAMAGED as error:
        raise BadInputError(path, f"no readable .npz archive ({reason(error)})", expected) from error


def npz_pickles(path: Path, keys: Collection[str], most: int, expected: str) -> dict[str, bytes]:
    """Of those `keys` of an `.npz` file that hold Python objects: the pickles, unread. Raises BadInputError.

    `most`: bytes that all together may have.
    """
    require_file(path, expected)
    found: dict[str, bytes] = {}
    try:
        with zipfile.ZipFile(path) as archive:
            for key in keys:
                left = most - sum(map(len, found.values()))
                pickle = _pickle_in(f"{path}[{key}]", archive, archive.getinfo(f"{key}.npy"), left)
                if pickle is not None:
                    found[key] = pickle
        return found
    except DAMAGED as error:
        raise BadInputError(path, f"no readable .npz archive ({reason(error)})", expected) from error


def _pickle_in(where: str, archive: zipfile.ZipFile, info: zipfile.ZipInfo, most: int) -> bytes | None:
    """The pickle of a member that holds objects; None for any other, which is not read."""
    with archive.open(info) as file:
        if not _holds_objects(file):
            return None
        if info.file_size > most:
            raise BadInputError(where, f"{info.file_size} bytes of Python objects", f"at most {most}")
        return file.read()


def npy_pickle(path: Path, most: int, expected: str) -> bytes | None:
    """The pickle of a `.npy` file that holds Python objects, unread; None for any other. Raises BadInputError.

    `most`: bytes that it may have.
    """
    size = require_file(path, expected)
    try:
        with path.open("rb") as file:
            if file.read(len(NPY)) != NPY:
                return None
            file.seek(0)
            if not _holds_objects(file):
                return None
            if size > most:
                raise BadInputError(path, f"{size} bytes of Python objects", f"at most {most}")
            return file.read()
    except DAMAGED as error:
        raise BadInputError(path, f"no readable NumPy array ({reason(error)})", expected) from error


def _holds_objects(file: IO[bytes]) -> bool:
    """Whether the array that comes next in `file` is one of Python objects; leaves `file` after its header.

    Raises one of DAMAGED on a broken header.
    """
    version = np.lib.format.read_magic(file)
    return version in _HEADERS and _header(file, version)[2].hasobject


def read_bytes(path: Path, most: int, expected: str) -> bytes:
    """The whole file. Raises BadInputError when it is missing, empty or has more than `most` bytes."""
    size = require_file(path, expected)
    if size > most:
        raise BadInputError(path, f"{size} bytes", f"at most {most}")
    try:
        with path.open("rb") as file:
            return file.read(most)
    except OSError as error:
        raise BadInputError.of_os_error(path, error, expected) from error


def _member(path: Path, archive: zipfile.ZipFile, info: zipfile.ZipInfo) -> NDArray[Any]:
    where = f"{path}[{info.filename.removesuffix('.npy')}]"
    with archive.open(info) as file:
        wanted = _checked_bytes(where, file, "numbers") + file.tell()
        if info.file_size < wanted:
            raise BadInputError(where, f"{info.file_size} bytes, truncated", f"{wanted} by its own header")
    with archive.open(info) as file:
        return _read_array(file)


def read_header(where: Path | str, file: IO[bytes]) -> tuple[tuple[int, ...], bool, np.dtype[Any]]:
    """Shape, Fortran order and type of the array whose `.npy` header comes next in `file`.

    Raises BadInputError on pickled objects and unknown versions, one of DAMAGED on a broken header.
    """
    version = np.lib.format.read_magic(file)
    if version not in _HEADERS:
        raise BadInputError(where, f".npy version {version}", "1.0 or 2.0")
    shape, fortran, dtype = _header(file, version)
    if dtype.hasobject:
        raise BadInputError(where, "pickled objects", "numbers", "save it as a plain number array")
    return shape, fortran, dtype


def _header(file: IO[bytes], version: tuple[int, int]) -> tuple[tuple[int, ...], bool, np.dtype[Any]]:
    """Shape, Fortran order and type by the header that comes next in `file`. Raises one of DAMAGED on a broken one."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # of headers written by Python 2
            return _HEADERS[version](file)
    except DAMAGED:
        raise
    except Exception as error:  # NumPy sorts and unpacks the literal before it knows what that holds
        raise ValueError(f"a damaged header: {error}") from error


def _read_array(file: IO[bytes]) -> NDArray[Any]:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        return np.asarray(np.lib.format.read_array(file, allow_pickle=False))


def _checked_bytes(where: Path | str, file: IO[bytes], expected: str) -> int:
    """Bytes of data that the header announces; leaves `file` at their start."""
    shape, _, dtype = read_header(where, file)
    if any(side < 0 for side in shape):
        raise BadInputError(where, f"shape {shape}", expected)
    wanted = math.prod(shape) * dtype.itemsize
    if wanted > MAX_ARRAY_BYTES:
        raise BadInputError(where, f"shape {shape}, {wanted} bytes", f"at most {MAX_ARRAY_BYTES} bytes")
    return wanted


def whole_number(digits: str) -> int | float:
    """A whole number of a JSON document; infinity for one that no float can hold."""
    return int(digits) if len(digits) < LONGEST_WHOLE else math.copysign(math.inf, -1 if digits.startswith("-") else 1)


def as_numbers(where: Path | str, array: NDArray[Any], expected: str) -> NDArray[np.float64]:
    """`array` as float64. Raises BadInputError when it holds no real numbers."""
    if array.dtype.kind not in "fiu":
        raise BadInputError(where, f"dtype {array.dtype}", expected)
    with np.errstate(invalid="ignore"):
        return array.astype(np.float64)
