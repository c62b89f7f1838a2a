"""OpenGL for the GPU unit: the context, calls that moderngl lacks, programs, copies and camera matrices.

There is one off-screen EGL context per process, on hardware or in software. Only this file creates a context. The
context must be current on the calling thread. Each shader is a file of `trilane.shaders`; Python only adds `#define
NAME VALUE` lines after its `#version`.

Functions of this file make all copies of a frame's data between the CPU's memory and the GPU's, and count their bytes.
A context has one counter, because the stages that draw with it do one job at a time. A software driver copies within
the same memory, and such copies count too.

A target's first row in memory is the top row of the image. Therefore `target_clip` flips y in the projection, and
`avatar.vert` flips y of crop rectangles.
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
from trilane.units import NS_PER_S

REQUIRED_VERSION = 330
CONTEXT = "OpenGL context"  # key of the context in `UnitContext.shared`
LIBRARY = "libEGL.so.1"  # eglGetProcAddress gives every OpenGL function, so libGL is not needed
SOFTWARE_RENDERERS = ("llvmpipe", "softpipe", "swr", "swiftshader", "swrast")


@dataclass(frozen=True)
class Driver:
    """The OpenGL driver. `hardware`: False for a renderer that runs on the CPU."""

    vendor: str
    renderer: str
    version: str
    hardware: bool


def open_context(threads: int | None = None) -> Any:
    """Return a new off-screen `moderngl.Context` of OpenGL 3.3 or later, current on the calling thread.

    `threads`: number of CPU threads that a software driver may use, including the calling thread. Mesa reads this
    number only when the process makes its first context.

    Raises MissingPartError if no context can be made.
    """
    if threads is not None:
        os.environ["LP_NUM_THREADS"] = str(threads if threads > 1 else 0)
    if "torch" in sys.modules:
        # PyTorch's compiler and Mesa each load an LLVM. If Mesa's is first, the compiler ends the process (SIGSEGV).
        with suppress(ModuleNotFoundError):
            import_module("triton")
    try:
        create: Any = moderngl.create_context
        return create(require=REQUIRED_VERSION, standalone=True, backend="egl", libegl=LIBRARY, libgl=LIBRARY)
    except Exception as error:  # moderngl and glcontext raise bare Exception
        raise MissingPartError(f"no OpenGL 3.3 context through EGL ({error})", EGL_LINE) from error


def check(ctx: Any) -> None:
    """Raise UnitLostError if the context was lost, TrilaneError if a call since the last check failed.

    Without a current context, OpenGL calls do nothing and report no error, so an old tensor would pass for a new one.
    """
    error = ctx.error if current() else "GL_CONTEXT_LOST"
    if error == "GL_CONTEXT_LOST":
        raise UnitLostError("the OpenGL context was lost")
    if error != "GL_NO_ERROR":
        raise TrilaneError(f"OpenGL reports {error}: its memory ran out, or a call was wrong")


@contextmanager
def checked(ctx: Any) -> Iterator[None]:
    """Call `check` after the `with` block. If the block raises without a current context, raise UnitLostError."""
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
    """Return the driver of `ctx`, from its own strings."""
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
    """Return the OpenGL function `name`, a key of `_SIGNATURES`. Raises MissingPartError if the driver lacks it."""
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
    """Fill the bound framebuffer's depth with 1, the largest depth."""
    function("glClearBufferfv")(DEPTH, 0, (ctypes.c_float * 1)(1.0))


def write_level(texture: int, level: int, size: tuple[int, int, int], pixels: bytes) -> None:
    """Write one level of an array texture.

    `texture`: OpenGL name of the texture.
    `level`: number of the level.
    `size`: (width, height, layers) of the level.
    `pixels`: FP16 RGBA numbers, layer by layer.
    """
    function("glBindTexture")(TEXTURE_2D_ARRAY, texture)
    function("glPixelStorei")(UNPACK_ALIGNMENT, 1)
    function("glTexSubImage3D")(TEXTURE_2D_ARRAY, level, 0, 0, 0, *size, RGBA, HALF_FLOAT, pixels)
    function("glBindTexture")(TEXTURE_2D_ARRAY, 0)


