"""Built-in motions: angles typed a second time, curves by their closed form, feet that do not slide."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest

from trilane.avatars.bundle import bundle_folder
from trilane.body.body import ShapedBody, load_body
from trilane.body.joints import JOINT_INDEX, JOINT_NAMES
from trilane.body.kinematics import Skeleton
from trilane.scene.motion import builtin
from trilane.scene.motion.builtin import BUILD, BUILTIN, SWINGS, hanging_arm, relaxed_hands, waving_arm
from trilane.scene.motion.footsteps import FootTrack, Swing, Walker, blurred, smooth_step, solve_leg
from trilane.scene.motion.motion import Wrap, bracket, wrapped_time
from trilane.scene.mover import Mover, make_mover
from trilane.scene.rotations import about, matrix_from_rotvec, rotvec_from_matrix
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


def step(x: float) -> float:
    s = min(max(x, 0.0), 1.0)
    return 6 * s**5 - 15 * s**4 + 10 * s**3


# --- curves ---


def test_the_smooth_step_by_hand() -> None:
    assert smooth_step(np.array([-1, 0, 0.25, 0.5, 1, 2])).tolist() == [0, 0, 0.103515625, 0.5, 1, 1]


def test_the_eased_line_by_hand() -> None:
    """Speed 1 / 0.78 between two ramps of 0.22, over which it rises and falls evenly."""
    speed = 1 / 0.78
    xs = [-1, 0, 0.11, 0.22, 0.5, 0.6, 0.78, 0.89, 1, 2]
    expected = [0, 0, speed * 0.11**2 / 0.44, speed * 0.11, 0.5, 0.5 + 0.1 * speed, 1 - speed * 0.11,
                1 - speed * 0.11**2 / 0.44, 1, 1]  # fmt: skip
    assert builtin._eased(np.array(xs)) == pytest.approx(expected)


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


def test_the_least_of_the_neighbours_round_the_cycle() -> None:
    assert builtin._eroded(np.array([5.0, 4, 9, 8, 7, 1]), 1).tolist() == [1, 4, 4, 7, 1, 1]
    assert builtin._eroded(np.array([5.0, 4, 9, 8, 7, 1]), 2).tolist() == [1, 1, 4, 1, 1, 1]


# --- arms and hands ---

#: Curl of a relaxed finger's joints, radians.
CURLS = {
    "index": (0.22, 0.32, 0.18), "middle": (0.30, 0.38, 0.22), "pinky": (0.38, 0.42, 0.25), "ring": (0.34, 0.40, 0.24),
}  # fmt: skip


@pytest.mark.parametrize(("side", "name"), [(1, "left"), (-1, "right")])
def test_fingers_curl_towards_the_palm(side: int, name: str) -> None:
    hand = relaxed_hands(side)
    first = JOINT_INDEX[f"{name}_index1"]
    for finger, angles in CURLS.items():
        for part, angle in enumerate(angles, 1):
            joint = JOINT_INDEX[f"{name}_{finger}{part}"]
            assert hand[joint - first].tolist() == [0, 0, -side * angle]
    thumb = JOINT_INDEX[f"{name}_thumb1"] - first
    assert hand[thumb:].tolist() == [[0.1, -side * 0.15, 0], [0, side * 0.1, 0], [0, side * 0.12, 0]]


@pytest.mark.parametrize("side", [1, -1])
@pytest.mark.parametrize("swing", [0.3, 0.0, -0.2])
def test_a_hanging_arm(side: int, swing: float) -> None:
    """1.27 rad below the T pose; the elbow bends by 0.22, by 0.1 of a swing, and by 0.7 of one that goes ahead."""
    shoulder, elbow, wrist = hanging_arm(side, np.array([swing]))
    c, s = math.cos(1.27), math.sin(1.27)
    turned = about(0, swing + 0.03) @ np.array([[c, side * s, 0], [-side * s, c, 0], [0, 0, 1]])
    assert shoulder[0] == pytest.approx(turned)
    bend = 0.22 + 0.1 * abs(swing) + (0.7 * -swing if swing < 0 else 0)
    assert rotvec_from_matrix(elbow[0]) == pytest.approx([0, -side * bend, 0])
    assert rotvec_from_matrix(wrist[0]) == pytest.approx([0, 0, -side * 0.08])


@pytest.mark.parametrize("wave", [-1.0, 0.0, 0.7])
def test_a_waving_arm_points_where_it_should(wave: float) -> None:
    """Upper arm and forearm, from the T pose's -X, along the directions of the table; the palm's side is level."""
    shoulder, elbow, wrist = (turn[0] for turn in waving_arm(np.array([wave])))
    upper = np.array([-0.80 - 0.05 * wave, -0.38 + 0.025 * wave, 0.30])
    fore = np.array([-0.22 - 0.42 * wave, 0.95, 0.22])
    upper, fore = upper / np.linalg.norm(upper), fore / np.linalg.norm(fore)
    right = np.array([-1.0, 0, 0])
    assert shoulder @ right == pytest.approx(upper)
    assert shoulder @ elbow @ right == pytest.approx(fore)
    assert rotvec_from_matrix(elbow)[[0, 2]] == pytest.approx([0, 0], abs=1e-12)
    assert wrist == pytest.approx(about(1, -0.1) @ about(2, -0.25 * wave))
    for turn in (shoulder, elbow, wrist):
        assert np.linalg.det(turn) == pytest.approx(1.0)


# --- legs ---


def test_a_leg_has_its_measures() -> None:
    assert dataclasses.asdict(BUILD) == {
        "hip": (0.117, -0.008, -0.010), "knee": (0.014, -0.408, 0.034), "ankle": (0.0, -0.443, -0.025),
        "ankle_height": 0.077, "ball": (0.0, -0.062, 0.146), "heel_behind": 0.057, "feet_apart": 0.19,
    }  # fmt: skip
    thigh, shin = math.hypot(0.014, 0.408, 0.034), math.hypot(0.443, 0.025)
    assert BUILD.leg_m == pytest.approx(thigh + shin)
    assert BUILD.side((1.0, 2.0, 3.0), -1).tolist() == [-1, 2, 3]


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
TABLE = [*((1, pair) for pair in LEFT), *((-1, pair) for pair in RIGHT)]


def test_the_route_is_that_of_its_tables() -> None:
    times = np.linspace(0, 10, 41)
    x, z, heading = builtin._route(times)
    assert not x.any()
    assert z == pytest.approx([route_at(t)[0] for t in times])
    assert heading == pytest.approx([route_at(t)[1] for t in times])
    assert sorted((s.side, (s.start_s, s.end_s)) for s in SWINGS) == sorted(TABLE)


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


def test_pitches_grow_with_the_stride() -> None:
    for ahead, size in ((-0.3, 0.0), (0.0, 0.0), (0.45, 0.5), (0.9, 1.0), (2.0, 1.0)):
        heading = 0.7
        new = (1.0 + ahead * math.sin(heading), 2.0 + ahead * math.cos(heading), heading)
        assert Walker._pitches((1.0, 2.0, 0.1), new) == pytest.approx((0.12 + 0.55 * size, -0.28 * size))


def test_a_heel_strikes_on_the_heel() -> None:
    """Toes up by 0.28: the foot turns about the heel, 0.077 below and 0.057 behind the ankle."""
    (ankle,) = marching()._ankle(np.array([1.0, 2.0, math.pi / 2]), np.array([-0.28]))
    y, z = -0.077, -0.057
    turned = math.cos(-0.28) * y - math.sin(-0.28) * z, math.sin(-0.28) * y + math.cos(-0.28) * z
    assert ankle == pytest.approx([1.0 + z - turned[1], 0.077 + y - turned[0], 2.0])


def test_swings_of_one_foot_may_not_overlap() -> None:
    walker = dataclasses.replace(marching(), swings=(Swing(1, 0.0, 1.0), Swing(1, 0.0, 2.0), Swing(-1, 2.0, 3.0)))
    with pytest.raises(ValueError, match="swings of one foot overlap"):
        walker.foot(1, np.array([0.5]))


# --- the body on its feet ---


def tracks(count: int, ahead: float = 0.0, load: float = 1.0, heading: float = 0.0) -> tuple[FootTrack, FootTrack]:
    """Feet that stand 0.5 m along +z, the left one `ahead` of the right one; `load`: on the right foot."""
    made = []
    for side in (1, -1):
        place = np.tile([side * 0.095, 0.077, 0.5 + (1 + side) / 2 * ahead], (count, 1)) @ about(1, heading).T
        weight = np.full(count, 1.0 if side > 0 else load)
        made.append(FootTrack(place, np.full(count, heading), np.zeros(count), weight))
    return made[0], made[1]


def angles(poses: np.ndarray, name: str) -> np.ndarray:
    return np.asarray(poses[:, JOINT_INDEX[name]])


@pytest.mark.parametrize("heading", [0.0, 1.1])
def test_a_stride_turns_hips_and_shoulders_against_each_other(heading: float) -> None:
    """The left foot 0.3 m ahead: the pelvis is turned by -0.066, the trunk by 1.9 of it back, the head by 0.9."""
    count = 120
    times = np.arange(count) / RATE
    poses, place = builtin._body(times, *tracks(count, ahead=0.3, heading=heading), wave=False)
    yaw = -0.22 * 0.3
    assert matrix_from_rotvec(angles(poses, "pelvis")) == pytest.approx(np.tile(about(1, heading + yaw), (count, 1, 1)))
    for name, share in (("spine1", 0.25), ("spine2", 0.35), ("spine3", 0.4)):
        assert angles(poses, name)[:, 1] == pytest.approx(np.full(count, -1.9 * share * yaw))
        assert angles(poses, name)[:, 2] == pytest.approx(np.zeros(count))
    assert angles(poses, "head")[:, 1] == pytest.approx(np.full(count, 0.9 * yaw))
    ahead = 0.5 + 0.02 + 0.15
    assert place[:, [0, 2]] == pytest.approx(
        np.tile([ahead * math.sin(heading), ahead * math.cos(heading)], (count, 1))
    )
    for side, name in ((1, "left"), (-1, "right")):
        shoulder, elbow, _ = hanging_arm(side, np.full(count, 0.6 * side * 0.3))
        assert matrix_from_rotvec(angles(poses, f"{name}_shoulder")) == pytest.approx(shoulder)
        assert matrix_from_rotvec(angles(poses, f"{name}_elbow")) == pytest.approx(elbow)


def test_weight_on_one_foot_leans_the_body_to_it() -> None:
    """All weight on the left: rolled by 0.05, the trunk by -0.055 in shares, the pelvis 0.028 + 0.01 m to the left."""
    count = 120
    times = np.arange(count) / RATE
    poses, place = builtin._body(times, *tracks(count, load=0.0), wave=False, shift_m=0.01)
    assert angles(poses, "pelvis") == pytest.approx(np.tile([0, 0, 0.05], (count, 1)))
    for name, share in (("spine1", 0.25), ("spine2", 0.35), ("spine3", 0.4)):
        assert angles(poses, name)[:, 2] == pytest.approx(np.full(count, -0.055 * share))
    assert place[:, [0, 2]] == pytest.approx(np.tile([0.038, 0.52], (count, 1)))
    heights = []
    for side in (1, -1):
        hip = about(2, 0.05) @ [side * 0.117, -0.008, -0.010]
        level = math.hypot(side * 0.095 - 0.038 - hip[0], 0.0 - 0.02 - hip[2])
        heights.append(0.077 + math.sqrt((0.993 * BUILD.leg_m) ** 2 - level**2) - hip[1])
    assert place[:, 1] == pytest.approx(np.full(count, min(heights)))


def test_a_heel_that_is_up_bends_the_toes() -> None:
    count = 60
    left, right = tracks(count)
    left = dataclasses.replace(left, pitch=np.linspace(-0.3, 0.9, count))
    poses, _ = builtin._body(np.arange(count) / RATE, left, right, wave=False)
    assert angles(poses, "left_foot")[:, 0] == pytest.approx(-np.clip(left.pitch, 0, 0.6))
    assert not angles(poses, "right_foot").any()


def test_the_trunk_breathes_and_leans_with_the_pace() -> None:
    """Once in about 3.6 s, a whole number of times a cycle: 3 times in 10 s; 0.05 rad a metre per second."""
    count = 600
    times = np.arange(count) / RATE
    poses = np.zeros((count, 55, 3))
    zero, pace = np.zeros(count), np.linspace(0, 1, count)
    builtin._trunk(poses, times, zero, zero, pace)
    breath = np.sin(2 * np.pi * times / 10 * 3)
    assert angles(poses, "spine1")[:, 0] == pytest.approx(0.0125 * pace)
    assert angles(poses, "spine2")[:, 0] == pytest.approx(0.0175 * pace)
    assert angles(poses, "spine3")[:, 0] == pytest.approx(0.02 * pace - 0.012 * breath)
    assert angles(poses, "neck") == pytest.approx(np.tile([0.02, 0, 0], (count, 1)))
    assert angles(poses, "head")[:, 0] == pytest.approx(0.01 * breath - 0.03 * pace)


def test_the_pace_is_the_mean_speed_of_both_feet() -> None:
    """Feet that swing ahead and back by 0.3 and 0.1 m: the trunk leans by 0.0125 of 0.2 m times the wave's speed."""
    count = 120
    k = np.arange(count)
    moved = [
        dataclasses.replace(foot, ankle=foot.ankle + np.outer(reach * np.sin(2 * np.pi * k / count), [0, 0, 1]))
        for foot, reach in zip(tracks(count), (0.3, 0.1), strict=True)
    ]
    poses, _ = builtin._body(k / RATE, moved[0], moved[1], wave=False)
    speed = 0.2 * np.cos(2 * np.pi * k / count) * math.sin(2 * math.pi / count) * RATE
    assert angles(poses, "spine1")[:, 0] == pytest.approx(0.0125 * blurred(np.abs(speed), 8))


