"""GLSL sources of `trilane.shaders`, specialised by preprocessor definitions.

Rule: a shader is a file of its own; Python adds only `#define NAME VALUE` lines after its `#version`.
"""

from __future__ import annotations

from importlib.resources import files
from pathlib import Path
from typing import Any

import moderngl

from trilane.errors import TrilaneError


def shader_source(name: str | Path, **defines: int | str) -> str:
    """Text of shader `name` (a file of `trilane.shaders`, or a path) with the definitions inserted."""
    text = name.read_text() if isinstance(name, Path) else (files("trilane.shaders") / name).read_text()
    version, _, body = text.partition("\n")
    lines = [version, *(f"#define {key} {value}" for key, value in defines.items()), "#line 2", body]
    return "\n".join(lines)


def build_program(ctx: Any, vertex: str | Path, fragment: str | Path, **defines: int | str) -> Any:
    """A linked program of two shader files that share `defines`. Raises TrilaneError with the compiler's log."""
    try:
        return ctx.program(shader_source(vertex, **defines), shader_source(fragment, **defines))
    except moderngl.Error as error:
        raise TrilaneError(f"shaders {vertex} and {fragment}: {error}") from error


def set_uniforms(program: Any, values: dict[str, Any]) -> None:
    """Set the uniforms of `values` that the compiler kept."""
    for name, value in values.items():
        if name in program:
            program[name].value = value
