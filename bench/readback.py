"""Which way of moving pixels between GPU and slot is the fastest on this driver?

Rule: every way moves the same bytes, turn about: alone, and after a draw that it may hide behind.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from functools import partial
from typing import Any

import numpy as np

from trilane.bench.fixture import ENCODING, standing
from trilane.bench.gpu_buffering import READBACKS, UPLOADS, Readback, Upload
from trilane.bench.raster import interleaved, summary
from trilane.errors import TrilaneError
from trilane.stages.gpu.opengl_context import describe, open_context
from trilane.stages.gpu.packed_pass import CHANNELS, PackedAvatar, PackedPass, Placement
from trilane.stages.gpu.skinned_mesh import SkinnedMesh

SIZES = (256, 512, 1024)
TIME_SOURCES = {
    True: "host clock around calls that wait for the GPU",
    False: "host clock: a software driver, the GPU's work is CPU time",
}


def measure(
    sizes: Sequence[int] = SIZES, channels: Sequence[int] = CHANNELS, repeats: int = 20, threads: int = 1
) -> dict[str, Any]:
    """One row for each size, number of channels and way: `kind` (readback, upload), `way`, `lag`, `move`, `turn`.

    `move`: the copy alone, when nothing else is left to do (uploads: with a copy to another framebuffer). `turn`: with
    the draw of the tensor before it. `fastest`: for each kind the way with the smallest sum of medians, of `turn` on a
    hardware driver and of `move` on a software one, where nothing runs beside the caller. Raises MissingPartError.
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
    subject = standing(channels)
    packed = PackedPass(ctx, channels, ENCODING, deferred=not describe(ctx).hardware)
    avatar = PackedAvatar(packed, SkinnedMesh(ctx, subject.arrays), subject.texture)
    placement = Placement(subject.joints, subject.projection, (0, 0, *shape))
    ways = {name: make(ctx, size * size * channels) for name, make in READBACKS.items()}
    tensors = {name: np.zeros(size * size * channels, np.uint8) for name in READBACKS}

    def move(way: Readback, tensor: Any) -> None:
        way.submit(packed.target(shape).words, (0, 0, size, size), packed.layers, tensor)

    def turn(way: Readback, tensor: Any) -> None:
        avatar.draw(packed.begin(shape), subject.view, placement)
        move(way, tensor)

    turns = interleaved({name: partial(turn, way, tensors[name]) for name, way in ways.items()}, repeats)
    ctx.finish()
    moves = interleaved({name: partial(move, way, tensors[name]) for name, way in ways.items()}, repeats)
    for name, way in ways.items():
        way.drain()
        if not np.array_equal(tensors[name], tensors["direct"]):
            raise TrilaneError(f"readback {name} gave other bytes than direct")
    facts = {"kind": "readback", "size": size, "channels": channels}
    return [
        {**facts, "way": name, "lag": way.lag, "move": summary(moves[name]), "turn": summary(turns[name])}
        for name, way in ways.items()
    ]


def _upload_rows(ctx: Any, size: int, repeats: int) -> list[dict[str, Any]]:
    image = np.random.default_rng(0).integers(0, 256, size * size * 4, dtype=np.uint8)
    target = ctx.framebuffer([ctx.texture((size, size), 4)])
    textures = {name: ctx.texture((size, size), 4) for name in UPLOADS}

    def move(way: Upload, texture: Any, source: Any) -> None:
        way.write(texture, image)
        ctx.copy_framebuffer(target, source)
        ctx.finish()

    times = interleaved(
        {
            name: partial(move, make(ctx, image.nbytes), textures[name], ctx.framebuffer([textures[name]]))
            for name, make in UPLOADS.items()
        },
        repeats,
    )
    found = np.empty_like(image)
    for name, texture in textures.items():
        texture.read_into(found)
        if not np.array_equal(found, image):
            raise TrilaneError(f"upload {name} gave other bytes than it took")
    facts = {"kind": "upload", "size": size, "channels": 4, "lag": 0}
    return [{**facts, "way": name, "move": summary(taken)} for name, taken in times.items()]


def _fastest(rows: list[dict[str, Any]], kind: str, figure: str) -> str:
    ways: dict[str, float] = {}
    for row in rows:
        if row["kind"] == kind:
            ways[row["way"]] = ways.get(row["way"], 0.0) + row[figure]["median_ms"]
    return min(ways, key=lambda way: ways[way])