def test_arms_lag_the_stride_by_three_samples_and_the_right_one_waves() -> None:
    count = 600
    times = np.arange(count) / RATE
    stride = 0.3 * np.sin(2 * np.pi * times)
    poses = np.zeros((count, 55, 3))
    builtin._arms(poses, times, stride, wave=True)
    lag = np.roll(stride, 3)
    for name, side in (("left", 1), ("right", -1)):
        for joint, turn in zip(("shoulder", "elbow", "wrist"), hanging_arm(side, 0.6 * side * lag), strict=True):
            found = matrix_from_rotvec(angles(poses, f"{name}_{joint}"))
            rows = slice(None) if side > 0 else slice(0, 147)  # the right arm hangs before 2.45 s
            assert found[rows] == pytest.approx(turn[rows], abs=1e-9)
    assert angles(poses, "left_collar") == pytest.approx(np.tile([0, 0, -0.06], (count, 1)))
    up = np.array([step((t - 2.45) / 0.6) - step((t - 4.75) / 0.7) for t in times])
    assert angles(poses, "right_collar")[:, 2] == pytest.approx(0.06 - 0.18 * up)
    raised = waving_arm(np.sin(2 * np.pi * 1.7 * (times - 3.05)))
    for joint, turn in zip(("shoulder", "elbow", "wrist"), raised, strict=True):
        assert matrix_from_rotvec(angles(poses, f"right_{joint}"))[184:284] == pytest.approx(turn[184:284], abs=1e-9)
    for name, side in (("left", 1), ("right", -1)):
        first = JOINT_INDEX[f"{name}_index1"]
        flat = 1 - 0.75 * up if side < 0 else np.ones(count)
        assert poses[:, first : first + 15] == pytest.approx(relaxed_hands(side) * flat[:, None, None])
    still = np.zeros((count, 55, 3))
    builtin._arms(still, times, stride, wave=False)
    assert angles(still, "right_collar")[:, 2] == pytest.approx(np.full(count, 0.06))
    assert angles(still, "right_index1") == pytest.approx(np.tile([0, 0, 0.22], (count, 1)))


