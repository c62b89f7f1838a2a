"""OpenGL as the GPU unit uses it: the context, calls that moderngl lacks, programs, copies and camera matrices.

There is one off-screen EGL context per process, hardware or software. No other file creates one, and the calling thread
must have it current. Each shader is a file of `trilane.shaders`; Python only adds `#define NAME VALUE` lines after its
`#version`.

Every copy of a frame between the CPU's memory and the GPU's is made by a function here, and counted as it is made. A
context has one counter, because the stages that draw with it do one job at a time. Software drivers copy within the
same memory, and these copies count too.

A target's first row in memory is the top row of the image, so y is flipped in the projection by `target_clip`, and
nowhere else.
"""

from __future__ import annotations

import ctypes
import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import cache
from importlib import import_module
from importlib.resources import files
from pathlib import Path
from typing import Any

import moderngl
import numpy as np
from numpy.typing import NDArray

from trilane.arrays import U8, Floats
from trilane.errors import EGL_LINE, MissingPartError, TrilaneError, UnitLostError
from trilane.pipeline.memory import ByteCounter

REQUIRED_VERSION = 330
CONTEXT = "OpenGL context"  # key of the context among what the stages of the unit share
LIBRARY = "libEGL.so.1"  # eglGetProcAddress gives every OpenGL function, so libGL is not needed
SOFTWARE_RENDERERS = ("llvmpipe", "softpipe", "swr", "swiftshader", "swrast")


@dataclass(frozen=True)
class Driver:
    """The OpenGL driver.

    `hardware`: False for a renderer that runs on the CPU.
    """

    vendor: str
    renderer: str
    version: str
    hardware: bool


def open_context(threads: int | None = None) -> Any:
    """Open an off-screen `moderngl.Context` of OpenGL 3.3 or later, current on the calling thread.

    `threads`: number of CPU threads that a software driver may use, the calling thread included; Mesa reads it once,
    when the process makes its first context. Raises MissingPartError when no context can be made.
    """
    if threads is not None:
        os.environ["LP_NUM_THREADS"] = str(threads if threads > 1 else 0)
    if "torch" in sys.modules:
        # PyTorch's compiler and Mesa each bring LLVM. If Mesa's comes first, the compiler ends the process (SIGSEGV).
        with suppress(ModuleNotFoundError):
            import_module("triton")
    try:
        create: Any = moderngl.create_context
        return create(require=REQUIRED_VERSION, standalone=True, backend="egl", libegl=LIBRARY, libgl=LIBRARY)
    except Exception as error:  # moderngl and glcontext raise bare Exception
        raise MissingPartError(f"no OpenGL 3.3 context through EGL ({error})", EGL_LINE) from error


