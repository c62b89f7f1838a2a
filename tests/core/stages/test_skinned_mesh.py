"""The GPU unit's meshes by their values: weights, order of triangles and vertices, patches, what is refused."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import moderngl
import numpy as np
import pytest
from numpy.typing import NDArray

from trilane.body.joints import JOINTS
from trilane.errors import BadInputError, TrilaneError
from trilane.stages.gpu.opengl import build_program, shader_source
from trilane.stages.gpu.skinned_mesh import (
    BodyPose,
    Mesh,
    PosedMesh,
    SkinnedMesh,
    avatar_mesh,
    enough_weights,
    is_closed,
    mesh_arrays,
    patch_order,
    weight_batches,
)


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


def test_the_avatars_mesh_is_the_bodys_and_is_the_same_from_the_cache(shaped: Any) -> None:
    from trilane.body.skinning import largest_weights

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
    shaped: Any, tmp_path: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr("trilane.stages.gpu.skinned_mesh.is_closed", lambda *_: True)
    assert [avatar_mesh(shaped).closed for _ in range(2)] == [True, True]


def test_a_mesh_says_what_a_pose_lacks() -> None:
    written: list[bytes] = []
    joints: Any = SimpleNamespace(write=lambda data: written.append(data.tobytes()))
    pose = BodyPose(np.arange(6, dtype=np.float32).reshape(2, 3))
    posed, skinned = object.__new__(PosedMesh), object.__new__(SkinnedMesh)
    skinned._joints, skinned.posedirs, skinned._ctx = joints, None, SimpleNamespace(extra=None)
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


@pytest.mark.parametrize(("count", "size"), [(1 << 16, 2), ((1 << 16) + 1, 4)])
def test_indices_are_of_two_bytes_where_that_suffices(count: int, size: int) -> None:
    arrays = SimpleNamespace(position=np.broadcast_to(0.0, (count, 3)))
    triangles = np.array([(count - 1, 1, 2)], np.uint32)
    ((_, indices),) = Mesh(SimpleNamespace(buffer=bytes), arrays, {4: triangles}).batches  # type: ignore[arg-type]
    assert np.frombuffer(indices, f"u{size}").tolist() == [count - 1, 1, 2]