def fence() -> int:
    """Return a fence after all commands so far. Pass it to `wait_fence` exactly once."""
    return int(function("glFenceSync")(SYNC_GPU_COMMANDS_COMPLETE, 0))


def wait_fence(sync: int) -> None:
    """Wait for the fence `sync` and delete it. Raises TrilaneError if that fails or takes over a second."""
    result = function("glClientWaitSync")(sync, SYNC_FLUSH_COMMANDS, int(NS_PER_S))
    function("glDeleteSync")(sync)
    if result in (TIMEOUT_EXPIRED, WAIT_FAILED):
        raise TrilaneError("the GPU did not finish within 1 s")


@contextmanager
def srgb_target() -> Iterator[None]:
    """Blend in linear light inside the `with` block, if the target is sRGB; outside, bytes are not converted."""
    function("glEnable")(FRAMEBUFFER_SRGB)
    try:
        yield
    finally:
        function("glDisable")(FRAMEBUFFER_SRGB)


def shader_source(name: str | Path, **defines: int | str) -> str:
    """Return the text of a shader with definitions. `name`: file of `trilane.shaders`, or a path."""
    file = name if isinstance(name, Path) else files("trilane.shaders") / name
    text = file.read_text(encoding="utf-8")
    version, _, body = text.partition("\n")
    lines = [version, *(f"#define {key} {value}" for key, value in defines.items()), "#line 2", body]
    return "\n".join(lines)


def build_program(ctx: Any, vertex: str | Path, fragment: str | Path, **defines: int | str) -> Any:
    """Return a linked program of two shaders.

    `ctx`: OpenGL context.
    `vertex`, `fragment`: files of `trilane.shaders`, or paths.
    `defines`: preprocessor definitions of both shaders.
    Raises TrilaneError with the compiler's log if a shader does not compile.
    """
    try:
        return ctx.program(shader_source(vertex, **defines), shader_source(fragment, **defines))
    except moderngl.Error as error:
        raise TrilaneError(f"shaders {vertex} and {fragment}: {error}") from error


def set_uniforms(program: Any, values: dict[str, Any]) -> None:
    """Set the uniforms `values` by name; a uniform that the shader's compiler removed is ignored."""
    for name, value in values.items():
        if name in program:
            program[name].value = value


def counter_of(ctx: Any) -> ByteCounter:
    """Return the byte counter of the context `ctx`, which is made on first use."""
    if ctx.extra is None:
        ctx.extra = ByteCounter()
    counter: ByteCounter = ctx.extra
    return counter


def upload(ctx: Any, target: Any, data: Any, **how: Any) -> None:
    """Write data to the GPU, and count its bytes.

    `target`: buffer, texture, or uniform that is an array.
    `data`: bytes or a contiguous array.
    `how`: further arguments of `target.write`.
    """
    target.write(data, **how)
    counter_of(ctx).uploaded += memoryview(data).nbytes


def uploaded_buffer(ctx: Any, data: bytes) -> Any:
    """Return a new buffer with the content `data`, and count its bytes."""
    counter_of(ctx).uploaded += len(data)
    return ctx.buffer(data)


def read_into(ctx: Any, framebuffer: Any, pixels: U8, *box: Any, **how: Any) -> None:
    """Copy `framebuffer` into the whole array `pixels`, and count its bytes.

    `box`, `how`: further arguments of `Framebuffer.read_into`.
    """
    framebuffer.read_into(pixels, *box, **how)
    counter_of(ctx).read_back += pixels.nbytes


FLIP_Y = np.diag([1.0, -1.0, 1.0, 1.0])


def target_clip(view: Floats, projection: Floats) -> bytes:
    """Return the matrix `clip_from_world` of a target whose first row is the top row, as bytes of a GLSL `mat4`.

    The bytes are column-major float32. `view`, `projection`: OpenGL matrices (4,4).
    """
    clip = FLIP_Y @ np.asarray(projection, np.float64) @ np.asarray(view, np.float64)
    return clip.T.astype(np.float32).tobytes()


def eye_of(view: Floats) -> NDArray[np.float64]:
    """Return the position (3,) of the camera, metres, world space. `view`: matrix (4,4), rotation and translation."""
    rotation = np.asarray(view, np.float64)[:3, :3]
    return -rotation.T @ np.asarray(view, np.float64)[:3, 3]
