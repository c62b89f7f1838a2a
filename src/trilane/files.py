"""Reads untrusted input files: sizes are read from headers before memory is taken, and nothing is unpickled.

Any defect of a file becomes one BadInputError that names the file. A file's first bytes tell its format; its suffix
does not. Signatures come from the format's own specification, or from libmagic's list. Most formats that Trilane does
not read have a remedy, such as a way to convert the file. In every function, `expected` is the sentence part that says
what the file should be.
"""

from __future__ import annotations

import errno
import math
import re
import tokenize
import warnings
import zipfile
import zlib
from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from trilane.errors import BadInputError, reason

HEAD_BYTES = 512
PICTURE, VIDEO, ARRAY, PICKLE, ARCHIVE, FOREIGN = "picture", "video", "array", "pickle", "archive", "foreign"
PICTURE_SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".webp", ".tif", ".tiff")

_AS_BVH = "in Blender: File > Import, choose the armature, then File > Export > Motion Capture (.bvh)"
_OTHER_3D = f"export the motion as BVH, such as {_AS_BVH}"
_UNPACK = "unpack it and give the file inside"
#: Keys of a motion's rate in files of arrays.
RATE_KEYS = ("mocap_framerate", "mocap_frame_rate", "fps", "frame_rate")
#: Remedy for a file whose arrays Trilane does not read.
ARRAYS = "save its arrays with NumPy where it opens: numpy.savez(FILE, poses=..., trans=..., mocap_frame_rate=...)"


@dataclass(frozen=True)
class Signature:
    """A known file format.

    `name`: name with its article. `group`: `PICTURE`, `VIDEO`, `ARRAY`, `PICKLE`, `ARCHIVE` or `FOREIGN`.
    `remedy`: way to make a file of this format usable, as part of a sentence; may be empty.
    """

    name: str
    group: str = FOREIGN
    remedy: str = ""


#: Pairs of a pattern of a file's first bytes and the format that it shows. The first pattern that matches counts.
SIGNATURES: tuple[tuple[bytes, Signature], ...] = (
    (rb"Kaydara FBX Binary|; FBX ", Signature("an FBX file", remedy=_OTHER_3D)),
    (rb"glTF", Signature("a binary glTF file (GLB, VRM)", remedy=_OTHER_3D)),
    (rb'\s*\{\s*"asset"\s*:\s*\{', Signature("a glTF file", remedy=_OTHER_3D)),
    (rb"PXR-USDC|#usda|PK\x03\x04.{26}[^\0]{0,120}\.usd", Signature("a USD file", remedy=_OTHER_3D)),
    (rb"BLENDER", Signature("a Blender file", remedy="in Blender: File > Export > Motion Capture (.bvh)")),
    (rb"Ogawa", Signature("an Alembic file", remedy=_OTHER_3D)),
    (rb"//Maya ASCII|FOR[48]....Maya", Signature("a Maya scene", remedy=_OTHER_3D)),
    (rb"Vocaloid Motion Data", Signature("a VMD file of MikuMikuDance", remedy=_OTHER_3D)),
    (rb"%YAML.{0,60}unity3d", Signature("a Unity asset", remedy="export the clip as FBX, then " + _AS_BVH)),
    (rb"\s*(<\?xml.{0,100})?<mvnx", Signature("an MVNX file", remedy="in Xsens MVN: File > Export > BVH")),
    (rb"(#[^\n]*\n|\s)*:(FULLY-SPECIFIED|version 1\.)", Signature("an ASF or AMC file", remedy=_OTHER_3D)),
    (rb"\s*<\?xml.{0,300}<COLLADA", Signature("a COLLADA file", remedy=_OTHER_3D)),
    (rb"[\x02-\x08]\x50", Signature("a C3D file", remedy="solve it to a skeleton and save that as BVH")),
    (rb"\x80[\x02-\x05]", Signature("a Python pickle", PICKLE, ARRAYS)),
    (rb"\x89HDF\r\n\x1a\n", Signature("an HDF5 file", remedy=ARRAYS)),
    (rb"MATLAB 5\.0 MAT-file", Signature("a MATLAB file", remedy=ARRAYS)),
    (rb"version https://git-lfs", Signature("a Git LFS pointer, not the file itself", remedy="fetch it: git lfs pull")),
    (rb"(?i:\s*<(!doctype html|html))", Signature("a web page", remedy="download the file itself")),
    (rb"%PDF", Signature("a PDF file")),
    (rb"\x7fELF", Signature("a program")),
    (rb"ply\r?\n", Signature("a PLY model", remedy="it has no motion and no camera")),
    (rb"\xff\xfe|\xfe\xff", Signature("text in UTF-16", remedy="save it as UTF-8")),
    (rb"\x93NUMPY", Signature("a NumPy array (.npy)", ARRAY)),
    (rb"PK\x03\x04.{26}[^\0/]{0,120}/data\.pkl|PK\x03\x04.{26}[^\0/]{0,120}/\.format_version",
     Signature("a file of torch.save", remedy=ARRAYS)),
    (rb"PK\x03\x04.{26}[^\0/]{0,120}\.npy", Signature("NumPy arrays (.npz)", ARRAY)),
    (rb"PK(\x03\x04|\x05\x06)", Signature("a ZIP archive", ARCHIVE, _UNPACK)),
    (rb"\x1f\x8b|BZh[1-9]1AY|\xfd7zXZ\0|7z\xbc\xaf|Rar!\x1a|\x28\xb5\x2f\xfd|.{257}ustar",
     Signature("a packed file", ARCHIVE, _UNPACK)),
    (rb"\x89PNG\r\n\x1a\n", Signature("a PNG picture", PICTURE)),
    (rb"\xff\xd8\xff", Signature("a JPEG picture", PICTURE)),
    (rb"GIF8[79]a", Signature("a GIF picture", PICTURE)),
    (rb"BM.{4}\0\0\0\0", Signature("a BMP picture", PICTURE)),
    (rb"RIFF.{4}WEBP", Signature("a WebP picture", PICTURE)),
    (rb"II\*\0|MM\0\*", Signature("a TIFF picture", PICTURE)),
    (rb"\0.{3}ftyp(hei|mif1|avif)", Signature("a HEIF picture", PICTURE, "save it as JPEG or PNG")),
    (rb"v/1\x01|#\?RADIANCE", Signature("an HDR picture", PICTURE, "save it as JPEG or PNG")),
    (rb"\0.{3}(ftyp|moov|mdat|wide|free)", Signature("an MP4 or QuickTime video", VIDEO)),
    (rb"\x1aE\xdf\xa3", Signature("a Matroska or WebM video", VIDEO)),
    (rb"RIFF.{4}AVI ", Signature("an AVI video", VIDEO)),
    (rb"YUV4MPEG2 ", Signature("a YUV4MPEG video", VIDEO)),
)  # fmt: skip
_PATTERNS = tuple((re.compile(pattern, re.DOTALL), signature) for pattern, signature in SIGNATURES)


