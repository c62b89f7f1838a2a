"""Levels of a mesh: how far they move the surface, on plain geometry; and their file, whole, damaged or of another."""

from __future__ import annotations

import dataclasses
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from trilane.avatars.bundle import add_mesh_levels, load_bundle, write_manifest
from trilane.avatars.mesh_levels import (
    MESH_LEVELS,
    ROUNDING_M,
    MeshLevel,
    grouped,
    levels_from_arrays,
    levels_to_arrays,
    read_mesh_levels,
)
from trilane.body.body import ShapedBody
from trilane.body.joints import JOINT_INDEX, JOINTS, Posed, Skeleton
from trilane.body.skinning import CpuSkinner
from trilane.errors import BadInputError
from trilane.scene.crop import error_px, least_w, stretch_of
from trilane.stages.avatar_assets import AvatarData, load_avatar
from trilane.units import AVATARS


def coarse(shaped: ShapedBody, every: int, rest_m: float) -> MeshLevel:
    """Each `every`th triangle of the mesh, said to move the surface by `rest_m` in any pose."""
    none = np.zeros((1, 54), np.float32)
    faces, uv_faces = (rows[::every].copy() for rows in (shaped.body.faces, shaped.body.uv_faces))
    return MeshLevel(faces, uv_faces, np.array([rest_m], np.float32), none, none, 0.001)


@pytest.fixture
def levelled(tiny_bundle: Path, tmp_path: Path) -> Path:
    """A bundle with two levels of its mesh."""
    bundle = load_bundle(shutil.copytree(tiny_bundle, tmp_path / "levelled"))
    shaped = bundle.shaped_body()
    add_mesh_levels(bundle, [coarse(shaped, 2, 0.001), coarse(shaped, 40, 0.02)])
    return bundle.folder


def test_levels_are_read_as_they_were_written(levelled: Path) -> None:
    bundle = load_bundle(levelled)
    shaped = bundle.shaped_body()
    levels = bundle.read_mesh_levels(shaped)
    assert [len(level.faces) for level in levels] == [len(shaped.body.faces[::2]), len(shaped.body.faces[::40])]
    np.testing.assert_array_equal(levels[1].uv_faces, shaped.body.uv_faces[::40])
    assert [level.uv_error for level in levels] == [0.001, 0.001]
    assert levels[1].least_m == pytest.approx(0.02)
    again = levels_from_arrays(levels_to_arrays(levels))
    np.testing.assert_array_equal(again[1].faces, levels[1].faces)


def test_an_avatar_without_levels_has_its_whole_mesh(tiny_bundle: Path) -> None:
    data: AvatarData = load_avatar(load_bundle(tiny_bundle))
    assert data.mesh_levels == ()
    assert not (tiny_bundle / MESH_LEVELS).exists()


def test_a_file_that_the_manifest_names_has_to_be_there(levelled: Path) -> None:
    (levelled / MESH_LEVELS).unlink()
    with pytest.raises(BadInputError, match="mesh_levels") as caught:
        load_bundle(levelled)
    assert "mesh-levels.npz" in str(caught.value)


def test_levels_of_another_shape_are_refused(levelled: Path) -> None:
    bundle = load_bundle(levelled)
    write_manifest(levelled, bundle.manifest.model_copy(update={"betas": (1.0,)}))
    taller = load_bundle(levelled)
    with pytest.raises(BadInputError, match="levels of another body") as caught:
        taller.read_mesh_levels(taller.shaped_body())
    assert "trilane avatar levels" in str(caught.value)


@pytest.mark.parametrize(("apart", "is_taken"), [(1e-7, True), (1e-4, False), (np.nan, False)])
def test_last_digits_of_a_sum_are_no_other_body(levelled: Path, apart: float, is_taken: bool) -> None:
    """Another processor, or another number of threads, adds the products of a shape in another order."""
    bundle = load_bundle(levelled)
    shaped = bundle.shaped_body()
    other = replace(shaped, vertices=(shaped.vertices + apart).astype(np.float32), joints=shaped.joints + apart)
    if is_taken:
        assert len(bundle.read_mesh_levels(other)) == 2
    else:
        with pytest.raises(BadInputError, match="levels of another body"):
            bundle.read_mesh_levels(other)


