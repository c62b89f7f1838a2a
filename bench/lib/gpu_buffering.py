"""Variants of moving pixels between the GPU and a slot, by name.

Rule: every variant gives the same bytes; they differ in when the caller waits.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from typing import Any, Protocol

from trilane.arrays import U8
from trilane.stages.gpu import opengl

Box = tuple[int, int, int, int]
RING = 3


class Readback(Protocol):
    """Reads part of a framebuffer of 32-bit unsigned words.

    `lag`: number of submits after which the bytes arrive.
    """

    lag: int

    def submit(self, target: Any, box: Box, words: int, tensor: U8) -> None:
        """Start to read.

        `target`: framebuffer.
        `box`: (x, y, width, height) in pixels.
        `words`: number of components of a pixel.
        `tensor`: bytes to fill, `lag` submits later.
        """

    def drain(self) -> None:
        """Fill every tensor that was submitted."""


class DirectReadback:
    """The driver copies to the slot, and the caller waits."""

    lag = 0

    def __init__(self, ctx: Any, most_bytes: int) -> None:
        """Do nothing: no memory is needed."""

    def submit(self, target: Any, box: Box, words: int, tensor: U8) -> None:
        """Read at once."""
        target.read_into(tensor, box, components=words, dtype="u4", alignment=1)

    def drain(self) -> None:
        """Do nothing: no read is pending."""


class PboReadback:
    """The driver copies to one pixel buffer, the caller from there to the slot."""

    lag = 0
    orphan = False

    def __init__(self, ctx: Any, most_bytes: int) -> None:
        self._buffer = ctx.buffer(reserve=most_bytes)

    def submit(self, target: Any, box: Box, words: int, tensor: U8) -> None:
        """Read to the buffer, then copy."""
        if self.orphan:
            self._buffer.orphan()
        target.read_into(self._buffer, box, components=words, dtype="u4", alignment=1)
        self._buffer.read_into(tensor, size=tensor.nbytes)

    def drain(self) -> None:
        """Do nothing: no read is pending."""


class OrphanPboReadback(PboReadback):
    """Reads as `PboReadback`, with fresh memory for each frame, so that the driver need not wait for the old."""

    orphan = True


class RingReadback:
    """A ring of pixel buffers, each with a fence; the slot is filled when its buffer is needed again."""

    lag = RING - 1

    def __init__(self, ctx: Any, most_bytes: int) -> None:
        self._free = deque(ctx.buffer(reserve=most_bytes) for _ in range(RING))
        self._waiting: deque[tuple[Any, int, U8]] = deque()

    def submit(self, target: Any, box: Box, words: int, tensor: U8) -> None:
        """Start this read; finish the oldest when no buffer is free."""
        buffer = self._free.popleft()
        target.read_into(buffer, box, components=words, dtype="u4", alignment=1)
        self._waiting.append((buffer, opengl.fence(), tensor))
        if not self._free:
            self._finish()

    def drain(self) -> None:
        """Wait for all buffers."""
        while self._waiting:
            self._finish()

    def _finish(self) -> None:
        buffer, sync, tensor = self._waiting.popleft()
        opengl.wait_fence(sync)
        buffer.read_into(tensor, size=tensor.nbytes)
        self._free.append(buffer)


READBACKS: dict[str, Callable[[Any, int], Readback]] = {
    "direct": DirectReadback,
    "pbo": PboReadback,
    "pbo-orphan": OrphanPboReadback,
    "pbo-ring": RingReadback,
}


class Upload(Protocol):
    """Writes a slot's bytes to a texture."""

    def write(self, texture: Any, image: U8) -> None:
        """Write `image`; the caller may change it afterwards."""


class SubUpload:
    """The driver copies from the slot."""

    def __init__(self, ctx: Any, most_bytes: int) -> None:
        """Do nothing: no memory is needed."""

    def write(self, texture: Any, image: U8) -> None:
        """Copy at once."""
        texture.write(image, alignment=1)


class OrphanUpload:
    """Uploads through one pixel buffer, with fresh memory for each frame."""

    def __init__(self, ctx: Any, most_bytes: int) -> None:
        self._buffer = ctx.buffer(reserve=most_bytes)

    def write(self, texture: Any, image: U8) -> None:
        """Copy to fresh memory, from which the driver copies on."""
        self._buffer.orphan()
        self._buffer.write(image)
        texture.write(self._buffer, alignment=1)


class RingUpload:
    """Uploads through a ring of pixel buffers; one is written again only after its fence."""

    def __init__(self, ctx: Any, most_bytes: int) -> None:
        self._ring: deque[tuple[Any, int | None]] = deque((ctx.buffer(reserve=most_bytes), None) for _ in range(RING))

    def write(self, texture: Any, image: U8) -> None:
        """Copy to the oldest buffer, from which the driver copies on."""
        buffer, sync = self._ring.popleft()
        if sync is not None:
            opengl.wait_fence(sync)
        buffer.write(image)
        texture.write(buffer, alignment=1)
        self._ring.append((buffer, opengl.fence()))


UPLOADS: dict[str, Callable[[Any, int], Upload]] = {"sub": SubUpload, "orphan": OrphanUpload, "ring": RingUpload}
