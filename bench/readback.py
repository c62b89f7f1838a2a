"""Which variant of moving pixels between GPU and slot is the fastest on this driver?

Rule: all variants move the same bytes, and run in interleaved rounds. Readbacks are timed twice: with an idle GPU, and
directly after a draw. Poses, pictures and slots change from round to round.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import asdict
from functools import partial
from typing import Any

import numpy as np

from trilane.arrays import U8
from trilane.bench.lib.fixture import ENCODING, WARM_UP, interleaved_ms, standing, summary_ms
from trilane.bench.lib.interleaved_processes import INPUTS, SLOTS
from trilane.errors import TrilaneError
from trilane.stages.gpu import opengl
from trilane.stages.gpu.opengl import describe, open_context
from trilane.stages.gpu.raster import PackedAvatar, PackedPass, Placement
from trilane.stages.gpu.skinned_mesh import SkinnedMesh
from trilane.units import CHANNELS

SIZES = (256, 512, 1024)
TIME_SOURCES = {
    True: "host clock around calls that wait for the GPU",
    False: "host clock: a software driver, the GPU's work is CPU time",
}


def measure(
    sizes: Sequence[int] = SIZES, channels: Sequence[int] = CHANNELS, repeats: int = 20, threads: int = 1
) -> dict[str, Any]:
    """Measure how long each variant takes to move pixels, by size and number of channels.

    `rows` has a row for each variant, size and number of channels:
    `kind`: readback or upload.
    `size`: side of the square tensor or picture.
    `channels`: number of channels.
    `way`: name of the variant.
    `lag`: how many frames later the bytes arrive.
    `move`: time to move the bytes with an idle GPU; for an upload, also to copy them to another framebuffer.
    `turn`, only for readbacks: time to draw the tensor and move the bytes.
    Each time has median, minimum and 90th percentile in ms.

    `fastest`: variant with the smallest sum of medians, by kind. On a hardware driver, the medians of `turn` count for
    readbacks; in all other cases, the medians of `move` count.
    `driver`: facts about the OpenGL driver.
    `time_source`: clock of the times.
    `config`: settings of the bench.

    Raises MissingPartError without OpenGL, TrilaneError if the variants give different bytes.
    """
    ctx = open_context(threads)
    driver = describe(ctx)
    rows = [row for size in sizes for count in channels for row in _readback_rows(ctx, size, count, repeats)]
    rows += [row for size in sizes for row in _upload_rows(ctx, size, repeats)]
    return {
        "rows": rows,
        "fastest": {
            "readback": _fastest(rows, "readback", "turn" if driver.hardware else "move"),
            "upload": _fastest(rows, "upload", "move"),
        },
        "driver": asdict(driver),
        "time_source": TIME_SOURCES[driver.hardware],
        "config": {"repeats": repeats, "threads": threads},
    }


def _readback_rows(ctx: Any, size: int, channels: int, repeats: int) -> list[dict[str, Any]]:
    shape = (size, size)
    fixture = standing(channels)
    packed = PackedPass(ctx, channels, ENCODING, deferred=not describe(ctx).hardware)
    avatar = PackedAvatar(packed, SkinnedMesh(ctx, fixture.arrays), fixture.texture)
    variants = {name: make(ctx, size * size * channels) for name, make in READBACKS.items()}
    tensors = {name: np.zeros((SLOTS, size * size * channels), np.uint8) for name in READBACKS}

    def draw(number: int) -> None:
        placement = Placement(fixture.joints(number), fixture.projection, (0, 0, *shape))
        avatar.draw(packed.begin(shape), fixture.view, placement)

    def drawn(number: int) -> None:
        draw(number)
        ctx.finish()

    def move(variant: Readback, slots: Any, number: int) -> None:
        variant.submit(packed.target(shape).words, (0, 0, size, size), packed.layers, slots[number % SLOTS])

    def turn(variant: Readback, slots: Any, number: int) -> None:
        draw(number)
        move(variant, slots, number)

    def timed(run: Any, prepare: Callable[[int], None] = lambda _: None) -> dict[str, list[float]]:
        runs = {name: partial(run, variant, tensors[name]) for name, variant in variants.items()}
        times = interleaved_ms(runs, repeats, prepare)
        for name, variant in variants.items():
            variant.drain()
            if not np.array_equal(tensors[name], tensors["direct"]):
                raise TrilaneError(f"readback {name} gave other bytes than direct")
        return times

    turns, moves = timed(turn), timed(move, drawn)
    facts = {"kind": "readback", "size": size, "channels": channels}
    return [
        {**facts, "way": name, "lag": variant.lag, "move": summary_ms(moves[name]), "turn": summary_ms(turns[name])}
        for name, variant in variants.items()
    ]


def _upload_rows(ctx: Any, size: int, repeats: int) -> list[dict[str, Any]]:
    images = np.random.default_rng(0).integers(0, 256, (INPUTS, size * size * 4), dtype=np.uint8)
    slots = np.empty((SLOTS, size * size * 4), np.uint8)
    target = ctx.framebuffer([ctx.texture((size, size), 4)])
    textures = {name: ctx.texture((size, size), 4) for name in UPLOADS}

    def fill(number: int) -> None:
        slots[number % SLOTS] = images[number % INPUTS]

    def move(variant: Upload, texture: Any, source: Any, number: int) -> None:
        variant.write(texture, slots[number % SLOTS])
        ctx.copy_framebuffer(target, source)
        ctx.finish()

    times = interleaved_ms(
        {
            name: partial(move, make(ctx, slots[0].nbytes), textures[name], ctx.framebuffer([textures[name]]))
            for name, make in UPLOADS.items()
        },
        repeats,
        fill,
    )
    read, last = np.empty_like(slots[0]), images[(WARM_UP + repeats - 1) % INPUTS]
    for name, texture in textures.items():
        texture.read_into(read)
        if not np.array_equal(read, last):
            raise TrilaneError(f"upload {name} gave other bytes than were written")
    facts = {"kind": "upload", "size": size, "channels": 4, "lag": 0}
    return [{**facts, "way": name, "move": summary_ms(moves)} for name, moves in times.items()]


def _fastest(rows: list[dict[str, Any]], kind: str, figure: str) -> str:
    sums: dict[str, float] = {}
    for row in rows:
        if row["kind"] == kind:
            sums[row["way"]] = sums.get(row["way"], 0.0) + row[figure]["median_ms"]
    return min(sums, key=lambda variant: sums[variant])


# Variants of moving pixels between the GPU and a slot.
#
# Rule: every variant gives the same bytes. The variants differ in when the caller waits.

Box = tuple[int, int, int, int]
RING = 3


class Readback:
    """Reads part of a framebuffer of 32-bit unsigned words into a slot. The caller waits until the driver has copied.

    `lag`: number of further submits after which the bytes arrive.
    """

    lag = 0

    def __init__(self, ctx: Any, most_bytes: int) -> None:
        """Do nothing: no memory is needed. `most_bytes`: size of the largest tensor, for variants with buffers."""

    def submit(self, target: Any, box: Box, words: int, tensor: U8) -> None:
        """Start a read.

        `target`: framebuffer.
        `box`: (x, y, width, height) of the part in pixels.
        `words`: number of words of a pixel.
        `tensor`: array that gets the bytes, `lag` submits later.
        """
        target.read_into(tensor, box, components=words, dtype="u4", alignment=1)

    def drain(self) -> None:
        """Finish all reads, so that every submitted tensor has its bytes."""


class PboReadback(Readback):
    """A readback through a pixel buffer. The driver copies to the buffer, and the caller from the buffer to the slot.

    `orphan`: whether the buffer gets new memory for each frame.
    """

    orphan = False

    def __init__(self, ctx: Any, most_bytes: int) -> None:
        self._buffer = ctx.buffer(reserve=most_bytes)

    def submit(self, target: Any, box: Box, words: int, tensor: U8) -> None:
        """Read to the buffer, and copy from the buffer to `tensor`."""
        if self.orphan:
            self._buffer.orphan()
        target.read_into(self._buffer, box, components=words, dtype="u4", alignment=1)
        self._buffer.read_into(tensor, size=tensor.nbytes)


class OrphanPboReadback(PboReadback):
    """A `PboReadback` with new memory for each frame, so that the driver need not wait for the old memory."""

    orphan = True


class RingReadback(Readback):
    """A readback through a ring of pixel buffers with fences.

    A buffer's bytes are copied to their slot only when the next read needs the buffer, `lag` submits later.
    """

    lag = RING - 1

    def __init__(self, ctx: Any, most_bytes: int) -> None:
        self._free = deque(ctx.buffer(reserve=most_bytes) for _ in range(RING))
        self._waiting: deque[tuple[Any, int, U8]] = deque()

    def submit(self, target: Any, box: Box, words: int, tensor: U8) -> None:
        """Start a read; if no buffer is free after that, finish the oldest read."""
        buffer = self._free.popleft()
        target.read_into(buffer, box, components=words, dtype="u4", alignment=1)
        self._waiting.append((buffer, opengl.fence(), tensor))
        if not self._free:
            self._finish()

    def drain(self) -> None:
        """Finish all reads, the oldest first."""
        while self._waiting:
            self._finish()

    def _finish(self) -> None:
        buffer, sync, tensor = self._waiting.popleft()
        opengl.wait_fence(sync)
        buffer.read_into(tensor, size=tensor.nbytes)
        self._free.append(buffer)


READBACKS: dict[str, Callable[[Any, int], Readback]] = {
    "direct": Readback,
    "pbo": PboReadback,
    "pbo-orphan": OrphanPboReadback,
    "pbo-ring": RingReadback,
}


class Upload:
    """Writes the bytes of a slot to a texture: the driver copies directly from the slot."""

    def __init__(self, ctx: Any, most_bytes: int) -> None:
        """Do nothing: no memory is needed."""

    def write(self, texture: Any, image: U8) -> None:
        """Write `image` to `texture`. After the call, the caller may change `image`."""
        texture.write(image, alignment=1)


class OrphanUpload(Upload):
    """An upload through one pixel buffer that gets new memory for each frame."""

    def __init__(self, ctx: Any, most_bytes: int) -> None:
        self._buffer = ctx.buffer(reserve=most_bytes)

    def write(self, texture: Any, image: U8) -> None:
        """Copy `image` to new memory of the buffer, from which the driver copies to `texture`."""
        self._buffer.orphan()
        self._buffer.write(image)
        texture.write(self._buffer, alignment=1)


class RingUpload(Upload):
    """An upload through a ring of pixel buffers. A buffer is written again only after the GPU has passed its fence."""

    def __init__(self, ctx: Any, most_bytes: int) -> None:
        self._ring: deque[tuple[Any, int | None]] = deque((ctx.buffer(reserve=most_bytes), None) for _ in range(RING))

    def write(self, texture: Any, image: U8) -> None:
        """Copy `image` to the oldest buffer of the ring, from which the driver copies to `texture`."""
        buffer, sync = self._ring.popleft()
        if sync is not None:
            opengl.wait_fence(sync)
        buffer.write(image)
        texture.write(buffer, alignment=1)
        self._ring.append((buffer, opengl.fence()))


UPLOADS: dict[str, Callable[[Any, int], Upload]] = {"sub": Upload, "orphan": OrphanUpload, "ring": RingUpload}
