"""Backgrounds from the user's files: a picture, a folder of pictures, a video.

Rule: every frame covers the output: it is scaled until no border is left, and what overhangs is cut off equally on both
sides. Videos and folders start again when they end; photos that belong to the camera's views are shown with them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Protocol

from trilane.arrays import U8
from trilane.errors import BadInputError, reason
from trilane.files import require_file
from trilane.scene.camera.path import CameraPath
from trilane.scene.footage import film_of, in_order
from trilane.shapes import Shape
from trilane.stages.gpu.picture_file import PHONE_PHOTOS, PICTURES, read_picture
from trilane.stages.gpu.video_reader import VideoReader


class Background(Protocol):
    """A background of a fixed shape (height, width)."""

    def at(self, time_s: float) -> U8 | None:
        """The picture (h,w,3) uint8 sRGB at `time_s`, or None when it is the one of the last call."""

    def close(self) -> None:
        """Release files and threads."""


def open_background(path: Path, shape: Shape, fps: float, camera: CameraPath | None = None) -> Background:
    """The background in `path`; a folder's pictures follow each other at `fps`. Raises BadInputError.

    `camera`: the one that may have filmed it.
    """
    turned = () if camera is None else camera.optics.turned
    if camera is not None and camera.is_held:
        return Pictures([Path(name) for name in camera.pictures], camera.nearest, shape, turned)
    if path.is_dir():
        pictures = pictures_in(path)
        return Pictures(pictures, film_of([one.name for one in pictures], fps).number_at, shape, turned)
    require_file(path, "a video, a picture, or a folder of pictures")
    if is_picture(path):
        return Pictures([path], lambda _time_s: 0, shape, turned)
    return VideoReader(path, shape, turned[0] if turned else None)


def is_picture(path: Path) -> bool:
    """Whether the name of `path` says that it is a picture."""
    return path.suffix.lower() in PICTURES | PHONE_PHOTOS


def pictures_in(folder: Path) -> list[Path]:
    """Its pictures, in order. Raises BadInputError without any."""
    names = _names_in(folder)
    if not names:
        near = next((sub for sub in sorted(folder.iterdir()) if sub.is_dir() and _names_in(sub)), None)
        remedy = f"did you mean {near}?" if near else ""
        raise BadInputError(folder, "no pictures", f"files that end in {', '.join(sorted(PICTURES))}", remedy)
    pictures = [folder / name for name in in_order(names)]
    for path in pictures:
        require_file(path, "a picture")  # a pipe of such a name would be waited for
    return pictures


def _names_in(folder: Path) -> list[str]:
    """Names of its pictures. Raises BadInputError when it cannot be read."""
    try:
        return [path.name for path in folder.iterdir() if path.suffix.lower() in PICTURES]
    except OSError as error:
        raise BadInputError(folder, f"no readable folder ({reason(error)})", "a folder of pictures") from None


class Pictures:
    """Pictures in files, one after the other. `number_at`: the number of the one that is shown at a time."""

    def __init__(
        self, paths: Sequence[Path], number_at: Callable[[float], int], shape: Shape, turned: Sequence[int] = ()
    ) -> None:
        """`turned`: by how many quarters each is turned, or all are; empty for what the files say."""
        self._paths, self._number_at, self._shape, self._turned = paths, number_at, shape, turned
        self._shown = -1
        self._first: U8 | None = self._read(0)

    def at(self, time_s: float) -> U8 | None:
        """The picture whose turn it is."""
        number = self._number_at(time_s)
        if number == self._shown:
            return None
        self._shown = number
        first, self._first = self._first, None
        return first if first is not None and number == 0 else self._read(number)

    def close(self) -> None:
        """Nothing is held."""

    def _read(self, number: int) -> U8:
        turned = self._turned[number % len(self._turned)] if self._turned else None
        return read_picture(self._paths[number], self._shape, turned)
