"""Built-in motions: poses that are held, curves by their closed form, feet that do not slide."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from trilane.body.body import ShapedBody
from trilane.body.joints import JOINT_INDEX, Skeleton
from trilane.scene.motion import builtin
from trilane.scene.motion.builtin import (
    BUILD,
    BUILTIN,
    SWINGS,
    FootTrack,
    Swing,
    Walker,
    blurred,
    smooth_step,
    solve_leg,
)
from trilane.scene.motion.motion import Wrap
from trilane.scene.mover import Mover, make_mover
from trilane.scene.rotations import about, matrix_from_rotvec, rotvec_from_matrix
from trilane.scene.schema import AvatarSpec

RATE = 60


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


@pytest.mark.parametrize("name", BUILTIN)
def test_a_built_in_motion_is_as_it_was(held: Callable[[str, Any], None], name: str) -> None:
    motion = BUILTIN[name]()
    held("poses", motion.poses)
    held("places", motion.translation)
    held("times", motion.times_s)
    assert (motion.leg_m, motion.travels, motion.betas) == (BUILD.leg_m if name != "t-pose" else None, False, None)
    assert len(motion.notes) == 1 and motion.notes[0].startswith("built in: ")


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


def step(x: float) -> float:
    s = min(max(x, 0.0), 1.0)
    return 6 * s**5 - 15 * s**4 + 10 * s**3


# --- curves ---


def test_the_smooth_step_by_hand() -> None:
    assert smooth_step(np.array([-1, 0, 0.25, 0.5, 1, 2])).tolist() == [0, 0, 0.103515625, 0.5, 1, 1]


def test_a_blurred_wave_is_damped_by_its_frequency() -> None:
    """A cyclic Gaussian of s samples leaves exp(-2 (pi s f)²) of a wave of f cycles a sample, and a mean unchanged."""
    k = np.arange(120)
    wave = np.column_stack([3 + np.cos(2 * np.pi * 5 * k / 120), np.sin(2 * np.pi * 2 * k / 120)])
    gain = [math.exp(-2 * (math.pi * 4 * f) ** 2) for f in (5 / 120, 2 / 120)]
    expected = np.column_stack(
        [3 + gain[0] * np.cos(2 * np.pi * 5 * k / 120), gain[1] * np.sin(2 * np.pi * 2 * k / 120)]
    )
    assert blurred(wave, 4) == pytest.approx(expected)
    assert blurred(wave[:, 0], 4) == pytest.approx(expected[:, 0])
    impulse = blurred(np.eye(1, 121, 60)[0], 3)
    assert impulse[60:64] == pytest.approx(np.exp(-(np.arange(4) ** 2) / 18) / (3 * math.sqrt(2 * math.pi)), rel=1e-4)


# --- legs ---


@pytest.mark.parametrize("side", [1, -1])
def test_a_solved_leg_reaches_its_ankle_with_its_sole(side: int) -> None:
    """Hip, knee and ankle one after the other end at the track's ankle, and the foot lies as the track says."""
    random = np.random.default_rng(side + 2)
    count = 40
    hip = random.normal(0, 0.1, (count, 3)) + np.array([0, 0.9, 0])
    pelvis = matrix_from_rotvec(random.normal(0, 0.15, (count, 3)))
    away = random.normal(0, 0.25, (count, 3)) + np.array([0, -0.7, 0])
    away *= (0.6 + 0.24 * random.random(count))[:, None] / np.linalg.norm(away, axis=1, keepdims=True)
    foot = FootTrack(hip + away, random.normal(0, 0.3, count), random.normal(0, 0.3, count), np.ones(count))
    hips, knees, ankles = solve_leg(BUILD, side, hip, pelvis, foot)
    thigh, shin = BUILD.side(BUILD.knee, side), BUILD.side(BUILD.ankle, side)
    for k in range(count):
        at_hip = pelvis[k] @ hips[k]
        at_knee = at_hip @ knees[k]
        assert hip[k] + at_hip @ thigh + at_knee @ shin == pytest.approx(foot.ankle[k], abs=1e-9)
        assert at_knee @ ankles[k] == pytest.approx(about(1, foot.heading[k]) @ about(0, foot.pitch[k]), abs=1e-9)
        bend = rotvec_from_matrix(knees[k])
        assert bend[0] > 0 and bend[1:] == pytest.approx([0, 0], abs=1e-9)  # knees bend one way, about +X
        lateral = about(1, foot.heading[k])[:, 0] + pelvis[k][:, 0]  # the knee lies midway between foot and pelvis
        reach = thigh + knees[k] @ shin
        across = np.cross(np.cross([1.0, 0, 0], reach), reach)
        wanted = np.cross(np.cross(lateral, foot.ankle[k] - hip[k]), foot.ankle[k] - hip[k])
        turned = at_hip @ across
        assert turned / np.linalg.norm(turned) == pytest.approx(wanted / np.linalg.norm(wanted), abs=1e-9)


def test_a_leg_is_stretched_towards_what_it_cannot_reach() -> None:
    foot = FootTrack(np.array([[0.0, -0.5, 0.0]]), np.zeros(1), np.zeros(1), np.ones(1))
    hips, knees, _ = solve_leg(BUILD, 1, np.array([[0.0, 0.9, 0.0]]), np.eye(3)[None], foot)
    end = hips[0] @ (np.array(BUILD.knee) + knees[0] @ np.array(BUILD.ankle))
    assert end / np.linalg.norm(end) == pytest.approx([0, -1, 0], abs=1e-9)
    assert np.linalg.norm(end) == pytest.approx(BUILD.leg_m, abs=2e-4)  # but for the knee's own offset to the side


# --- footsteps ---


