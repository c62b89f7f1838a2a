"""Rotations at every angle, and the joint chain against the plain recursion."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from trilane.arrays import F64
from trilane.body.joints import JOINT_PARENTS, Skeleton, rodrigues, turn
from trilane.errors import BadInputError

PARENTS = np.array(JOINT_PARENTS, np.int32)

directions = st.tuples(*[st.floats(-1, 1)] * 3).filter(lambda v: np.linalg.norm(v) > 0.1)
angles = st.one_of(
    st.floats(0, 7),
    st.floats(-300, -1).map(lambda exponent: 10.0**exponent),
    st.integers(-3, 3).flatmap(lambda k: st.floats(-1e-6, 1e-6).map(lambda d: k * np.pi + d)),
    st.floats(0, 1000),
)


def unit(direction: tuple[float, ...]) -> F64:
    return np.asarray(np.array(direction) / np.linalg.norm(direction))


@given(directions, angles)
def test_rotation_is_exact_at_every_angle(direction: tuple[float, ...], angle: float) -> None:
    """Against cos and sin of the whole angle: R = c I + s [a]x + (1 - c) a a^T, and orthonormal to the last bits."""
    a = unit(direction)
    cross = np.array([[0, -a[2], a[1]], [a[2], 0, -a[0]], [-a[1], a[0], 0]])
    c, s = np.cos(angle), np.sin(angle)
    rotation = rodrigues(angle * a)
    tolerance = 1e-15 * (4 + abs(angle))
    np.testing.assert_allclose(rotation, c * np.eye(3) + s * cross + (1 - c) * np.outer(a, a), atol=tolerance)
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=4e-15)
    assert np.linalg.det(rotation) == pytest.approx(1.0, abs=4e-15)


def test_zero_is_the_identity_exactly() -> None:
    assert (rodrigues(np.zeros(3)) == np.eye(3)).all()
    assert np.abs(turn(np.full(3, 1e-200))).max() == 1e-200
    assert np.abs(turn(np.full(3, 5e-324))).max() <= 5e-324


def test_half_turns_are_exact() -> None:
    for axis in range(3):
        expected = -np.eye(3)
        expected[axis, axis] = 1.0
        np.testing.assert_allclose(rodrigues(np.pi * np.eye(3)[axis]), expected, atol=2e-16)
    a = unit((1, 1, 0))
    np.testing.assert_allclose(rodrigues(np.pi * a), 2 * np.outer(a, a) - np.eye(3), atol=3e-16)


def test_small_turns_keep_their_digits() -> None:
    v = np.array([3e-9, -2e-9, 1e-9])
    linear = np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])
    second = (np.outer(v, v) - v @ v * np.eye(3)) / 2
    np.testing.assert_allclose(turn(v), linear + second, rtol=1e-14)


def plain_chain(joints: F64, pose: F64, translation: F64, world: F64) -> tuple[F64, F64]:
    """Skinning matrices and joints by the 55-step recursion."""
    rotations = rodrigues(pose.reshape(55, 3))
    places = np.zeros((55, 4, 4))
    for j, parent in enumerate(JOINT_PARENTS):
        local = np.eye(4)
        local[:3, :3] = rotations[j]
        local[:3, 3] = joints[j] + translation if parent < 0 else joints[j] - joints[parent]
        places[j] = (world if parent < 0 else places[parent]) @ local
    matrices = places[:, :3].copy()
    matrices[:, :, 3] -= np.einsum("jab,jb->ja", matrices[:, :, :3], joints)
    return matrices, places[:, :3, 3]


def test_chain_equals_the_plain_recursion() -> None:
    random = np.random.default_rng(4)
    joints = random.normal(0, 0.5, (55, 3))
    skeleton = Skeleton(joints, PARENTS)
    for _ in range(20):
        pose, translation = random.normal(0, 1.5, 165), random.normal(0, 2, 3)
        world = np.eye(4)
        world[:3, :3], world[:3, 3] = rodrigues(random.normal(0, 2, 3)), random.normal(0, 3, 3)
        posed = skeleton.pose(pose, translation, world)
        matrices, places = plain_chain(joints, pose, translation, world)
        np.testing.assert_allclose(posed.matrices, matrices, rtol=1e-6, atol=2e-6)
        np.testing.assert_allclose(posed.joints, places, atol=1e-13)
        np.testing.assert_allclose(posed.feature.reshape(54, 3, 3), turn(pose.reshape(55, 3))[1:], atol=1e-7)


def test_rest_pose_is_the_identity() -> None:
    posed = Skeleton(np.random.default_rng(1).normal(0, 1, (55, 3)), PARENTS).pose(np.zeros(165))
    np.testing.assert_allclose(posed.matrices, np.tile(np.eye(3, 4), (55, 1, 1)), atol=1e-15)
    assert not posed.feature.any()


def test_any_order_of_joints() -> None:
    parents = np.array([-1, 2, 3, 0], np.int32)
    joints = np.array([[0.0, 0, 0], [3, 0, 0], [2, 0, 0], [1, 0, 0]])
    posed = Skeleton(joints, parents).pose([0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, np.pi / 2])
    np.testing.assert_allclose(posed.joints, [[0, 0, 0], [1, 2, 0], [1, 1, 0], [1, 0, 0]], atol=1e-15)


@pytest.mark.parametrize("value", [np.nan, np.inf, 1e300])
def test_frames_that_are_not_finite_are_refused(value: float) -> None:
    skeleton = Skeleton(np.zeros((55, 3)), PARENTS)
    pose = np.zeros(165)
    with pytest.raises(BadInputError, match="place"):
        skeleton.pose(pose, [value, 0, 0])
    pose[70] = value
    with pytest.raises(BadInputError, match="pose"):
        skeleton.pose(pose)
