"""Skin weights and levels of detail: vertices by hand, and no pose moves a vertex further than its bound says."""

from __future__ import annotations

import math
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from trilane.arrays import F64
from trilane.body.body import ShapedBody, load_body
from trilane.body.joints import JOINT_INDEX, JOINTS, Skeleton, rodrigues
from trilane.body.skinning import (
    CARRIED_BY,
    DETAILS,
    EVERYTHING,
    ROUNDING_M,
    CpuSkinner,
    DetailBounds,
    FrameSkinner,
    carried,
    largest_weights,
    left_out,
    posed_vertices,
    weight_error_bound,
)
from trilane.scene.crop import Rect, cheapest_within, error_px, least_w, stretch_of
from trilane.scene.rotations import about
from trilane.stages.cpu.pose import FINEST, ModelledBody, widened


def test_largest_weights_are_kept_and_renormalised(shaped: ShapedBody) -> None:
    weights = shaped.body.weights
    top = largest_weights(weights, 4)
    assert top.joints.shape == top.weights.shape == (len(weights), 4)
    assert (np.diff(top.weights, axis=1) <= 0).all()
    np.testing.assert_allclose(top.weights.sum(axis=1), 1.0, atol=1e-6)
    np.testing.assert_allclose(
        top.weights[:, 0], np.sort(weights)[:, -1] / np.sort(weights)[:, -4:].sum(axis=1), rtol=1e-5
    )
    np.testing.assert_allclose(largest_weights(weights, 12).dense(), weights, atol=1e-7)


