"""The paint of clothes: the colours of many points of every garment, whatever draws them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import moderngl
import numpy as np
import pytest
from PIL import Image

from trilane.arrays import F64
from trilane.stages.gpu.opengl import shader_source
from trilane.training.clothing import (
    DANCER,
    DEFAULT,
    GARMENTS,
    HANGING,
    HIKER,
    MATERIALS,
    Landmarks,
    Look,
    find_landmarks,
)
from trilane.training.sample_renderer import PAINT, _places
from trilane.training.surface import BodyArrays, body_arrays, vertex_normals

#: Points of each material, and the rows and columns of their picture.
SHAPE = (64, 96)
#: Passes on what the fragment shader reads, at a pixel for each point.
POINTS = """#version 330
in vec2 at;
in vec3 rest, place, normal;
in vec4 colour;
out vec3 v_position, v_normal, v_rest;
out vec4 v_colour;
void main() {
    gl_Position = vec4(at, 0.0, 1.0);
    v_position = place; v_normal = normal; v_rest = rest; v_colour = colour;
}
"""


@pytest.fixture(scope="module")
def arrays(person: Any) -> BodyArrays:
    return body_arrays(person.body.shape())


@pytest.fixture(scope="module")
def landmarks(arrays: BodyArrays) -> Landmarks:
    return find_landmarks(arrays.vertices, arrays.joints, arrays.weights)


def look_of(material: str) -> Look:
    """The look that has the garment; skin, shoes and soles are the default's."""
    return next((look for look in (HIKER, DANCER) if material in look.garments), DEFAULT)


def points_of(material: str, body: BodyArrays, landmarks: Landmarks, random: np.random.Generator) -> tuple[F64, F64]:
    """Points 3 mm off the faces that the material may cover, half of them by area, and 1 for those on an eyeball."""
    if material in HANGING:
        (vertices, faces), weights = HANGING[material](body, landmarks)
        body = BodyArrays(vertices, faces, body.uv, body.uv_faces, weights, body.joints)
    eyes = np.zeros(len(body.faces), bool) if material in HANGING else landmarks.eyeball[body.faces].all(axis=1)
    if material in GARMENTS:
        wanted = GARMENTS[material][0](body.vertices, landmarks)[body.faces].all(axis=1) & ~eyes
    elif material == "skin" or material in HANGING:
        wanted = body.vertices[body.faces[:, 0], 1] > -2
    else:
        wanted = body.vertices[body.faces[:, 0], 1] < landmarks.joints[7, 1] + 0.03
    sides = np.diff(body.vertices[body.faces], axis=1)
    area = np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=1) * wanted
    chance = wanted / wanted.sum() / 2 + area / area.sum() / 2
    face = random.choice(len(wanted), SHAPE[0] * SHAPE[1], p=chance)
    corners = body.faces[face]
    share = random.dirichlet(np.ones(3), len(face))
    normals = vertex_normals(body.vertices, body.faces)
    points = np.einsum("pc,pca->pa", share, body.vertices[corners] + 0.003 * normals[corners])
    return points, eyes[face].astype(float)


def painted(gl: Any, landmarks: Landmarks, material: str, content: F64, turn: F64, shape: tuple[int, int]) -> Any:
    """(h,w,4) of the points of `content`, whose columns are `POINTS`'s inputs, seen by a camera that is turned so."""
    program = gl.program(POINTS, shader_source(PAINT, **look_of(material).definitions(landmarks)))
    view = np.eye(4)
    view[:3, :3] = turn
    places = {"material": MATERIALS.index(material), "view": tuple(view.T.ravel()), "eye": (0.3, 0.4, 3.0)}
    for name, value in (_places(landmarks) | places).items():
        if name in program:
            program[name].value = value
    buffer = gl.buffer(content.astype(np.float32).tobytes())
    vertices = gl.vertex_array(program, [(buffer, "2f 3f 3f 3f 4f", "at", "rest", "place", "normal", "colour")])
    target = gl.framebuffer([gl.texture(shape[::-1], 4, dtype="f4")])
    target.use()
    target.clear(0, 0, 0, 0)
    gl.enable_only(moderngl.NOTHING)
    vertices.render(moderngl.POINTS)
    return np.frombuffer(target.read(components=4, dtype="f4"), np.float32).reshape(*shape, 4)


def test_a_sole_has_a_dark_line_84_mm_under_the_ankle(gl: Any, landmarks: Landmarks) -> None:
    """4.4 mm wide, its edges softened over 2 mm; there rubber has 0.62 of its colour, 0.62^2.2 of its light, wherever
    else the point is. Points above the line, in it and below."""
    under_mm = np.array([70.0, 80.7, 82.9, 84.0, 85.1, 87.3, 95.0])
    line = np.array([0, 0, 1, 1, 1, 0, 0])
    count = len(under_mm)
    at = np.stack([(np.arange(count) + 0.5) / count * 2 - 1, np.zeros(count)], axis=1)
    height = landmarks.joints[7, 1] - under_mm / 1000
    rest = np.stack([np.linspace(-0.2, 0.2, count), height, np.linspace(-0.1, 0.2, count)], axis=1)
    same = np.tile([*(0.1, 0.2, 0.3), *(0.0, 0.0, 1.0), *(1.0, 0.0, 0.0, 0.0)], (count, 1))
    found = painted(gl, landmarks, "sole", np.concatenate([at, rest, same], axis=1), np.eye(3), (1, count))[0]
    wanted = np.array([0.88, 0.85, 0.80]) ** 2.2 * np.where(line, 0.62**2.2, 1.0)[:, None]
    light = found[0, :3] / wanted[0]
    assert np.ptp(light) < 1e-4 * light[0]
    np.testing.assert_allclose(found[:, :3], wanted * light, rtol=1e-4)


@pytest.mark.parametrize("material", MATERIALS)
def test_the_colours_of_every_garment_are_as_they_were(
    gl: Any, golden: Any, arrays: BodyArrays, landmarks: Landmarks, material: str
) -> None:
    """A pixel for each of 6,144 points, in places and lights drawn at random. Between drivers a sine or a power differs
    by a few roundings of float32, so a byte by one; by more where one side of an edge becomes the other."""
    random = np.random.default_rng((3, MATERIALS.index(material)))
    count = SHAPE[0] * SHAPE[1]
    points, eyeball = points_of(material, arrays, landmarks, random)
    row, column = np.divmod(np.arange(count), SHAPE[1])
    at = np.stack([(column + 0.5) / SHAPE[1], (row + 0.5) / SHAPE[0]], axis=1) * 2 - 1
    normals = random.normal(0, 1, (count, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    colour = np.stack([random.uniform(-0.1, 1.1, count), eyeball, np.zeros(count), np.zeros(count)], axis=1)
    content = np.concatenate([at, points, random.normal(0, 1, (count, 3)), 2 * normals, colour], axis=1)
    turn, _ = np.linalg.qr(np.random.default_rng(1).normal(size=(3, 3)))
    found = painted(gl, landmarks, material, content, turn, SHAPE)
    assert set(np.unique(found[..., 3])) <= {0.0, 1.0}
    picture = np.round(255 * found[..., :3].clip(0, 1) ** (1 / 2.2)).astype(np.uint8)
    golden(f"paint-{material}", picture, 0.005, 0.0005)
    with Image.open(Path(__file__).with_name(f"paint-{material}.png")) as image:
        off = np.abs(picture.astype(int) - np.asarray(image))
    assert (off > 1).sum() <= 6, "small parts, as the line between the lips, are few of the points"
