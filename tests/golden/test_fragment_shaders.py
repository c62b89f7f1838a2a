"""Each fragment shader alone, on targets of a few pixels in float32: every pixel against the formula in float64 NumPy.

Rule: triangles end between pixel centres, so coverage is exact on any driver, and bounds are float32's rounding.
"""

from __future__ import annotations

from typing import Any

import moderngl
import numpy as np
import pytest
from numpy.typing import NDArray

from trilane.arrays import F64
from trilane.stages.gpu.opengl import build_program

#: Metres and shares of a few units, after some ten roundings of float32.
NEAR = 1e-5
FLAT = np.eye(4)


def centres(shape: tuple[int, int]) -> tuple[F64, F64]:
    """Column and row of every pixel's centre as 0..1 of the target, (h,w) each."""
    row, column = (np.indices(shape) + 0.5) / np.array(shape)[:, None, None]
    return column, row


def drawn(
    gl: Any,
    vertex: str,
    fragment: str,
    shape: tuple[int, int],
    vertices: int,
    uniforms: dict[str, Any],
    mode: int = moderngl.TRIANGLES,
    content: Any = (),
    **defines: int | str,
) -> NDArray[np.float32]:
    """The target (h,w,4), in the order of its memory; -7 where nothing was drawn."""
    program = build_program(gl, vertex, fragment, **defines)
    for name, value in uniforms.items():
        if isinstance(value, np.ndarray):
            program[name].write(value.astype(np.float32).tobytes())
        elif name in program:
            program[name].value = value
    target = gl.framebuffer([gl.texture(shape[::-1], 4, dtype="f4")])
    target.use()
    target.clear(-7, -7, -7, -7)
    gl.enable_only(moderngl.NOTHING)
    gl.vertex_array(program, list(content)).render(mode, vertices=vertices)
    return np.frombuffer(target.read(components=4, dtype="f4"), np.float32).reshape(*shape, 4)


def texture_of(gl: Any, image: NDArray[np.floating], unit: int = 0) -> Any:
    """`image` (h,w,4) as a float32 texture, read without repeating, at `unit`."""
    texture = gl.texture(image.shape[1::-1], 4, image.astype(np.float32).tobytes(), dtype="f4")
    texture.repeat_x = texture.repeat_y = False
    texture.use(unit)
    return texture


@pytest.mark.parametrize("fragment", ["uv_and_coverage.frag", "uv_only.frag"])
def test_u_and_v_are_written_as_they_are(gl: Any, fragment: str) -> None:
    shape, uv = (4, 7), np.array([(0.1, 0.9), (0.6, 0.9), (0.1, 0.2), (0.6, 0.2)])
    corners = np.array([(-1, -1, 0), (1, -1, 0), (-1, 1, 0), (1, 1, 0)])
    buffer = gl.buffer(np.c_[corners, uv].astype(np.float32).tobytes())
    content = [(buffer, "3f 2f", "position", "uv")]
    uniforms = {"clip_from_world": FLAT}
    found = drawn(gl, "posed_vertices.vert", fragment, shape, 4, uniforms, moderngl.TRIANGLE_STRIP, content)
    column, row = centres(shape)
    np.testing.assert_allclose(found[..., 0], 0.1 + 0.5 * column, atol=NEAR)
    np.testing.assert_allclose(found[..., 1], 0.9 - 0.7 * row, atol=NEAR)
    if fragment == "uv_and_coverage.frag":
        assert (found[..., 2:] == 1).all()


def test_the_rooms_texture_is_multiplied_by_its_light(gl: Any) -> None:
    """Read at texel centres, where any filter gives the texel; opaque whatever the texture's alpha."""
    shape = (4, 6)
    image = np.random.default_rng(3).random((*shape, 4))
    texture_of(gl, image)
    corners = np.array([(-1, -1, 0), (1, -1, 0), (-1, 1, 0), (1, 1, 0)])
    uv, light = [(0, 0), (1, 0), (0, 1), (1, 1)], [(0.2, 0.4, 0.9), (0.8, 0.4, 0.9), (0.2, 0.7, 0.3), (0.8, 0.7, 0.3)]
    buffer = gl.buffer(np.c_[corners, uv, light].astype(np.float32).tobytes())
    content = [(buffer, "3f 2f 3f", "position", "uv", "light")]
    uniforms = {"clip_from_world": FLAT, "detail": 0}
    found = drawn(gl, "room.vert", "room.frag", shape, 4, uniforms, moderngl.TRIANGLE_STRIP, content)
    column, row = centres(shape)
    lit = np.stack([0.2 + 0.6 * column, 0.4 + 0.3 * row, 0.9 - 0.6 * row], axis=-1)
    np.testing.assert_allclose(found[..., :3], image[..., :3] * lit, atol=NEAR)
    assert (found[..., 3] == 1).all()


