"""Builds OpenGL programs from the GLSL files of `trilane.shaders`.

Rule: each shader is a file of its own; Python only adds `#define NAME VALUE` lines after its `#version`.
"""

from __future__ import annotations

from importlib.resources import files
from pathlib import Path
from typing import Any

import moderngl

from trilane.errors import TrilaneError


def shader_source(name: str | Path, **defines: int | str) -> str:
    """Text of shader `name`, a file of `trilane.shaders` or a path, with the definitions inserted."""
    file = name if isinstance(name, Path) else files("trilane.shaders") / name
    text = file.read_text(encoding="utf-8")
    version, _, body = text.partition("\n")
    lines = [version, *(f"#define {key} {value}" for key, value in defines.items()), "#line 2", body]
    return "\n".join(lines)


def build_program(ctx: Any, vertex: str | Path, fragment: str | Path, **defines: int | str) -> Any:
    """A linked program of two shaders.

    `ctx`: the OpenGL context.
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