def route_at(t: float) -> tuple[float, float]:
    """z and heading of the walker's route, from the tables typed again."""
    z = -1.1 + 1.5 * float(builtin._eased(np.array([(t - 0.25) / 2.4]))[0])
    z -= 1.5 * float(builtin._eased(np.array([(t - 6.45) / 2.4]))[0])
    return z, math.pi * (step((t - 5.25) / 1.3) + step((t - 8.75) / 1.2))


#: Lift and landing of each foot, seconds.
LEFT = [(0.88, 1.34), (2.04, 2.50), (5.32, 5.66), (6.18, 6.50), (7.14, 7.60), (8.30, 8.76), (9.22, 9.52)]
RIGHT = [(0.30, 0.76), (1.46, 1.92), (5.74, 6.10), (6.60, 7.04), (7.72, 8.18), (8.84, 9.16), (9.58, 9.88)]


@pytest.mark.parametrize(("side", "swings"), [(1, LEFT), (-1, RIGHT)])
def test_a_foot_stands_where_the_walker_is_in_the_middle_of_its_stance(
    side: int, swings: list[tuple[float, float]]
) -> None:
    """Half of 0.19 m aside of the route; flat, at the height of an ankle; in the air it carries no weight."""
    flat = 0
    for k, (_, landing) in enumerate(swings):
        lifting = swings[(k + 1) % len(swings)][0] + (10 if k + 1 == len(swings) else 0)
        middle = (landing + lifting) / 2
        z, heading = route_at(middle % 10)
        track = Walker(BUILD, builtin._route, SWINGS, 10.0).foot(
            side, np.array([middle % 10, (swings[k][0] + landing) / 2])
        )
        if landing + 0.1 < middle < lifting - 0.2:  # it has rolled down and does not roll off yet
            flat += 1
            ankle = [side * 0.095 * math.cos(heading), 0.077, z - side * 0.095 * math.sin(heading)]
            assert track.ankle[0] == pytest.approx(ankle, abs=1e-9)
            assert track.pitch[0] == pytest.approx(0.0, abs=1e-9)
            assert math.remainder(track.heading[0] - heading, 2 * math.pi) == pytest.approx(0.0, abs=1e-9)
        assert track.load.tolist() == [1.0, 0.0]
        assert track.ankle[1, 1] > 0.077 + 0.03
    assert flat >= 5


def marching() -> Walker:
    """Steps on the spot, at x = 5 and z = 1: left at 0-1 s, right at 2-3 s of a cycle of 4 s."""
    swings = (Swing(1, 0.0, 1.0), Swing(-1, 2.0, 3.0))

    def route(times: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        return np.full(len(times), 5.0), np.full(len(times), 1.0), np.zeros(len(times))

    return Walker(BUILD, route, swings, 4.0)


def test_a_step_on_the_spot_by_hand() -> None:
    """No stride: the toe-off pitch is 0.12, the strike's 0; the foot turns over its ball, then is carried."""
    walker = marching()
    assert (walker.roll_s, walker.plant_s) == (0.2, 0.1)
    times = np.array([0.0, 0.5, 1.0, 2.0, 3.9, 3.95])
    track = walker.foot(1, times)
    assert track.load.tolist() == [0, 0, 1, 1, 1, 1]
    pitches = [0.12, 0.12 * (1 - step(0.55)), 0.0, 0.0, 0.12 * step(0.5) ** 1.5, 0.12 * step(0.75) ** 1.5]
    assert track.pitch == pytest.approx(pitches)

    def on_ball(pitch: float) -> np.ndarray:
        y, z = -0.062, 0.146
        turned = math.cos(pitch) * y - math.sin(pitch) * z, math.sin(pitch) * y + math.cos(pitch) * z
        return np.array([5.095, 0.077 + y - turned[0], 1.0 + z - turned[1]])

    for k in (0, 2, 3, 4, 5):
        assert track.ankle[k] == pytest.approx(on_ball(pitches[k])), k
    rise = (0.04 + 0.07 * 0.12) * math.sin(math.pi * 0.5**0.7)
    flat = np.array([5.095, 0.077, 1.0])
    assert track.ankle[1] == pytest.approx((on_ball(0.12) + flat) / 2 + [0, rise, 0])


def test_swings_of_one_foot_may_not_overlap() -> None:
    walker = dataclasses.replace(marching(), swings=(Swing(1, 0.0, 1.0), Swing(1, 0.0, 2.0), Swing(-1, 2.0, 3.0)))
    with pytest.raises(ValueError, match="swings of one foot overlap"):
        walker.foot(1, np.array([0.5]))


# --- the motions ---


def test_one_who_walks_there_and_back_takes_ten_steps_either_way_and_three_to_turn() -> None:
    """Right, left, right, ... without end: 26 steps; 5 m of way."""
    lifts = [0.55 + 0.58 * k for k in range(10)] + [6.49, 6.87, 7.23] + [7.95 + 0.58 * k for k in range(10)]
    swings = builtin.far_swings()
    assert [swing.side for swing in swings] == [-1, 1] * 13
    assert [swing.start_s for swing in swings] == pytest.approx([*lifts, 13.89, 14.27, 14.63])
    lengths = [0.46] * 10 + [0.32, 0.30, 0.30]
    assert [swing.end_s - swing.start_s for swing in swings] == pytest.approx(lengths * 2)
    motion = BUILTIN["there-and-back"]()
    assert np.abs(motion.translation[:, 0]).max() < 0.1  # sways, and leans to the loaded foot
    assert motion.translation[:, 2].min() == pytest.approx(-2.5, abs=0.1)
    assert motion.translation[:, 2].max() == pytest.approx(2.5, abs=0.1)
