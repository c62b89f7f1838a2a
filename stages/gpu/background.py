"""Backgrounds from the user's files: a picture, a folder of pictures, a video.

Rule: every frame covers the output: it is scaled until no border is left, and what overhangs is cut off equally on both
sides. Videos and folders start again when they end.
"""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Protocol

import numpy as np
from PIL import Image, ImageOps, UnidentifiedImageError

from trilane.arrays import U8
from trilane.errors import BadInputError, reason
from trilane.files import require_file
from trilane.stages.gpu.video_reader import VideoReader

Shape = tuple[int, int]

PICTURES = frozenset({".png", ".jpg", ".jpeg", ".bmp", ".webp", ".tif", ".tiff"})
MAX_PIXELS = 64_000_000


class Background(Protocol):
    """A background of a fixed shape (height, width)."""

    def at(self, time_s: float) -> U8 | None:
        """The picture (h,w,3) uint8 sRGB at `time_s`, or None when it is the one of the last call."""

    def close(self) -> None:
        """Release files and threads."""


def open_background(path: Path, shape: Shape, fps: float) -> Background:
    """The background in `path`; a folder's pictures follow each other at `fps`. Raises BadInputError."""
    if path.is_dir():
        return PictureFolder(path, shape, fps)
    require_file(path, "a video, a picture, or a folder of pictures")
    return Still(path, shape) if path.suffix.lower() in PICTURES else VideoReader(path, shape)


class Still:
    """One picture."""

    def __init__(self, path: Path, shape: Shape) -> None:
        self._picture: U8 | None = read_picture(path, shape)

    def at(self, time_s: float) -> U8 | None:  # noqa: ARG002 - a still shows the same at all times
        """The picture at the first call, None later."""
        picture, self._picture = self._picture, None
        return picture

    def close(self) -> None:
        """Nothing is held."""


class PictureFolder:
    """The pictures of a folder in the order of their names."""

    def __init__(self, folder: Path, shape: Shape, fps: float) -> None:
        self._paths = sorted(path for path in folder.iterdir() if path.suffix.lower() in PICTURES)
        if not self._paths:
            raise BadInputError(folder, "no pictures", f"files that end in {', '.join(sorted(PICTURES))}")
        self._shape, self._fps, self._shown = shape, fps, -1
        read_picture(self._paths[0], shape)

    def at(self, time_s: float) -> U8 | None:
        """The picture whose turn it is."""
        index = int(time_s * self._fps + 1e-6) % len(self._paths)
        if index == self._shown:
            return None
        self._shown = index
        return read_picture(self._paths[index], self._shape)

    def close(self) -> None:
        """Nothing is held."""


def read_picture(path: Path, shape: Shape) -> U8:
    """The picture in `path`, turned as its EXIF says, covering `shape`: (h,w,3) uint8. Raises BadInputError."""
    try:
        with warnings.catch_warnings(action="ignore"), Image.open(path) as image:
            if image.width * image.height > MAX_PIXELS:
                raise BadInputError(path, f"{image.width}x{image.height} pixels", f"at most {MAX_PIXELS} pixels")
            upright = ImageOps.exif_transpose(image).convert("RGB")
        return np.asarray(ImageOps.fit(upright, (shape[1], shape[0]), Image.Resampling.LANCZOS))
    except (OSError, ValueError, SyntaxError, UnidentifiedImageError, Image.DecompressionBombError) as error:
        raise BadInputError(
            path, f"no readable picture ({reason(error)})", "a PNG, JPEG, BMP, WebP or TIFF file"
        ) from error
