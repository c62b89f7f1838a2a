"""What the GPU unit refuses, and how it speaks with its driver: quantisation, slots, threads, lost contexts, fences."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from trilane.errors import BadInputError, MissingPartError, TrilaneError, UnitLostError
from trilane.stages.config import Quantisation
from trilane.stages.gpu import opengl
from trilane.stages.gpu.opengl import shader_source
from trilane.stages.gpu.raster import PackedPass, check_texture


@pytest.mark.parametrize(("scale", "zero_point"), [(0.0, 0), (-1.0, 0), (np.nan, 0), (np.inf, 0), (1, -1), (1, 256)])
def test_a_quantisation_that_cannot_be_is_refused(scale: float, zero_point: int) -> None:
    with pytest.raises(BadInputError, match="quantisation"):
        Quantisation(scale, zero_point)


def test_textures_are_what_fp16_holds() -> None:
    check_texture(np.full((2, 3, 4), -65504.0), 4)
    check_texture(np.zeros((0, 3, 4)), 4)
    for wrong in (np.full((2, 3, 4), -65505.0), np.zeros((2, 3, 8)), np.zeros((2, 12)), np.zeros((1, 2, 3, 4))):
        with pytest.raises(BadInputError, match="neural texture"):
            check_texture(wrong, 4)
    mixed = np.zeros((2, 2, 4))
    mixed[1, 1, 3] = np.nan
    with pytest.raises(BadInputError, match="nan"):
        check_texture(mixed, 4)


@pytest.mark.parametrize(
    ("deferred", "filtering", "channels", "said"),
    [
        (False, "cubic", 4, "texture filter: found 'cubic', expected one of linear, mipmap, anisotropic"),
        (True, "mipmap", 4, "texture filter: found mipmap, expected linear; draw mesh and texture in one pass"),
        (False, "linear", 5, "network input: found 5 channels, expected 4, 8, 12 or 16; pad with zero channels"),
    ],
)
def test_what_a_packed_pass_cannot_do_is_said(deferred: bool, filtering: str, channels: int, said: str) -> None:
    with pytest.raises(BadInputError) as raised:
        PackedPass(None, channels, Quantisation(1.0, 0), deferred, filtering)
    assert str(raised.value) == said


def test_definitions_come_after_the_version_and_lines_keep_their_numbers() -> None:
    text = shader_source("whole_screen.vert", A=1, B="x")
    assert text.splitlines()[:4] == ["#version 330", "#define A 1", "#define B x", "#line 2"]
    assert text.splitlines()[4].startswith("// One triangle over the whole target")


def test_an_error_inside_is_the_contexts_only_when_that_is_lost(monkeypatch: pytest.MonkeyPatch) -> None:
    for current, kind in ((True, KeyError), (False, UnitLostError)):
        monkeypatch.setattr(opengl, "current", lambda here=current: here)
        with pytest.raises(kind), opengl.checked(SimpleNamespace(error="GL_NO_ERROR")):
            raise KeyError("x")
    monkeypatch.setattr(opengl, "current", lambda: True)
    with (
        pytest.raises(TrilaneError, match="GL_INVALID_VALUE"),
        opengl.checked(SimpleNamespace(error="GL_INVALID_VALUE")),
    ):
        pass


def test_a_function_that_the_driver_lacks_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    class Library:
        def __init__(self, _name: str) -> None:
            self.eglGetProcAddress = SimpleNamespace()
            self.eglGetProcAddress = type("Get", (), {"__call__": lambda _self, _name: None})()

    monkeypatch.setattr(opengl.ctypes, "CDLL", Library)
    with pytest.raises(MissingPartError, match="lacks glFenceSync"):
        opengl.function.__wrapped__("glFenceSync")
