"""The motions of the project's own: cyclic, human in their angles, on feet that do not slide."""

from __future__ import annotations

import numpy as np
import pytest

from trilane.avatars.bundle import bundle_folder
from trilane.body.body import ShapedBody, load_body
from trilane.body.joints import JOINT_INDEX
from trilane.body.kinematics import Skeleton
from trilane.scene.motion.builtin import BUILTIN, SWINGS
from trilane.scene.motion.motion import Wrap, bracket, wrapped_time
from trilane.scene.mover import Mover, make_mover
from trilane.scene.rotations import matrix_from_rotvec, rotvec_from_matrix
from trilane.scene.schema import AvatarSpec

RATE = 60


@pytest.fixture(scope="module")
def body() -> ShapedBody:
    return load_body(bundle_folder("default") / "body.npz").shape()


@pytest.fixture(scope="module")
def walker(body: ShapedBody) -> Mover:
    return make_mover(AvatarSpec(), BUILTIN["walk-wave-turn"](), body)


@pytest.fixture(scope="module")
def joints(walker: Mover, body: ShapedBody) -> np.ndarray:
    """(600, 55, 3) world positions over the cycle."""
    skeleton = Skeleton(body.joints, body.body.parents)
    samples = (walker.sample(k / RATE) for k in range(10 * RATE))
    return np.stack([skeleton.pose(pose, place, walker.world).joints.copy() for pose, place in samples])


@pytest.mark.parametrize("name", BUILTIN)
def test_a_cycle_ends_where_it_began(name: str) -> None:
    motion = BUILTIN[name]()
    assert motion.wrap is Wrap.LOOP
    assert np.isfinite(motion.poses).all()
    for t_s in (0.0, 0.4, 3.3):
        here, there = motion.sample(t_s), motion.sample(t_s + 7 * motion.duration_s)
        assert here[0] == pytest.approx(there[0], abs=1e-9)
        assert here[1] == pytest.approx(there[1], abs=1e-9)


#: The pelvis keeps midway between the feet, so it is at most half as fast as a foot: one that swings two steps far,
#: each of 0.58 s at 5 m / (0.78 * 5.88 s), in 0.46 s, at most 1.875 times as fast as on average (`smooth_step`).
FASTEST_M_S = 1.875 * (0.58 * 5 / (0.78 * 5.88)) / 0.46


@pytest.mark.parametrize(("name", "fastest"), [("walk-wave-turn", 1.5), ("there-and-back", FASTEST_M_S), ("idle", 1.5)])
def test_no_joint_jumps(name: str, fastest: float) -> None:
    motion = BUILTIN[name]()
    turns = matrix_from_rotvec(motion.poses)
    step = rotvec_from_matrix(np.swapaxes(turns[:-1], -1, -2) @ turns[1:])
    assert np.linalg.norm(step, axis=-1).max() * RATE < 12.0
    assert np.abs(np.diff(motion.translation, axis=0)).max() * RATE < fastest


def test_the_default_motion_is_300_frames_at_30_a_second() -> None:
    assert BUILTIN["walk-wave-turn"]().duration_s == 10.0


def test_the_walker_stays_near_the_origin_and_upright(joints: np.ndarray) -> None:
    assert np.linalg.norm(joints[:, 0, [0, 2]], axis=1).max() < 1.5
    assert joints[:, JOINT_INDEX["head"], 1].min() > 1.4
    knees = joints[:, [JOINT_INDEX["left_knee"], JOINT_INDEX["right_knee"]], 1]
    assert knees.min() > 0.35


@pytest.mark.parametrize(("side", "name"), [(1, "left_foot"), (-1, "right_foot")])
def test_a_standing_foot_does_not_slide(joints: np.ndarray, side: int, name: str) -> None:
    times = np.arange(len(joints)) / RATE
    stands = np.ones(len(joints), dtype=bool)
    for swing in SWINGS:
        if swing.side == side:
            stands &= (times < swing.start_s - 0.02) | (times > swing.end_s + 0.12)
    speed = np.linalg.norm(np.gradient(joints[:, JOINT_INDEX[name]][:, [0, 2]], axis=0), axis=1) * RATE
    assert speed[stands].mean() < 0.02
    assert speed[stands].max() < 0.15


def test_arms_hang_but_for_the_wave(joints: np.ndarray) -> None:
    left, right = (joints[:, JOINT_INDEX[f"{side}_wrist"], 1] for side in ("left", "right"))
    shoulder = joints[:, JOINT_INDEX["right_shoulder"], 1]
    assert (left < joints[:, JOINT_INDEX["left_shoulder"], 1] - 0.25).all()
    waving = slice(int(3.2 * RATE), int(4.6 * RATE))
    assert (right[waving] > shoulder[waving]).all()
    assert (right[: 2 * RATE] < shoulder[: 2 * RATE] - 0.25).all()
    assert np.ptp(joints[waving, JOINT_INDEX["right_wrist"], 0]) > 0.12


def test_it_waves_to_the_viewer_and_walks_away(walker: Mover) -> None:
    assert matrix_from_rotvec(walker.sample(3.8)[0][0])[2, 2] > 0.99
    assert matrix_from_rotvec(walker.sample(7.5)[0][0])[2, 2] < -0.95


@pytest.mark.parametrize("t_s", [-3.0, 0.0, 0.3, 1.0, 1.7, 1e9])
@pytest.mark.parametrize("wrap", Wrap)
def test_any_time_falls_inside_the_motion(t_s: float, wrap: Wrap) -> None:
    inside = wrapped_time(t_s, 1.0, wrap)
    assert 0.0 <= inside <= 1.0
    assert wrapped_time(t_s, 0.0, wrap) == 0.0
    i, j, fraction = bracket(np.array([0.0, 0.25, 1.0]), inside)
    assert i + 1 == j
    assert 0.0 <= fraction <= 1.0
