"""Raw OpenGL calls that moderngl has no method for.

Rule: one table of signatures and no state; the calling thread must have the context current.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from typing import Any

from trilane.errors import MissingPartError, TrilaneError
from trilane.install import EGL_LINE
from trilane.stages.gpu.opengl_context import LIBRARY

COLOR, DEPTH = 0x1800, 0x1801
SYNC_GPU_COMMANDS_COMPLETE, SYNC_FLUSH_COMMANDS = 0x9117, 1
TIMEOUT_EXPIRED, WAIT_FAILED = 0x911B, 0x911D
FRAMEBUFFER_SRGB = 0x8DB9
TEXTURE_2D_ARRAY, RGBA, HALF_FLOAT, UNPACK_ALIGNMENT = 0x8C1A, 0x1908, 0x140B, 0x0CF5
SRGB8_ALPHA8 = 0x8C43

_INT, _UINT, _PTR = ctypes.c_int, ctypes.c_uint, ctypes.c_void_p
_SIGNATURES: dict[str, tuple[Any, tuple[Any, ...]]] = {
    "glClearBufferuiv": (None, (_UINT, _INT, _PTR)),
    "glClearBufferfv": (None, (_UINT, _INT, _PTR)),
    "glFenceSync": (_PTR, (_UINT, _UINT)),
    "glClientWaitSync": (_UINT, (_PTR, _UINT, ctypes.c_uint64)),
    "glDeleteSync": (None, (_PTR,)),
    "glEnable": (None, (_UINT,)),
    "glDisable": (None, (_UINT,)),
    "glBindTexture": (None, (_UINT, _UINT)),
    "glPixelStorei": (None, (_UINT, _INT)),
    "glTexSubImage3D": (None, (_UINT, *(_INT,) * 7, _UINT, _UINT, _PTR)),
}


@cache
def function(name: str) -> Callable[..., Any]:
    """OpenGL function `name` of `_SIGNATURES`. Raises MissingPartError when the driver lacks it."""
    library = ctypes.CDLL(LIBRARY)
    library.eglGetProcAddress.restype = ctypes.c_void_p
    address = library.eglGetProcAddress(name.encode())
    if not address:
        raise MissingPartError(f"the OpenGL driver lacks {name}", EGL_LINE)
    result, arguments = _SIGNATURES[name]
    call: Callable[..., Any] = ctypes.CFUNCTYPE(result, *arguments)(address)
    return call


def clear_unsigned(value: tuple[int, int, int, int]) -> None:
    """Fill colour attachment 0 of the bound framebuffer, which has an unsigned integer format, with `value`."""
    function("glClearBufferuiv")(COLOR, 0, (ctypes.c_uint * 4)(*value))


def clear_depth() -> None:
    """Fill the bound framebuffer's depth with 1, the greatest depth."""
    function("glClearBufferfv")(DEPTH, 0, (ctypes.c_float * 1)(1.0))


def write_level(texture: int, level: int, size: tuple[int, int, int], pixels: bytes) -> None:
    """Put half-float RGBA `pixels` into a `level` of array texture `texture`; `size`: width, height, layers of it."""
    function("glBindTexture")(TEXTURE_2D_ARRAY, texture)
    function("glPixelStorei")(UNPACK_ALIGNMENT, 1)
    function("glTexSubImage3D")(TEXTURE_2D_ARRAY, level, 0, 0, 0, *size, RGBA, HALF_FLOAT, pixels)
    function("glBindTexture")(TEXTURE_2D_ARRAY, 0)


def fence() -> int:
    """A fence after every command issued so far. It must be passed to `wait_fence` exactly once."""
    return int(function("glFenceSync")(SYNC_GPU_COMMANDS_COMPLETE, 0))


def wait_fence(sync: int, timeout_ns: int = 1_000_000_000) -> None:
    """Wait for fence `sync` and delete it. Raises TrilaneError when the GPU does not reach it within `timeout_ns`."""
    result = function("glClientWaitSync")(sync, SYNC_FLUSH_COMMANDS, timeout_ns)
    function("glDeleteSync")(sync)
    if result in (TIMEOUT_EXPIRED, WAIT_FAILED):
        raise TrilaneError(f"the GPU did not finish within {timeout_ns / 1e9:g} s")


@contextmanager
def srgb_target() -> Iterator[None]:
    """Draws inside the block blend in linear light when the target is sRGB; outside it bytes are written unchanged."""
    function("glEnable")(FRAMEBUFFER_SRGB)
    try:
        yield
    finally:
        function("glDisable")(FRAMEBUFFER_SRGB)
