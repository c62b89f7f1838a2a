"""Backgrounds from the user's files: a picture, a folder of pictures, or a video, each examined before a run.

Every picture covers the output: `cover` scales it until no border is left, and crops both sides equally. Videos and
folders start again when they end; photos that belong to the camera's views are shown with these views. The EXIF tag of
a picture says by how many quarter turns it is shown, but a caller may choose another number. A picture that Pillow
would show wrongly is converted to eight bits, or refused.

`survey` returns size, rate and range of a background. Rule: all pictures that the run will show are opened before the
run: each picture is decoded, and a video's frames are counted. Therefore a broken file is named before a process is
started.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from itertools import pairwise
from pathlib import Path
from statistics import median
from typing import Any, Protocol

import av
import numpy as np
from PIL import ExifTags, Image, UnidentifiedImageError

from trilane import machine
from trilane.arrays import U8, Shape
from trilane.errors import BadInputError, reason
from trilane.files import PICTURE_SUFFIXES, require_file
from trilane.scene.camera.path import CameraPath
from trilane.scene.footage import Footage, Stored, film_of, in_order
from trilane.scene.lens import cover
from trilane.stages.gpu.video_reader import (
    A_VIDEO,
    DEFAULT_STEP_S,
    VideoReader,
    check_size,
    open_video,
    pixels_of,
    quarters_of,
    require_video,
    video_stream,
)

#: Suffixes of phone photos that Pillow does not read; FFmpeg would show only one tile of them.
PHONE_PHOTOS = frozenset({".heic", ".heif", ".hif"})
MAX_PIXELS = 64_000_000
DEEP_STEP = 257  # factor from eight bits to sixteen
DEEP_MODES = frozenset({"I;16", "I;16L", "I;16B", "I;16N"})
REFUSED_MODES = {"F": "numbers with fractions, as high-range pictures have", "I": "whole numbers of 32 bits"}
#: The operation that brings a picture upright, and its clockwise quarter turns without mirroring, by the EXIF tag.
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
    """Return size and quarter turns of the picture in `path`, without decoding it. Raises BadInputError."""
    with _opened(path) as image:
        return Stored((image.height, image.width), QUARTERS.get(_orientation(image), 0))


def check_picture(path: Path) -> None:
    """Raise BadInputError if the picture in `path` cannot be decoded; a JPEG is decoded at an eighth of its size."""
    with _opened(path) as image:
        image.draft("RGB", (1, 1))
        image.load()


def read_picture(path: Path, shape: Shape, turned: int | None = None) -> U8:
    """Return the picture in `path`, scaled and cropped to `shape`, as (h,w,3) uint8. Raises BadInputError.

    `shape`: (height, width).
    `turned`: number of clockwise quarter turns; None for the turn of the EXIF tag.
    """
    with _opened(path) as image:
        how = BY_TAG.get(_orientation(image)) if turned is None else CLOCKWISE.get(turned % 4)
        upright = image if how is None else image.transpose(how)
        if image.mode in DEEP_MODES:
            upright = Image.fromarray((np.asarray(upright).astype(np.uint32) // DEEP_STEP).astype(np.uint8))
        upright = upright.convert("RGB")
        cut = cover((upright.height, upright.width), shape)
        x, y = upright.width / cut.width, upright.height / cut.height
        box = (cut.left * x, cut.top * y, (cut.left + shape[1]) * x, (cut.top + shape[0]) * y)
        return np.array(upright.resize((shape[1], shape[0]), Image.Resampling.LANCZOS, box))


def _orientation(image: Image.Image) -> int:
    """Return the EXIF orientation tag; in a PNG, a tag after the pixels is ignored, so that no pixels are decoded."""
    return int(Image.Image.getexif(image).get(ExifTags.Base.Orientation, 1))


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
        """Return the picture (h,w,3) uint8 sRGB at `time_s`; None if it is the same as at the last call."""

    def close(self) -> None:
        """Release files and threads."""


def open_background(path: Path, shape: Shape, fps: float, camera: CameraPath | None = None) -> Background:
    """Return the opened background in `path`. Raises BadInputError.

    `shape`: (height, width) of its pictures.
    `fps`: pictures of a folder a second; ignored if the names of the pictures are times.
    `camera`: camera of the scene, to whose views the pictures may belong; None if they belong to no views.
    """
    turned = () if camera is None else camera.optics.turned
    if camera is not None and camera.is_held:
        return PictureSequence([Path(name) for name in camera.pictures], camera.nearest, shape, turned)
    if path.is_dir():
        pictures = pictures_in(path)
        return PictureSequence(pictures, film_of([one.name for one in pictures], fps).number_at, shape, turned)
    require_file(path, A_VIDEO)
    if is_picture(path):
        return PictureSequence([path], lambda _time_s: 0, shape, turned)
    return VideoReader(path, shape, turned[0] if turned else None)


def is_picture(path: Path) -> bool:
    """Return whether `path` has the suffix of a picture."""
    return path.suffix.lower() in (*PICTURE_SUFFIXES, *PHONE_PHOTOS)


def pictures_in(folder: Path) -> list[Path]:
    """Return the pictures in `folder`, by name, with numbers in names compared as numbers.

    Raises BadInputError if there are none, or if one of them is no regular file.
    """
    names = _names_in(folder)
    if not names:
        near = next((sub for sub in sorted(folder.iterdir()) if sub.is_dir() and _names_in(sub)), None)
        remedy = f"did you mean {near}?" if near else ""
        raise BadInputError(folder, "no pictures", f"files that end in {', '.join(sorted(PICTURE_SUFFIXES))}", remedy)
    pictures = [folder / name for name in in_order(names)]
    for path in pictures:
        require_file(path, "a picture")  # refuses a pipe with such a name, which could block for ever
    return pictures


def _names_in(folder: Path) -> list[str]:
    """Return the names of the pictures in `folder`. Raises BadInputError if it cannot be read."""
    try:
        return [path.name for path in folder.iterdir() if path.suffix.lower() in PICTURE_SUFFIXES]
    except OSError as error:
        raise BadInputError(folder, f"no readable folder ({reason(error)})", "a folder of pictures") from None


class PictureSequence:
    """A `Background` of pictures in files, one after the other."""

    def __init__(
        self, paths: Sequence[Path], number_at: Callable[[float], int], shape: Shape, turned: Sequence[int] = ()
    ) -> None:
        """Keep the paths, and read the first picture.

        `number_at`: function that returns the index of the picture at a time in seconds.
        `shape`: (height, width) of the pictures that are returned.
        `turned`: number of clockwise quarter turns of each picture, or a single number for all; empty for the turns of
        the EXIF tags.
        """
        self._paths, self._number_at, self._shape, self._turned = paths, number_at, shape, turned
        self._shown = -1
        self._first: U8 | None = self._read(0)

    def at(self, time_s: float) -> U8 | None:
        """Return the picture at `time_s`, as `Background.at`."""
        number = self._number_at(time_s)
        if number == self._shown:
            return None
        self._shown = number
        first, self._first = self._first, None
        return first if first is not None and number == 0 else self._read(number)

    def close(self) -> None:
        """Do nothing, because no file is open."""

    def _read(self, number: int) -> U8:
        turned = self._turned[number % len(self._turned)] if self._turned else None
        return read_picture(self._paths[number], self._shape, turned)


#: A video has a variable rate if the steps between its frames differ by more than this share of the usual step.
STEADY = 0.25
MOST_PACKETS = 500_000
#: Least share of its stated frames that a whole file contains.
LEAST_WHOLE = 0.99
QUARTER_WORDS = {1: ", turned by 90 degrees", 2: ", turned by 180 degrees", 3: ", turned by 270 degrees"}
EIGHT_BITS = 8


def survey(path: Path, fps: float) -> Footage:
    """Return the facts of the background in `path`: size, rate and range. Raises BadInputError.

    `fps`: pictures of a folder a second; ignored if the names of the pictures are times.
    """
    if path.is_dir():
        return _folder(path, fps)
    require_file(path, A_VIDEO)
    if is_picture(path):
        stored = look_at_picture(path)
        return Footage((f"picture of {_size(stored)}",), (), (stored,), (path.name,), str(path.absolute().parent))
    return _video(path)


def check_pictures(path: Path, fps: float, frames: int, camera: CameraPath) -> None:
    """Decode each picture of `path` that a run shows. Raises BadInputError naming a picture that cannot be decoded.

    `fps`: frames of the run a second, and pictures of a folder a second unless their names are times.
    `frames`: number of frames of the run.
    `camera`: camera of the scene, to whose views the pictures may belong.
    """
    if path.is_dir():
        with ThreadPoolExecutor(len(machine.here.cores())) as pool:
            for _ in pool.map(check_picture, _shown(path, fps, frames, camera)):
                pass
    elif is_picture(path):
        check_picture(path)


def _shown(path: Path, fps: float, frames: int, camera: CameraPath) -> list[Path]:
    if camera.is_held:
        return [Path(name) for name in camera.pictures]
    pictures = pictures_in(path)
    film = film_of([picture.name for picture in pictures], fps)
    last_s = (frames - 1) / fps
    return pictures if last_s >= film.period_s else pictures[: film.number_at(last_s) + 1]


def _folder(path: Path, fps: float) -> Footage:
    pictures = pictures_in(path)
    stored = tuple(look_at_picture(picture) for picture in pictures)
    names = tuple(picture.name for picture in pictures)
    sizes = {_size(one) for one in stored}
    size = sizes.pop() if len(sizes) == 1 else f"{len(sizes)} sizes, the first {_size(stored[0])}"
    film = film_of(names, fps)
    clock = () if film.began_s is None else tuple(film.began_s + time_s for time_s in film.times_s)
    what = (f"folder of {len(pictures)} pictures of {size}",)
    return Footage(what, film.rate, stored, names, str(path.absolute()), film.period_s, clock)


def _size(stored: Stored) -> str:
    height, width = stored.shown()
    return f"{width}x{height}{QUARTER_WORDS.get(stored.turned, '')}"


def _video(path: Path) -> Footage:
    require_video(path)
    try:
        with open_video(path) as container:
            stream = video_stream(container, path)
            frame = next(iter(container.decode(stream)), None)
            if frame is None:
                raise BadInputError(path, "no video frame", "a video with at least one frame")
            check_size(path, frame)
            pixels, codec = pixels_of(stream), stream.codec_context.name
            stored = Stored((frame.height, round(frame.width * pixels.aspect)), quarters_of(frame))
            bits = max(component.bits for component in frame.format.components)
        with open_video(path) as container:
            times = _times(container, path)
    except (av.FFmpegError, ValueError) as error:
        raise BadInputError(path, f"no readable video ({error})", "a video that FFmpeg can decode") from error
    steps = sorted(later - earlier for earlier, later in pairwise(times))
    period_s = times[-1] - times[0] + (times[-1] - times[-2] if steps else DEFAULT_STEP_S)
    what = [f"video of {_size(stored)}, {codec}"]
    if pixels.transfer:
        what.append(
            f"high range ({pixels.transfer}, {bits} bits): tone mapped by ITU-R BT.2390, white at 203 cd/m2, "
            "peaks at 1000"
        )
    elif bits > EIGHT_BITS:
        what.append(f"{bits} bits a colour: shown with 8")
    return Footage(tuple(what), (_rate(steps, period_s),), (stored,), period_s=period_s)


def _times(container: Any, path: Path) -> list[float]:
    """Return the frames' times in seconds, ascending, without decoding. Raises BadInputError for a cut-off file."""
    stream = video_stream(container, path)
    times, count = set(), 0
    for packet in container.demux(stream):
        count += packet.size > 0
        if packet.pts is not None and not packet.is_discard:
            times.add(packet.pts * packet.time_base)
        if count >= MOST_PACKETS:
            break
    if count < LEAST_WHOLE * min(stream.frames, MOST_PACKETS):
        raise BadInputError(path, f"{count} of the {stream.frames} frames that it names", "a file that was not cut off")
    return sorted(float(time) for time in times) or [0.0]


def _rate(steps: Sequence[float], period_s: float) -> str:
    """Return the rate in words. `steps`: times between frames in seconds, sorted. `period_s`: length of the video."""
    if not steps:
        return "one frame"
    usual = median(steps)
    if steps[-1] - steps[0] <= STEADY * usual:
        return f"{1 / usual:.4g}/s"
    mean = (len(steps) + 1) / period_s
    return (
        f"variable rate, {1 / steps[-1]:.3g} to {1 / steps[0]:.3g}/s, {mean:.3g}/s on average: its own times are kept"
    )
