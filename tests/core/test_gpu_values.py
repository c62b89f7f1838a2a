"""The GPU unit's parts that need no driver, by their values: matrices, mesh order, room, shadows, planes, checks."""

from __future__ import annotations

import os
from types import SimpleNamespace
from typing import Any

import moderngl
import numpy as np
import pytest
from numpy.typing import NDArray

from trilane.body.joints import JOINT_INDEX, JOINTS
from trilane.errors import BadInputError, MissingPartError, TrilaneError, UnitLostError
from trilane.scene.schema import PlaneSpec
from trilane.stages.gpu import opengl_calls, opengl_context, raster
from trilane.stages.gpu.avatar_mesh import avatar_mesh, enough_weights
from trilane.stages.gpu.builtin_room import Extent, floor_texture, room_mesh, room_textures, wall_texture
from trilane.stages.gpu.camera_matrices import eye_of, target_clip
from trilane.stages.gpu.contact_shadows import floor_discs
from trilane.stages.gpu.detected_planes import half_sides
from trilane.stages.gpu.mesh_arrays import is_closed, mesh_arrays, patch_order, weight_batches
from trilane.stages.gpu.packed_pass import PackedPass, Quantisation
from trilane.stages.gpu.raster import RasterStage
from trilane.stages.gpu.shader_program import build_program, shader_source
from trilane.stages.gpu.skinned_mesh import BodyPose, PosedMesh, SkinnedMesh, _index_bytes
from trilane.stages.gpu.texture_array import check_texture

# --- camera ----------------------------------------------------------------------------------------------------------


def test_the_targets_first_row_is_the_top_one() -> None:
    """The product of both matrices with its second row negated, column by column."""
    view, projection = np.random.default_rng(0).normal(size=(2, 4, 4))
    product = projection @ view
    found = np.frombuffer(target_clip(view, projection), np.float32).reshape(4, 4).T
    np.testing.assert_allclose(found, [product[0], -product[1], product[2], product[3]], rtol=1e-6)


def test_the_eye_is_where_the_view_puts_the_origin() -> None:
    turn = np.array([[0.0, 0, -1], [0.6, 0.8, 0], [0.8, -0.6, 0]])
    view = np.eye(4)
    view[:3, :3], view[:3, 3] = turn, (1.0, 2.0, 3.0)
    np.testing.assert_allclose(view @ [*eye_of(view), 1], [0, 0, 0, 1], atol=1e-12)


# --- meshes ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("lost", "at", "count"), [(1e-3, 4, 4), (1.1e-3, 4, 8), (1e-3, 8, 8), (0.01, 8, 12), (0.05, 12, 12)]
)
def test_as_many_weights_as_hold_all_but_a_thousandth(lost: float, at: int, count: int) -> None:
    """`lost` is what the weights from number `at` on hold, in one vertex among others that need one weight."""
    weights = np.zeros((3, JOINTS))
    weights[:, 7] = 1
    weights[1, 7] = 0
    weights[1, 20 : 20 + at] = (1 - lost) / at
    weights[1, 40] = lost
    assert enough_weights(SimpleNamespace(weights=weights)) == count  # type: ignore[arg-type]


def test_the_avatars_mesh_is_the_bodys_and_is_the_same_from_the_cache(body_arrays: Any, tmp_path: Any) -> None:
    from trilane.body.body import load_body
    from trilane.body.skin_weights import largest_weights

    np.savez(tmp_path / "body.npz", allow_pickle=False, **body_arrays)
    shaped = load_body(tmp_path / "body.npz").shape()
    body = shaped.body
    top = largest_weights(body.weights, 8)
    expected = mesh_arrays(shaped.vertices, body.faces, body.uv, body.uv_faces, top.joints, top.weights)
    for _ in range(2):
        found = avatar_mesh(shaped)
        for name in ("position", "uv", "joint", "weight", "triangles", "source"):
            np.testing.assert_array_equal(getattr(found, name), getattr(expected, name))
        assert found.closed == expected.closed is False
        assert found.weights_per_vertex == 8


