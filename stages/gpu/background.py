"""Backgrounds from the user's files: a picture, a folder of pictures, a video.

Every frame covers the output: `cover` scales the picture until no border is left, and crops the overhang equally on
both sides; the picture's lens is changed alike. Videos and folders start again when they end; photos that belong to the
camera's views are shown with them. A picture is turned as its EXIF tag says, unless its reader is told otherwise. What
Pillow would show wrongly is converted to eight bits, or refused.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Protocol

import numpy as np
from PIL import ExifTags, Image, UnidentifiedImageError

from trilane.arrays import U8
from trilane.errors import BadInputError, reason
from trilane.files import require_file
from trilane.scene.camera.path import CameraPath
from trilane.scene.footage import Stored, film_of, in_order
from trilane.scene.lens import cover
from trilane.shapes import Shape
from trilane.stages.gpu.video_reader import VideoReader

PICTURES = frozenset({".png", ".jpg", ".jpeg", ".bmp", ".webp", ".tif", ".tiff"})
#: Photos that phones write and Pillow does not read; FFmpeg would show a single tile of them.
PHONE_PHOTOS = frozenset({".heic", ".heif", ".hif"})
MAX_PIXELS = 64_000_000
DEEP_STEP = 257  # factor from eight bits to sixteen
DEEP_MODES = frozenset({"I;16", "I;16L", "I;16B", "I;16N"})
REFUSED_MODES = {"F": "numbers with fractions, as high-range pictures have", "I": "whole numbers of 32 bits"}
#: For each EXIF tag, how a picture is brought upright, and by how many quarters that turns it clockwise, mirrored or
#: not.
BY_TAG = {
    2: Image.Transpose.FLIP_LEFT_RIGHT,
    3: Image.Transpose.ROTATE_180,
    4: Image.Transpose.FLIP_TOP_BOTTOM,
    5: Image.Transpose.TRANSPOSE,
    6: Image.Transpose.ROTATE_270,
    7: Image.Transpose.TRANSVERSE,
    8: Image.Transpose.ROTATE_90,
}
QUARTERS = {5: 1, 6: 1, 3: 2, 4: 2, 7: 3, 8: 3}
CLOCKWISE = {1: Image.Transpose.ROTATE_270, 2: Image.Transpose.ROTATE_180, 3: Image.Transpose.ROTATE_90}
EXPECTED = "a PNG, JPEG, BMP, WebP or TIFF file"


def look_at_picture(path: Path) -> Stored:
    """Return the size of the picture in `path`, by its head alone. Raises BadInputError."""
    with _opened(path) as image:
        return Stored((image.height, image.width), QUARTERS.get(_orientation(image), 0))


def check_picture(path: Path) -> None:
    """Decode all of the picture in `path`, a JPEG at an eighth of its size. Raises BadInputError."""
    with _opened(path) as image:
        image.draft("RGB", (1, 1))
        image.load()


def read_picture(path: Path, shape: Shape, turned: int | None = None) -> U8:
    """Return the picture in `path` covering `shape` (h,w): (h,w,3) uint8. Raises BadInputError.

    `turned`: number of quarters that it is turned clockwise; None for its EXIF tag.
    """
    with _opened(path) as image:
        how = BY_TAG.get(_orientation(image)) if turned is None else CLOCKWISE.get(turned % 4)
        upright = _eight_bits(image if how is None else image.transpose(how))
        cut = cover((upright.height, upright.width), shape)
        x, y = upright.width / cut.width, upright.height / cut.height
        box = (cut.left * x, cut.top * y, (cut.left + shape[1]) * x, (cut.top + shape[0]) * y)
        return np.array(upright.resize((shape[1], shape[0]), Image.Resampling.LANCZOS, box))


def _orientation(image: Image.Image) -> int:
    """Return the EXIF tag; for a PNG only if it stands before the pixels, which are not decoded for it."""
    return int(Image.Image.getexif(image).get(ExifTags.Base.Orientation, 1))


def _eight_bits(image: Image.Image) -> Image.Image:
    if image.mode in DEEP_MODES:
        return Image.fromarray((np.asarray(image).astype(np.uint32) // DEEP_STEP).astype(np.uint8)).convert("RGB")
    return image.convert("RGB")


@contextmanager
def _opened(path: Path) -> Iterator[Image.Image]:
    if path.suffix.lower() in PHONE_PHOTOS:
        raise BadInputError(path, "an HEIF photo", EXPECTED, "export it as JPEG")
    try:
        with warnings.catch_warnings(action="ignore"), Image.open(path) as image:
            if image.width * image.height > MAX_PIXELS:
                raise BadInputError(path, f"{image.width}x{image.height} pixels", f"at most {MAX_PIXELS} pixels")
            if image.mode in REFUSED_MODES:
                raise BadInputError(path, f"a picture of {REFUSED_MODES[image.mode]}", "one of 8 or 16 bits a colour")
            yield image
    except (OSError, ValueError, SyntaxError, UnidentifiedImageError, Image.DecompressionBombError) as error:
        raise BadInputError(path, f"no readable picture ({reason(error)})", EXPECTED) from error


class Background(Protocol):
    """A background of a fixed shape (height, width)."""

    def at(self, time_s: float) -> U8 | None:
        """Return the picture (h,w,3) uint8 sRGB at `time_s`, or None when it is that of the last call."""

    def close(self) -> None:
        """Release files and threads."""


def open_background(path: Path, shape: Shape, fps: float, camera: CameraPath | None = None) -> Background:
    """Open the background in `path`; a folder's pictures follow each other at `fps`. Raises BadInputError.

    `camera`: camera that may have filmed it.
    """
    turned = () if camera is None else camera.optics.turned
    if camera is not None and camera.is_held:
        return PictureSequence([Path(name) for name in camera.pictures], camera.nearest, shape, turned)
    if path.is_dir():
        pictures = pictures_in(path)
        return PictureSequence(pictures, film_of([one.name for one in pictures], fps).number_at, shape, turned)
    require_file(path, "a video, a picture, or a folder of pictures")
    if is_picture(path):
        return PictureSequence([path], lambda _time_s: 0, shape, turned)
    return VideoReader(path, shape, turned[0] if turned else None)


def is_picture(path: Path) -> bool:
    """Return whether the name of `path` says that it is a picture."""
    return path.suffix.lower() in PICTURES | PHONE_PHOTOS


def pictures_in(folder: Path) -> list[Path]:
    """Return the pictures in `folder`, in order. Raises BadInputError without any."""
    names = _names_in(folder)
    if not names:
        near = next((sub for sub in sorted(folder.iterdir()) if sub.is_dir() and _names_in(sub)), None)
        remedy = f"did you mean {near}?" if near else ""
        raise BadInputError(folder, "no pictures", f"files that end in {', '.join(sorted(PICTURES))}", remedy)
    pictures = [folder / name for name in in_order(names)]
    for path in pictures:
        require_file(path, "a picture")  # refuses a pipe of such a name, which would be waited for
    return pictures


def _names_in(folder: Path) -> list[str]:
    """Return the names of pictures in `folder`. Raises BadInputError when it cannot be read."""
    try:
        return [path.name for path in folder.iterdir() if path.suffix.lower() in PICTURES]
    except OSError as error:
        raise BadInputError(folder, f"no readable folder ({reason(error)})", "a folder of pictures") from None


class PictureSequence:
    """Pictures in files, one after the other.

    `number_at`: function that gives the number of the picture shown at a time.
    """

    def __init__(
        self, paths: Sequence[Path], number_at: Callable[[float], int], shape: Shape, turned: Sequence[int] = ()
    ) -> None:
        """Keep the files.

        `turned`: number of quarters that each is turned, or a single one for all; empty for what the files say.
        """
        self._paths, self._number_at, self._shape, self._turned = paths, number_at, shape, turned
        self._shown = -1
        self._first: U8 | None = self._read(0)

    def at(self, time_s: float) -> U8 | None:
        """Return the picture whose turn it is."""
        number = self._number_at(time_s)
        if number == self._shown:
            return None
        self._shown = number
        first, self._first = self._first, None
        return first if first is not None and number == 0 else self._read(number)

    def close(self) -> None:
        """Do nothing: no file is held."""

    def _read(self, number: int) -> U8:
        turned = self._turned[number % len(self._turned)] if self._turned else None
        return read_picture(self._paths[number], self._shape, turned)
