"""The mesh's rectangle, part by part: patches and spheres by formula, candidates in float32 against every vertex."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from trilane.arrays import F64
from trilane.body.body import ShapedBody
from trilane.body.joints import Posed, Skeleton
from trilane.body.skinning import CpuSkinner, blend_reach
from trilane.scene.crop import Rect
from trilane.stages.cpu import mesh_bounds
from trilane.stages.cpu.mesh_bounds import ROUNDING_M, MeshBounds, Outermost

LENS = np.array([(1.5, 0, 0.2, 0), (0, 2.0, -0.1, 0), (0, 0, -1.02, -0.202), (0, 0, -1, 0.0)])  # near 0.1, far 10


def bent(shaped: ShapedBody, seed: int = 0, size: float = 0.5) -> Any:
    pose = np.random.default_rng(seed).normal(0, size, 165)
    return Skeleton(shaped.joints, shaped.body.parents).pose(pose, (0.1, 0.2, -0.3))


# --- patches ---------------------------------------------------------------------------------------------------------


def test_levels_are_the_same_from_the_cache(shaped: ShapedBody) -> None:
    weights = shaped.body.weights.astype(float)
    made = mesh_bounds._build_levels(shaped, weights)
    for _ in range(2):
        for level, expected in zip(mesh_bounds.build_levels(shaped, weights), made, strict=True):
            for name in ("centres", "size", "give", "blend"):
                np.testing.assert_array_equal(getattr(level, name), getattr(expected, name))
            for name in ("parts", "faces"):
                assert [g.tolist() for g in getattr(level, name)] == [g.tolist() for g in getattr(expected, name)]


@pytest.mark.parametrize("size", [0.1, 0.6, 2.0])
def test_spheres_hold_their_patches_in_every_pose(shaped: ShapedBody, size: float) -> None:
    """No vertex is farther from its patch's centre than the radius; blend shapes may move both."""
    weights = shaped.body.weights.astype(float)
    skinner = CpuSkinner(shaped)
    for seed in range(4):
        posed = bent(shaped, seed, size)
        vertices = skinner.vertices(posed)
        angles = np.linalg.norm(posed.feature.reshape(-1, 9), axis=1)  # |R - I| = 2 sqrt(2) sin(t / 2)
        for level in mesh_bounds._build_levels(shaped, weights):
            radius = level.size + level.give @ (angles / np.sqrt(2)) + 2 * level.blend @ angles
            for number, faces in enumerate(level.faces):
                members = np.unique(shaped.body.faces[faces])
                away = np.linalg.norm(vertices[members] - vertices[level.centres[number]], axis=1)
                assert away.max() <= radius[number] + 1e-6


# --- spheres on the screen -------------------------------------------------------------------------------------------


def view_of(shaped: ShapedBody, clip: F64 = LENS, posed: Any = None) -> Any:
    return mesh_bounds._View.of(posed or bent(shaped), clip)


def test_spheres_are_sorted_by_the_near_and_far_plane(shaped: ShapedBody) -> None:
    """Before the near plane at 0.1 m, across it, behind it; across and beyond the far one at 10 m."""
    view = view_of(shaped)
    depth = np.array([0.2, 0.2, -0.5, 0.05, 9.95, 10.2, 10.2, 0.04, 5.0])
    radius = np.array([0.05, 0.15, 0.05, 0.1, 0.3, 0.1, 0.3, 0.05, 0.0])
    centres = np.c_[np.zeros((9, 2)), -depth, np.ones(9)] @ LENS.T
    front, cut = mesh_bounds._against_near(centres, radius, view)
    assert front.tolist() == [True, False, False, False, True, False, True, False, True]
    assert cut.tolist() == [False, True, False, True, False, False, False, False, False]