def signature_of(path: Path) -> Signature | None:
    """Return the format of the regular file `path`; None if the format is not known.

    Raises OSError if the file cannot be read.
    """
    with path.open("rb") as file:
        head = file.read(HEAD_BYTES)
    return signature_of_head(head)


def signature_of_head(head: bytes) -> Signature | None:
    """Return the format of a file; None if it is not known. `head`: the file's first bytes, up to HEAD_BYTES."""
    return next((signature for pattern, signature in _PATTERNS if pattern.match(head)), None)


MAX_ARRAY_BYTES = 1 << 30
MAX_TEXT_BYTES = 256 << 20
LONGEST_WHOLE = 300  # characters of a number; floats have up to 309 digits

#: Errors that NumPy and zipfile raise on damaged files.
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
    """Return the size of the file `path` in bytes. Raises BadInputError if it is no regular file or is empty.

    `if_empty`: remedy for an empty file.
    """
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
    """Return a sentence part that says what is at `path`, where no regular file is."""
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
    """Return the text of the file. Raises BadInputError if it is missing, empty, over 256 MiB, or no text in UTF-8."""
    size = require_file(path, expected)
    if size > MAX_TEXT_BYTES:
        raise BadInputError(path, f"{size} bytes", f"at most {MAX_TEXT_BYTES}")
    try:
        refuse_other(path, expected)
        # utf-8-sig drops a byte order mark, which is no part of the text.
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
    """Raise BadInputError if the file cannot be read, or has a known format outside `groups` (`Signature.group`)."""
    try:
        signature = signature_of(path)
    except OSError as error:
        raise BadInputError.of_os_error(path, error, expected) from None
    if signature is not None and signature.group not in groups:
        raise BadInputError(path, signature.name, expected, signature.remedy)


