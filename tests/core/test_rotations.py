"""Rotations: exact at the ends, inverse of each other, and a slerp that keeps to the great circle."""

from __future__ import annotations

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