@pytest.mark.parametrize(
    ("key", "value", "match"),
    [
        ("uv_error", None, "no usable array"),
        ("uv_error", np.zeros(9), "no usable array"),
        ("uv_error", np.array([np.nan]), "NaN"),
        ("faces1", None, "no array"),
        ("faces1", np.zeros((0, 3), np.int32), "shape"),
        ("faces1", np.full((1, 3), 1 << 20), "out of range"),
        ("uv_faces2", np.full((642, 3), -1), "out of range"),
        ("faces2", np.zeros((642, 3)), "dtype"),
        ("rest1", np.array([-1.0], np.float32), "negative"),
        ("swing1", np.full((1, 54), np.inf, np.float32), "infinity"),
        ("blend2", np.zeros((2, 54), np.float32), "rows"),
        ("digest", np.zeros(32, np.uint8), "another body"),
        ("measures", None, "another body"),
        ("measures", np.zeros(3), "another body"),
    ],
)
def test_a_damaged_array_is_named(levelled: Path, key: str, value: Any, match: str) -> None:
    file, shaped = levelled / MESH_LEVELS, load_bundle(levelled).shaped_body()
    with np.load(file) as stored:
        arrays = {name: stored[name] for name in stored.files}
    arrays = {name: array for name, array in (arrays | {key: value}).items() if array is not None}
    np.savez(file, allow_pickle=False, **arrays)
    with pytest.raises(BadInputError, match=match) as caught:
        read_mesh_levels(file, shaped)
    assert key in str(caught.value) or match == "another body"


mesh_levels = pytest.importorskip("trilane.training.mesh_levels", reason="needs scipy")


def body_of(vertices: NDArray[np.float64], faces: NDArray[np.int64], uv: NDArray[np.float64]) -> ShapedBody:
    """The default avatar's skeleton with another surface, all of whose vertices hang on the pelvis."""
    shaped = load_bundle("default").shaped_body()
    weights = np.zeros((len(vertices), JOINTS), np.float32)
    weights[:, 0] = 1.0
    body = dataclasses.replace(
        shaped.body,
        v_template=vertices.astype(np.float32),
        weights=weights,
        posedirs=None,
        offsets=None,
        faces=faces.astype(np.int32),
        uv=uv.astype(np.float32),
        uv_faces=faces.astype(np.int32),
    )
    return ShapedBody(vertices.astype(np.float32), shaped.joints, body)


#: A square of side 1 in the plane z = 0 with its middle raised by 0.1. UV is x, y.
CORNERS = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0.5, 0.5, 0.1]], np.float64)
FAN = np.array([[0, 1, 4], [1, 2, 4], [2, 3, 4], [3, 0, 4]])
FLAT = np.array([[0, 1, 2], [0, 2, 3]])


def level_of(shaped: ShapedBody, triangles: NDArray[np.int64]) -> MeshLevel:
    """The level with `triangles` of vertices, each of which has one corner."""
    mesh = mesh_levels.Corners(shaped)
    corner = np.argsort(mesh.vertex)
    triangles = corner[triangles]
    level: MeshLevel = mesh.level(triangles, mesh.pairs(triangles))
    return level


def at_rest(shaped: ShapedBody) -> Posed:
    return Skeleton(shaped.joints, shaped.body.parents).pose(np.zeros((JOINTS, 3)))


def test_a_vertex_that_is_left_out_moves_by_its_height() -> None:
    shaped = body_of(CORNERS, FAN, CORNERS[:, :2])
    level = level_of(shaped, FLAT)
    assert level.metres(at_rest(shaped)) == pytest.approx(0.1 + ROUNDING_M, abs=1e-7)
    assert level.uv_error == 0.0


