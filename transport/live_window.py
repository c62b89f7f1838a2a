"""A window into a run: the newest picture comes out, the camera's steering goes in. Rule: no process waits.

The window is one region of memory without a name (memfd), which every process maps. A viewer writes down the time of
each look; the presenting stage copies a picture in only if the last look was a short time ago. There are two buffers,
written in turns, each with a number. If the number changes while a reader copies the buffer, the reader tries again.

Each number has 8 bytes at an address that is a multiple of 8, so it is read and written in one piece. On a processor
that reorders writes, a reader may get a torn picture, but the run is not disturbed.
"""

from __future__ import annotations

import mmap
import os
import time
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from trilane.transport.packets import PAGE

LOOKED_NS: Final = 500_000_000  # a viewer counts as looking for this time after each look
TRIES: Final = 3
CLOSED: Final = -1

_HEAD: Final = np.dtype(
    [
        ("looked_ns", "<i8"),
        ("newest", "<i8"),
        ("number", "<i8", (2,)),
        ("frame", "<i8", (2,)),
        ("sampled_ns", "<i8", (2,)),
        ("media_s", "<f8", (2,)),
        ("azimuth_deg", "<f8"),
        ("elevation_deg", "<f8"),
        ("zoom", "<f8"),
    ]
)


class Steering(NamedTuple):
    """How a viewer has turned the camera about its target, and how much nearer to the target the camera is.

    `azimuth_deg`, `elevation_deg`: turns of the camera about the target, to the right and upwards, in degrees.
    `zoom`: number by which the camera's distance from the target is divided.
    """

    azimuth_deg: float = 0.0
    elevation_deg: float = 0.0
    zoom: float = 1.0


class ShownPicture(NamedTuple):
    """The picture of one frame.

    `frame`: number of the frame.
    `media_s`: time of the scene in seconds.
    `sampled_ns`: time at which the frame's input was sampled, in ns of CLOCK_MONOTONIC.
    `pixels`: RGB picture (height, width, 3) uint8.
    """

    frame: int
    media_s: float
    sampled_ns: int
    pixels: NDArray[np.uint8]


def create_window(height: int, width: int) -> int:
    """Return a descriptor of a new window for pictures of `height` x `width` pixels; raises OSError."""
    fd = os.memfd_create("trilane:window", os.MFD_CLOEXEC)
    try:
        os.posix_fallocate(fd, 0, PAGE + 2 * height * width * 3)
        LiveWindow(fd, height, width).steer(Steering())
    except OSError:
        os.close(fd)
        raise
    return fd


def path_of(fd: int) -> Path:
    """Return a path by which other processes of this user open the window, as long as this process has `fd` open."""
    return Path(f"/proc/{os.getpid()}/fd/{fd}")


class LiveWindow:
    """A window for pictures of `height` x `width` pixels. The descriptor `fd` may be closed after the call.

    Raises ValueError when the memory behind `fd` is too small for two such pictures.
    """

    def __init__(self, fd: int, height: int, width: int) -> None:
        size = PAGE + 2 * height * width * 3
        if os.fstat(fd).st_size < size:
            raise ValueError(f"a window of {os.fstat(fd).st_size} bytes for pictures of {width}x{height}")
        memory = np.frombuffer(mmap.mmap(fd, size), np.uint8)
        self._head = memory[: _HEAD.itemsize].view(_HEAD)
        self._pixels = memory[PAGE:].reshape(2, height, width, 3)

    @classmethod
    def opened(cls, path: Path, height: int, width: int) -> LiveWindow:
        """Return the window at `path`, as `LiveWindow` does; raises OSError too, if `path` cannot be opened."""
        fd = os.open(path, os.O_RDWR | os.O_CLOEXEC)
        try:
            return cls(fd, height, width)
        finally:
            os.close(fd)

    # for viewers

    def look(self) -> None:
        """Ask the run to copy its pictures into the window for the next `LOOKED_NS` nanoseconds."""
        self._head["looked_ns"] = time.monotonic_ns()

    def steer(self, steering: Steering) -> None:
        """Turn and zoom the scene's camera by `steering` from the next frame on, in place of any earlier steering."""
        for name, value in zip(Steering._fields, steering, strict=True):
            self._head[name] = value

    def newest(self, had: int) -> ShownPicture | None:
        """Return the newest picture; None if there is none, or if it changes during each try to copy it.

        `had`: number of the frame that the caller has already; the result for this frame is None too.
        """
        for _ in range(TRIES):
            side = int(self._head["newest"][0]) & 1
            number = int(self._head["number"][0, side])
            frame = int(self._head["frame"][0, side])
            if number == 0 or number == CLOSED or frame == had:
                return None
            times = float(self._head["media_s"][0, side]), int(self._head["sampled_ns"][0, side])
            pixels = self._pixels[side].copy()
            if int(self._head["number"][0, side]) == number:
                return ShownPicture(frame, *times, pixels)
        return None

    # for the run

    @property
    def is_looked_at(self) -> bool:
        return time.monotonic_ns() - int(self._head["looked_ns"][0]) < LOOKED_NS

    @property
    def steering(self) -> Steering:
        return Steering(*(float(self._head[name][0]) for name in Steering._fields))

    def show(self, frame: int, media_s: float, sampled_ns: int, pixels: NDArray[np.uint8]) -> None:
        """Make `pixels` (height, width, 3) uint8 the newest picture. Parameters are as in `ShownPicture`."""
        side = 1 - (int(self._head["newest"][0]) & 1)
        number = int(self._head["number"][0, 1 - side])
        # Marked first: a reader that still copies this buffer then finds its number changed.
        self._head["number"][0, side] = CLOSED
        self._pixels[side] = pixels
        self._head["frame"][0, side], self._head["media_s"][0, side] = frame, media_s
        self._head["sampled_ns"][0, side] = sampled_ns
        self._head["number"][0, side] = max(number, 0) + 1
        self._head["newest"][0] = side
