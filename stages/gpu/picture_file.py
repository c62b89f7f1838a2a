"""One picture of the user's: looked at, checked, and read as it is to be shown.

Rule: a picture is turned as its EXIF tag says, unless its reader is told otherwise; it is scaled and cut by `cover`,
as its lens is. What Pillow would show wrongly is brought to eight bits here, or refused.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from PIL import ExifTags, Image, UnidentifiedImageError

from trilane.arrays import U8
from trilane.errors import BadInputError, reason
from trilane.scene.footage import Stored
from trilane.scene.lens import cover
from trilane.shapes import Shape

PICTURES = frozenset({".png", ".jpg", ".jpeg", ".bmp", ".webp", ".tif", ".tiff"})
#: Photos that a phone writes and Pillow does not read; FFmpeg would show one tile of them.
PHONE_PHOTOS = frozenset({".heic", ".heif", ".hif"})
MAX_PIXELS = 64_000_000
DEEP_STEP = 257  # from eight bits to sixteen
DEEP_MODES = frozenset({"I;16", "I;16L", "I;16B", "I;16N"})
REFUSED_MODES = {"F": "numbers with fractions, as high-range pictures have", "I": "whole numbers of 32 bits"}
#: How a picture is brought upright, by its EXIF tag; and by how many quarters that turns it clockwise, mirrored or not.
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
    """The size of the picture in `path`, by its head alone. Raises BadInputError."""
    with _opened(path) as image:
        return Stored((image.height, image.width), QUARTERS.get(_orientation(image), 0))


def check_picture(path: Path) -> None:
    """Decode all of the picture in `path`, a JPEG at an eighth of its size. Raises BadInputError."""
    with _opened(path) as image:
        image.draft("RGB", (1, 1))
        image.load()


def read_picture(path: Path, shape: Shape, turned: int | None = None) -> U8:
    """The picture in `path` covering `shape` (h,w): (h,w,3) uint8. Raises BadInputError.

    `turned`: by how many quarters it is turned clockwise; None for what its EXIF tag says.
    """
    with _opened(path) as image:
        how = BY_TAG.get(_orientation(image)) if turned is None else CLOCKWISE.get(turned % 4)
        upright = _eight_bits(image if how is None else image.transpose(how))
        cut = cover((upright.height, upright.width), shape)
        x, y = upright.width / cut.width, upright.height / cut.height
        box = (cut.left * x, cut.top * y, (cut.left + shape[1]) * x, (cut.top + shape[0]) * y)
        return np.array(upright.resize((shape[1], shape[0]), Image.Resampling.LANCZOS, box))


def _orientation(image: Image.Image) -> int:
    """The EXIF tag; of a PNG as far as it stands before the pixels, which are not decoded for it."""
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
