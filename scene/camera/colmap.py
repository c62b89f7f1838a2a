"""COLMAP sparse models: a folder with `cameras` and `images`, as `.txt` or as `.bin`.

Poses are world to camera with optical axes (x right, y down, looks along +Z). Views are in the order of their photos'
names. The map has no unit, no vertical axis and no times. Distortion is left out and noted. Format:
https://colmap.github.io/format.html, https://colmap.github.io/cameras.html. Camera models have the numbers of COLMAP's
`sensor/models.h`.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any, NamedTuple

import numpy as np

from trilane.errors import BadInputError
from trilane.files import read_text, require_file
from trilane.scene.camera.recorded import LengthUnit, RawCamera, times_without
from trilane.scene.lens import Bent, Lens, checked_lens, distortion_note
from trilane.scene.recordings import Detected, natural
from trilane.scene.rotations import matrix_from_quat, normalised


class CameraModel(NamedTuple):
    """A camera model. `parameters`: names of its parameters, in file order; `f` is both focal lengths."""

    name: str
    parameters: tuple[str, ...]
    is_fisheye: bool = False


_F, _FXY = ("f", "cx", "cy"), ("fx", "fy", "cx", "cy")
#: Camera models, by COLMAP's number.
MODELS = {
    0: CameraModel("SIMPLE_PINHOLE", _F),
    1: CameraModel("PINHOLE", _FXY),
    2: CameraModel("SIMPLE_RADIAL", (*_F, "k1")),
    3: CameraModel("RADIAL", (*_F, "k1", "k2")),
    4: CameraModel("OPENCV", (*_FXY, "k1", "k2", "p1", "p2")),
    5: CameraModel("OPENCV_FISHEYE", (*_FXY, "k1", "k2", "k3", "k4"), is_fisheye=True),
    6: CameraModel("FULL_OPENCV", (*_FXY, "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")),
    7: CameraModel("FOV", (*_FXY, "omega"), is_fisheye=True),
    8: CameraModel("SIMPLE_RADIAL_FISHEYE", (*_F, "k1"), is_fisheye=True),
    9: CameraModel("RADIAL_FISHEYE", (*_F, "k1", "k2"), is_fisheye=True),
    10: CameraModel("THIN_PRISM_FISHEYE", (*_FXY, "k1", "k2", "p1", "p2", "k3", "k4", "sx1", "sy1"), is_fisheye=True),
}
BY_NAME = {model.name: model for model in MODELS.values()}
#: Largest plausible side of a picture, pixels; largest length of a photo's name, letters.
MAX_SIDE_PX, MAX_NAME = 1e6, 256


@dataclass(frozen=True)
class ColmapCamera:
    """A camera of the file.

    `model`: name of its camera model. `width_px`, `height_px`: size of its pictures. `values`: parameters by name.
    """

    model: str
    width_px: float
    height_px: float
    values: dict[str, float]

    def lens(self) -> Lens:
        """Return the lens as a pinhole, without distortion."""
        v = self.values
        fx, fy = v.get("fx", v.get("f", 0.0)), v.get("fy", v.get("f", 0.0))
        return Lens(self.width_px, self.height_px, fx, fy, v["cx"], v["cy"])

    def bent(self) -> Bent:
        """Return the lens with its distortion by the parameters k and p; other distortion is left out."""
        parameters = {key: value for key, value in self.values.items() if key[0] in "kp"}
        return Bent(self.lens(), parameters, BY_NAME[self.model].is_fisheye)


class ColmapImage(NamedTuple):
    """A view.

    `name`: name of its photo.
    `quat` (w, x, y, z), `shift` (x, y, z): transform from world to camera, in units of the map.
    `camera`: number of its camera.
    """

    name: str
    quat: tuple[float, ...]
    shift: tuple[float, ...]
    camera: int


def checked_camera(
    where: str | Path, model: CameraModel, size: tuple[float, float], values: Sequence[float]
) -> ColmapCamera:
    """Return a camera of `model` with the parameters `values`. `size`: (width, height) in pixels.

    Raises BadInputError when the numbers are not plausible. `where`: file, and line or camera in it, for the message.
    """
    if len(values) != len(model.parameters):
        raise BadInputError(where, f"{len(values)} parameters", f"{len(model.parameters)} of {model.name}")
    if not all(1 <= side <= MAX_SIDE_PX for side in size):
        raise BadInputError(where, f"a picture of {size[0]:g}x{size[1]:g}", f"sides of 1 to {MAX_SIDE_PX:g} pixels")
    named = dict(zip(model.parameters, values, strict=True))
    focal = [named[key] for key in ("f", "fx", "fy") if key in named]
    if not all(math.isfinite(value) for value in values) or min(focal) <= 0:
        raise BadInputError(where, "parameters that are not finite or a focal length below 0", "those of a camera")
    camera = ColmapCamera(model.name, *size, named)
    checked_lens(where, camera.lens())
    return camera


CAMERAS = "CAMERA_ID MODEL WIDTH HEIGHT PARAMS a line"
IMAGES = "IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME a line, then its points"
WORDS = 10  # words of an image's first line, with the name as one word


def read_cameras_text(path: Path) -> dict[int, ColmapCamera]:
    """Return the cameras of `path`, a `cameras.txt`, by number. Raises BadInputError with the line."""
    cameras = {}
    for number, line in _lines(path, CAMERAS):
        where, words = f"{path}, line {number}", line.split()
        if len(words) < 5 or words[1] not in BY_NAME:
            found = f"the camera model {words[1]!r}" if len(words) > 1 else f"{len(words)} words"
            raise BadInputError(where, found, f"{CAMERAS}, with one of {', '.join(BY_NAME)}")
        try:
            numbers = [float(word) for word in words[2:]]
            camera = int(words[0])
        except ValueError as error:
            raise BadInputError(where, str(error), CAMERAS) from None
        if camera in cameras:
            raise BadInputError(where, f"a second camera {camera}", "one line for each camera")
        cameras[camera] = checked_camera(where, BY_NAME[words[1]], (numbers[0], numbers[1]), numbers[2:])
    return cameras


def read_images_text(path: Path) -> list[ColmapImage]:
    """Return the views of `path`, an `images.txt`. Raises BadInputError with the line."""
    images, is_points = [], False
    for number, line in _lines(path, IMAGES, keeps_blank=True):
        is_image = _is_image(line)
        if is_image:
            images.append(_image(f"{path}, line {number}", line))
        elif not is_points and line:
            raise BadInputError(f"{path}, line {number}", repr(line[:40]), IMAGES)
        is_points = is_image
    return images


def _lines(path: Path, expected: str, keeps_blank: bool = False) -> list[tuple[int, str]]:
    lines = ((number, line.strip()) for number, line in enumerate(read_text(path, expected).splitlines(), 1))
    return [(number, line) for number, line in lines if not line.startswith("#") and (line or keeps_blank)]


def _is_image(line: str) -> bool:
    """Return whether `line` is the first line of an image, and not a line of points.

    An image's line has a name after its numbers; a line of points consists of triples of numbers.
    """
    words = line.split(maxsplit=WORDS - 1)
    if len(words) < WORDS:
        return False
    try:
        [float(word) for word in words[WORDS - 1].split()]
    except ValueError:
        return True
    return len(line.split()) % 3 != 0


def _image(where: str, line: str) -> ColmapImage:
    words = line.split(maxsplit=WORDS - 1)
    try:
        if len(words[9]) > MAX_NAME:
            raise BadInputError(where, f"a name of {len(words[9])} letters", f"at most {MAX_NAME}")
        numbers = tuple(float(word) for word in words[1:8])
        return ColmapImage(words[9], numbers[:4], numbers[4:], int(words[8]))
    except ValueError as error:
        raise BadInputError(where, str(error), IMAGES) from None


COUNT, CAMERA, IMAGE = struct.Struct("<Q"), struct.Struct("<iiQQ"), struct.Struct("<i7di")
POINT_BYTES, MAX_NAME_BYTES = 24, 4 * MAX_NAME
MAX_ENTRIES = 1_000_000


class _Reader:
    """Reads `file`, which has `size` bytes, and refuses to read beyond its end."""

    def __init__(self, path: Path, file: IO[bytes], size: int) -> None:
        self.path, self._file, self._size = path, file, size

    def require(self, count: int, what: str) -> None:
        """Raise BadInputError if the file has fewer than `count` further bytes. `what`: these bytes in words."""
        left = self._size - self._file.tell()
        if count > left:
            raise BadInputError(self.path, f"{left} bytes, truncated", f"{count} bytes of {what}")

    def take(self, form: struct.Struct, what: str) -> tuple[Any, ...]:
        self.require(form.size, what)
        return form.unpack(self._file.read(form.size))

    def entries(self, least: int, what: str) -> Iterator[int]:
        """Read the number of entries from the file, and return an iterator over their indices.

        `least`: least size of an entry, bytes. `what`: entries in words. Raises BadInputError when the file is too
        short, or for more than MAX_ENTRIES entries.
        """
        count = self.take(COUNT, f"the count of {what}")[0]
        if count > MAX_ENTRIES:
            raise BadInputError(self.path, f"{count} {what}", f"at most {MAX_ENTRIES}")
        self.require(count * least, f"{count} {what}")
        return iter(range(count))

    def name(self) -> str:
        """Return the text up to the next NUL byte, and continue after that byte."""
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
    """Return the cameras of `path`, a `cameras.bin`, by number. Raises BadInputError."""
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
    """Return the views of `path`, an `images.bin`. Raises BadInputError."""
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


EXPECTED = "a COLMAP model: cameras.txt and images.txt, or cameras.bin and images.bin"
MAX_VIEWS = 100_000
#: Folders below a project's folder that may hold the model.
BELOW = (Path(), Path("sparse/0"), Path("sparse"), Path("0"), Path("colmap/sparse/0"))
ENDINGS = (".bin", ".txt")


def model_in(folder: Path) -> tuple[Path, str] | None:
    """Return (folder at or below `folder` that holds a model, suffix of the model's files); None without a model."""
    for below in BELOW:
        for ending in ENDINGS:
            if all((folder / below / f"{name}{ending}").is_file() for name in ("cameras", "images")):
                return folder / below, ending
    return None


def load_colmap(path: Path, rate_hz: float | None = None) -> RawCamera:
    """Read the COLMAP model at `path`, a folder or a file of the model. Raises BadInputError that names the file.

    `rate_hz`: views a second by the scene; None if the scene does not say.
    """
    found = model_in(path if path.is_dir() else path.parent)
    if found is None:
        raise BadInputError(path, "no COLMAP model", EXPECTED)
    folder, ending = found
    cameras, images = _read(folder, ending)
    if not 1 <= len(images) <= MAX_VIEWS:
        raise BadInputError(folder / f"images{ending}", f"{len(images)} images", f"1 to {MAX_VIEWS}")
    views = sorted(images, key=lambda image: natural(image.name))
    lenses, distorted = _lenses(folder / f"images{ending}", views, cameras)
    world_to_camera = matrix_from_quat(normalised(np.array([image.quat for image in views])))
    turns = np.swapaxes(world_to_camera, 1, 2)
    places = -(turns @ np.array([image.shift for image in views])[:, :, None])[:, :, 0]
    times, rate = times_without(turns, rate_hz)
    models = " and ".join(sorted({cameras[image.camera].model for image in views}))
    notes = (f"COLMAP model, {len(views)} views by {len(cameras)} cameras ({models}), no times: {rate}", *distorted)
    names = tuple(image.name for image in views)
    detected = Detected("COLMAP model", f"cameras{ending} and images{ending}", rate=f"no times in the format: {rate}")
    source = "by the model" if len(lenses) == 1 else "by the model, view by view"
    return RawCamera(
        times, turns, places, "-y", lenses, source, notes, lambda k: names[k], detected, names, unit=LengthUnit.NONE
    )


def _read(folder: Path, ending: str) -> tuple[dict[int, ColmapCamera], list[ColmapImage]]:
    cameras, images = folder / f"cameras{ending}", folder / f"images{ending}"
    if ending == ".bin":
        return read_cameras_binary(cameras), read_images_binary(images)
    return read_cameras_text(cameras), read_images_text(images)


def _lenses(
    where: Path, views: Sequence[ColmapImage], cameras: Mapping[int, ColmapCamera]
) -> tuple[tuple[Lens, ...], tuple[str, ...]]:
    """Return (one lens for all views or one for each, without distortion; notes on the distortion).

    Raises BadInputError about `where` if a view has an unknown camera.
    """
    for image in views:
        if image.camera not in cameras:
            raise BadInputError(f"{where}: {image.name}", f"camera {image.camera}", "a camera of the model")
    used = dict.fromkeys(image.camera for image in views)
    notes = distortion_note(cameras[number].bent() for number in used)
    lenses = {number: cameras[number].lens() for number in used}
    if len(set(lenses.values())) == 1:
        return (next(iter(lenses.values())),), notes
    return tuple(lenses[image.camera] for image in views), notes