def read_npy(path: Path, expected: str) -> NDArray[Any]:
    """Return the array of a `.npy` file. Raises BadInputError for any other file, and for a damaged one.

    A pickled or truncated array, or one of more than MAX_ARRAY_BYTES, is refused before its data are read.
    """
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
    """Return the arrays that `keys` name in the `.npz` file, by name. Raises BadInputError for a bad file or array.

    A key without an array is left out, and other arrays are not opened. The returned arrays may have at most
    MAX_ARRAY_BYTES bytes together.
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
    """Return the names of the arrays in an `.npz` file, in the file's order. Raises BadInputError for a bad file."""
    require_file(path, expected)
    try:
        refuse_other(path, expected, ARRAY, ARCHIVE)
        with zipfile.ZipFile(path) as archive:
            return [name.removesuffix(".npy") for name in archive.namelist() if name.endswith(".npy")]
    except DAMAGED as error:
        raise BadInputError(path, f"no readable .npz archive ({reason(error)})", expected) from error


def npz_pickles(path: Path, keys: Collection[str], most: int, expected: str) -> dict[str, bytes]:
    """Return the bytes of each array of Python objects in an `.npz` file, by the array's name.

    The bytes are the `.npy` header and the pickle, which stays pickled. Raises BadInputError for bad or too large data.

    `keys`: names of arrays in the file; arrays of numbers are left out.
    `most`: most bytes that all returned arrays may have together.
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
    with archive.open(info) as file:
        if not _holds_objects(file):
            return None
        if info.file_size > most:
            raise BadInputError(where, f"{info.file_size} bytes of Python objects", f"at most {most}")
        return file.read()


def npy_pickle(path: Path, most: int, expected: str) -> bytes | None:
    """Return the bytes of a `.npy` file that holds Python objects; None for any other file.

    Raises BadInputError for a bad file, and for Python objects in a file of more than `most` bytes.
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
    """Read the `.npy` header that comes next in `file`, and return whether its array holds Python objects."""
    version = np.lib.format.read_magic(file)
    return version in _HEADERS and _header(file, version)[2].hasobject


def read_bytes(path: Path, most: int, expected: str, if_empty: str = "") -> bytes:
    """Return the bytes of the whole file. Raises BadInputError if it is missing, empty or larger than `most` bytes.

    `if_empty`: remedy for an empty file.
    """
    size = require_file(path, expected, if_empty)
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
    """Read the `.npy` header that comes next in `file`; return (shape, whether the order is Fortran's, dtype).

    Raises BadInputError for pickled objects or an unknown version, and one of DAMAGED for a broken header.

    `where`: place that errors name.
    """
    version = np.lib.format.read_magic(file)
    if version not in _HEADERS:
        raise BadInputError(where, f".npy version {version}", "1.0 or 2.0")
    shape, fortran, dtype = _header(file, version)
    if dtype.hasobject:
        raise BadInputError(where, "pickled objects", "numbers", "save it as a plain number array")
    return shape, fortran, dtype


def _header(file: IO[bytes], version: tuple[int, int]) -> tuple[tuple[int, ...], bool, np.dtype[Any]]:
    """Return (shape, whether the order is Fortran's, dtype) of a header; raises one of DAMAGED for a broken one."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # about headers that Python 2 wrote
            return _HEADERS[version](file)
    except DAMAGED:
        raise
    except Exception as error:  # NumPy sorts and unpacks the literal before it checks the literal's type
        raise ValueError(f"a damaged header: {error}") from error


def _read_array(file: IO[bytes]) -> NDArray[Any]:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        return np.asarray(np.lib.format.read_array(file, allow_pickle=False))


def _checked_bytes(where: Path | str, file: IO[bytes], expected: str) -> int:
    """Read the `.npy` header that comes next in `file`, and return the number of data bytes that it announces.

    Raises BadInputError for a negative side or an array that is too large, and as `read_header` does.
    """
    shape, _, dtype = read_header(where, file)
    if any(side < 0 for side in shape):
        raise BadInputError(where, f"shape {shape}", expected)
    wanted = math.prod(shape) * dtype.itemsize
    if wanted > MAX_ARRAY_BYTES:
        raise BadInputError(where, f"shape {shape}, {wanted} bytes", f"at most {MAX_ARRAY_BYTES} bytes")
    return wanted


def whole_number(digits: str) -> int | float:
    """Return the value of a whole number in a JSON document.

    If the text has LONGEST_WHOLE characters or more, the result is infinity with the sign of the number.

    `digits`: the number as text, with its sign if it is negative.
    """
    return int(digits) if len(digits) < LONGEST_WHOLE else math.copysign(math.inf, -1 if digits.startswith("-") else 1)


def as_numbers(where: Path | str, array: NDArray[Any], expected: str) -> NDArray[np.float64]:
    """Return `array` as float64. Raises BadInputError, which names `where`, if it does not hold real numbers."""
    if array.dtype.kind not in "fiu":
        raise BadInputError(where, f"dtype {array.dtype}", expected)
    with np.errstate(invalid="ignore"):
        return array.astype(np.float64)