def test_headings_are_midway_between_the_feet_and_may_end_a_turn_further() -> None:
    count = 600
    left, right = tracks(count)
    around = 2 * np.pi * np.arange(count) / count
    left, right = (dataclasses.replace(foot, heading=around + aside) for foot, aside in ((left, 0.2), (right, -0.1)))
    assert builtin.blurred_heading(left, right) == pytest.approx(around + 0.05, abs=1e-9)


def test_velocities_are_central_differences() -> None:
    count = 60
    left, _ = tracks(count)
    place = left.ankle + np.column_stack([np.sin(2 * np.pi * np.arange(count) / count), np.zeros((count, 2))])
    speed = builtin._velocity(dataclasses.replace(left, ankle=place))
    expected = np.cos(2 * np.pi * np.arange(count) / count) * math.sin(2 * math.pi / count) * RATE
    assert speed[:, 0] == pytest.approx(expected, abs=1e-9)
    assert builtin._along(np.array([math.pi / 2, 0.0]), np.array([[2.0, 9, 3], [2.0, 9, 3]])) == pytest.approx([2, 3])


# --- the motions ---


def test_the_motions_say_what_they_are() -> None:
    walk, idle, rest = (BUILTIN[name]() for name in ("walk-wave-turn", "idle", "t-pose"))
    assert walk.notes == ("built in: walks, waves and turns, 60 frames/s",)
    assert idle.notes == ("built in: stands, 60 frames/s",)
    assert rest.notes == ("built in: the T pose",)
    for motion, count, leg in ((walk, 601, BUILD.leg_m), (idle, 481, BUILD.leg_m), (rest, 1, None)):
        assert (len(motion.times_s), motion.leg_m, motion.travels, motion.wrap) == (count, leg, False, Wrap.LOOP)
        assert motion.times_s == pytest.approx(np.arange(count) / 60)
        assert motion.poses[0].tolist() == motion.poses[-1].tolist() and motion.betas is None
        assert motion.translation[0].tolist() == motion.translation[-1].tolist()
    assert rest.translation.tolist() == [[0, 0.94, 0]] and not rest.poses.any()
    assert list(BUILTIN) == ["walk-wave-turn", "there-and-back", "idle", "t-pose"]


