"""COLMAP's binary files, little endian. Rule: nothing is taken from a count before the file is known to hold it.

Format: https://colmap.github.io/format.html#binary-file-format and COLMAP's `scene/reconstruction_io`: a count
(uint64), then the entries. A camera is id and model (int32), width and height (uint64), parameters (double). An image
is id (int32), quaternion w, x, y, z and shift (7 double), camera (int32), name up to a NUL byte, count of points
(uint64), points (two double and int64 each), which are skipped.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from pathlib import Path
from typing import IO, Any

from trilane.errors import BadInputError
from trilane.files import require_file
from trilane.scene.camera.colmap_model import MAX_NAME, MODELS, ColmapCamera, ColmapImage, checked_camera

COUNT, CAMERA, IMAGE = struct.Struct("<Q"), struct.Struct("<iiQQ"), struct.Struct("<i7di")
POINT_BYTES, MAX_NAME_BYTES = 24, 4 * MAX_NAME
MAX_ENTRIES = 1_000_000


class _Reader:
    """Reads `file` of `size` bytes and refuses to read beyond its end."""

    def __init__(self, path: Path, file: IO[bytes], size: int) -> None:
        self.path, self._file, self._size = path, file, size

    def require(self, count: int, what: str) -> None:
        """Raises BadInputError unless the file has `count` bytes more."""
        left = self._size - self._file.tell()
        if count > left:
            raise BadInputError(self.path, f"{left} bytes, truncated", f"{count} bytes of {what}")

    def take(self, form: struct.Struct, what: str) -> tuple[Any, ...]:
        self.require(form.size, what)
        return form.unpack(self._file.read(form.size))

    def entries(self, least: int, what: str) -> Iterator[int]:
        """Numbers of the entries, as many as the file says, each of `least` bytes."""
        count = self.take(COUNT, f"the count of {what}")[0]
        if count > MAX_ENTRIES:
            raise BadInputError(self.path, f"{count} {what}", f"at most {MAX_ENTRIES}")
        self.require(count * least, f"{count} {what}")
        return iter(range(count))

    def name(self) -> str:
        """Text up to a NUL byte."""
        at = self._file.tell()
        head, end, _ = self._file.read(MAX_NAME_BYTES).partition(b"\0")
        if not end:
            raise BadInputError(self.path, "a name without end", f"one of at most {MAX_NAME_BYTES} bytes")
        self._file.seek(at + len(head) + 1)
        return head.decode("utf-8", "replace")

    def skip(self, count: int, what: str) -> None:
        self.require(count, what)
        self._file.seek(count, 1)


def read_cameras_binary(path: Path) -> dict[int, ColmapCamera]:
    """The cameras of `path` by their numbers. Raises BadInputError."""
    cameras = {}
    size = require_file(path, "a COLMAP cameras.bin")
    with path.open("rb") as file:
        reader = _Reader(path, file, size)
        for entry in reader.entries(CAMERA.size, "cameras"):
            where = f"{path}, camera {entry + 1}"
            number, model, width, height = reader.take(CAMERA, "a camera")
            if model not in MODELS:
                raise BadInputError(where, f"the camera model {model}", f"0 to {max(MODELS)}")
            count = len(MODELS[model].parameters)
            values = reader.take(struct.Struct(f"<{count}d"), "parameters")
            cameras[number] = checked_camera(where, MODELS[model], (float(width), float(height)), values)
    return cameras


def read_images_binary(path: Path) -> list[ColmapImage]:
    """The images of `path`. Raises BadInputError."""
    images = []
    size = require_file(path, "a COLMAP images.bin")
    with path.open("rb") as file:
        reader = _Reader(path, file, size)
        for _ in reader.entries(IMAGE.size + 1 + COUNT.size, "images"):
            _, *numbers, camera = reader.take(IMAGE, "an image")
            name = reader.name()
            points = reader.take(COUNT, "the count of points")[0]
            reader.skip(points * POINT_BYTES, f"{points} points of {name!r}")
            images.append(ColmapImage(name, tuple(numbers[:4]), tuple(numbers[4:]), camera))
    return images
