"""Copies between the CPU's memory and the GPU's. Rule: every one of a frame is made here, and counted as it is made.

A context has one counter: the stages that draw with it do one job at a time. Software drivers copy in the same memory;
they copy all the same.
"""

from __future__ import annotations

from typing import Any

from trilane.arrays import U8
from trilane.pipeline.moved_bytes import ByteCounter


def counter_of(ctx: Any) -> ByteCounter:
    """The counter of context `ctx`, made on first use."""
    if ctx.extra is None:
        ctx.extra = ByteCounter()
    counter: ByteCounter = ctx.extra
    return counter


def upload(ctx: Any, target: Any, data: Any, **how: Any) -> None:
    """Write `data`, bytes or a contiguous array, to `target`: a buffer, a texture, or a uniform that is an array.

    `how`: what `target.write` takes.
    """
    target.write(data, **how)
    counter_of(ctx).uploaded += memoryview(data).nbytes


def uploaded_buffer(ctx: Any, data: bytes) -> Any:
    """A new buffer that holds `data`."""
    counter_of(ctx).uploaded += len(data)
    return ctx.buffer(data)


def read_into(ctx: Any, framebuffer: Any, pixels: U8, *box: Any, **how: Any) -> None:
    """Copy `framebuffer` into `pixels`, which it fills. `box`, `how`: what `Framebuffer.read_into` takes."""
    framebuffer.read_into(pixels, *box, **how)
    counter_of(ctx).read_back += pixels.nbytes