def test_one_who_walks_there_and_back_takes_ten_steps_either_way_and_three_to_turn() -> None:
    """Right, left, right, ... without end: 26 steps; walks begin at 0.5 and 7.9 s, turns at 6.4 and 13.8 s of 15."""
    lifts = [0.55 + 0.58 * k for k in range(10)] + [6.49, 6.87, 7.23] + [7.95 + 0.58 * k for k in range(10)]
    swings = builtin.far_swings()
    assert [swing.side for swing in swings] == [-1, 1] * 13
    assert [swing.start_s for swing in swings] == pytest.approx([*lifts, 13.89, 14.27, 14.63])
    lengths = [0.46] * 10 + [0.32, 0.30, 0.30]
    assert [swing.end_s - swing.start_s for swing in swings] == pytest.approx(lengths * 2)
    x, z, heading = builtin._far_route(np.array([0.5, 3.44, 6.39, 7.0, 7.7, 10.84, 13.79, 14.4, 15.0]))
    assert not x.any()
    assert z == pytest.approx([-2.5, 0, 2.5, 2.5, 2.5, 0, -2.5, -2.5, -2.5], abs=1e-9)
    assert heading == pytest.approx(np.pi * np.array([0, 0, 0, 0.5, 1, 1, 1, 1.5, 2]))
    motion = BUILTIN["there-and-back"]()
    assert motion.notes == ("built in: walks five metres, turns and walks back, 60 frames/s",)
    assert (len(motion.times_s), motion.leg_m, motion.travels) == (901, BUILD.leg_m, False)
    assert np.abs(motion.translation[:, 0]).max() < 0.1  # sways, and leans to the loaded foot
    assert motion.translation[:, 2].min() == pytest.approx(-2.5, abs=0.1)
    assert motion.translation[:, 2].max() == pytest.approx(2.5, abs=0.1)


