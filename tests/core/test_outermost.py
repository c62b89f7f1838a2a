"""The quick bounds of a body: candidates in float32 against every vertex in float64, and the sphere round all poses."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from trilane.arrays import F64
from trilane.body.body import ShapedBody, load_body
from trilane.body.kinematics import Skeleton
from trilane.body.skinning import CpuSkinner
from trilane.stages.cpu.mesh_bounds import ROUNDING_M, MeshBounds, Outermost

LENS = np.array([(1.5, 0, 0.2, 0), (0, 2.0, -0.1, 0), (0, 0, -1.02, -0.202), (0, 0, -1, 0.0)])  # near 0.1, far 10


@pytest.fixture
def shaped(tmp_path: Path, body_arrays: dict[str, NDArray[Any]]) -> ShapedBody:
    """A small body with pose blend shapes."""
    np.savez(tmp_path / "body.npz", allow_pickle=False, **body_arrays)
    return load_body(tmp_path / "body.npz").shape()


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


def test_the_reach_follows_the_bones_to_the_joints(tmp_path: Path, body_arrays: dict[str, NDArray[Any]]) -> None:
    """Without blend shapes, bone by bone."""
    np.savez(tmp_path / "body.npz", allow_pickle=False, **body_arrays | {"posedirs": 0 * body_arrays["posedirs"]})
    shaped = load_body(tmp_path / "body.npz").shape()
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
