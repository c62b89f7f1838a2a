"""A window into a run that goes on: the newest picture out, the camera's steering in. Rule: nobody waits for anybody.

The window is one region of memory without a name (memfd), which every process maps. A viewer notes when it looks; the
presenting stage copies a picture in only while somebody has looked lately. Two buffers take turns: a reader that finds
its buffer's number changed under it reads the other.

Each number has 8 bytes at an address that is a multiple of 8, so it is read and written in one piece. A processor that
reorders writes may show a torn picture, but cannot disturb the run.
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

LOOKED_NS: Final = 500_000_000  # time after the last look from which nobody counts as looking
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
    """How the camera is turned about its target, and how much nearer it is.

    `azimuth_deg`, `elevation_deg`: turns about the target in degrees.
    `zoom`: factor by which the camera is nearer.
    """

    azimuth_deg: float = 0.0
    elevation_deg: float = 0.0
    zoom: float = 1.0


class ShownPicture(NamedTuple):
    """A picture of `frame`.

    `media_s`: time of the scene in seconds.
    `sampled_ns`: time at which it was sampled.
    `pixels`: RGB picture (height, width, 3).
    """

    frame: int
    media_s: float
    sampled_ns: int
    pixels: NDArray[np.uint8]


def create_window(height: int, width: int) -> int:
    """Return a descriptor of a new window for pictures of that size; raises OSError."""
    fd = os.memfd_create("trilane:window", os.MFD_CLOEXEC)
    try:
        os.posix_fallocate(fd, 0, PAGE + 2 * height * width * 3)
        LiveWindow(fd, height, width).steer(Steering())
    except OSError:
        os.close(fd)
        raise
    return fd


def path_of(fd: int) -> Path:
    """Return the path by which another process of this user opens the window, while this process has it open."""
    return Path(f"/proc/{os.getpid()}/fd/{fd}")


class LiveWindow:
    """The window behind the descriptor `fd`, which may be closed afterwards.

    Raises ValueError when it is smaller than the pictures.
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
        """Return the window at `path`; raises OSError."""
        fd = os.open(path, os.O_RDWR | os.O_CLOEXEC)
        try:
            return cls(fd, height, width)
        finally:
            os.close(fd)

    # for whoever looks

    def look(self) -> None:
        """Ask for pictures for a while from now on."""
        self._head["looked_ns"] = time.monotonic_ns()

    def steer(self, steering: Steering) -> None:
        """Steer the camera from the next frame on."""
        for name, value in zip(Steering._fields, steering, strict=True):
            self._head[name] = value

    def newest(self, had: int) -> ShownPicture | None:
        """Return the newest picture; None without a picture, or when the newest one shows frame `had`."""
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
        """Make `pixels` (height, width, 3) the newest picture."""
        side = 1 - (int(self._head["newest"][0]) & 1)
        number = int(self._head["number"][0, 1 - side])
        # Marked first: a reader that still copies this buffer then finds its number changed.
        self._head["number"][0, side] = CLOSED
        self._pixels[side] = pixels
        self._head["frame"][0, side], self._head["media_s"][0, side] = frame, media_s
        self._head["sampled_ns"][0, side] = sampled_ns
        self._head["number"][0, side] = max(number, 0) + 1
        self._head["newest"][0] = side
