"""Pictures of a capture: a folder of files, or a video.

Rule: a picture is read as it is stored; one of another kind is refused and never converted. A video is decoded
forwards, so whoever reads in order decodes it once.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any, Protocol

import av
import numpy as np
from PIL import Image

from trilane.arrays import U8
from trilane.errors import BadInputError, reason
from trilane.unexpected_value import UnexpectedValue

ENDINGS = (".png", ".jpg", ".jpeg")
VIDEO_ENDINGS = (".mp4", ".mkv", ".mov", ".avi", ".webm")
#: Mode of a picture's file -> what it has, for people.
MODES = {
    "L": "one channel (grey)",
    "1": "one channel (black and white)",
    "LA": "two channels (grey and alpha)",
    "P": "a palette",
    "RGB": "three channels (RGB)",
    "RGBA": "four channels (RGBA)",
    "CMYK": "four channels (CMYK)",
}
#: Kind of picture -> modes that it is stored in, what is expected, and how to mend it; and PyAV's format of a video.
FRAME, MASK = "frame", "mask"
STORED: dict[str, tuple[tuple[str, ...], str, str, str]] = {
    FRAME: (
        ("RGB",),
        "three channels (RGB), 8 bits each",
        "save frames without alpha; masks are files of their own",
        "rgb24",
    ),
    MASK: (("L", "1"), "one channel of 8 bits: 255 on the person, 0 elsewhere", "save the mask as grey", "gray"),
}


class Pictures(Protocol):
    """Frames or masks of a capture. `names`: of each, in their order."""

    names: tuple[str, ...]

    def read(self, number: int) -> U8:
        """Picture `number`: (h,w,3) of a frame, (h,w) of a mask. Raises UnexpectedValue."""


def open_pictures(path: Path, kind: str) -> Pictures:
    """The pictures at `path`, a folder or a video. Raises BadInputError when there are none."""
    expected = f"a folder of {kind}s ({', '.join(ENDINGS)}) or a video ({', '.join(VIDEO_ENDINGS)})"
    if path.is_dir():
        names = sorted(each.name for each in path.iterdir() if each.suffix.lower() in ENDINGS)
        if not names:
            raise BadInputError(path, "no pictures", expected)
        return PictureFolder(path, tuple(names), kind)
    if not path.is_file():
        raise BadInputError(path, "no such file or folder", expected)
    if path.suffix.lower() not in VIDEO_ENDINGS:
        raise BadInputError(path, f"the ending {path.suffix!r}", expected)
    return PictureVideo(path, kind)


class PictureFolder:
    """Pictures that are files of `folder`."""

    def __init__(self, folder: Path, names: tuple[str, ...], kind: str) -> None:
        self.folder, self.names, self._kind = folder, names, kind

    def read(self, number: int) -> U8:
        """As `Pictures.read`."""
        modes, expected, remedy, _ = STORED[self._kind]
        try:
            with Image.open(self.folder / self.names[number]) as image:
                if image.mode not in modes:
                    raise UnexpectedValue(MODES.get(image.mode, f"the mode {image.mode}"), expected, remedy)
                return np.array(image.convert("L") if image.mode == "1" else image)
        except UnexpectedValue:
            raise
        except (OSError, SyntaxError, ValueError, Image.DecompressionBombError) as error:
            raise UnexpectedValue(f"a file that cannot be read ({reason(error)})", f"a {self._kind}") from None


class PictureVideo:
    """Pictures that are frames of a video; it is decoded once to count them."""

    def __init__(self, path: Path, kind: str) -> None:
        self._path, self._kind = path, kind
        self._stream: Iterator[Any] = iter(())
        self._next = 0
        self.names = tuple(f"{path.name}#{number}" for number, _ in enumerate(self._frames()))
        if not self.names:
            raise BadInputError(path, "a video without frames", f"a video of {kind}s")

    def read(self, number: int) -> U8:
        """As `Pictures.read`; going back opens the video again."""
        if number < self._next or not self._next:
            self._stream, self._next = self._frames(), 0
        frame = None
        while self._next <= number:
            frame = next(self._stream)
            self._next += 1
        _, expected, remedy, form = STORED[self._kind]
        if frame is None or len(frame.format.components) > 3:
            raise UnexpectedValue("four channels", expected, remedy)
        return np.asarray(frame.to_ndarray(format=form))

    def __getstate__(self) -> dict[str, Any]:
        """For another process, which opens the video anew."""
        return self.__dict__ | {"_stream": iter(()), "_next": 0}

    def _frames(self) -> Iterator[Any]:
        try:
            with av.open(str(self._path)) as container:
                yield from container.decode(video=0)
        except (av.FFmpegError, IndexError) as error:
            found = f"a video that cannot be decoded ({error})"
            raise BadInputError(self._path, found, f"a video of {self._kind}s") from None
