"""The K largest weights and the bound on what they cost; vertices by hand."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from trilane.body.body import ShapedBody, load_body
from trilane.body.kinematics import Skeleton, rodrigues
from trilane.body.skinning import CpuSkinner, FrameSkinner, largest_weights, posed_vertices, weight_error_bound
from trilane.errors import BadInputError

Arrays = dict[str, NDArray[Any]]


@pytest.fixture
def shaped(tmp_path: Path, body_arrays: Arrays) -> ShapedBody:
    np.savez(tmp_path / "body.npz", allow_pickle=False, **body_arrays)
    return load_body(tmp_path / "body.npz").shape()


def test_largest_weights_are_kept_and_renormalised(shaped: ShapedBody) -> None:
    """Largest first, rows sum to 1, ratios as they were."""
    weights = shaped.body.weights
    top = largest_weights(weights, 4)
    assert top.joints.shape == top.weights.shape == (len(weights), 4)
    assert (np.diff(top.weights, axis=1) <= 0).all()
    np.testing.assert_allclose(top.weights.sum(axis=1), 1.0, atol=1e-6)
    np.testing.assert_allclose(
        top.weights[:, 0], np.sort(weights)[:, -1] / np.sort(weights)[:, -4:].sum(axis=1), rtol=1e-5
    )
    np.testing.assert_allclose(largest_weights(weights, 12).dense(), weights, atol=1e-7)


@pytest.mark.parametrize("count", [0, 5, 55])
def test_other_counts_are_refused(shaped: ShapedBody, count: int) -> None:
    """Only the counts that the shaders know."""
    with pytest.raises(BadInputError, match="4, 8 or 12"):
        largest_weights(shaped.body.weights, count)


@settings(max_examples=150, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(seed=st.integers(0, 2**32 - 1), spread=st.floats(0.0, 4.0))
def test_no_pose_breaks_the_bound(shaped: ShapedBody, seed: int, spread: float) -> None:
    """Random poses of every size, half turns among them, move no vertex further than the bound says."""
    random = np.random.default_rng(seed)
    pose = random.normal(0.0, spread, (55, 3))
    flipped = random.random(55) < 0.3
    pose[flipped] = np.pi * pose[flipped] / np.maximum(np.linalg.norm(pose[flipped], axis=1, keepdims=True), 1e-9)
    posed = Skeleton(shaped.joints, shaped.body.parents).pose(pose)
    exact = CpuSkinner(shaped, pose_blend=False).vertices(posed)
    fewer = CpuSkinner(shaped, 4, pose_blend=False).vertices(posed)
    moved = np.linalg.norm(exact - fewer, axis=1)
    assert (moved <= weight_error_bound(shaped, 4) + 2e-6).all()


def test_bound_is_positive_where_weights_are_left_out(shaped: ShapedBody) -> None:
    """The bound is above 0 for vertices that lose weights, and 0 for the others."""
    bound = weight_error_bound(shaped, 4)
    lost = (shaped.body.weights > 0).sum(axis=1) > 4
    assert (bound[lost] > 0).all()
    np.testing.assert_allclose(bound[~lost], 0.0, atol=1e-6)
    np.testing.assert_allclose(weight_error_bound(shaped, 8), 0.0, atol=1e-6)


def test_turning_the_root_turns_the_body(shaped: ShapedBody) -> None:
    """A rigid motion of the root moves every vertex about the root's centre."""
    vector, shift = np.array([0.3, 2.0, -1.0]), np.array([1.0, -2.0, 0.5])
    pose = np.zeros(165)
    pose[:3] = vector
    moved = next(posed_vertices(shaped, pose, shift))
    expected = (shaped.vertices - shaped.joints[0]) @ rodrigues(vector).T + shaped.joints[0] + shift
    np.testing.assert_allclose(moved, expected, atol=2e-6)


def test_vertices_equal_the_sum_over_joints(shaped: ShapedBody) -> None:
    """x = sum_k w_k G_k (p + posedirs . (R - I)), written out."""
    body = shaped.body
    assert body.posedirs is not None
    posed = Skeleton(shaped.joints, body.parents).pose(np.random.default_rng(3).normal(0, 1, 165))
    rest = shaped.vertices + np.tensordot(body.posedirs, posed.feature, 1)
    per_joint = np.einsum("jab,vb->vja", posed.matrices[:, :, :3], rest) + posed.matrices[:, :, 3]
    expected = np.einsum("vj,vja->va", body.weights, per_joint)
    np.testing.assert_allclose(CpuSkinner(shaped).vertices(posed), expected, atol=1e-5)


def test_each_pose_gives_one_mesh(shaped: ShapedBody) -> None:
    """(T, 165) gives T meshes; one pose gives one."""
    poses = np.random.default_rng(3).normal(0, 1, (3, 165))
    assert [mesh.shape for mesh in posed_vertices(shaped, poses)] == [(90, 3)] * 3
    assert len(list(posed_vertices(shaped, poses[0]))) == 1


def test_a_frame_in_float32_is_within_a_hundredth_of_a_millimetre(shaped: ShapedBody) -> None:
    """Bodies of any size: rows beyond the last whole block of the product are skinned too."""
    rng = np.random.default_rng(5)
    skeleton, slow, fast = Skeleton(shaped.joints, shaped.body.parents), CpuSkinner(shaped), FrameSkinner(shaped)
    for _ in range(5):
        posed = skeleton.pose(rng.normal(0, 0.5, 165), rng.normal(0, 1, 3))
        vertices = np.full((len(shaped.vertices), 3), np.nan, np.float32)
        fast.skin_into(posed, vertices)
        assert np.abs(vertices - slow.vertices(posed)).max() <= 1e-5