def test_an_extent_grows_and_is_clipped_to_the_screen() -> None:
    extent = mesh_bounds._Extent()
    assert extent.rect() is None
    extent.add(np.zeros((0, 2)), np.zeros((0, 2)))
    extent.add(np.array([(0.1, -0.3), (0.2, -1.5)]), np.array([(0.3, 0.2), (0.25, 0.4)]))
    extent.add(np.array([(0.15, 0.0)]), np.array([(0.28, 0.1)]))
    assert extent.rect() == pytest.approx((0.1 - 1e-6, -1.0, 0.3 + 1e-6, 0.4 + 1e-6), abs=1e-12)
    low = np.array([(0.05, 0), (0.1, 0), (0.2, -2), (0.2, 0), (0.2, 0), (0.1, -1.5)])
    high = np.array([(0.2, 0), (0.3, 0.4), (0.2, 0), (0.31, 0), (0.2, 0.41), (0.3, 0.4)])
    assert extent.widened_by(low, high).tolist() == [True, False, False, True, True, False]
    extent.add(np.array([(-1.0, -1.0)]), np.array([(1.0, 2.0)]))
    assert not extent.widened_by(np.array([(-9.0, -9)]), np.array([(9.0, 9)])).any()
    assert extent.rect() == Rect(-1, -1, 1, 1)
    beside = mesh_bounds._Extent()
    beside.add(np.array([(1.2, 0)]), np.array([(1.4, 0.5)]))
    assert beside.rect() is None


def whole(points: F64, clip: F64, radius: float) -> tuple[F64, F64]:
    """Least and greatest place on the screen of spheres about `points`."""
    h = np.c_[points, np.ones(len(points))] @ clip.T
    norms = np.linalg.norm(clip[:, :3], axis=1)
    ends = np.stack(
        [(h[:, :2] + a * radius * norms[:2]) / (h[:, 3:] + b * radius * norms[3]) for a in (-1, 1) for b in (-1, 1)]
    )
    return ends.min(axis=(0, 1)), ends.max(axis=(0, 1))


@pytest.mark.parametrize("standoff", [0.0, 0.04])
def test_a_whole_body_needs_its_vertices_alone(shaped: ShapedBody, standoff: float) -> None:
    """Wholly on the screen: the spheres of its vertices, and no patch is looked at; else None from the quick way."""
    bounds, posed = MeshBounds(shaped, standoff_m=standoff), bent(shaped)
    vertices = CpuSkinner(shaped).vertices(posed).astype(np.float32)
    view = np.eye(4)
    view[2, 3] = -5
    bounds._levels = []
    low, high = whole(vertices.astype(float), LENS @ view, standoff + 1e-4)
    found = bounds.rect(posed, LENS @ view, vertices)
    assert found == pytest.approx((*(low - 1e-6), *(high + 1e-6)), abs=2e-6)
    for place in ((4.0, 0, -5), (0, -2.5, -5), (0, 0, -0.5), (0, 0, 5), (0, 0, -10.1), (0, 0, -20)):
        view[:3, 3] = place
        clip = mesh_bounds._View.of(posed, LENS @ view)
        assert bounds._rect_of_whole(vertices, clip) is None


def test_the_quick_way_keeps_the_standoff_from_every_plane(shaped: ShapedBody) -> None:
    """One vertex before a lens: at the near and the far plane a radius decides, and at the screen's edges."""
    bounds, radius = MeshBounds(shaped, standoff_m=0.01), 0.0101
    view = mesh_bounds._View.of(bent(shaped), LENS)

    def seen(x: float, y: float, depth: float) -> bool:
        return bounds._rect_of_whole(np.array([(x, y, -depth)], np.float32), view) is not None

    near = 0.202 / 2.02 + radius  # z + w = 0 at 0.1 m; its norm is 2.02
    assert seen(0, 0, near + 1e-3) and not seen(0, 0, near - 1e-3)
    far = 0.202 / 0.02 - radius  # w - z = 0 at 10.1 m; its norm is 0.02
    assert seen(0, 0, far - 1e-3) and not seen(0, 0, far + 1e-3)
    for sign in (-1, 1):  # with x = 1.5 X - 0.2 depth the edge lies where |x| + radius norm = w - radius
        edge = (sign * (2 - radius - radius * np.hypot(1.5, 0.2)) + 0.4) / 1.5
        assert seen(edge - sign * 1e-3, 0, 2) and not seen(edge + sign * 1e-3, 0, 2)


