"""The GPU unit without a driver: mesh order, seams, shadows, room, planes, camera matrices, driver errors."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from trilane.body.joints import JOINT_INDEX, JOINTS
from trilane.errors import MissingPartError, TrilaneError, UnitLostError
from trilane.scene.schema import PlaneSpec
from trilane.stages.gpu import opengl
from trilane.stages.gpu.composite_painters import (
    DISCS,
    Extent,
    floor_discs,
    floor_texture,
    half_sides,
    paint_texture,
    room_mesh,
    wall_texture,
)
from trilane.stages.gpu.opengl import target_clip


def test_room_faces_inward() -> None:
    """Every triangle winds counter-clockwise for an eye inside."""
    mesh = room_mesh(Extent())
    for triangles in (mesh.floor, mesh.boards, mesh.paint):
        corners = mesh.vertices[triangles, :3].astype(float)
        normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        assert (np.einsum("fi,fi->f", normal, np.array([0, 1.5, 0]) - corners[:, 0]) > 0).all()


def test_only_smooth_paint_is_read_texel_by_texel() -> None:
    """Neighbours of the paint differ by two codes at most, so that nobody sees texels; the board is not among them.

    Paint begins where the shade of the board has faded, with the colours that the wall has there.
    """
    paint, wall = paint_texture().astype(int), wall_texture().astype(float)
    assert max(np.abs(paint - np.roll(paint, 1, axis)).max() for axis in (0, 1)) <= 2
    halved = wall.reshape(512, 2, 128, 2, 4).mean(axis=(1, 3))
    shade_ends = round(0.21 / 4.0 * 512)
    assert np.abs(halved - paint)[shade_ends:].max() <= 1
    assert np.abs(halved - paint)[: shade_ends // 2].min(axis=1).max() > 10
    for height in (3.0, 3.5, 9.0):
        mesh = room_mesh(Extent(high=(4.0, height, 4.0)))
        assert mesh.vertices[mesh.paint, 1].min() >= 0.21
        assert mesh.vertices[mesh.boards, 1].min(axis=1).max() < 0.21 and len(mesh.boards) >= 4 * 12


def test_textures_repeat_without_a_seam() -> None:
    """Across the border neighbours differ no more than inside, where they may repeat."""
    for texture, axes in ((floor_texture(), (0, 1)), (wall_texture(), (1,)), (paint_texture(), (0, 1))):
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


def test_the_targets_first_row_is_the_top_one() -> None:
    """The product of both matrices with its second row negated, column by column."""
    view, projection = np.random.default_rng(0).normal(size=(2, 4, 4))
    product = projection @ view
    found = np.frombuffer(target_clip(view, projection), np.float32).reshape(4, 4).T
    np.testing.assert_allclose(found, [product[0], -product[1], product[2], product[3]], rtol=1e-6)


def test_a_room_grows_to_sixty_centimetres_beyond_the_camera() -> None:
    grown = Extent().holding(np.array([3.6, 2.9, -7.0]))
    assert (grown.low, grown.high) == ((-4.0, 0.0, -7.6), (4.2, 3.5, 4.0))
    assert grown.holding(np.array([-9.0, -5.0, 0.0])).low == (-9.6, 0.0, -7.6)
    assert Extent().holding(np.array([3.4, 2.4, -3.4])) == Extent()


def test_the_rooms_vertices_have_place_uv_and_light_of_their_side() -> None:
    """Every side on its own: a grid of seven by seven, finer in the corners, and the formulas of its light."""
    extent = Extent(low=(-5.0, 0.0, -4.0), high=(4.0, 3.5, 6.0))
    low, high = np.array(extent.low), np.array(extent.high)
    mesh = room_mesh(extent)
    vertices = mesh.vertices.astype(float).reshape(6, 49, 8)
    shares = [0, 0.04, 0.12, 0.5, 0.88, 0.96, 1]
    for vertex, (axis, end) in zip(vertices, [(1, 0), (1, 1), (0, 0), (0, 1), (2, 0), (2, 1)], strict=True):
        place = vertex[:, :3]
        np.testing.assert_allclose(place[:, axis], (low, high)[end][axis], rtol=1e-6)
        others = [k for k in range(3) if k != axis]
        expected = {
            tuple(np.round([low[k] + s * (high - low)[k] for k, s in zip(others, pair, strict=True)], 4))
            for pair in ((a, b) for a in shares for b in shares)
        }
        assert {tuple(row) for row in np.round(place[:, others], 4)} == expected
        if (axis, end) == (1, 0):
            np.testing.assert_allclose(vertex[:, 3:5], place[:, [0, 2]] / 2.4, atol=1e-5)
        elif axis == 1:
            np.testing.assert_allclose(vertex[:, 3:5], [(0.3, 0.7)] * 49, rtol=1e-6)
        else:
            along = place[:, 2] if axis == 0 else place[:, 0]
            np.testing.assert_allclose(vertex[:, 3:5], np.c_[along / 2.0, place[:, 1] / 4.0], atol=1e-5)
        for row in vertex:
            dim = 1.0
            for k in others:
                dim *= (1 - 0.26 * np.exp(-(row[k] - low[k]) / 0.45)) * (1 - 0.26 * np.exp(-(high[k] - row[k]) / 0.45))
            window = (high[0] - row[0]) / (high[0] - low[0]) / 2 + (row[2] - low[2]) / (high[2] - low[2]) / 2
            strength = dim * (0.86 + 0.2 * window) * (0.97 if axis == 1 else 1)
            colour = np.array([1 - 0.02 * window, 0.985, 0.955 + 0.035 * window])
            np.testing.assert_allclose(row[5:], strength * colour, rtol=1e-5)
    rest = np.concatenate([mesh.boards, mesh.paint])
    assert mesh.floor.max() == 48 and mesh.floor.shape == (72, 3) and rest.shape == (360, 3)
    assert sorted(np.unique(rest).tolist()) == list(range(49, 294))
    for triangles in (mesh.floor, rest):
        corners = mesh.vertices[triangles, :3].astype(float)
        area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1) / 2
        sides = (high - low) @ np.diag([1, 1, 1])
        walls = 2 * (sides[0] + sides[2]) * sides[1] + sides[0] * sides[2]
        assert area.sum() == pytest.approx(sides[0] * sides[2] if triangles is mesh.floor else walls, rel=1e-5)


#: Radius on the floor, strength there, height over which it fades to 1/e.
SHADOWS = {
    "ankle": (0.15, 0.65, 0.18),
    "foot": (0.16, 0.70, 0.15),
    "knee": (0.22, 0.45, 0.30),
    "pelvis": (0.50, 0.60, 1.20),
    "spine3": (0.45, 0.45, 0.60),
    "head": (0.30, 0.45, 0.30),
    "wrist": (0.16, 0.45, 0.15),
}


def test_no_disc_is_darker_than_the_shader_computes() -> None:
    """Beyond 0.72, the polynomial of `shadow.frag` leaves the power."""
    assert max(strength for _, _, strength, _ in DISCS) <= 0.72


@pytest.mark.parametrize("height", [-0.3, 0.0, 0.2, 0.45])
def test_a_disc_widens_and_fades_with_its_joints_height(height: float) -> None:
    """Joint k is moved to (k / 10, height, k); discs fainter than 0.02 are left out."""
    random = np.random.default_rng(0)
    rest = random.normal(size=(JOINTS, 3))
    joints = random.normal(size=(JOINTS, 3, 4))
    place = np.stack([np.arange(JOINTS) / 10, np.full(JOINTS, height), np.arange(JOINTS)], axis=1)
    joints[:, :, 3] = place - np.einsum("nij,nj->ni", joints[:, :, :3], rest)
    found = {round(float(row[1])): row for row in floor_discs(joints, rest)}
    above = max(height, 0)
    expected = {}
    for name, index in JOINT_INDEX.items():
        part = SHADOWS.get(name.removeprefix("left_").removeprefix("right_"))
        if part is not None and name not in ("jaw",):
            radius, strength, fade = part
            shown = strength * np.exp(-above / fade)
            if shown > 0.02:
                expected[index] = (index / 10, index, radius + 0.35 * above, shown)
    assert set(found) == set(expected)
    for index, row in expected.items():
        np.testing.assert_allclose(found[index], row, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize(
    ("normal", "turn", "across", "along"),
    [
        ((0, 2, 0), 0, (1, 0, 0), (0, 0, -1)),
        ((0, 1, 0), 90, (0, 0, -1), (-1, 0, 0)),
        ((0, -1, 0), 0, (1, 0, 0), (0, 0, 1)),
        ((0, 0, 3), 0, (0, 1, 0), (-1, 0, 0)),
        ((0, 0, 1), 30, (-0.5, 3**0.5 / 2, 0), (-(3**0.5) / 2, -0.5, 0)),
        ((1, 0, 0), 0, (0, 1, 0), (0, 0, 1)),
        ((0.6, 0.8, 0), 0, (-0.8, 0.6, 0), (0, 0, 1)),
        ((0, 0.96, 0.28), 0, (1, 0, 0), (0, 0.28, -0.96)),
    ],
)
def test_a_planes_sides_point_as_the_normal_and_its_turn_say(normal: Any, turn: float, across: Any, along: Any) -> None:
    found = half_sides(PlaneSpec(normal=normal, width_m=3, depth_m=1, turn_deg=turn))
    np.testing.assert_allclose(found[0], 1.5 * np.array(across), atol=1e-6)
    np.testing.assert_allclose(found[1], 0.5 * np.array(along), atol=1e-6)
