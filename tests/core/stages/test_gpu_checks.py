"""What the GPU unit refuses, and how it speaks with its driver: quantisation, slots, threads, lost contexts, fences."""

from __future__ import annotations

import os
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from trilane.errors import BadInputError, MissingPartError, TrilaneError, UnitLostError
from trilane.stages.gpu import opengl
from trilane.stages.gpu.opengl import shader_source
from trilane.stages.gpu.packed_pass import PackedPass, Quantisation, check_texture
from trilane.stages.gpu.raster import RasterStage


@pytest.mark.parametrize(("scale", "zero_point"), [(0.0, 0), (-1.0, 0), (np.nan, 0), (np.inf, 0), (1, -1), (1, 256)])
def test_a_quantisation_that_cannot_be_is_refused(scale: float, zero_point: int) -> None:
    with pytest.raises(BadInputError, match="quantisation"):
        Quantisation(scale, zero_point)


@pytest.mark.parametrize("zero_point", [0, 255])
def test_zero_points_are_bytes(zero_point: int) -> None:
    assert Quantisation(1e-9, zero_point).zero_point == zero_point


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


def test_a_frame_without_avatars_is_the_zero_point() -> None:
    tensor = np.zeros(12, np.uint8)
    packed = PackedPass(None, 12, Quantisation(0.5, 200), deferred=True)
    packed.background(tensor)
    assert tensor.tolist() == [200] * 12
    assert packed.layers == 3
    assert packed.uniforms == {"neural": 0, "uv_image": 1, "scale": 0.5, "zero_point": 200.0}


@pytest.mark.parametrize("slots", [(None, 0), (0, None)])
def test_a_raster_needs_both_slots(slots: Any) -> None:
    with pytest.raises(ValueError, match="input and an output slot"):
        RasterStage(None, [], []).run(0, *slots)  # type: ignore[arg-type]


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


def test_every_shape_has_its_target_before_the_first_frame() -> None:
    made: list[Any] = []
    packed: Any = SimpleNamespace(target=made.append)
    RasterStage(packed, [], [(32, 64), (64, 32)]).bind([], [])
    assert made == [(32, 64), (64, 32)]


def test_definitions_come_after_the_version_and_lines_keep_their_numbers() -> None:
    text = shader_source("whole_screen.vert", A=1, B="x")
    assert text.splitlines()[:4] == ["#version 330", "#define A 1", "#define B x", "#line 2"]
    assert text.splitlines()[4].startswith("// One triangle over the whole target")


@pytest.mark.parametrize(("threads", "expected"), [(None, "kept"), (1, "0"), (2, "2"), (5, "5")])
def test_a_software_driver_gets_its_threads(
    monkeypatch: pytest.MonkeyPatch, threads: int | None, expected: str
) -> None:
    """The calling thread counts: one thread is none beside it."""
    monkeypatch.setenv("LP_NUM_THREADS", "kept")
    asked: dict[str, Any] = {}
    monkeypatch.setattr(opengl.moderngl, "create_context", lambda **given: asked.update(given) or "context")
    assert opengl.open_context(threads) == "context"
    assert os.environ["LP_NUM_THREADS"] == expected
    library = "libEGL.so.1"
    assert asked == {"require": 330, "standalone": True, "backend": "egl", "libegl": library, "libgl": library}


@pytest.mark.parametrize(
    ("renderer", "hardware"),
    [("NVIDIA H200", True), ("llvmpipe (LLVM 15)", False), ("SwiftShader", False), ("softpipe", False), ("SWR", False)],
)
def test_a_renderer_on_the_cpu_is_no_hardware(renderer: str, hardware: bool) -> None:
    info = {"GL_VENDOR": "v", "GL_RENDERER": renderer, "GL_VERSION": "4.5"}
    found = opengl.describe(SimpleNamespace(info=info))
    assert found == opengl.Driver("v", renderer, "4.5", hardware)


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


@pytest.mark.parametrize(("result", "failed"), [(0x911A, False), (0x911C, False), (0x911B, True), (0x911D, True)])
def test_a_fence_is_waited_for_once_and_deleted(monkeypatch: pytest.MonkeyPatch, result: int, failed: bool) -> None:
    calls = []

    def function(name: str) -> Any:
        return lambda *given: calls.append((name, *given)) or (result if name == "glClientWaitSync" else 77)

    monkeypatch.setattr(opengl, "function", function)
    assert opengl.fence() == 77
    if failed:
        with pytest.raises(TrilaneError, match=r"within 1 s"):
            opengl.wait_fence(77)
    else:
        opengl.wait_fence(77)
    assert calls == [("glFenceSync", 0x9117, 0), ("glClientWaitSync", 77, 1, 1_000_000_000), ("glDeleteSync", 77)]


def test_srgb_is_switched_off_again_whatever_happens(monkeypatch: pytest.MonkeyPatch) -> None:
    calls: list[Any] = []
    monkeypatch.setattr(opengl, "function", lambda name: lambda *given: calls.append((name, *given)))
    with pytest.raises(KeyError), opengl.srgb_target():
        raise KeyError("x")
    assert calls == [("glEnable", 0x8DB9), ("glDisable", 0x8DB9)]
