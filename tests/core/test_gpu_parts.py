"""The GPU unit's parts that need no driver: mesh order, seams, closedness, shadows, the room, driver errors."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from trilane.body.joints import JOINTS
from trilane.errors import BadInputError, MissingPartError, TrilaneError, UnitLostError
from trilane.stages.gpu import opengl
from trilane.stages.gpu.builtin_room import Extent, floor_texture, room_mesh, wall_texture
from trilane.stages.gpu.composite_painters import DISCS, floor_discs
from trilane.stages.gpu.skinned_mesh import is_closed, mesh_arrays, patch_order, split_corners

TETRAHEDRON = np.array([(0.0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1)])
OUTWARD = np.array([(0, 2, 1), (0, 1, 3), (0, 3, 2), (1, 2, 3)])


def test_seams_split_vertices_and_nothing_else() -> None:
    """Each corner keeps its vertex and its UV; corners that share both share a row."""
    faces, uv_faces = np.array([(0, 1, 2), (2, 1, 3)]), np.array([(0, 1, 2), (4, 1, 3)])
    vertex, uv, triangles = split_corners(faces, uv_faces)
    assert np.array_equal(vertex[triangles], faces)
    assert np.array_equal(uv[triangles], uv_faces)
    assert len(vertex) == 5
    assert list(triangles.ravel()[:3]) == [0, 1, 2]


@given(count=st.integers(0, 300), patch=st.integers(1, 50))
def test_patch_order_is_a_permutation(count: int, patch: int) -> None:
    """No triangle is lost or drawn twice."""
    centres = np.random.default_rng(count).normal(size=(count, 3))
    assert sorted(patch_order(centres, patch)) == list(range(count))


def test_closed_meshes_wind_outward() -> None:
    """Turned inside out, opened, or with a face twice, it is not closed."""
    assert is_closed(TETRAHEDRON, OUTWARD)
    assert not is_closed(TETRAHEDRON, OUTWARD[:, ::-1])
    assert not is_closed(TETRAHEDRON, OUTWARD[:3])
    assert not is_closed(TETRAHEDRON, np.concatenate([OUTWARD, OUTWARD[:1]]))


BAD_MESHES = {
    "no faces": {"faces": np.empty((0, 3), int), "uv_faces": np.empty((0, 3), int)},
    "vertex index": {"faces": OUTWARD + 1},
    "negative index": {"faces": OUTWARD - 1},
    "uv index": {"uv_faces": OUTWARD + 1},
    "NaN": {"vertices": TETRAHEDRON * np.nan},
    "three weights": {"joint": np.zeros((4, 3), int), "weight": np.ones((4, 3)) / 3},
    "joint index": {"joint": np.full((4, 4), JOINTS)},
}


@pytest.mark.parametrize("name", BAD_MESHES)
def test_meshes_that_cannot_be_drawn_are_refused(name: str) -> None:
    """One BadInputError that names the array."""
    good: dict[str, Any] = {
        "vertices": TETRAHEDRON,
        "faces": OUTWARD,
        "uv": np.zeros((4, 2)),
        "uv_faces": OUTWARD,
        "joint": np.zeros((4, 4), int),
        "weight": np.full((4, 4), 0.25),
    }
    mesh_arrays(**good)
    with pytest.raises(BadInputError, match="mesh "):
        mesh_arrays(**(good | BAD_MESHES[name]))


def test_discs_fade_with_height() -> None:
    """On the floor every part casts its shadow; two metres up, none of the feet do."""
    joints = np.tile(np.eye(4)[:3], (JOINTS, 1, 1))
    rest = np.zeros((JOINTS, 3))
    on_floor = floor_discs(joints, rest)
    assert on_floor.shape == (len(DISCS), 4)
    joints[:, 1, 3] = 2.0
    assert len(floor_discs(joints, rest)) < 4
    joints[:, :, 3] = (3.0, 0.0, -1.0)
    assert np.allclose(floor_discs(joints, rest)[:, :2], (3.0, -1.0))


@given(st.tuples(*[st.floats(-50, 50)] * 3))
def test_room_holds_every_camera(eye: tuple[float, float, float]) -> None:
    """It grows, never shrinks, and its floor stays at 0."""
    room = Extent().holding(np.array(eye))
    assert all(low <= at - 0.5 for low, at in zip(room.low[::2], eye[::2], strict=True))
    assert all(high >= at + 0.5 for high, at in zip(room.high, eye, strict=True))
    assert room.low[1] == 0.0
    assert room.holding(np.array(eye)) is room
    assert room.holding(np.zeros(3)) is room


def test_room_faces_inward() -> None:
    """Every triangle winds counter-clockwise for an eye inside."""
    mesh = room_mesh(Extent())
    for triangles in (mesh.floor, mesh.rest):
        corners = mesh.vertices[triangles, :3].astype(float)
        normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        assert (np.einsum("fi,fi->f", normal, np.array([0, 1.5, 0]) - corners[:, 0]) > 0).all()


def test_textures_repeat_without_a_seam() -> None:
    """Across the border neighbours differ no more than inside, where they may repeat."""
    for texture, axes in ((floor_texture(), (0, 1)), (wall_texture(), (1,))):
        for axis in axes:
            rows = np.moveaxis(texture.astype(int), axis, 0)
            inside = np.abs(np.diff(rows, axis=0)).mean(axis=(1, 2))
            assert np.abs(rows[0] - rows[-1]).mean() <= inside.max() + 1


def test_missing_driver_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    """The message holds the line that installs it."""

    def refuse(**_: Any) -> None:
        raise Exception("libEGL.so.1: cannot open shared object file")

    monkeypatch.setattr(opengl.moderngl, "create_context", refuse)
    with pytest.raises(MissingPartError, match="apt-get install libegl1 libgl1-mesa-dri"):
        opengl.open_context()


@pytest.mark.parametrize(
    ("current", "error", "kind"),
    [
        (True, "GL_CONTEXT_LOST", UnitLostError),
        (False, "GL_NO_ERROR", UnitLostError),
        (True, "GL_OUT_OF_MEMORY", TrilaneError),
    ],
)
def test_what_a_driver_reports_is_an_error(
    monkeypatch: pytest.MonkeyPatch, current: bool, error: str, kind: type[TrilaneError]
) -> None:
    """A lost context is one that a new process mends; without a current one the driver reports nothing."""
    monkeypatch.setattr(opengl, "current", lambda: current)
    with pytest.raises(kind, match="OpenGL") as caught:
        opengl.check(SimpleNamespace(error=error))
    assert type(caught.value) is kind


def test_a_frame_that_went_well_is_no_error(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(opengl, "current", lambda: True)
    opengl.check(SimpleNamespace(error="GL_NO_ERROR"))
