"""A video as a background: decoded ahead on a thread, in step with media time.

Rule: each frame is shown at the time that the file gives it, whatever the rate. The thread decodes at most AHEAD frames
in advance, and `at` waits for at most one frame to be decoded.
"""

from __future__ import annotations

import queue
import threading
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

import av
import numpy as np
from av.sidedata.sidedata import Type

from trilane.arrays import U8
from trilane.errors import BadInputError, TrilaneError
from trilane.scene.lens import cover
from trilane.shapes import Shape
from trilane.stages.gpu.high_range import HLG, PQ, to_srgb

AHEAD = 4
MAX_PIXELS = 64_000_000
DEFAULT_STEP_S = 1 / 30
ROUNDING_S = 1e-6
#: By their numbers in ITU-T H.273, which are FFmpeg's.
TRANSFERS, BT2020_PRIMARIES = {16: PQ, 18: HLG}, 9
MIN_ASPECT = 0.1  # of a pixel; what is beyond is a mistake of the file
MICROSECONDS = 1e6  # of a second: the unit of a container's duration and of its seeks


class VideoReader:
    """The first video stream of a file, scaled and cropped to `shape`, played in a loop. Raises BadInputError.

    `turned`: by how many quarters it is turned clockwise; None for what the file says.
    """

    def __init__(self, path: Path, shape: Shape, turned: int | None = None) -> None:
        self._path, self._shape, self._turned = path, shape, turned
        self._start_s: float | None = None  # of the file's first frame, in its own time
        self._period_s = 0.0  # of the loop; 0 until the video has ended once
        self._shown_s = -1.0
        self._next: tuple[float, U8]
        self._queue: queue.Queue[tuple[float, U8] | TrilaneError]
        self._open(0.0)

    def at(self, time_s: float) -> U8 | None:
        """The newest frame (h,w,3) uint8 not after `time_s`; None when the last call returned that frame already.

        Times may go back, as they do from the frames that are measured before a run to its first one: then the video
        is opened again. Raises BadInputError when the file cannot be decoded.
        """
        if time_s + ROUNDING_S < self._shown_s:
            self.close()
            self._open(time_s)
        due = None
        while self._next[0] <= time_s + ROUNDING_S:
            self._shown_s, due = self._next
            item = self._queue.get()
            if isinstance(item, TrilaneError):
                raise item
            self._next = item
        return due

    def _open(self, from_s: float) -> None:
        """Decode from `from_s` on, or from a little earlier."""
        self._queue = queue.Queue(AHEAD)
        self._stop = threading.Event()
        self._shown_s = -1.0
        frames = self._frames(from_s)
        self._next = next(frames)
        self._thread = threading.Thread(target=self._decode, args=(frames,), name="background video", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Stop the thread and close the file."""
        self._stop.set()
        with suppress(queue.Empty):
            while True:
                self._queue.get_nowait()
        self._thread.join()

    def _decode(self, frames: Iterator[tuple[float, U8]]) -> None:
        try:
            for item in frames:
                self._put(item)
                if self._stop.is_set():
                    return
        except TrilaneError as error:
            self._put(error)

    def _put(self, item: tuple[float, U8] | TrilaneError) -> None:
        while not self._stop.is_set():
            with suppress(queue.Full):
                return self._queue.put(item, timeout=0.1)

    def _frames(self, from_s: float) -> Iterator[tuple[float, U8]]:
        """Pairs of time and picture without end, from `from_s` or a little earlier.

        Raises BadInputError for a video without frames.
        """
        begin = from_s // self._period_s * self._period_s if self._period_s else 0.0
        seek_s = from_s - begin
        while True:
            last, step = -1.0, DEFAULT_STEP_S
            for time_s, picture in self._one_round(seek_s):
                at = max(time_s, last)  # in some files times decrease
                step = at - last if at > last >= 0 else step
                last = at
                yield begin + at, picture
            if last < 0:
                raise BadInputError(self._path, "no video frame", "a video with at least one frame")
            self._period_s = last + step
            begin, seek_s = begin + self._period_s, 0.0

    def _one_round(self, seek_s: float) -> Iterator[tuple[float, U8]]:
        """The frames from the last key frame before `seek_s` to the end, with their times from the file's first one."""
        try:
            with av.open(str(self._path), metadata_errors="replace") as container:
                stream = video_stream(container, self._path)
                if self._start_s is not None and 0 < seek_s < (container.duration or 0) / MICROSECONDS:
                    container.seek(round((self._start_s + seek_s) * MICROSECONDS))
                for index, frame in enumerate(container.decode(stream)):
                    time_s = frame.time if frame.time is not None else index * DEFAULT_STEP_S
                    self._start_s = time_s if self._start_s is None else self._start_s
                    yield max(time_s - self._start_s, 0.0), self._fit(frame, pixels_of(stream))
        except (av.FFmpegError, ValueError) as error:
            raise BadInputError(self._path, f"no readable video ({error})", "a video that FFmpeg can decode") from error

    def _fit(self, frame: Any, pixels: Pixels) -> U8:
        check_size(self._path, frame)
        return fitted(frame, pixels, self._shape, self._turned)


def fitted(frame: Any, pixels: Pixels, shape: Shape, turned: int | None = None) -> U8:
    """`frame`, of `pixels`, covering `shape` (h,w), turned clockwise by `turned` quarters, or as its file says.

    What the file mirrors is mirrored only in the latter case.
    """
    quarters = quarters_of(frame) if turned is None else turned % 4
    stored = (frame.height, round(frame.width * pixels.aspect))
    cut = cover(stored[::-1] if quarters % 2 else stored, shape)
    height, width = (cut.width, cut.height) if quarters % 2 else (cut.height, cut.width)
    scaled = frame.reformat(width=width, height=height, format="rgb48le" if pixels.transfer else "rgb24").to_ndarray()
    if turned is None and is_mirrored(frame):
        scaled = scaled[::-1]
    upright = np.rot90(scaled, -quarters)[cut.top : cut.top + shape[0], cut.left : cut.left + shape[1]]
    return to_srgb(upright, pixels.transfer, pixels.is_wide) if pixels.transfer else np.ascontiguousarray(upright)


def quarters_of(frame: Any) -> int:
    """By how many quarters `frame` is turned clockwise to be shown, as its file says."""
    return int(-round(frame.rotation / 90) % 4)


def is_mirrored(frame: Any) -> bool:
    """Whether `frame` is to be mirrored top to bottom before it is turned, as its file says: a selfie's display matrix.

    FFmpeg takes its angle from where x goes (`av_display_rotation_get`), so what is left of a mirror image is that y is
    reversed.
    """
    for side in frame.side_data:
        if side.type == Type.DISPLAYMATRIX:
            (a, b, _), (c, d, _), _ = np.frombuffer(bytes(side), np.int32).reshape(3, 3).astype(float)
            return bool(a * d - b * c < 0)
    return False


def check_size(path: Path, frame: Any) -> None:
    """Raises BadInputError when `frame` of `path` is too large."""
    if frame.width * frame.height > MAX_PIXELS:
        raise BadInputError(path, f"{frame.width}x{frame.height} pixels", f"at most {MAX_PIXELS} pixels")


def video_stream(container: Any, path: Path) -> Any:
    """The first video stream. Raises BadInputError when there is none."""
    if not container.streams.video:
        raise BadInputError(path, "no video stream", "a video")
    return container.streams.video[0]


class Pixels(NamedTuple):
    """Those of a video. `aspect`: width over height of one. `transfer`: PQ or HLG, empty for the usual range.

    `is_wide`: whether their primaries are those of BT.2020.
    """

    aspect: float = 1.0
    transfer: str = ""
    is_wide: bool = False


def pixels_of(stream: Any) -> Pixels:
    """Those of a video `stream`."""
    codec = stream.codec_context
    aspect = float(codec.sample_aspect_ratio or 0)
    return Pixels(
        aspect if MIN_ASPECT < aspect < 1 / MIN_ASPECT else 1.0,
        TRANSFERS.get(int(codec.color_trc), ""),
        int(codec.color_primaries) == BT2020_PRIMARIES,
    )