def test_a_vertex_that_is_kept_moves_where_a_folded_level_shows_its_texel_twice() -> None:
    """The raised middle is a corner of the level, but its texel also lies on the flat triangles, 0.1 below."""
    shaped = body_of(CORNERS, FAN, CORNERS[:, :2])
    level = level_of(shaped, np.vstack([FAN, FLAT]))
    assert level.metres(at_rest(shaped)) == pytest.approx(0.1 + ROUNDING_M, abs=1e-7)


def test_a_texture_that_slides_counts_as_much_as_a_surface_that_moves() -> None:
    """The middle lies in the plane but its texel does not lie in the middle: (0.75, 0.5) is 0.25 from (0.5, 0.5)."""
    flat = np.where([False, False, True], 0.0, CORNERS)
    uv = CORNERS[:, :2].copy()
    uv[4] = 0.75, 0.5
    shaped = body_of(flat, FAN, uv)
    assert level_of(shaped, FLAT).metres(at_rest(shaped)) == pytest.approx(0.25 + ROUNDING_M, abs=1e-7)


def test_a_seam_that_is_cut_short_states_its_texels() -> None:
    """The side's middle bulges by 0.2 in place and by 0.125 in the texture; the level's side is straight."""
    vertices = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0.5, -0.2, 0]], np.float64)
    uv = vertices[:, :2].copy()
    uv[4] = 0.5, -0.125
    uv += 0.2
    shaped = body_of(vertices, np.array([[0, 4, 3], [4, 2, 3], [4, 1, 2]]), uv)
    level = level_of(shaped, np.array([[0, 1, 2], [0, 2, 3]]))
    assert level.uv_error == pytest.approx(0.125, abs=1e-6)
    assert level.metres(at_rest(shaped)) >= 0.2


def test_a_stretch_over_a_joint_is_turned_by_it() -> None:
    """The middle hangs on the left knee alone. Half a turn of it moves a point by up to twice its distance from it.

    Either the middle is turned, or all but the middle the other way round: the bound is one of these two.
    """
    shaped = body_of(CORNERS, FAN, CORNERS[:, :2])
    weights = shaped.body.weights.copy()
    knee = JOINT_INDEX["left_knee"]
    weights[4, 0], weights[4, knee] = 0.0, 1.0
    shaped = ShapedBody(shaped.vertices, shaped.joints, dataclasses.replace(shaped.body, weights=weights))
    pose = np.zeros((JOINTS, 3))
    pose[knee, 1] = np.pi
    posed = Skeleton(shaped.joints, shaped.body.parents).pose(pose)
    levers = [np.linalg.norm(point - shaped.joints[knee]) for point in (CORNERS[4], CORNERS[4] * (1, 1, 0))]
    bound = level_of(shaped, FLAT).metres(posed)
    assert min(abs(bound - (0.1 + 2 * lever + ROUNDING_M)) for lever in levers) < 1e-5
    places = CpuSkinner(shaped).vertices(posed)
    assert bound >= np.linalg.norm(places[4] - (places[0] + places[2]) / 2)


def test_groups_bound_each_of_their_rows() -> None:
    random = np.random.default_rng(5)
    rest, swing = random.random(20_000) ** 4, random.random((20_000, 54)) ** 8
    blend = random.random((20_000, 54)) ** 20
    few = grouped(rest, swing, blend)
    assert len(few[0]) < 10_000
    for _ in range(100):
        sines, turned = random.random(54) * 2, random.random(54) * 2
        exact = (rest + swing @ sines + blend @ turned).max()
        assert (few[0] + few[1] @ sines + few[2] @ turned).max() >= exact * (1 - 1e-5)


def test_a_reduced_body_has_the_same_vertices_in_the_same_order() -> None:
    shaped = body_of(CORNERS, FAN, CORNERS[:, :2])
    reduced = level_of(shaped, FLAT).reduced(shaped)
    np.testing.assert_array_equal(reduced.vertices, CORNERS[:4].astype(np.float32))
    np.testing.assert_array_equal(np.sort(reduced.body.faces.ravel()), [0, 0, 1, 2, 2, 3])
    np.testing.assert_array_equal(reduced.joints, shaped.joints)