def test_one_who_stands_shifts_the_weight_and_looks_about() -> None:
    """Feet 0.19 m apart, turned out by 0.1; 0.018 m from side to side in 8 s; the head turns by 0.12, 0.6 rad early."""
    idle = BUILTIN["idle"]()
    times = np.arange(480) / 60
    shift = 0.018 * np.sin(2 * np.pi * times / 8)
    assert idle.translation[:480, 0] == pytest.approx(shift, abs=1e-12)
    assert idle.translation[:480, 2] == pytest.approx(np.full(480, 0.02))
    assert angles(idle.poses[:480], "head")[:, 1] == pytest.approx(0.12 * np.sin(2 * np.pi * times / 8 + 0.6), abs=1e-9)
    breath = np.sin(2 * np.pi * times / 8 * 2)
    assert angles(idle.poses[:480], "spine3")[:, 0] == pytest.approx(-0.012 * breath)
    assert not angles(idle.poses, "pelvis").any()
    for side, name in ((1, "left"), (-1, "right")):
        turn = np.eye(3)
        for joint in ("hip", "knee", "ankle"):
            turn = turn @ matrix_from_rotvec(idle.poses[120, JOINT_NAMES.index(f"{name}_{joint}")])
        assert turn == pytest.approx(about(1, 0.1 * side), abs=1e-9)
        hip, knee = (matrix_from_rotvec(idle.poses[120, JOINT_INDEX[f"{name}_{joint}"]]) for joint in ("hip", "knee"))
        start = idle.translation[120] + BUILD.side(BUILD.hip, side)
        ankle = start + hip @ (BUILD.side(BUILD.knee, side) + knee @ BUILD.side(BUILD.ankle, side))
        assert ankle == pytest.approx([side * 0.095, 0.077, 0], abs=1e-9)


def test_the_walker_is_the_body_on_its_feet_with_a_waving_arm() -> None:
    walk = BUILTIN["walk-wave-turn"]()
    times = np.arange(600) / 60
    walker = Walker(BUILD, builtin._route, tuple(Swing(side, *pair) for side, pair in TABLE), 10.0)
    poses, places = builtin._body(times, walker.foot(1, times), walker.foot(-1, times), wave=True)
    assert walk.poses[:600] == pytest.approx(poses) and walk.translation[:600] == pytest.approx(places)
