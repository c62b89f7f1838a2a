"""Raw OpenGL calls that moderngl has no method for.

Rule: thin; one table of signatures, no state. Every call needs the context current on its thread.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from typing import Any

from trilane.errors import MissingPartError, TrilaneError
from trilane.install import EGL_LINE
from trilane.stages.gpu.context import LIBRARY

COLOR, DEPTH = 0x1800, 0x1801
SYNC_GPU_COMMANDS_COMPLETE, SYNC_FLUSH_COMMANDS = 0x9117, 1
TIMEOUT_EXPIRED, WAIT_FAILED = 0x911B, 0x911D
FRAMEBUFFER_SRGB = 0x8DB9
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
}


@cache
def function(name: str) -> Callable[..., Any]:
    """OpenGL function `name`. Raises MissingPartError when the driver lacks it."""
    library = ctypes.CDLL(LIBRARY)
    library.eglGetProcAddress.restype = ctypes.c_void_p
    address = library.eglGetProcAddress(name.encode())
    if not address:
        raise MissingPartError(f"the OpenGL driver lacks {name}", EGL_LINE)
    result, arguments = _SIGNATURES[name]
    call: Callable[..., Any] = ctypes.CFUNCTYPE(result, *arguments)(address)
    return call


def clear_unsigned(value: tuple[int, int, int, int]) -> None:
    """Fill colour attachment 0 of the bound framebuffer, an unsigned integer format, with `value`."""
    function("glClearBufferuiv")(COLOR, 0, (ctypes.c_uint * 4)(*value))


def clear_depth() -> None:
    """Fill the depth of the bound framebuffer with 1."""
    function("glClearBufferfv")(DEPTH, 0, (ctypes.c_float * 1)(1.0))


def fence() -> int:
    """A fence behind every command given so far; to be waited for once."""
    return int(function("glFenceSync")(SYNC_GPU_COMMANDS_COMPLETE, 0))


def wait_fence(sync: int, timeout_ns: int = 1_000_000_000) -> None:
    """Wait for a fence and delete it. Raises TrilaneError when it does not come in time."""
    result = function("glClientWaitSync")(sync, SYNC_FLUSH_COMMANDS, timeout_ns)
    function("glDeleteSync")(sync)
    if result in (TIMEOUT_EXPIRED, WAIT_FAILED):
        raise TrilaneError(f"the GPU did not finish within {timeout_ns / 1e9:g} s")


@contextmanager
def srgb_target() -> Iterator[None]:
    """Within it, draws into an sRGB target blend in linear light; outside, bytes are written as they are."""
    function("glEnable")(FRAMEBUFFER_SRGB)
    try:
        yield
    finally:
        function("glDisable")(FRAMEBUFFER_SRGB)
