"""The mesh's rectangle where a single term of its bound decides: pose blend shapes, joints, stand-off."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from trilane.body.body import ShapedBody, load_body
from trilane.body.kinematics import Posed, Skeleton
from trilane.stages.cpu.mesh_bounds import MeshBounds, _blend_reach

SQUARE = np.array([[-0.01, -0.01, 0], [0.01, -0.01, 0], [0.01, 0.01, 0], [-0.01, 0.01, 0]], np.float32)


@pytest.fixture
def square(tmp_path: Path, body_arrays: dict[str, NDArray[Any]]) -> ShapedBody:
    """A square of 2 cm at the origin on the root, without pose blend shapes; joints at the origin, left_hip 1 m up."""
    np.savez(tmp_path / "body.npz", allow_pickle=False, **body_arrays)
    weights = np.zeros((4, 55), np.float32)
    weights[:, 0] = 1.0
    body = dataclasses.replace(
        load_body(tmp_path / "body.npz"),
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
    reach = _blend_reach(blended(square).body.posedirs, 4)
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
