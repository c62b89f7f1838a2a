"""The OpenGL context of the GPU unit.

Rule: one off-screen EGL context per process, hardware or software; no other file creates one.
"""

from __future__ import annotations

import ctypes
import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from typing import Any

import moderngl

from trilane.errors import MissingPartError, TrilaneError, UnitLostError
from trilane.install import EGL_LINE

REQUIRED_VERSION = 330
CONTEXT = "OpenGL context"  # its key among what the stages of the unit share
LIBRARY = "libEGL.so.1"  # eglGetProcAddress gives every OpenGL function, so libGL need not be there
SOFTWARE_RENDERERS = ("llvmpipe", "softpipe", "swr", "swiftshader", "swrast")


@dataclass(frozen=True)
class Driver:
    """The OpenGL driver. `hardware` is False for a renderer that runs on the CPU."""

    vendor: str
    renderer: str
    version: str
    hardware: bool


def open_context(threads: int | None = None) -> Any:
    """A new off-screen `moderngl.Context` of OpenGL 3.3 or later, current on the calling thread.

    `threads`: CPU threads that a software driver may use, the calling thread included; Mesa reads the number once, when
    the process makes its first context. Raises MissingPartError when no context can be made.
    """
    if threads is not None:
        os.environ["LP_NUM_THREADS"] = str(threads if threads > 1 else 0)
    try:
        create: Any = moderngl.create_context
        return create(require=REQUIRED_VERSION, standalone=True, backend="egl", libegl=LIBRARY, libgl=LIBRARY)
    except Exception as error:  # moderngl and glcontext raise bare Exception
        raise MissingPartError(f"no OpenGL 3.3 context through EGL ({error})", EGL_LINE) from error


def check(ctx: Any) -> None:
    """Raises UnitLostError when the context was lost, TrilaneError when a call since the last check failed.

    Without a current context OpenGL calls do nothing and report no error, so an old tensor would look like a new one.
    """
    error = ctx.error if current() else "GL_CONTEXT_LOST"
    if error == "GL_CONTEXT_LOST":
        raise UnitLostError("the OpenGL context was lost")
    if error != "GL_NO_ERROR":
        raise TrilaneError(f"OpenGL reports {error}: its memory ran out, or a call was wrong")


@contextmanager
def checked(ctx: Any) -> Iterator[None]:
    """Run the block, then `check`. An exception raised while there is no current context becomes UnitLostError."""
    try:
        yield
    except Exception as error:
        if current():
            raise
        raise UnitLostError("the OpenGL context was lost") from error
    check(ctx)


def current() -> bool:
    """Whether the calling thread has a current EGL context."""
    return bool(_current_context()())


@cache
def _current_context() -> Any:
    call = ctypes.CDLL(LIBRARY).eglGetCurrentContext
    call.restype, call.argtypes = ctypes.c_void_p, ()
    return call


def describe(ctx: Any) -> Driver:
    """The driver of `ctx`, by the names it gives itself."""
    info = ctx.info
    renderer = str(info["GL_RENDERER"])
    software = any(name in renderer.lower() for name in SOFTWARE_RENDERERS)
    return Driver(str(info["GL_VENDOR"]), renderer, str(info["GL_VERSION"]), not software)