SQUARE = np.array([[-0.01, -0.01, 0], [0.01, -0.01, 0], [0.01, 0.01, 0], [-0.01, 0.01, 0]], np.float32)


@pytest.fixture
def square(shaped: ShapedBody) -> ShapedBody:
    """A square of 2 cm at the origin on the root, without pose blend shapes; joints at the origin, left_hip 1 m up."""
    weights = np.zeros((4, 55), np.float32)
    weights[:, 0] = 1.0
    body = dataclasses.replace(
        shaped.body,
        weights=weights,
        posedirs=None,
        faces=np.array([[0, 1, 2], [0, 2, 3]], np.int32),
    )
    joints = np.zeros((55, 3))
    joints[1] = 0, 1, 0
    return ShapedBody(SQUARE, joints, body)


def looking_at(x: float, half_m: float = 0.2) -> NDArray[np.float64]:
    """Clip matrix of a parallel view of the plane z = 0 round (x, 0), `half_m` to each side."""
    clip = np.diag([1 / half_m, 1 / half_m, -0.1, 1.0])
    clip[0, 3] = -x / half_m
    return clip


def posed(shaped: ShapedBody, hip_angle: float, axis: int) -> Posed:
    pose = np.zeros(165)
    pose[3 + axis] = hip_angle
    return Skeleton(shaped.joints, shaped.body.parents).pose(pose)


def blended(shaped: ShapedBody) -> ShapedBody:
    """Turning left_hip half round about y, where R - I = diag(-2, 0, -2), moves the square by 1 m to +x."""
    posedirs = np.zeros((4, 3, 486), np.float32)
    posedirs[:, 0, 0] = -0.3
    posedirs[:, 0, 8] = -0.2
    return dataclasses.replace(shaped, body=dataclasses.replace(shaped.body, posedirs=posedirs))


def test_a_mesh_that_only_its_blend_shapes_bring_into_the_picture(square: ShapedBody) -> None:
    shaped = blended(square)
    frame = posed(shaped, math.pi, 1)
    rect = MeshBounds(shaped).rect(frame, looking_at(1.0))
    assert rect is not None
    found = (rect.x0, rect.y0, rect.x1, rect.y1)
    assert found == pytest.approx((-0.05, -0.05, 0.05, 0.05), abs=1e-5)
    assert MeshBounds(shaped, pose_blend=False).rect(frame, looking_at(1.0)) is None
    at_rest = MeshBounds(shaped, pose_blend=False).rect(frame, looking_at(0.0))
    assert at_rest is not None and at_rest.x1 == pytest.approx(0.05, abs=1e-5)
    assert MeshBounds(shaped).rect(frame, looking_at(0.0)) is None


def test_the_reach_of_blend_shapes_is_their_norm(square: ShapedBody) -> None:
    reach = blend_reach(blended(square))
    assert reach.shape == (4, 54)
    assert reach[:, 0] == pytest.approx([math.hypot(0.3, 0.2)] * 4)
    assert not reach[:, 1:].any()


def test_a_corner_that_only_a_joint_brings_into_the_picture(square: ShapedBody) -> None:
    """One corner hangs on left_hip, 1 m above: at half a turn about z it is at y = 2, and the view looks there."""
    weights = square.body.weights.copy()
    weights[2] = 0.0
    weights[2, 1] = 1.0
    shaped = dataclasses.replace(square, body=dataclasses.replace(square.body, weights=weights))
    clip = looking_at(0.0)
    clip[1, 3] = -2.0 / 0.2
    rect = MeshBounds(shaped).rect(posed(shaped, math.pi, 2), clip)
    assert rect is not None
    assert (rect.y1, rect.x0) == pytest.approx((-0.05, -0.05), abs=1e-5)  # (-0.01, 1.99) of (0, 2), over 0.2