def sheet(across: F64, along: F64, dx: F64, dy: F64) -> F64:
    """Alpha of a plane (h,w): `across`, `along` in metres and half sides, `dx`, `dy` metres a pixel."""
    alpha = []
    for metres, half, step in ((across[0], across[1], dx), (along[0], along[1], dy)):
        to_line = np.abs(metres - 0.25 * np.rint(metres / 0.25))
        to_rim = half - np.abs(metres)
        alpha.append([np.clip(1 - np.maximum(distance, 0) / step, 0, 1) for distance in (to_line, to_rim)])
    crowded = np.clip(2 * max(dx, dy) / 0.25, 0, 1)
    shown = np.maximum(np.maximum(alpha[0][0], alpha[1][0]) * (1 - crowded), np.maximum(alpha[0][1], alpha[1][1]))
    return 0.10 + (0.45 - 0.10) * shown


@pytest.mark.parametrize("side_m", [0.8, 2.3, 9.0], ids=["lines", "closer lines", "lines too close"])
def test_a_plane_has_lines_and_a_rim(gl: Any, side_m: float) -> None:
    """White; alpha 0.10, 0.45 on a line every 0.25 m and at the rim, both a pixel wide, the lines fading with distance.

    The plane is not square and does not fill the target, so that its two sides cannot be exchanged.
    """
    shape = (24, 32)
    half = np.array([side_m / 2, side_m / 3])
    scale = np.array([1.5 / side_m, 2.4 / side_m])  # a metre in normalised device coordinates
    view = np.diag([*scale, 1, 1])
    uniforms = {
        "clip_from_world": view,
        "centre": np.zeros((1, 3)),
        "across": np.array([(half[0], 0, 0)]),
        "along": np.array([(0, half[1], 0)]),
    }
    found = drawn(gl, "plane.vert", "plane.frag", shape, 6, uniforms, PLANES=1)
    column, row = centres(shape)
    x, y = (2 * column - 1) / scale[0], (2 * row - 1) / scale[1]
    inside = (np.abs(x) < half[0]) & (np.abs(y) < half[1])
    step = 2 / scale / np.array(shape[::-1])
    expected = sheet((x, half[0]), (y, half[1]), *step)  # type: ignore[arg-type]
    assert 300 < inside.sum() < 500
    np.testing.assert_allclose(found[inside][:, 3], expected[inside], atol=1e-4)  # fract() of metres over a pixel
    assert (found[inside][:, :3] == 1).all()
    assert (found[~inside] == -7).all()


def encoded(light: F64) -> F64:
    """Linear light to sRGB, IEC 61966-2-1."""
    return np.where(light <= 0.0031308, 12.92 * light, 1.055 * np.maximum(light, 1e-9) ** (1 / 2.4) - 0.055)


@pytest.mark.parametrize("samples", [2, 4])
def test_samples_are_averaged_with_a_tent(gl: Any, samples: int) -> None:
    """Weights fall linearly from the pixel's middle to 0 at its neighbours' middles; colours count by their alpha."""
    shape, random = (4, 5), np.random.default_rng(samples)
    image = random.random((shape[0] * samples, shape[1] * samples, 4)) * [2.2, 0.004, 1, 1]
    image[:, : 2 * samples + 1, 3] = 0  # nothing is seen of the first columns, and a part of the next
    image[: 2 * samples, :, 3] *= 1e-3  # of the first row hardly anything, in full colour
    texture_of(gl, image)
    found = drawn(gl, "whole_screen.vert", "tent_filter.frag", shape, 3, {"samples": 0}, SAMPLES=samples)
    expected = np.zeros((*shape, 4))
    for row in range(shape[0]):
        for column in range(shape[1]):
            y = np.arange(samples * row - samples // 2, samples * row + samples + samples // 2)
            x = np.arange(samples * column - samples // 2, samples * column + samples + samples // 2)
            weights = [1 - np.abs((k + 0.5) / samples - n - 0.5) for k, n in ((y, row), (x, column))]
            weight = np.outer(*weights) / np.outer(*weights).sum()
            y, x = np.clip(y, 0, len(image) - 1), np.clip(x, 0, image.shape[1] - 1)
            texels = image[np.ix_(y, x)]
            alpha = (weight * texels[..., 3]).sum()
            colour = np.einsum("yx,yxc->c", weight * texels[..., 3], texels[..., :3])
            expected[row, column] = *encoded(np.clip(colour / max(alpha, 1e-6), 0, 1)), alpha
    np.testing.assert_allclose(found, expected, atol=NEAR)
    assert (found[:, 0] == 0).all()
    assert (found[..., 1].max() < 0.05) and (found[..., 0].max() > 0.9999)
