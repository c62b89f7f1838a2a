"""Each vertex shader alone: what it writes, read back by transform feedback, against the formula in float64 NumPy.

Rule: no rasteriser takes part, so every number is compared to a few parts in a million.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from trilane.stages.gpu.opengl import shader_source

CLIP = np.array([[0.9, 0.1, -0.2, 0.3], [0.05, 1.1, 0.15, -0.4], [0.2, -0.3, 0.7, 0.6], [-0.1, 0.25, 0.35, 1.7]])
#: Two triangles of a rectangle: which side of its middle each of the six vertices lies on.
CORNERS = np.array([(-1, -1), (1, -1), (1, 1), (-1, -1), (1, 1), (-1, 1)], float)
#: Relative and absolute: float32 keeps 6e-8 of each of up to some hundred terms of size one.
NEAR = {"rtol": 1e-5, "atol": 1e-5}


def written(
    gl: Any,
    shader: str,
    outputs: dict[str, int],
    count: int,
    content: Sequence[Any] = (),
    uniforms: dict[str, Any] | None = None,
    textures: dict[str, Any] | None = None,
    **defines: int | str,
) -> dict[str, NDArray[np.float32]]:
    """What `shader` writes for vertices 0 to `count` - 1: `outputs` gives the numbers of each."""
    names = ["gl_Position", *outputs]
    widths = [4, *outputs.values()]
    program = gl.program(vertex_shader=shader_source(shader, **defines), varyings=names)
    for name, value in (uniforms or {}).items():
        if isinstance(value, np.ndarray):
            program[name].write(value.astype(np.float32).tobytes())
        elif isinstance(value, Block):
            program[name].binding = value
        else:
            program[name].value = value
    for unit, (name, texture) in enumerate((textures or {}).items()):
        texture.use(unit)
        program[name].value = unit
    gl.simple_framebuffer((1, 1)).use()  # without a target OpenGL draws nothing
    result = gl.buffer(reserve=count * sum(widths) * 4)
    gl.vertex_array(program, list(content)).transform(result, gl.POINTS, vertices=count)
    rows = np.frombuffer(result.read(), np.float32).reshape(count, -1)
    ends = np.cumsum(widths)
    return {name: rows[:, end - width : end] for name, end, width in zip(names, ends, widths, strict=True)}


class Block(int):
    """Where a uniform block is bound."""


def clip_of(world: NDArray[np.floating]) -> NDArray[np.float64]:
    return np.c_[world, np.ones(len(world))] @ CLIP.T


def test_one_triangle_covers_the_whole_target(gl: Any) -> None:
    """Its corners are (-1,-1), (3,-1) and (-1,3); `place` is 0 and 1 at the target's borders."""
    found = written(gl, "whole_screen.vert", {"place": 2}, 3)
    assert found["gl_Position"].tolist() == [[-1, -1, 0, 1], [3, -1, 0, 1], [-1, 3, 0, 1]]
    assert found["place"].tolist() == [[0, 0], [2, 0], [0, 2]]


def test_the_farthest_triangle_lies_at_depth_one(gl: Any) -> None:
    found = written(gl, "farthest.vert", {}, 3)
    assert found["gl_Position"].tolist() == [[-1, -1, 1, 1], [3, -1, 1, 1], [-1, 3, 1, 1]]


def test_a_part_of_the_avatar_lies_where_the_whole_has_it(gl: Any) -> None:
    """A quarter to a half across, a third to all of it down."""
    uniforms = {"rect": (-0.5, -0.75, 0.3, 1.5), "source": (0.1, 0.2, 0.9, 0.8)}
    part = [(gl.buffer(np.tile(np.float32((0.25, 1 / 3, 0.5, 1)), (4, 1)).tobytes()), "4f", "part")]
    found = written(gl, "avatar.vert", {"v_uv": 2}, 4, part, uniforms)
    expected = [[-0.3, -0.75, 0, 1], [-0.1, -0.75, 0, 1], [-0.3, 0.75, 0, 1], [-0.1, 0.75, 0, 1]]
    np.testing.assert_allclose(found["gl_Position"], expected, **NEAR)
    np.testing.assert_allclose(found["v_uv"], [(0.3, 0.4), (0.5, 0.4), (0.3, 0.8), (0.5, 0.8)], **NEAR)


def test_planes_lie_in_the_world(gl: Any) -> None:
    """Each has six vertices: its centre and half its sides either way; metres are from the centre."""
    random = np.random.default_rng(0)
    centre, across, along = random.normal(size=(3, 3, 3))
    uniforms = {"clip_from_world": CLIP.T, "centre": centre, "across": across, "along": along}
    found = written(gl, "plane.vert", {"v_metres": 2, "v_half": 2}, 18, uniforms=uniforms, PLANES=3)
    plane, side = np.repeat(np.arange(3), 6), np.tile(CORNERS, (3, 1))
    world = centre[plane] + side[:, :1] * across[plane] + side[:, 1:] * along[plane]
    half = np.stack([np.linalg.norm(across, axis=1), np.linalg.norm(along, axis=1)], axis=1)[plane]
    np.testing.assert_allclose(found["gl_Position"], clip_of(world), **NEAR)
    np.testing.assert_allclose(found["v_half"], half, **NEAR)
    np.testing.assert_allclose(found["v_metres"], side * half, **NEAR)


