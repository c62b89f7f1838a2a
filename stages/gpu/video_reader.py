"""A video as a background: decoded ahead on a thread, in step with media time.

Rule: the thread decodes at most AHEAD frames in advance, and `at` waits for at most one frame to be decoded.
"""

from __future__ import annotations

import queue
import threading
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import av
import numpy as np

from trilane.arrays import U8
from trilane.errors import BadInputError, TrilaneError

AHEAD = 4
MAX_PIXELS = 64_000_000
DEFAULT_STEP_S = 1 / 30


class VideoReader:
    """The first video stream of a file, scaled and cropped to `shape`, played in a loop. Raises BadInputError."""

    def __init__(self, path: Path, shape: tuple[int, int]) -> None:
        self._path, self._shape = path, shape
        self._queue: queue.Queue[tuple[float, U8] | TrilaneError] = queue.Queue(AHEAD)
        self._stop = threading.Event()
        frames = self._frames()
        self._next = next(frames)
        self._thread = threading.Thread(target=self._decode, args=(frames,), name="background video", daemon=True)
        self._thread.start()

    def at(self, time_s: float) -> U8 | None:
        """The newest frame (h,w,3) uint8 not after `time_s`; None when the last call returned that frame already.

        Raises BadInputError when the file cannot be decoded.
        """
        due = None
        while self._next[0] <= time_s + 1e-6:
            due = self._next[1]
            item = self._queue.get()
            if isinstance(item, TrilaneError):
                raise item
            self._next = item
        return due

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

    def _frames(self) -> Iterator[tuple[float, U8]]:
        """Pairs of time and picture without end, from time 0. Raises BadInputError for a video without frames."""
        begin = 0.0
        while True:
            last, step = -1.0, DEFAULT_STEP_S
            for time_s, picture in self._one_round():
                at = max(time_s, last)  # in some files times decrease
                step = at - last if at > last >= 0 else step
                last = at
                yield begin + at, picture
            if last < 0:
                raise BadInputError(self._path, "no video frame", "a video with at least one frame")
            begin += last + step

    def _one_round(self) -> Iterator[tuple[float, U8]]:
        try:
            with av.open(str(self._path)) as container:
                if not container.streams.video:
                    raise BadInputError(self._path, "no video stream", "a video")
                stream = container.streams.video[0]
                start: float | None = None
                for index, frame in enumerate(container.decode(stream)):
                    time_s = frame.time if frame.time is not None else index * DEFAULT_STEP_S
                    start = time_s if start is None else start
                    yield max(time_s - start, 0.0), self._fit(frame)
        except (av.FFmpegError, ValueError) as error:
            raise BadInputError(self._path, f"no readable video ({error})", "a video that FFmpeg can decode") from error

    def _fit(self, frame: Any) -> U8:
        if frame.width * frame.height > MAX_PIXELS:
            raise BadInputError(self._path, f"{frame.width}x{frame.height} pixels", f"at most {MAX_PIXELS} pixels")
        turns = round(frame.rotation / 90) % 4
        height, width = self._shape if turns % 2 == 0 else self._shape[::-1]
        scale = max(width / frame.width, height / frame.height)
        size = max(width, round(frame.width * scale)), max(height, round(frame.height * scale))
        pixels = frame.reformat(width=size[0], height=size[1], format="rgb24").to_ndarray()
        top, left = (size[1] - height) // 2, (size[0] - width) // 2
        return np.ascontiguousarray(np.rot90(pixels[top : top + height, left : left + width], turns))