def test_a_closed_body_is_closed_from_the_cache_too(
    body_arrays: Any, tmp_path: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    from trilane.body.body import load_body

    np.savez(tmp_path / "body.npz", allow_pickle=False, **body_arrays)
    shaped = load_body(tmp_path / "body.npz").shape()
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr("trilane.stages.gpu.mesh_arrays.is_closed", lambda *_: True)
    assert [avatar_mesh(shaped).closed for _ in range(2)] == [True, True]


@pytest.mark.parametrize(
    ("filtering", "hardware", "deferred"),
    [("linear", False, True), ("linear", True, False), ("anisotropic", False, False), ("mipmap", False, False)],
)
def test_uvs_are_drawn_first_where_that_is_quicker(
    monkeypatch: pytest.MonkeyPatch, filtering: str, hardware: bool, deferred: bool
) -> None:
    """On a driver that is software, and with the filter of four texels alone."""
    asked: list[Any] = []

    def passed(*given: Any) -> Any:
        asked.append(given)
        raise StopIteration

    config = SimpleNamespace(scene=SimpleNamespace(texture_filter=filtering))
    monkeypatch.setattr(raster, "RunConfig", SimpleNamespace(model_validate=lambda _: config))
    monkeypatch.setattr(raster, "distinct", lambda _: ["folder"])
    monkeypatch.setattr(raster, "texture_of", lambda *_: np.zeros((2, 2, 8)))
    monkeypatch.setattr(raster, "quantisation_of", lambda *_: "bytes")
    monkeypatch.setattr(raster, "describe", lambda _: SimpleNamespace(hardware=hardware, renderer="r"))
    monkeypatch.setattr(raster, "PackedPass", passed)
    devices: list[str] = []
    unit: Any = SimpleNamespace(shared=lambda *_: "context", assets={}, use_device=devices.append)
    with pytest.raises(StopIteration):
        raster.build({"config": {}}, unit)
    assert asked == [("context", 8, "bytes", deferred, filtering)] and devices == (["r"] if hardware else [])


def test_a_mesh_says_what_a_pose_lacks() -> None:
    written: list[bytes] = []
    joints: Any = SimpleNamespace(write=lambda data: written.append(data.tobytes()))
    pose = BodyPose(np.arange(6, dtype=np.float32).reshape(2, 3))
    posed, skinned = object.__new__(PosedMesh), object.__new__(SkinnedMesh)
    skinned._joints, skinned.posedirs = joints, None
    with pytest.raises(ValueError, match=r"^a posed mesh needs the frame's vertices$"):
        posed.upload_pose(pose)
    skinned.upload_pose(pose)
    skinned.posedirs = object()
    with pytest.raises(ValueError, match=r"^a mesh with pose blend shapes needs the pose feature$"):
        skinned.upload_pose(pose)
    assert written == [pose.joints.tobytes()] * 2


def test_shaders_that_do_not_compile_are_named_with_the_compilers_log() -> None:
    def refused(_vertex: str, fragment: str) -> None:
        raise moderngl.Error(f"0:7: {fragment.splitlines()[1]}")

    said = r"^shaders whole_screen\.vert and uv_only\.frag: 0:7: #define K 3$"
    with pytest.raises(TrilaneError, match=said):
        build_program(SimpleNamespace(program=refused), "whole_screen.vert", "uv_only.frag", K=3)
    made = build_program(SimpleNamespace(program=lambda *texts: texts), "whole_screen.vert", "uv_only.frag", K=3)
    assert made == (shader_source("whole_screen.vert", K=3), shader_source("uv_only.frag", K=3))


SQUARE = np.array([(0.0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0), (9, 9, 9)])


def square(**changed: Any) -> dict[str, Any]:
    """Two triangles; vertex 4 is of no face; joints and weights are all different."""
    weight = np.array([(0.1, 0.2, 0.3, 0.4), (0.7, 0.1, 0.2, 0.0), (1, 0, 0, 0), (0.25, 0.5, 0.15, 0.1), (1, 0, 0, 0)])
    return {
        "vertices": SQUARE,
        "faces": np.array([(0, 1, 2), (0, 2, 3)]),
        "uv": np.arange(12).reshape(6, 2) / 10,
        "uv_faces": np.array([(5, 1, 2), (0, 2, 3)]),
        "joint": np.arange(20).reshape(5, 4),
        "weight": weight,
    } | changed


def test_a_meshs_rows_are_its_corners_with_the_largest_weight_first() -> None:
    normal, colour = np.random.default_rng(0).normal(size=(5, 3)), np.random.default_rng(1).random((5, 4))
    mesh = mesh_arrays(**square(), normal=normal, colour=colour)
    assert mesh.source.tolist() == [0, 1, 2, 0, 3]
    assert mesh.triangles.tolist() == [[0, 1, 2], [3, 2, 4]]
    np.testing.assert_array_equal(mesh.position, SQUARE[mesh.source].astype(np.float32))
    np.testing.assert_array_equal(mesh.uv, square()["uv"][[5, 1, 2, 0, 3]].astype(np.float32))
    assert mesh.joint.tolist() == [[3, 2, 1, 0], [4, 6, 5, 7], [8, 9, 10, 11], [3, 2, 1, 0], [13, 12, 14, 15]]
    expected = [(0.4, 0.3, 0.2, 0.1), (0.7, 0.2, 0.1, 0), (1, 0, 0, 0), (0.4, 0.3, 0.2, 0.1), (0.5, 0.25, 0.15, 0.1)]
    np.testing.assert_allclose(mesh.weight, expected, rtol=1e-6)
    np.testing.assert_array_equal(mesh.surface["normal"], normal[mesh.source].astype(np.float32))
    np.testing.assert_array_equal(mesh.surface["colour"], colour[mesh.source].astype(np.float32))
    assert not mesh.closed
    assert mesh_arrays(**square()).surface == {}
    types = [array.dtype for array in (mesh.position, mesh.uv, mesh.joint, mesh.weight, mesh.triangles, mesh.source)]
    assert types == [np.float32, np.float32, np.uint8, np.float32, np.uint32, np.int64]


def test_triangles_are_drawn_with_the_weights_that_their_corners_need() -> None:
    """Corners with 4, 5, 8 and 9 weights: their triangles take 4, 8 and 12."""
    weight = np.zeros((6, 12))
    for row, used in enumerate((4, 4, 4, 5, 8, 9)):
        weight[row, :used] = 1 / used
    faces = np.array([(0, 1, 2), (0, 1, 3), (4, 1, 2), (0, 5, 4)])
    uv, joint = np.zeros((6, 2)), np.zeros((6, 12), int)
    vertices = np.arange(18.0).reshape(6, 3) % 7
    mesh = mesh_arrays(vertices, faces, uv, np.zeros((4, 3), int), joint, weight)
    batches = weight_batches(mesh)
    found = {k: sorted(sorted(mesh.source[t].tolist()) for t in triangles) for k, triangles in batches.items()}
    assert found == {4: [[0, 1, 2]], 8: [[0, 1, 3], [1, 2, 4]], 12: [[0, 4, 5]]}
    plain = mesh_arrays(**square())
    assert list(weight_batches(plain)) == [4]


def ordered(centres: NDArray[np.float64], rows: list[int], patch: int) -> list[list[int]]:
    """`patch_order` by its description: the patches of `rows`."""
    if len(rows) <= patch:
        return [rows]
    spans = [max(centres[r][a] for r in rows) - min(centres[r][a] for r in rows) for a in range(3)]
    axis = spans.index(max(spans))
    rows = sorted(rows, key=lambda r: centres[r][axis])
    whole = len(rows) >= 2 * patch
    half = int(np.ceil(len(rows) // 2 / patch)) * patch if whole else len(rows) // 2
    return ordered(centres, rows[:half], patch) + ordered(centres, rows[half:], patch)


@pytest.mark.parametrize(("count", "patch"), [(10, 4), (7, 4), (8, 4), (9, 4), (33, 5), (4, 4), (40, 10)])
def test_patches_are_halved_along_their_longest_side(count: int, patch: int) -> None:
    centres = np.random.default_rng(count).normal(size=(count, 3)) * [1.0, 1.2, 0.9]
    patches = ordered(centres, list(range(count)), patch)
    assert patch_order(centres, patch).tolist() == [row for rows in patches for row in rows]
    line = patch_order(np.c_[np.arange(10.0)[::-1], np.zeros((10, 2))], 4)
    assert line.tolist() == list(range(9, -1, -1))


def box(columns: int, rows: int) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """A closed box of 4 (columns rows + columns + rows) triangles that wind outward."""
    n, count = columns + 1, (columns + 1) * (rows + 1)
    low = np.array([(x, y, 0.0) for y in range(rows + 1) for x in range(n)])
    a = np.array([y * n + x for y in range(rows) for x in range(columns)])
    top = np.concatenate([np.stack([a, a + 1, a + n + 1], 1), np.stack([a, a + n + 1, a + n], 1)]) + count
    rim = [*range(columns), *(y * n + columns for y in range(rows)), *range(count - 1, count - n, -1)]
    rim += [y * n for y in range(rows, 0, -1)]
    around = zip(rim, [*rim[1:], rim[0]], strict=True)
    side = [t for p, q in around for t in ((p, q, q + count), (p, q + count, p + count))]
    return np.concatenate([low, low + np.array([0, 0, 0.3])]), np.concatenate([top, top[:, ::-1] - count, side])


def test_few_open_edges_leave_a_mesh_closed() -> None:
    """One triangle left out opens three edges, which may be half a percent of all: of 600, which 200 triangles have."""
    for columns, rows, enough in ((2, 16, False), (3, 12, True)):
        vertices, faces = box(columns, rows)
        assert len(faces) == (204 if enough else 200)
        assert is_closed(vertices, faces)
        assert is_closed(vertices, faces[:-1]) is enough
        assert not is_closed(vertices * [1, 1, -1], faces)
    flat = np.array([(0, 1, 2), (0, 2, 1)])
    assert not is_closed(SQUARE, flat)


BAD = {
    "faces": [{"faces": np.arange(6)}, {"faces": np.zeros((2, 4), int)}, {"faces": np.array([(0, 1, 5), (0, 2, 3)])}],
    "uv_faces": [{"uv_faces": np.zeros((3, 3), int)}, {"uv_faces": np.array([(0, 1, 6), (0, 2, 3)])}],
    "joint": [
        {"joint": np.zeros((5, 5), int), "weight": np.ones((5, 5))},
        {"joint": np.full((5, 4), 55)},
        {"joint": np.full((5, 4), -1)},
        {"weight": np.ones((5, 8))},
        {"joint": np.zeros((4, 4), int), "weight": np.ones((4, 4))},
    ],
    "vertices": [{"vertices": SQUARE * [1, np.nan, 1]}],
    "uv": [{"uv": np.full((6, 2), np.inf)}],
    "weight": [{"weight": np.full((5, 4), np.nan)}],
}


@pytest.mark.parametrize(("where", "changed"), [(where, row) for where, rows in BAD.items() for row in rows])
def test_what_cannot_be_drawn_is_refused_by_its_name(where: str, changed: dict[str, Any]) -> None:
    with pytest.raises(BadInputError, match=f"^mesh {where}: "):
        mesh_arrays(**square(**changed))


def test_the_last_index_of_each_kind_is_allowed() -> None:
    mesh_arrays(**square(joint=np.full((5, 4), 54), faces=np.array([(4, 0, 1), (0, 1, 4)])))


@pytest.mark.parametrize(("count", "size"), [(1 << 16, 2), ((1 << 16) + 1, 4)])
def test_indices_are_of_two_bytes_where_that_suffices(count: int, size: int) -> None:
    arrays = SimpleNamespace(position=np.broadcast_to(0.0, (count, 3)))
    triangles = np.array([(count - 1, 1, 2)], np.uint32)
    found = np.frombuffer(_index_bytes(arrays, triangles), f"u{size}")  # type: ignore[arg-type]
    assert found.tolist() == [count - 1, 1, 2]


# --- room ------------------------------------------------------------------------------------------------------------


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
    assert mesh.floor.max() == 48 and mesh.floor.shape == (72, 3) and mesh.rest.shape == (360, 3)
    assert sorted(np.unique(mesh.rest).tolist()) == list(range(49, 294))
    for triangles in (mesh.floor, mesh.rest):
        corners = mesh.vertices[triangles, :3].astype(float)
        area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1) / 2
        sides = (high - low) @ np.diag([1, 1, 1])
        walls = 2 * (sides[0] + sides[2]) * sides[1] + sides[0] * sides[2]
        assert area.sum() == pytest.approx(sides[0] * sides[2] if triangles is mesh.floor else walls, rel=1e-5)


def test_the_floor_is_of_sixteen_planks_with_dark_seams() -> None:
    """Each plank has the tone of its draw; the seam between two is 0.58 as bright, and 0.81 a pixel beside it."""
    floor = floor_texture()
    assert floor.shape == (1024, 1024, 4) and (floor[..., 3] == 255).all()
    assert np.array_equal(room_textures()[0], floor)
    pixels = floor[..., :3].astype(float)
    columns = pixels.mean(axis=(0, 2)).reshape(16, 64).mean(axis=0)
    inner = columns[4:60].mean()
    np.testing.assert_allclose(columns[[0, 1, 63]] / inner, [0.58, 1 - 0.42 * 0.4583, 1 - 0.42 * 0.4583], atol=0.02)
    np.testing.assert_allclose(columns[2:63] / inner, 1, atol=0.02)
    random = np.random.default_rng(7)
    start, tones = random.random(16), np.clip(random.normal(0, 0.05, (16, 2)), -0.09, 0.09)
    for plank in range(16):
        along = np.arange(1024) / 512 + start[plank]
        for length in range(2):
            rows = (along.astype(int) % 2 == length) & (np.abs(along % 1 - 0.5) < 0.49)
            tone = tones[plank, length]
            found = pixels[rows, 64 * plank + 4 : 64 * plank + 60].mean(axis=(0, 1))
            wanted = (1 + tone) * (np.array([176, 134, 96]) + np.array([7, 2, -3]) * tone / 0.05)
            np.testing.assert_allclose(found, wanted, rtol=0.02)  # the grain's mean over 56 columns, four deviations
        ends = np.abs(along % 1 - 0.5) * 2 > 0.998
        assert pixels[ends, 64 * plank + 4 : 64 * plank + 60].mean() < 0.7 * inner
    assert 0.03 < (pixels[:, 4:60].std(axis=0) / inner).mean() < 0.08


def test_the_wall_is_paint_above_a_board() -> None:
    """Rows by their height, each the mean of its columns: the noise of the paint is 0.7 %."""
    wall = wall_texture()
    assert wall.shape == (1024, 256, 4) and (wall[..., 3] == 255).all()
    assert np.array_equal(room_textures()[1], wall)
    height = (np.arange(1024) + 0.5) / 256
    found = wall[..., :3].astype(float).mean(axis=1)
    for row, at in enumerate(height):
        if at < 0.11:
            rising = (at - (0.11 - 0.012)) / 0.012
            expected = np.array([243, 241, 236]) * (1 - 0.25 * min(max(rising, 0), 1)) * (0.6 if at < 0.012 else 1)
            np.testing.assert_allclose(found[row], expected, atol=0.5)
        else:
            expected = np.array([218, 213, 201]) * (1 - 0.12 * np.exp(-(at - 0.11) / 0.02))
            np.testing.assert_allclose(found[row], expected, rtol=0.01)
    paint = wall[200:, :, :3].astype(float)
    assert 0.006 < (paint / paint.mean(axis=(0, 1))).std() < 0.008
    assert not np.array_equal(paint[0], paint[12])


# --- shadows and planes ----------------------------------------------------------------------------------------------

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


# --- checks ----------------------------------------------------------------------------------------------------------


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


# --- driver ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("threads", "expected"), [(None, "kept"), (1, "0"), (2, "2"), (5, "5")])
def test_a_software_driver_gets_its_threads(
    monkeypatch: pytest.MonkeyPatch, threads: int | None, expected: str
) -> None:
    """The calling thread counts: one thread is none beside it."""
    monkeypatch.setenv("LP_NUM_THREADS", "kept")
    asked: dict[str, Any] = {}
    monkeypatch.setattr(opengl_context.moderngl, "create_context", lambda **given: asked.update(given) or "context")
    assert opengl_context.open_context(threads) == "context"
    assert os.environ["LP_NUM_THREADS"] == expected
    library = "libEGL.so.1"
    assert asked == {"require": 330, "standalone": True, "backend": "egl", "libegl": library, "libgl": library}


@pytest.mark.parametrize(
    ("renderer", "hardware"),
    [("NVIDIA H200", True), ("llvmpipe (LLVM 15)", False), ("SwiftShader", False), ("softpipe", False), ("SWR", False)],
)
def test_a_renderer_on_the_cpu_is_no_hardware(renderer: str, hardware: bool) -> None:
    info = {"GL_VENDOR": "v", "GL_RENDERER": renderer, "GL_VERSION": "4.5"}
    found = opengl_context.describe(SimpleNamespace(info=info))
    assert found == opengl_context.Driver("v", renderer, "4.5", hardware)


def test_an_error_inside_is_the_contexts_only_when_that_is_lost(monkeypatch: pytest.MonkeyPatch) -> None:
    for current, kind in ((True, KeyError), (False, UnitLostError)):
        monkeypatch.setattr(opengl_context, "current", lambda here=current: here)
        with pytest.raises(kind), opengl_context.checked(SimpleNamespace(error="GL_NO_ERROR")):
            raise KeyError("x")
    monkeypatch.setattr(opengl_context, "current", lambda: True)
    with (
        pytest.raises(TrilaneError, match="GL_INVALID_VALUE"),
        opengl_context.checked(SimpleNamespace(error="GL_INVALID_VALUE")),
    ):
        pass


def test_a_function_that_the_driver_lacks_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    class Library:
        def __init__(self, _name: str) -> None:
            self.eglGetProcAddress = SimpleNamespace()
            self.eglGetProcAddress = type("Get", (), {"__call__": lambda _self, _name: None})()

    monkeypatch.setattr(opengl_calls.ctypes, "CDLL", Library)
    with pytest.raises(MissingPartError, match="lacks glFenceSync"):
        opengl_calls.function.__wrapped__("glFenceSync")


@pytest.mark.parametrize(("result", "failed"), [(0x911A, False), (0x911C, False), (0x911B, True), (0x911D, True)])
def test_a_fence_is_waited_for_once_and_deleted(monkeypatch: pytest.MonkeyPatch, result: int, failed: bool) -> None:
    calls = []

    def function(name: str) -> Any:
        return lambda *given: calls.append((name, *given)) or (result if name == "glClientWaitSync" else 77)

    monkeypatch.setattr(opengl_calls, "function", function)
    assert opengl_calls.fence() == 77
    if failed:
        with pytest.raises(TrilaneError, match=r"within 1 s"):
            opengl_calls.wait_fence(77)
    else:
        opengl_calls.wait_fence(77)
    assert calls == [("glFenceSync", 0x9117, 0), ("glClientWaitSync", 77, 1, 1_000_000_000), ("glDeleteSync", 77)]


def test_srgb_is_switched_off_again_whatever_happens(monkeypatch: pytest.MonkeyPatch) -> None:
    calls: list[Any] = []
    monkeypatch.setattr(opengl_calls, "function", lambda name: lambda *given: calls.append((name, *given)))
    with pytest.raises(KeyError), opengl_calls.srgb_target():
        raise KeyError("x")
    assert calls == [("glEnable", 0x8DB9), ("glDisable", 0x8DB9)]