def test_shadows_lie_on_the_floor(gl: Any) -> None:
    """Each disc is a square of twice its radius about (x, 0, z)."""
    blob = np.array([(0.5, -1.25, 0.3, 0.7), (-2.0, 0.75, 0.15, 0.4)])
    uniforms = {"clip_from_world": CLIP.T, "blob": blob}
    found = written(gl, "shadow.vert", {"v_place": 2, "v_strength": 1}, 12, uniforms=uniforms, BLOBS=2)
    disc, side = np.repeat(np.arange(2), 6), np.tile(CORNERS, (2, 1))
    x, z, radius, strength = blob[disc].T
    world = np.stack([x + side[:, 0] * radius, np.zeros(12), z + side[:, 1] * radius], axis=1)
    np.testing.assert_allclose(found["gl_Position"], clip_of(world), **NEAR)
    np.testing.assert_array_equal(found["v_place"], side)
    np.testing.assert_allclose(found["v_strength"][:, 0], strength, **NEAR)


def test_posed_vertices_and_the_rooms_are_projected_and_passed_on(gl: Any) -> None:
    rows = np.random.default_rng(1).normal(size=(5, 8)).astype(np.float32)
    buffer = gl.buffer(rows.tobytes())
    uniforms = {"clip_from_world": CLIP.T}
    room = [(buffer, "3f 2f 3f", "position", "uv", "light")]
    found = written(gl, "room.vert", {"v_uv": 2, "v_light": 3}, 5, room, uniforms)
    np.testing.assert_allclose(found["gl_Position"], clip_of(rows[:, :3]), **NEAR)
    np.testing.assert_array_equal(found["v_uv"], rows[:, 3:5])
    np.testing.assert_array_equal(found["v_light"], rows[:, 5:])
    posed = [(buffer, "3f 2f 3x4", "position", "uv")]
    found = written(gl, "posed_vertices.vert", {"v_uv": 2}, 5, posed, uniforms)
    np.testing.assert_allclose(found["gl_Position"], clip_of(rows[:, :3]), **NEAR)
    np.testing.assert_array_equal(found["v_uv"], rows[:, 3:5])


JOINTS_HERE, FEATURES, ROW = 9, 6, 8


@pytest.mark.parametrize("weights", [4, 8, 12])
@pytest.mark.parametrize("shaped", [False, True], ids=["plain", "pose blend shapes"])
def test_a_vertex_is_skinned_as_the_formula_says(gl: Any, weights: int, shaped: bool) -> None:
    """x = (sum_k w_k H_k) [rest + posedirs @ feature, 1]; normals turn, and do not move; all else is passed on.

    Every weight, joint, feature and texel has its own number, and the texels of a vertex lie across rows of the image.
    """
    random = np.random.default_rng(weights)
    count = 7
    joints = random.normal(size=(JOINTS_HERE, 3, 4)).astype(np.float32)
    position, normal = random.normal(size=(2, count, 3)).astype(np.float32)
    uv, colour = random.random((count, 2), np.float32), random.random((count, 4), np.float32)
    joint = random.integers(0, JOINTS_HERE, (count, weights)).astype(np.uint8)
    weight = random.dirichlet(np.ones(weights), count).astype(np.float32)
    columns = {"position": ("3f", position), "uv": ("2f", uv), "normal": ("3f", normal), "colour": ("4f", colour)}
    for group in range(weights // 4):
        part = slice(4 * group, 4 * group + 4)
        columns[f"joint_{'abc'[group]}"] = ("4u1", joint[:, part])
        columns[f"weight_{'abc'[group]}"] = ("4f", weight[:, part])
    defines: dict[str, int | str] = {"K": weights, "JOINTS": JOINTS_HERE, "SURFACE": 1}
    textures, feature, offset = {}, gl.buffer(reserve=32), np.zeros((count, 3))
    if shaped:
        source = random.permutation(count).astype(np.uint32)
        directions = random.normal(size=(count, FEATURES, 3)).astype(np.float16)
        numbers = np.pad(random.normal(size=FEATURES).astype(np.float32), (0, 2), constant_values=99)
        columns["source"] = ("1u4", source[:, None])
        defines |= {"POSE_FEATURES": FEATURES, "ROW": ROW}
        image = np.zeros((-(-count * FEATURES // ROW) * ROW, 3), np.float16)
        image[: count * FEATURES] = directions.reshape(-1, 3)
        textures["posedirs"] = gl.texture((ROW, len(image) // ROW), 3, image.tobytes(), dtype="f2", alignment=1)
        feature.write(numbers.tobytes())
        offset = np.einsum("f,vfa->va", numbers[:FEATURES].astype(float), directions[source].astype(float))
    packed = np.hstack([np.ascontiguousarray(values).view(np.uint8) for _, values in columns.values()])
    content = [(gl.buffer(packed.tobytes()), " ".join(f for f, _ in columns.values()), *columns)]
    outputs = {"v_uv": 2, "v_position": 3, "v_normal": 3, "v_rest": 3, "v_colour": 4}
    gl.buffer(joints.tobytes()).bind_to_uniform_block(0)
    feature.bind_to_uniform_block(1)
    uniforms = {"clip_from_world": CLIP.T, "Joints": Block(0)} | ({"PoseFeature": Block(1)} if shaped else {})
    found = written(gl, "skin.vert", outputs, count, content, uniforms, textures, **defines)
    rows = np.einsum("vk,vkij->vij", weight.astype(float), joints[joint].astype(float))
    rest = position + offset
    world = np.einsum("vij,vj->vi", rows[..., :3], rest) + rows[..., 3]
    np.testing.assert_allclose(found["gl_Position"], clip_of(world), **NEAR)
    np.testing.assert_allclose(found["v_position"], world, **NEAR)
    np.testing.assert_allclose(found["v_rest"], rest, **NEAR)
    np.testing.assert_allclose(found["v_normal"], np.einsum("vij,vj->vi", rows[..., :3], normal), **NEAR)
    np.testing.assert_array_equal(found["v_uv"], uv)
    np.testing.assert_array_equal(found["v_colour"], colour)