@pytest.mark.parametrize("standoff", [0.0, 0.05])
def test_clothes_widen_the_rectangle_by_their_reach(square: ShapedBody, standoff: float) -> None:
    frame = posed(square, 0.0, 0)
    bounds = MeshBounds(square, standoff_m=standoff)
    for vertices in (None, SQUARE):
        rect = bounds.rect(frame, looking_at(0.0), vertices)
        assert rect is not None
        reach = (0.01 + standoff) / 0.2
        assert (rect.x0, rect.x1) == pytest.approx((-reach, reach), abs=1e-3)
        assert rect.x1 >= reach


def ends(vertices: NDArray[np.float32], camera: F64, radius: float) -> tuple[F64, F64] | None:
    """Least and greatest (x, y) over the spheres, each (V,2), in float64; None when one reaches a plane or an edge."""
    h = vertices.astype(float) @ camera[:, :3].T + camera[:, 3]
    reach = radius * np.linalg.norm(camera[:, :3], axis=1)
    planes = np.stack([h[:, 3] + h[:, 2], h[:, 3] - h[:, 2]])
    norms = [np.linalg.norm(camera[3, :3] + sign * camera[2, :3]) for sign in (1, -1)]
    if (planes <= radius * np.array(norms)[:, None]).any() or (h[:, 3] <= reach[3]).any():
        return None
    every = np.stack([(h[:, :2] + a * reach[:2]) / (h[:, 3:] + b * reach[3]) for a in (-1, 1) for b in (-1, 1)])
    low, high = every.min(axis=0), every.max(axis=0)
    return (low, high) if (low > -1).all() and (high < 1).all() else None


@pytest.mark.parametrize("away_m", [0.0, 300.0, 8000.0])
def test_the_outermost_vertices_are_among_those_found(away_m: float) -> None:
    """Clouds in which many vertices are equally far out, as near as float32 can tell; far from the world's origin it
    tells places of the camera's picture apart only coarsely.
    """
    rng = np.random.default_rng(int(away_m))
    finder, both, neither = Outermost(400), 0, 0
    for _ in range(150):
        place = rng.normal(size=3) * away_m
        cloud = rng.uniform(-0.6, 0.6, (400, 3))
        cloud[:, :2] = np.round(cloud[:, :2] * 3) / 3  # so that hundreds share a side
        vertices = (cloud + place).astype(np.float32)
        view = np.eye(4)
        view[:3, :3] = np.linalg.qr(rng.normal(size=(3, 3)))[0] if rng.random() < 0.5 else np.eye(3)
        view[:3, 3] = np.array([*rng.normal(0, 0.3, 2), -rng.uniform(0.3, 11.0)]) - view[:3, :3] @ place
        camera, radius = LENS @ view, float(rng.uniform(0, 0.05))
        found, expected = finder.of(vertices, camera, radius), ends(vertices, camera, radius)
        both += found is not None
        neither += expected is None
        if expected is None:
            assert found is None
        elif found is not None:
            for axis in (0, 1):
                assert expected[0][:, axis].argmin() in found
                assert expected[1][:, axis].argmax() in found
                assert expected[0][found, axis].min() == expected[0][:, axis].min()
    assert both >= 30 and neither >= 30


def test_where_float32_is_exact_only_the_outermost_are_handed_on() -> None:
    """Four corners and a hundred vertices inside them, by a hundredth."""
    inside = np.random.default_rng(0).uniform(-0.49, 0.49, (100, 2))
    corners = [(-0.5, -0.5), (0.5, -0.5), (-0.5, 0.5), (0.5, 0.5)]
    vertices = np.c_[np.concatenate([corners, inside]), np.full(104, -2.0)].astype(np.float32)
    found = Outermost(104).of(vertices, np.diag([1.0, 1.0, 1.0, 1.0]) @ LENS, 0.0)
    assert found is not None and set(found.tolist()) == {0, 1, 2, 3}