def test_a_wave_is_simplified_within_its_tolerance() -> None:
    """A bumpy sheet of two pieces of texture, which meet at a seam; the tolerance holds, with far fewer triangles."""
    pytest.importorskip("meshoptimizer")
    side = 33
    x, y = (axis.ravel() for axis in np.meshgrid(np.linspace(0, 1, side), np.linspace(0, 1, side), indexing="ij"))
    place = np.stack([x, y, 0.02 * np.sin(5 * x) * np.cos(4 * y)], axis=1)
    number = np.arange(side * side).reshape(side, side)
    a, b, c, d = (part.ravel() for part in (number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:]))
    faces = np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])
    uv = np.concatenate([np.stack([0.45 * x, y], axis=1), np.stack([0.5 + 0.45 * x, y], axis=1)])
    shaped = body_of(place, faces, uv[: len(place)])
    right = place[faces].mean(axis=1)[:, 0] > 0.5
    uv_faces = np.where(right[:, None], faces + len(place), faces).astype(np.int32)
    shaped = ShapedBody(
        shaped.vertices, shaped.joints, dataclasses.replace(shaped.body, uv=uv.astype(np.float32), uv_faces=uv_faces)
    )
    mesh = mesh_levels.Corners(shaped)
    triangles, pairs = mesh_levels.simplify_within(mesh, 0.002)
    assert mesh.moved_m(pairs).max() <= 0.002
    assert len(triangles) < len(faces) / 4
    level = mesh.level(triangles, pairs)
    # No crack: the vertices on the seam are the same on both sides of it.
    ends = [
        {
            int(v)
            for v, row in zip(level.faces.ravel(), level.uv_faces.ravel(), strict=True)
            if (row >= len(place)) == is_right
        }
        for is_right in (False, True)
    ]
    on_seam = {int(v) for v in np.flatnonzero(np.isclose(x, 0.5))}
    assert ends[0] & on_seam == ends[1] & on_seam


# --- the levels of the included avatars ------------------------------------------------------------------------------


@pytest.fixture(scope="module", params=AVATARS)
def included(request: pytest.FixtureRequest) -> tuple[ShapedBody, tuple[MeshLevel, ...]]:
    bundle = load_bundle(request.param)
    shaped = bundle.shaped_body()
    return shaped, bundle.read_mesh_levels(shaped)


def random_pose(random: np.random.Generator) -> NDArray[np.float64]:
    """Of any size, from standing still to wild."""
    return random.normal(0.0, 10 ** random.uniform(-2, 0.4), (JOINTS, 3))


Texels = tuple[NDArray[Any], NDArray[Any], NDArray[Any], NDArray[Any]]


def worst_texels(level: MeshLevel, shaped: ShapedBody) -> Texels:
    """The places where the bound is evaluated, which are the furthest apart; as `texels_of` returns them."""
    mesh = mesh_levels.Corners(shaped)
    number = {pair: corner for corner, pair in enumerate(zip(mesh.vertex, mesh.uv_row, strict=True))}
    corners = zip(level.faces.ravel(), level.uv_faces.ravel(), strict=True)
    pairs = mesh.pairs(np.array([number[pair] for pair in corners]).reshape(-1, 3))
    rows = mesh.vertex[pairs.corners]
    return rows[:, :2], -pairs.shares[:, :2], rows[:, 2:], pairs.shares[:, 2:]


