"""Rotations: by hand, exact at the ends, inverse of each other, and a slerp that keeps to the great circle."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from trilane.scene import rotations as rot

unit_range = st.floats(-1, 1, allow_subnormal=False)
vectors = arrays(np.float64, 3, elements=unit_range)
quats = arrays(np.float64, 4, elements=unit_range).filter(lambda q: np.linalg.norm(q) > 0.1).map(rot.normalised)


@given(vectors, st.floats(0, 3.1))
def test_axis_angle_survives_quaternion_and_matrix(direction: np.ndarray, angle: float) -> None:
    if np.linalg.norm(direction) < 1e-3:
        return
    rotvec = direction / np.linalg.norm(direction) * angle
    assert rot.rotvec_from_quat(rot.quat_from_rotvec(rotvec)) == pytest.approx(rotvec, abs=1e-12)
    assert rot.rotvec_from_matrix(rot.matrix_from_rotvec(rotvec)) == pytest.approx(rotvec, abs=1e-7)


@pytest.mark.parametrize("angle", [0.0, 1e-300, 1e-160, 1e-9, np.pi, 3 * np.pi, 100.0])
def test_a_turn_about_z_is_exact(angle: float) -> None:
    expected = [[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]]
    assert np.abs(rot.matrix_from_rotvec([0.0, 0.0, angle]) - expected).max() < 1e-14


@given(quats)
def test_matrices_are_rotations_and_lead_back(quat: np.ndarray) -> None:
    matrix = rot.matrix_from_quat(quat)
    assert matrix @ matrix.T == pytest.approx(np.eye(3), abs=1e-12)
    assert np.linalg.det(matrix) == pytest.approx(1.0)
    assert abs(float(rot.quat_from_matrix(matrix) @ quat)) == pytest.approx(1.0)


@given(quats, quats)
def test_a_product_turns_by_one_and_then_the_other(first: np.ndarray, second: np.ndarray) -> None:
    both = rot.matrix_from_quat(rot.quat_multiply(second, first))
    assert both == pytest.approx(rot.matrix_from_quat(second) @ rot.matrix_from_quat(first), abs=1e-12)


@given(quats, quats, st.floats(0, 1))
def test_slerp_keeps_to_the_shorter_arc_at_even_speed(start: np.ndarray, end: np.ndarray, s: float) -> None:
    between = rot.slerp(start, end, s)
    assert np.linalg.norm(between) == pytest.approx(1.0)
    whole = np.arccos(min(abs(start @ end), 1.0))
    assert np.arccos(min(abs(between @ start), 1.0)) == pytest.approx(s * whole, abs=1e-6)
    assert np.arccos(min(abs(between @ end), 1.0)) == pytest.approx((1 - s) * whole, abs=1e-6)


@given(vectors, vectors)
def test_the_shortest_turn_lays_one_direction_on_the_other(source: np.ndarray, target: np.ndarray) -> None:
    if min(np.linalg.norm(source), np.linalg.norm(target)) < 1e-3:
        return
    turn = rot.shortest_turn(source, target)
    assert turn @ rot.normalised(source) == pytest.approx(rot.normalised(target), abs=1e-6)


def test_opposite_directions_turn_about_the_fallback() -> None:
    assert rot.shortest_turn([0, 0, 1], [0, 0, -1]) == pytest.approx(np.diag([1.0, -1.0, -1.0]), abs=1e-12)
    assert rot.shortest_turn([1, 0, 0], [-1, 0, 0]) @ [1, 0, 0] == pytest.approx([-1, 0, 0], abs=1e-12)


def test_rotations_by_hand() -> None:
    h = math.sqrt(0.5)
    assert rot.quat_from_rotvec([0, math.pi / 2, 0]) == pytest.approx([h, 0, h, 0])
    assert rot.quat_from_rotvec([2 * math.pi, 0, 0]) == pytest.approx([-1, 0, 0, 0])
    assert rot.rotvec_from_quat([-h, 0, h, 0]) == pytest.approx([0, -math.pi / 2, 0])
    assert rot.rotvec_from_quat([1, 1e-13, 0, 0]) == pytest.approx([2e-13, 0, 0])
    assert rot.rotvec_from_quat([-1, 1e-13, 0, 0]) == pytest.approx([-2e-13, 0, 0])
    assert rot.rotvec_from_quat([0, 0, 0, 1]) == pytest.approx([0, 0, math.pi])
    assert rot.quat_multiply([0, 1, 0, 0], [0, 0, 1, 0]) == pytest.approx([0, 0, 0, 1])  # i j = k
    for axis, (i, j) in enumerate(((1, 2), (2, 0), (0, 1))):
        turn = rot.about(axis, math.pi / 2)
        assert turn[:, i] == pytest.approx(np.eye(3)[j], abs=1e-15)
        assert turn[:, j] == pytest.approx(-np.eye(3)[i], abs=1e-15)
    assert rot.about(1, [0.0, 0.5]).shape == (2, 3, 3)
    assert rot.Y_UP_FROM_Z_UP.tolist() == [[1, 0, 0], [0, 0, 1], [0, -1, 0]]
    assert np.isnan(rot.normalised([0, 0, 0])).all()


def test_quaternions_of_every_largest_component() -> None:
    """Half turns about each axis and about the diagonals, and a turn with all parts."""
    h = math.sqrt(0.5)
    for quat in (
        [0, 1, 0, 0],
        [0, 0, 1, 0],
        [0, 0, 0, 1],
        [0, h, h, 0],
        [0, 0, h, h],
        [0, h, 0, h],
        [0.5, 0.1, -0.7, 0.5],
    ):
        unit = np.array(quat) / np.linalg.norm(quat)
        found = rot.quat_from_matrix(rot.matrix_from_quat(unit))
        assert abs(found @ unit) == pytest.approx(1.0, abs=1e-12)


def test_many_rotations_at_once_are_each_as_alone() -> None:
    random = np.random.default_rng(5)
    vectors = random.normal(0, 2, (2, 3, 3))
    quats = rot.quat_from_rotvec(vectors)
    other = rot.quat_from_rotvec(random.normal(0, 2, (2, 3, 3)))
    share = random.random((2, 3))
    for i in range(2):
        for j in range(3):
            assert quats[i, j] == pytest.approx(rot.quat_from_rotvec(vectors[i, j]))
            assert rot.rotvec_from_quat(quats)[i, j] == pytest.approx(rot.rotvec_from_quat(quats[i, j]))
            matrix = rot.matrix_from_quat(quats[i, j])
            assert rot.matrix_from_quat(quats)[i, j] == pytest.approx(matrix)
            assert rot.quat_from_matrix(rot.matrix_from_quat(quats))[i, j] == pytest.approx(
                rot.quat_from_matrix(matrix)
            )
            assert rot.slerp(quats, other, share)[i, j] == pytest.approx(
                rot.slerp(quats[i, j], other[i, j], share[i, j])
            )
            assert rot.normalised(vectors)[i, j] == pytest.approx(vectors[i, j] / np.linalg.norm(vectors[i, j]))


def test_slerp_by_hand() -> None:
    start, end = np.array([1.0, 0, 0, 0]), rot.quat_from_rotvec([0, 1.2, 0])
    for share in (0.0, 0.25, 1.0):
        for sign in (1, -1):
            found = rot.rotvec_from_quat(rot.slerp(start, sign * end, share))
            assert found == pytest.approx([0, 1.2 * share, 0], abs=1e-12)
    near = rot.quat_from_rotvec([0, 1.9e-6, 0])
    assert rot.slerp(start, near, 0.25)[2] == pytest.approx(0.95e-6 / 4, rel=1e-9)
    far = rot.quat_from_rotvec([0, 2.1e-6, 0])
    assert rot.slerp(start, far, 0.25)[2] == pytest.approx(1.05e-6 / 4, rel=1e-3)


def test_shortest_turns_by_hand() -> None:
    assert rot.shortest_turn([2, 0, 0], [0, 3, 0]) == pytest.approx(rot.about(2, math.pi / 2))
    assert rot.shortest_turn([1, 0, 0], [1, 0, 0]) == pytest.approx(np.eye(3))
    fallback = rot.shortest_turn([0, 1, 0], [0, -1, 0], fallback=[0.3, 0.8, 0.4])
    axis = np.array([0.6, 0, 0.8])
    assert fallback == pytest.approx(2 * np.outer(axis, axis) - np.eye(3))
    for i in range(3):  # the fallback itself has no perpendicular part
        unit = np.eye(3)[i]
        turn = rot.shortest_turn(unit, -unit, fallback=unit)
        assert turn @ unit == pytest.approx(-unit) and np.linalg.det(turn) == pytest.approx(1.0)