def test_beside_the_middle_the_far_end_of_the_sphere_counts() -> None:
    """Left ends at radius 0.1, by x - 0.1 over depth + 0.1: 0.5 / 1.1 = 0.45 is left of 2.0 / 4.1 = 0.49, though over
    depth - 0.1 it would be 0.5 / 0.9 = 0.56 against 2.0 / 3.9 = 0.51. The last two are outermost on the other sides.
    """
    vertices = np.array([(0.6, 0, -1), (2.1, 0, -4), (0.75, 0.3, -1), (0.75, -0.3, -1)], np.float32)
    lens = np.array([(1.0, 0, 0, 0), (0, 1, 0, 0), LENS[2], LENS[3]])
    found = Outermost(4).of(vertices, lens, 0.1)
    assert found is not None and set(found.tolist()) == {0, 2, 3}


def test_a_number_that_is_none_is_left_to_the_slow_way() -> None:
    vertices = np.array([(0, 0, -2), (0.1, np.nan, -2)], np.float32)
    assert Outermost(2).of(vertices, LENS, 0.0) is None


def test_no_pose_brings_a_vertex_further_from_the_root_than_the_reach(shaped: ShapedBody) -> None:
    """Random turns of any size; straightened out, a chain comes near to it."""
    bounds, skinner = MeshBounds(shaped, standoff_m=0.0), CpuSkinner(shaped)
    skeleton = Skeleton(shaped.joints, shaped.body.parents)
    rng = np.random.default_rng(3)
    for size in (0.0, 0.3, 1.0, 3.0) * 20:
        posed = skeleton.pose(rng.normal(0, size, 165), (3.0, 1.0, -2.0))
        away = np.linalg.norm(skinner.vertices(posed) - posed.joints[0], axis=1)
        assert away.max() <= bounds.reach_m
    more = MeshBounds(shaped, standoff_m=0.25)
    assert more.reach_m == pytest.approx(bounds.reach_m + 0.25)


def test_the_reach_follows_the_bones_to_the_joints(shaped: ShapedBody) -> None:
    """Without blend shapes, bone by bone."""
    shaped = dataclasses.replace(shaped, body=dataclasses.replace(shaped.body, posedirs=None))
    parents, joints = shaped.body.parents, shaped.joints
    longest = 0.0
    for vertex, row in zip(shaped.vertices.astype(float), shaped.body.weights, strict=True):
        for joint in np.flatnonzero(row):
            length, at = float(np.linalg.norm(vertex - joints[joint])), int(joint)
            while parents[at] >= 0:
                length += float(np.linalg.norm(joints[at] - joints[parents[at]]))
                at = int(parents[at])
            longest = max(longest, length)
    assert MeshBounds(shaped).reach_m == pytest.approx(longest + ROUNDING_M)


def test_a_body_off_the_screen_is_so_in_every_pose(shaped: ShapedBody) -> None:
    """What is said to be off the screen has no rectangle; a sphere that just touches a plane may be seen."""
    bounds, skeleton = MeshBounds(shaped, standoff_m=0.02), Skeleton(shaped.joints, shaped.body.parents)
    rng, off = np.random.default_rng(5), 0
    for _ in range(300):
        place = rng.normal(0, 4.0, 3)
        posed = skeleton.pose(rng.normal(0, 0.8, 165), place - shaped.joints[0])
        if bounds.is_off_screen(posed.joints[0], LENS):
            off += 1
            assert bounds.rect(posed, LENS) is None
    assert 100 < off < 300
    reach = bounds.reach_m
    behind, back = np.array([0.0, 0.0, -0.1]), np.array([0.0, 0.0, 1.0])  # on the near plane, z + w = 0
    assert bounds.is_off_screen(behind + 1.001 * reach * back, LENS)
    assert not bounds.is_off_screen(behind + 0.999 * reach * back, LENS)
    edge, outward = np.array([-1.6, 0.0, -3.0]), np.array([-1.5, 0.0, 0.8]) / 1.7  # x + w = 1.5 x - 0.8 z = 0
    assert bounds.is_off_screen(edge + 1.001 * reach * outward, LENS)
    assert not bounds.is_off_screen(edge + 0.999 * reach * outward, LENS)