def texels_of(level: MeshLevel, shaped: ShapedBody, random: np.random.Generator, count: int) -> Texels:
    """Random points of both meshes that show the same texels, found by a search over all triangles.

    Returns the vertices (N,3) and shares (N,3) of the whole mesh, and those of the level.
    """
    body = shaped.body
    face = random.integers(0, len(body.faces), count)
    shares = random.dirichlet(np.ones(3), count)
    uv = body.uv.astype(np.float64)
    points = np.einsum("nk,nka->na", shares, uv[body.uv_faces[face]])
    a, b, c = (uv[level.uv_faces[:, k]] for k in range(3))
    found, rows, others = [], [], []
    for number, point in enumerate(points):
        area = cross(b - a, c - a)
        inside = np.stack(
            [cross(b - point, c - point), cross(c - point, a - point), cross(a - point, b - point)], axis=1
        )
        with np.errstate(divide="ignore", invalid="ignore"):
            inside /= area[:, None]
        for triangle in np.flatnonzero((inside >= 0).all(axis=1)):
            found.append(number)
            rows.append(triangle)
            others.append(inside[triangle])
    return body.faces[face[found]], shares[found], level.faces[rows], np.array(others)


def cross(a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])


def clip_from(random: np.random.Generator) -> NDArray[np.float64]:
    """A camera that looks at the body's middle from 2 to 30 metres, from any side."""
    turned = random.uniform(-np.pi, np.pi)
    view = np.eye(4)
    view[:3, :3] = [[np.cos(turned), 0, -np.sin(turned)], [0, 1, 0], [np.sin(turned), 0, np.cos(turned)]]
    view[:3, 3] = 0.0, -0.9, -random.uniform(2.0, 30.0)
    focal, near, far = 1 / np.tan(np.radians(25.0)), 0.05, 100.0
    projection = np.diag([focal * 3 / 4, focal, (far + near) / (near - far), 0.0])
    projection[2, 3], projection[3, 2] = 2 * far * near / (near - far), -1.0
    return np.asarray(projection @ view)


def check_bounds(
    included: tuple[ShapedBody, tuple[MeshLevel, ...]], poses: int, texels: int | None, seed: int
) -> float:
    """Every texel moves by no more than the bound: in metres, and on the picture of a random camera.

    `texels`: number of random texels; None for the worst ones. Returns the largest share of the bound in metres.
    """
    from trilane.body.skinning import DetailBounds

    shaped, levels = included
    random = np.random.default_rng(seed)
    skeleton, skinner, reach = (
        Skeleton(shaped.joints, shaped.body.parents),
        CpuSkinner(shaped),
        DetailBounds(shaped).reach,
    )
    output = (480, 640)
    same = [texels_of(level, shaped, random, texels) if texels else worst_texels(level, shaped) for level in levels]
    most = 0.0
    for number in range(poses):
        which = number % len(levels)
        own, shares, other, others = same[which]
        posed = skeleton.pose(random_pose(random))
        places, clip = skinner.vertices(posed), clip_from(random)
        ends = [np.einsum("nk,nka->na", part, places[rows]) for part, rows in ((shares, own), (others, other))]
        bound = levels[which].metres(posed)
        most = max(most, float(np.linalg.norm(ends[0] - ends[1], axis=1).max()) / bound)
        assert most <= 1.0
        limit = error_px(bound, stretch_of(clip, output), least_w(posed, clip, reach))
        if np.isfinite(limit):
            seen = [points @ clip[:, :3].T + clip[:, 3] for points in ends]
            pixels = [points[:, :2] / points[:, 3:] * (320, 240) for points in seen]
            shown = (np.abs(seen[0][:, :2]) <= seen[0][:, 3:]).all(axis=1)
            assert np.linalg.norm(pixels[0] - pixels[1], axis=1)[shown].max(initial=0.0) <= limit
    return most


def test_no_texel_moves_further_than_the_bound(included: tuple[ShapedBody, tuple[MeshLevel, ...]]) -> None:
    check_bounds(included, 60, 150, 1)


def test_the_bound_holds_where_texels_move_furthest_and_is_nearly_reached(
    included: tuple[ShapedBody, tuple[MeshLevel, ...]],
) -> None:
    """A bound that is twice as large as it need be would choose levels far too late."""
    assert check_bounds(included, 100, None, 3) > 0.9


@pytest.mark.slow
def test_no_texel_moves_further_than_the_bound_in_5000_poses_views_and_levels(
    included: tuple[ShapedBody, tuple[MeshLevel, ...]],
) -> None:
    check_bounds(included, 5000, 2000, 2)