@settings(max_examples=150, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(seed=st.integers(0, 2**32 - 1), spread=st.floats(0.0, 4.0))
def test_no_pose_breaks_the_bound(shaped: ShapedBody, seed: int, spread: float) -> None:
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


OUTPUT = (480, 640)
FEW = 200
MANY = 5000


@pytest.fixture
def blended(tmp_path: Path, body_arrays: dict[str, NDArray[Any]]) -> ShapedBody:
    """A small body with pose blend shapes, and weights of many joints at every vertex."""
    random = np.random.default_rng(7)
    weights = random.random(body_arrays["weights"].shape) ** 8
    arrays = {**body_arrays, "weights": (weights / weights.sum(axis=1, keepdims=True)).astype(np.float32)}
    arrays["posedirs"] = random.normal(0.0, 0.002, arrays["posedirs"].shape).astype(np.float32)
    np.savez(tmp_path / "blended.npz", allow_pickle=False, **arrays)
    return load_body(tmp_path / "blended.npz").shape()


def random_pose(random: np.random.Generator) -> F64:
    """Of any size from standing still to wild, half turns among them."""
    pose = random.normal(0.0, 10 ** random.uniform(-2, 0.6), (JOINTS, 3))
    half = random.random(JOINTS) < 0.1
    pose[half] *= math.pi / np.maximum(np.linalg.norm(pose[half], axis=1, keepdims=True), 1e-9)
    return pose


def random_clip(random: np.random.Generator) -> F64:
    """A camera that looks at the body from 0.5 to 30 metres, from anywhere."""
    focal = random.uniform(0.8, 4.0)
    near, far = 0.05, 100.0
    projection = np.zeros((4, 4))
    projection[0, 0], projection[1, 1] = focal * 3 / 4, focal
    projection[2, 2], projection[2, 3] = (far + near) / (near - far), 2 * far * near / (near - far)
    projection[3, 2] = -1.0
    view = np.eye(4)
    view[:3, :3] = about(0, random.uniform(-1.5, 1.5)) @ about(1, random.uniform(-3, 3))
    view[:3, 3] = random.normal(0, 0.5), random.normal(0, 0.5), -(10 ** random.uniform(-0.3, 1.5))
    return np.asarray(projection @ view)


def on_screen(vertices: F64, clip: F64) -> tuple[F64, NDArray[np.bool_]]:
    """(V,2) pixels, and which vertices are in the picture."""
    points = vertices @ clip[:, :3].T + clip[:, 3]
    ahead = points[:, 3] > 1e-6
    ndc = points[:, :2] / np.where(ahead, points[:, 3], 1.0)[:, None]
    return ndc * (OUTPUT[1] / 2, OUTPUT[0] / 2), ahead & (np.abs(ndc) <= 1.0).all(axis=1)


def check_bounds(shaped: ShapedBody, poses: int, seed: int) -> None:
    """Random poses and views: no level moves a vertex of the body, or of its picture, further than the bound."""
    random = np.random.default_rng(seed)
    bounds, exact = DetailBounds(shaped), CpuSkinner(shaped)
    skeleton = Skeleton(shaped.joints, shaped.body.parents)
    skinners = [FrameSkinner(shaped, detail) for detail in DETAILS]
    drawn = np.empty(shaped.vertices.shape, np.float32)
    for _ in range(poses):
        posed = skeleton.pose(random_pose(random))
        clip = random_clip(random)
        true = exact.vertices(posed)
        places, seen = on_screen(true, clip)
        metres, w = bounds.metres(posed), least_w(posed, clip, bounds.reach, bounds.blend_m(posed))
        for skinner, bound in zip(skinners, metres, strict=True):
            skinner.skin_into(posed, drawn)
            assert np.linalg.norm(drawn - true, axis=1).max() <= bound + ROUNDING_M
            other, also = on_screen(drawn.astype(np.float64), clip)
            both = seen & also
            moved = np.linalg.norm(other - places, axis=1)[both].max(initial=0.0)
            assert moved <= error_px(bound + ROUNDING_M, stretch_of(clip, OUTPUT), w)


def test_no_pose_and_no_view_breaks_the_bounds(blended: ShapedBody) -> None:
    check_bounds(blended, FEW, seed=1)


def test_nor_do_those_of_the_default_body(body: ShapedBody) -> None:
    check_bounds(body, FEW // 10, seed=2)


@pytest.mark.slow
def test_nor_do_five_thousand(blended: ShapedBody) -> None:
    check_bounds(blended, MANY, seed=3)


def test_at_rest_only_rounding_is_left(blended: ShapedBody) -> None:
    """No joint is turned: weights do not matter, and the features of the blend shapes are 0."""
    posed = Skeleton(blended.joints, blended.body.parents).pose(np.zeros((JOINTS, 3)))
    assert DetailBounds(blended).metres(posed) == [ROUNDING_M] * (len(DETAILS) - 1) + [0.0]


def test_a_bound_by_hand(shaped: ShapedBody) -> None:
    """One joint, the left elbow, is turned by a right angle; only vertices that lose or gain weight of it can move.

    sum over b has one term, |E_b| 2 sin(45 degrees) |p - c_b|, of the vertex that has most of it.
    """
    elbow = JOINT_INDEX["left_elbow"]
    pose = np.zeros((JOINTS, 3))
    pose[elbow] = 0.0, 0.0, math.pi / 2
    posed = Skeleton(shaped.joints, shaped.body.parents).pose(pose)
    below = [j for j in range(JOINTS) if _is_below(shaped, j, elbow)]
    distance = np.linalg.norm(shaped.vertices - shaped.joints[elbow], axis=1)
    for detail, bound in zip(DETAILS[:-1], DetailBounds(shaped).metres(posed), strict=False):
        change = (detail.weights(shaped).astype(np.float64) - shaped.body.weights)[:, below].sum(axis=1)
        moved = np.abs(change) * 2 * math.sin(math.pi / 4) * distance
        blend = _blend_by_hand(shaped, elbow) if not detail.pose_blend else np.zeros(len(moved))
        assert bound >= (moved + blend).max() + ROUNDING_M - 1e-7
        assert (
            bound
            <= moved.max()
            + blend.max()
            + ROUNDING_M
            + np.abs(change).max() * _blend_by_hand(shaped, elbow).max() * math.sqrt(2.0)
            + 1e-9
        )


def _is_below(shaped: ShapedBody, joint: int, other: int) -> bool:
    while joint > 0:
        if joint == other:
            return True
        joint = int(shaped.body.parents[joint])
    return False


def _blend_by_hand(shaped: ShapedBody, joint: int) -> F64:
    """|R - I| of a right angle is 2 sqrt(2) sin(45 degrees) = 2."""
    if shaped.body.posedirs is None:
        return np.zeros(len(shaped.vertices))
    block = shaped.body.posedirs.reshape(-1, 3, JOINTS - 1, 9)[:, :, joint - 1]
    return np.asarray(2.0 * np.sqrt((block.astype(np.float64) ** 2).sum(axis=(1, 2))))


def test_hands_and_face_are_carried_by_wrist_and_head() -> None:
    """33 joints; a vertex of a fingertip and of an eye move wholly with wrist and head, one of the knee as before."""
    assert len(CARRIED_BY) == 33
    rows = np.zeros((3, JOINTS), np.float32)
    rows[0, JOINT_INDEX["left_ring3"]], rows[0, JOINT_INDEX["left_wrist"]] = 0.75, 0.25
    rows[1, JOINT_INDEX["right_eye"]], rows[1, JOINT_INDEX["jaw"]] = 0.5, 0.5
    rows[2, JOINT_INDEX["left_knee"]] = 1.0
    moved = carried(rows)
    assert [np.flatnonzero(row).tolist() for row in moved] == [
        [JOINT_INDEX["left_wrist"]],
        [JOINT_INDEX["head"]],
        [JOINT_INDEX["left_knee"]],
    ]
    assert carried(np.eye(JOINTS, dtype=np.float32))[JOINT_INDEX["right_thumb1"], JOINT_INDEX["right_wrist"]] == 1.0


# --- metres to pixels ------------------------------------------------------------------------------------------------


def straight_clip(distance: float) -> F64:
    """A camera on +Z at `distance` with a field of view of 90 degrees each way: W = distance - z, X = x, Y = y."""
    clip = np.zeros((4, 4))
    clip[0, 0] = clip[1, 1] = 1.0
    clip[2, 2], clip[3, 2], clip[3, 3] = -1.0, -1.0, distance
    return clip


def test_pixels_by_hand() -> None:
    """1 cm at W = 2.01 and a corner of 640x480: J has the rows 320 (1, 0, 1) and 240 (0, 1, 1).

    J J^T is ((204800, 76800), (76800, 115200)), whose larger eigenvalue is 160000 + sqrt(44800^2 + 76800^2). Its root,
    times 0.01 / (2.01 - 0.01), is 2.4946 pixels.
    """
    stretch = stretch_of(straight_clip(5.0), OUTPUT)
    assert error_px(0.01, stretch, 2.01) == pytest.approx(2.4946, abs=1e-4)
    assert error_px(0.0, stretch, -1.0) == 0.0
    assert error_px(0.01, stretch, 0.01) == math.inf
    assert error_px(0.01, stretch, -3.0) == math.inf


def test_the_least_w_by_hand(shaped: ShapedBody) -> None:
    """W = 5 - z; with a reach of 0.25 m about the joint nearest to the camera, and 0.05 of blend shapes."""
    posed = Skeleton(shaped.joints, shaped.body.parents).pose(np.zeros((JOINTS, 3)))
    reach = np.full(JOINTS, 0.25)
    nearest = float(posed.joints[:, 2].max())
    assert least_w(posed, straight_clip(5.0), reach, 0.05) == pytest.approx(5.0 - nearest - 0.3)
    reach[posed.joints[:, 2].argmax()] = 0.0
    others = np.delete(posed.joints[:, 2], posed.joints[:, 2].argmax()).max()
    assert least_w(posed, straight_clip(5.0), reach) == pytest.approx(5.0 - float(others) - 0.25)


@pytest.mark.parametrize(
    ("errors", "budget", "expected"),
    [([9.0, 3.0, 0.5, 0.0], 0.5, 2), ([9.0, 3.0, 0.5, 0.0], 10.0, 0), ([9.0, math.inf, 0.0], 0.1, 2)],
)
def test_the_cheapest_level_within_the_budget(errors: list[float], budget: float, expected: int) -> None:
    assert cheapest_within(errors, budget) == expected


# --- an avatar of the CPU unit ---------------------------------------------------------------------------------------


def test_far_off_less_is_modelled_than_near(blended: ShapedBody) -> None:
    """The same pose at 3 metres and further off: each level is the first whose bound is within half a pixel."""
    body = ModelledBody([blended], (), skins=True, budget_px=0.5)
    posed = body.skeleton().pose(np.full((JOINTS, 3), 0.3))
    chosen = [body.choose(posed, straight_clip(distance), OUTPUT) for distance in (3.0, 30.0, 300.0, 30000.0)]
    levels = [one.level for one in chosen]
    assert levels == sorted(levels, reverse=True)
    assert (levels[0], levels[-1]) == (FINEST, 0)
    assert all(one.error_px <= 0.5 for one in chosen)


@pytest.mark.parametrize(("skins", "budget"), [(False, 0.5), (True, 0.0)])
def test_everything_is_modelled_where_the_gpu_skins_or_nothing_may_be_left_out(
    blended: ShapedBody, skins: bool, budget: float
) -> None:
    body = ModelledBody([blended], (), skins=skins, budget_px=budget)
    posed = body.skeleton().pose(np.full((JOINTS, 3), 0.3))
    choice = body.choose(posed, straight_clip(3000.0), OUTPUT)
    assert (choice.level, choice.error_px) == (FINEST, 0.0)


def test_a_rectangle_grows_by_the_error() -> None:
    """3.2 pixels of 640 are 0.01 of a side that is 2 long; 2.4 of 480 too. The screen's edge is not passed."""
    x, y = 6.4 / 640, 6.4 / 480
    half = 0.5
    grown = widened(Rect(-half, -half, half, half), 3.2, OUTPUT)
    assert grown == pytest.approx((-half - x, -half - y, half + x, half + y))
    assert widened(Rect(-1.0, -1.0, 1.0, 0.0), 3.2, OUTPUT) == pytest.approx((-1.0, -1.0, 1.0, y))


def test_what_a_level_leaves_out_is_said_in_words() -> None:
    """Of three vertices the first has five weights, all on the body, the second two of a hand, the third one."""
    weights = np.zeros((3, JOINTS), np.float32)
    weights[0, :5] = 0.2
    weights[1, [JOINT_INDEX["left_index1"], JOINT_INDEX["left_index2"]]] = 0.5
    weights[2, 0] = 1.0
    body = SimpleNamespace(weights=weights, posedirs=None)
    cut = "all but the 4 largest skin weights of 1 of 3 vertices"
    assert left_out(DETAILS[0], body) == ["turns of fingers, jaw and eyes", cut]  # type: ignore[arg-type]
    assert left_out(DETAILS[1], body) == [cut]  # type: ignore[arg-type]
    assert left_out(DETAILS[2], body) == left_out(EVERYTHING, body) == []  # type: ignore[arg-type]
    body.posedirs = np.zeros((3, 3, 486))
    assert left_out(DETAILS[2], body) == ["pose blend shapes"]  # type: ignore[arg-type]
    assert left_out(DETAILS[3], body) == []  # type: ignore[arg-type]
