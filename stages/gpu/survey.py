"""Checks the background of a scene before a run, and says what it is.

Rule: everything that the run will show is opened here: each picture is decoded, and a video's frames are counted. A
broken file is then named before a process is started. A note says size, rate and range.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise
from pathlib import Path
from statistics import median
from typing import Any, NamedTuple

import av

from trilane import machine
from trilane.errors import BadInputError
from trilane.files import HEAD_BYTES, PICTURE, VIDEO, require_file, signature_of_head
from trilane.scene.camera.path import CameraPath
from trilane.scene.footage import Footage, Stored, film_of
from trilane.stages.gpu.background import check_picture, is_picture, look_at_picture, pictures_in
from trilane.stages.gpu.video_reader import DEFAULT_STEP_S, Pixels, check_size, pixels_of, quarters_of, video_stream

#: A video has a variable rate when a step between its frames differs from the usual one by more than this share.
STEADY = 0.25
MOST_PACKETS = 500_000
#: Least share of its stated frames that a whole file contains.
LEAST_WHOLE = 0.99
A_VIDEO = "a video, a picture, or a folder of pictures"
#: Control characters, except those that lay out a text.
NO_TEXT = re.compile(rb"[\x00-\x08\x0e-\x1a\x1c-\x1f]")
QUARTER_WORDS = {1: ", turned by 90 degrees", 2: ", turned by 180 degrees", 3: ", turned by 270 degrees"}
EIGHT_BITS = 8


def survey(path: Path, fps: float) -> Footage:
    """Return what `path` is; a folder's pictures follow each other at `fps`. Raises BadInputError."""
    if path.is_dir():
        return _folder(path, fps)
    require_file(path, A_VIDEO)
    if is_picture(path):
        stored = look_at_picture(path)
        return Footage((f"picture of {_size(stored)}",), (), (stored,), (path.name,), str(path.absolute().parent))
    return _video(path)


def check_pictures(path: Path, fps: float, frames: int, camera: CameraPath) -> None:
    """Decode each picture of `path` that a run of `frames` frames shows. Raises BadInputError naming a bad one.

    `camera`: camera of the scene, whose views the pictures may belong to.
    """
    if path.is_dir():
        for _ in _checked(_shown(path, fps, frames, camera)):
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


def _checked(paths: Sequence[Path]) -> Iterable[None]:
    with ThreadPoolExecutor(len(machine.here.cores())) as pool:
        yield from pool.map(check_picture, paths)


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


class _Head(NamedTuple):
    """A video's first frame, and the facts of its stream.

    `bits`: bits per colour.
    """

    stored: Stored
    pixels: Pixels
    codec: str
    bits: int


def require_video(path: Path) -> None:
    """Raise BadInputError for a file that is no video, even where FFmpeg may show it or files that it names.

    Texts and archives are such files.
    """
    try:
        with path.open("rb") as file:
            head = file.read(HEAD_BYTES)
    except OSError as error:
        raise BadInputError.of_os_error(path, error, A_VIDEO) from None
    signature = signature_of_head(head)
    if signature is not None and signature.group not in (PICTURE, VIDEO):
        raise BadInputError(path, signature.name, A_VIDEO, signature.remedy)
    if is_text(head):
        raise BadInputError(path, "text", A_VIDEO)


def is_text(head: bytes) -> bool:
    """Return whether a file that begins with `head` may be text: every video has bytes that no text has."""
    return not NO_TEXT.search(head)


def _video(path: Path) -> Footage:
    require_video(path)
    try:
        with av.open(str(path), metadata_errors="replace") as container:
            head = _head(container, path)
        with av.open(str(path), metadata_errors="replace") as container:
            times = _times(container, path)
    except (av.FFmpegError, ValueError) as error:
        raise BadInputError(path, f"no readable video ({error})", "a video that FFmpeg can decode") from error
    steps = sorted(later - earlier for earlier, later in pairwise(times))
    period_s = times[-1] - times[0] + (times[-1] - times[-2] if steps else DEFAULT_STEP_S)
    what = [f"video of {_size(head.stored)}, {head.codec}"]
    if head.pixels.transfer:
        what.append(
            f"high range ({head.pixels.transfer}, {head.bits} bits): tone mapped by ITU-R BT.2390, white at 203 cd/m2, "
            "peaks at 1000"
        )
    elif head.bits > EIGHT_BITS:
        what.append(f"{head.bits} bits a colour: shown with 8")
    return Footage(tuple(what), (_rate(steps, period_s),), (head.stored,), period_s=period_s)


def _head(container: Any, path: Path) -> _Head:
    stream = video_stream(container, path)
    frame = next(iter(container.decode(stream)), None)
    if frame is None:
        raise BadInputError(path, "no video frame", "a video with at least one frame")
    check_size(path, frame)
    pixels = pixels_of(stream)
    stored = Stored((frame.height, round(frame.width * pixels.aspect)), quarters_of(frame))
    bits = max(component.bits for component in frame.format.components)
    return _Head(stored, pixels, stream.codec_context.name, bits)


def _times(container: Any, path: Path) -> list[float]:
    """Return increasing times of the frames, seconds, without decoding. Raises BadInputError for a truncated file."""
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
    """Say the rate in words, by the sorted `steps` between frames."""
    if not steps:
        return "one frame"
    usual = median(steps)
    if steps[-1] - steps[0] <= STEADY * usual:
        return f"{1 / usual:.4g}/s"
    mean = (len(steps) + 1) / period_s
    return (
        f"variable rate, {1 / steps[-1]:.3g} to {1 / steps[0]:.3g}/s, {mean:.3g}/s on average: its own times are kept"
    )