def check(ctx: Any) -> None:
    """Raise UnitLostError when the context was lost, TrilaneError when a call since the last check failed.

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
    """Return whether the calling thread has a current EGL context."""
    return bool(_current_context()())


@cache
def _current_context() -> Any:
    call = ctypes.CDLL(LIBRARY).eglGetCurrentContext
    call.restype, call.argtypes = ctypes.c_void_p, ()
    return call


def describe(ctx: Any) -> Driver:
    """Return the driver of `ctx`, by the names it gives itself."""
    info = ctx.info
    renderer = str(info["GL_RENDERER"])
    software = any(name in renderer.lower() for name in SOFTWARE_RENDERERS)
    return Driver(str(info["GL_VENDOR"]), renderer, str(info["GL_VERSION"]), not software)


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
    """Return OpenGL function `name` of `_SIGNATURES`. Raises MissingPartError when the driver lacks it."""
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
    """Write half-float RGBA `pixels` to a `level` of array texture `texture`.

    `size`: width, height and layers of the level.
    """
    function("glBindTexture")(TEXTURE_2D_ARRAY, texture)
    function("glPixelStorei")(UNPACK_ALIGNMENT, 1)
    function("glTexSubImage3D")(TEXTURE_2D_ARRAY, level, 0, 0, 0, *size, RGBA, HALF_FLOAT, pixels)
    function("glBindTexture")(TEXTURE_2D_ARRAY, 0)


def fence() -> int:
    """Return a fence after every command issued so far. It must be passed to `wait_fence` exactly once."""
    return int(function("glFenceSync")(SYNC_GPU_COMMANDS_COMPLETE, 0))


def wait_fence(sync: int, timeout_ns: int = 1_000_000_000) -> None:
    """Wait for fence `sync` and delete it. Raises TrilaneError when the GPU does not reach it within `timeout_ns`."""
    result = function("glClientWaitSync")(sync, SYNC_FLUSH_COMMANDS, timeout_ns)
    function("glDeleteSync")(sync)
    if result in (TIMEOUT_EXPIRED, WAIT_FAILED):
        raise TrilaneError(f"the GPU did not finish within {timeout_ns / 1e9:g} s")


@contextmanager
def srgb_target() -> Iterator[None]:
    """Draw inside the block with blending in linear light when the target is sRGB; outside, bytes are not converted."""
    function("glEnable")(FRAMEBUFFER_SRGB)
    try:
        yield
    finally:
        function("glDisable")(FRAMEBUFFER_SRGB)


def shader_source(name: str | Path, **defines: int | str) -> str:
    """Return the text of shader `name`, a file of `trilane.shaders` or a path, with the definitions inserted."""
    file = name if isinstance(name, Path) else files("trilane.shaders") / name
    text = file.read_text(encoding="utf-8")
    version, _, body = text.partition("\n")
    lines = [version, *(f"#define {key} {value}" for key, value in defines.items()), "#line 2", body]
    return "\n".join(lines)


def build_program(ctx: Any, vertex: str | Path, fragment: str | Path, **defines: int | str) -> Any:
    """Build and link a program of two shaders.

    `ctx`: OpenGL context.
    `vertex`, `fragment`: files of `trilane.shaders`, or paths.
    `defines`: preprocessor definitions of both.
    Raises TrilaneError with the compiler's log.
    """
    try:
        return ctx.program(shader_source(vertex, **defines), shader_source(fragment, **defines))
    except moderngl.Error as error:
        raise TrilaneError(f"shaders {vertex} and {fragment}: {error}") from error


def set_uniforms(program: Any, values: dict[str, Any]) -> None:
    """Set the uniforms of `values`; those that the shader's compiler removed are skipped."""
    for name, value in values.items():
        if name in program:
            program[name].value = value


def counter_of(ctx: Any) -> ByteCounter:
    """Return the counter of context `ctx`, made on first use."""
    if ctx.extra is None:
        ctx.extra = ByteCounter()
    counter: ByteCounter = ctx.extra
    return counter


def upload(ctx: Any, target: Any, data: Any, **how: Any) -> None:
    """Write `data`, bytes or a contiguous array, to `target`: a buffer, a texture, or a uniform that is an array.

    `how`: further arguments of `target.write`.
    """
    target.write(data, **how)
    counter_of(ctx).uploaded += memoryview(data).nbytes


def uploaded_buffer(ctx: Any, data: bytes) -> Any:
    """Return a new buffer that holds `data`."""
    counter_of(ctx).uploaded += len(data)
    return ctx.buffer(data)


def read_into(ctx: Any, framebuffer: Any, pixels: U8, *box: Any, **how: Any) -> None:
    """Copy `framebuffer` into `pixels`, which it fills.

    `box`, `how`: further arguments of `Framebuffer.read_into`.
    """
    framebuffer.read_into(pixels, *box, **how)
    counter_of(ctx).read_back += pixels.nbytes


FLIP_Y = np.diag([1.0, -1.0, 1.0, 1.0])


def target_clip(view: Floats, projection: Floats) -> bytes:
    """Return the matrix `clip_from_world` of a target whose first row is the top one.

    It is column-major float32 bytes of a `mat4`. `view`, `projection`: OpenGL matrices (4,4).
    """
    clip = FLIP_Y @ np.asarray(projection, np.float64) @ np.asarray(view, np.float64)
    return clip.T.astype(np.float32).tobytes()


def eye_of(view: Floats) -> NDArray[np.float64]:
    """Return the position (3,) of the camera in the world, metres; `view` (4,4) is a rotation and a translation."""
    rotation = np.asarray(view, np.float64)[:3, :3]
    return -rotation.T @ np.asarray(view, np.float64)[:3, 3]
