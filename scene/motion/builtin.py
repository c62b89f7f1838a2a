"""The built-in motions: a person who walks, waves and turns; walks there and back; stands; or is in the T pose.

Walks follow planned footprints. Rule: a foot that carries weight does not move, and the legs are solved to reach it, so
that feet do not slide. All times wrap around the cycle. Positions are in metres, Y up. Headings are in radians about
+Y; heading 0 faces +Z.

Tables state the times of steps, walks, turns and waves; the curves between them are computed. A cycle ends where it
began. A `side` is +1 for left and -1 for right. In the poses of arms and hands, rotations are relative to the parent
joint, from the T pose. Axes are +X left, +Y up and +Z ahead.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from trilane.arrays import F64
from trilane.body.joints import JOINT_INDEX, JOINTS
from trilane.scene.motion.motion import Motion, Wrap
from trilane.scene.rotations import about, matrix_from_quat, normalised, quat_from_matrix, rotvec_from_matrix, slerp


@dataclass(frozen=True)
class Build:
    """Measures of the legs that walk, metres.

    `hip`, `knee`, `ankle`, `ball`: position of each joint of the left leg at rest, (x, y, z) from the joint before it.
    The hip's position is from the pelvis.
    `ankle_height`: height of the ankle above the sole. `heel_behind`: distance of the heel behind the ankle.
    `feet_apart`: distance between the feet.
    """

    hip: tuple[float, float, float]
    knee: tuple[float, float, float]
    ankle: tuple[float, float, float]
    ankle_height: float
    ball: tuple[float, float, float]
    heel_behind: float
    feet_apart: float

    @property
    def leg_m(self) -> float:
        """Length of a leg from hip over knee to ankle, metres."""
        return float(np.linalg.norm(self.knee) + np.linalg.norm(self.ankle))

    def side(self, offset: tuple[float, float, float], side: int) -> F64:
        """Return `offset` (3,), a vector of the left side, mirrored if `side` is -1 (right)."""
        return np.array([offset[0] * side, offset[1], offset[2]])


@dataclass(frozen=True)
class Swing:
    """A swing of one foot through the air, from `start_s` to `end_s` in the cycle. `side`: +1 left, -1 right."""

    side: int
    start_s: float
    end_s: float


#: Function from times (T,), seconds, to x, z (metres) and heading (radians) of the walker, each (T,).
Route = Callable[[F64], tuple[F64, F64, F64]]


@dataclass(frozen=True)
class FootTrack:
    """One foot over time.

    `ankle` (T, 3): position of the ankle, metres.
    `heading` (T,): heading of the foot, radians.
    `pitch` (T,): pitch of the foot, radians, positive when the heel is up.
    `load` (T,): 1 on the ground, 0 in the air.
    """

    ankle: F64
    heading: F64
    pitch: F64
    load: F64


def smooth_step(x: F64) -> F64:
    """Return 6x^5 - 15x^4 + 10x^3, with `x` clipped to [0, 1]: a step from 0 to 1 with smooth ends."""
    s = np.clip(x, 0.0, 1.0)
    return np.asarray(s * s * s * (s * (6 * s - 15) + 10))


def blurred(values: F64, sigma: float) -> F64:
    """Return cyclic `values` (T, ...) blurred along time by a Gaussian. `sigma`: standard deviation in samples."""
    frequency = np.fft.rfftfreq(len(values)).reshape(-1, *[1] * (values.ndim - 1))
    gain = np.exp(-2 * (np.pi * sigma * frequency) ** 2)
    return np.fft.irfft(np.fft.rfft(values, axis=0) * gain, n=len(values), axis=0)


@dataclass(frozen=True)
class Walker:
    """A walker over a cycle of `period_s`, whose footprints follow from a route and a table of swings.

    `roll_s`: time in which the foot rolls onto its ball before it leaves the ground.
    `plant_s`: time in which the foot becomes flat after it has reached the ground.
    """

    build: Build
    route: Route
    swings: tuple[Swing, ...]
    period_s: float
    roll_s: float = 0.2
    plant_s: float = 0.1

    def foot(self, side: int, times_s: F64) -> FootTrack:
        """Return the track of the foot of `side` (+1 left, -1 right) at `times_s` (T,).

        Raises ValueError when swings of the foot overlap.
        """
        swings = sorted((s for s in self.swings if s.side == side), key=lambda s: s.start_s)
        tracks = [self._step(swings, k, times_s) for k in range(len(swings))]
        in_part = np.stack([inside for inside, _ in tracks])
        if not (in_part.sum(axis=0) == 1).all():
            raise ValueError("swings of one foot overlap")
        part = in_part.argmax(axis=0)
        columns = np.stack([table for _, table in tracks])[part, np.arange(len(times_s))]
        return FootTrack(columns[:, :3], columns[:, 3], columns[:, 4], columns[:, 5])

    def _step(self, swings: list[Swing], k: int, times_s: F64) -> tuple[NDArray[np.bool_], F64]:
        """Return the part of a foot's track from the start of swing `k` to the start of the next swing.

        The result is (mask of the times in that part (T,), table (T, 6) of ankle x, y, z, heading, pitch and load).
        """
        swing, after = swings[k], swings[(k + 1) % len(swings)]
        before = swings[k - 1]
        local = (times_s - swing.start_s) % self.period_s
        until_next = (after.start_s - swing.start_s) % self.period_s or self.period_s
        air = swing.end_s - swing.start_s
        old, new = self._print(before, swing), self._print(swing, after)
        toe_off, strike = self._pitches(old, new)
        next_off = self._pitches(new, self._print(after, swings[(k + 2) % len(swings)]))[0]
        phase = local / air
        in_air = local < air
        pitch = np.where(
            in_air,
            toe_off + (strike - toe_off) * smooth_step(phase * 1.1),
            strike * (1 - smooth_step((local - air) / self.plant_s))
            + next_off * smooth_step(1 - (until_next - local) / self.roll_s) ** 1.5,
        )
        turned = np.remainder(new[2] - old[2] + np.pi, 2 * np.pi) - np.pi
        heading = old[2] + turned * smooth_step(phase)
        lifted = self._ankle(np.array(old), np.array([toe_off]))
        landed = self._ankle(np.array(new), np.array([strike]))
        rise = (0.04 + 0.07 * abs(toe_off)) * np.sin(np.pi * np.clip(phase, 0, 1) ** 0.7)
        flying = lifted + (landed - lifted) * smooth_step(phase)[:, None] + rise[:, None] * np.array([0.0, 1.0, 0.0])
        ankle = np.where(in_air[:, None], flying, self._ankle(np.array(new), pitch))
        return local < until_next, np.column_stack([ankle, heading, pitch, ~in_air])

    def _print(self, swing: Swing, after: Swing) -> tuple[float, float, float]:
        """Return the footprint between swing `swing` and the next swing `after`, as (x, z, heading).

        x and z are the place of the point below the ankle, metres; the heading is in radians.
        """
        stance = (after.start_s - swing.end_s) % self.period_s
        middle = np.array([(swing.end_s + stance / 2) % self.period_s])
        x, z, heading = (float(value[0]) for value in self.route(middle))
        aside = swing.side * self.build.feet_apart / 2
        return x + np.cos(heading) * aside, z - np.sin(heading) * aside, heading

    @staticmethod
    def _pitches(old: tuple[float, float, float], new: tuple[float, float, float]) -> tuple[float, float]:
        """Return the pitch at toe-off (heel up) and at heel strike (toes up), radians; both grow with the stride."""
        ahead = np.array([np.sin(new[2]), np.cos(new[2])]) @ (np.array(new[:2]) - np.array(old[:2]))
        size = float(np.clip(ahead / 0.9, 0.0, 1.0))
        return 0.12 + 0.55 * size, -0.28 * size

    def _ankle(self, place: F64, pitch: F64) -> F64:
        """Return ankle positions (T, 3), metres, of a foot that stands on its ball or its heel.

        `place` (3,): footprint, as x, z, heading. `pitch` (T,): pitch of the foot, radians; positive on the ball.
        """
        turn = about(1, np.full(len(pitch), place[2])) @ about(0, pitch)
        flat = about(1, np.array(place[2]))
        ball = np.array(self.build.ball)
        heel = np.array([0.0, -self.build.ankle_height, -self.build.heel_behind])
        pivot = np.where((pitch > 0)[:, None], ball, heel)
        ground = np.array([place[0], self.build.ankle_height, place[1]])
        return ground + pivot @ flat.T - (turn @ pivot[..., None])[..., 0]


def solve_leg(build: Build, side: int, hip: F64, pelvis: F64, foot: FootTrack) -> tuple[F64, F64, F64]:
    """Return rotations (T, 3, 3) of hip, knee and ankle, relative to their parents, that put the ankle on its track.

    `build`: measures of the leg.
    `side`: +1 left, -1 right.
    `hip` (T, 3): positions of the hip joint.
    `pelvis` (T, 3, 3): rotations of the pelvis.
    `foot`: track of the foot. If the ankle is out of reach, the leg is stretched towards it.
    """
    thigh, shin = build.side(build.knee, side), build.side(build.ankle, side)
    to_ankle = foot.ankle - hip
    knee = about(0, _knee_angle(thigh, shin, np.linalg.norm(to_ankle, axis=1)))
    reach = thigh + knee @ shin
    lateral = (about(1, foot.heading)[:, :, 0] + pelvis[:, :, 0]) / 2
    turn = _frame(to_ankle, lateral) @ np.swapaxes(_frame(reach, np.array([1.0, 0.0, 0.0])), -1, -2)
    sole = about(1, foot.heading) @ about(0, foot.pitch)
    return np.swapaxes(pelvis, -1, -2) @ turn, knee, np.swapaxes(turn @ knee, -1, -2) @ sole


def _knee_angle(thigh: F64, shin: F64, distance: F64) -> F64:
    """Return the flexion (T,), radians about +X, at which hip and ankle are `distance` (T,) apart.

    This angle of the rotation R solves |thigh + R shin| = distance, which has the form a cos + b sin = c.
    """
    a, b = thigh[1] * shin[1] + thigh[2] * shin[2], thigh[2] * shin[1] - thigh[1] * shin[2]
    c = (distance**2 - thigh @ thigh - shin @ shin) / 2 - thigh[0] * shin[0]
    return np.asarray(np.arctan2(b, a) + np.arccos(np.clip(c / np.hypot(a, b), -1.0, 1.0)))


def _frame(along: F64, lateral: F64) -> F64:
    """Return matrices (T, 3, 3) whose second column is along `along` (T, 3) and whose first is nearest to `lateral`."""
    second = normalised(along)
    third = normalised(np.cross(np.broadcast_to(lateral, second.shape), second))
    return np.stack([np.cross(second, third), second, third], axis=-1)


#: Angle of a hanging arm below the T pose, radians, without the collar's part.
HANG = 1.27
ELBOW_EASE = 0.22
#: Directions of the raised right arm at the middle of the wave: upper arm and forearm.
UPPER_ARM = (-0.80, -0.38, 0.30)
FOREARM = (-0.22, 0.95, 0.22)
WAVE_REACH = 0.42
#: Curl of the three joints of each relaxed finger, radians, in SMPL-X order.
CURL = {
    "index": (0.22, 0.32, 0.18),
    "middle": (0.30, 0.38, 0.22),
    "pinky": (0.38, 0.42, 0.25),
    "ring": (0.34, 0.40, 0.24),
}


def hanging_arm(side: int, swing: F64) -> tuple[F64, F64, F64]:
    """Return rotations (T, 3, 3) of shoulder, elbow and wrist of an arm that hangs and swings.

    `side`: +1 left, -1 right. `swing` (T,): angle by which the arm swings back, radians.
    """
    shoulder = about(0, swing + 0.03) @ about(2, np.array(-side * HANG))
    bend = ELBOW_EASE + np.clip(-swing, 0, None) * 0.7 + 0.1 * np.abs(swing)
    elbow = about(1, -side * bend)
    wrist = np.broadcast_to(about(2, np.array(-side * 0.08)), elbow.shape)
    return shoulder, elbow, wrist


def waving_arm(wave: F64) -> tuple[F64, F64, F64]:
    """Return rotations (T, 3, 3) of shoulder, elbow and wrist of the right arm, with the palm to the viewer.

    `wave` (T,): position in the wave, -1 to 1; positive is outward.
    """
    upper = normalised(np.array(UPPER_ARM) + 0.05 * wave[:, None] * np.array([-1.0, 0.5, 0.0]))
    fore = normalised(np.array(FOREARM) + WAVE_REACH * wave[:, None] * np.array([-1.0, 0.0, 0.0]))
    ahead = normalised(fore - (fore * upper).sum(axis=-1, keepdims=True) * upper)
    shoulder = np.stack([-upper, np.cross(ahead, -upper), ahead], axis=-1)
    bend = np.arccos((fore * upper).sum(axis=-1))
    wrist = about(2, -0.25 * wave)
    return shoulder, about(1, bend), about(1, np.full(len(wave), -0.1)) @ wrist


def relaxed_hands(side: int) -> F64:
    """Return axis-angle (15, 3) of the fingers of one relaxed hand, in SMPL-X order. `side`: +1 left, -1 right."""
    fingers = [[(0.0, 0.0, -side * angle) for angle in curl] for curl in CURL.values()]
    thumb = [(0.1, -side * 0.15, 0.0), (0.0, side * 0.1, 0.0), (0.0, side * 0.12, 0.0)]
    return np.array([*fingers, thumb]).reshape(15, 3)


RATE_HZ = 60
#: Measures of an adult of 1.76 m; for other bodies the translation is scaled by the length of their legs.
BUILD = Build(
    hip=(0.117, -0.008, -0.010),
    knee=(0.014, -0.408, 0.034),
    ankle=(0.0, -0.443, -0.025),
    ankle_height=0.077,
    ball=(0.0, -0.062, 0.146),
    heel_behind=0.057,
    feet_apart=0.19,
)
#: Largest distance of an ankle from its hip, as a share of the leg's length.
REACH = 0.993

Changes = tuple[tuple[float, float, float], ...]

#: Changes of the route: start and end in seconds, and the change between them. WALKS change z, in metres; TURNS change
#: the heading, in radians.
WALKS = ((0.25, 2.65, 1.5), (6.45, 8.85, -1.5))
TURNS = ((5.25, 6.55, np.pi), (8.75, 9.95, np.pi))
START_Z_M = -1.1
#: Steps of the feet: side (+1 left, -1 right), and times of lift and landing in seconds.
SWINGS = (
    Swing(-1, 0.30, 0.76),
    Swing(1, 0.88, 1.34),
    Swing(-1, 1.46, 1.92),
    Swing(1, 2.04, 2.50),
    Swing(1, 5.32, 5.66),
    Swing(-1, 5.74, 6.10),
    Swing(1, 6.18, 6.50),
    Swing(-1, 6.60, 7.04),
    Swing(1, 7.14, 7.60),
    Swing(-1, 7.72, 8.18),
    Swing(1, 8.30, 8.76),
    Swing(-1, 8.84, 9.16),
    Swing(1, 9.22, 9.52),
    Swing(-1, 9.58, 9.88),
)
PERIOD_S = 10.0

#: The motion there and back has the same kinds of tables: FAR_M metres each way, in FAR_STEPS steps of STEP_S seconds.
FAR_M, FAR_STEPS, STEP_S = 5.0, 10, 0.58
FAR_WALKS = ((0.50, 6.38, FAR_M), (7.90, 13.78, -FAR_M))
FAR_TURNS = ((6.40, 7.60, np.pi), (13.80, 15.00, np.pi))
FAR_PERIOD_S = 15.0
#: Steps of a turn: times of lift and landing, seconds after the turn's beginning.
TURN_STEPS = ((0.09, 0.41), (0.47, 0.77), (0.83, 1.13))
#: Times, seconds, at which the waving arm starts to rise, is up, starts to sink, and is down.
WAVE_S = (2.45, 3.05, 4.75, 5.45)
WAVES_PER_S = 1.7


def walk_wave_turn() -> Motion:
    """Return the motion, ten seconds long, of a person who walks to the viewer, waves, turns and walks back."""
    times = np.arange(int(PERIOD_S * RATE_HZ)) / RATE_HZ
    walker = Walker(BUILD, _route, SWINGS, PERIOD_S)
    left, right = walker.foot(1, times), walker.foot(-1, times)
    return _closed(times, *_body(times, left, right), "walks, waves and turns")


def there_and_back() -> Motion:
    """Return the motion, fifteen seconds long, of a person who walks five metres along z, turns and walks back."""
    times = np.arange(int(FAR_PERIOD_S * RATE_HZ)) / RATE_HZ
    walker = Walker(BUILD, _far_route, far_swings(), FAR_PERIOD_S)
    left, right = walker.foot(1, times), walker.foot(-1, times)
    return _closed(times, *_body(times, left, right, wave=False), "walks five metres, turns and walks back")


def far_swings() -> tuple[Swing, ...]:
    """Return the steps of the person who walks there and back; the feet alternate, the right foot first."""
    spans = []
    for (walk_s, _, _), (turn_s, _, _) in zip(FAR_WALKS, FAR_TURNS, strict=True):
        lifts = (walk_s + 0.05 + k * STEP_S for k in range(FAR_STEPS))
        spans += [(lift_s, lift_s + 0.46) for lift_s in lifts]
        spans += [(turn_s + lift_s, turn_s + landing_s) for lift_s, landing_s in TURN_STEPS]
    return tuple(Swing(1 if k % 2 else -1, *span) for k, span in enumerate(spans))


def idle() -> Motion:
    """Return the motion, eight seconds long, of a person who stands, breathes, shifts the weight and looks about."""
    times = np.arange(8 * RATE_HZ) / RATE_HZ
    count, apart, height = len(times), BUILD.feet_apart, BUILD.ankle_height
    left, right = (
        FootTrack(
            np.tile([side * apart / 2, height, 0.0], (count, 1)),
            np.full(count, 0.1 * side),
            np.zeros(count),
            np.ones(count),
        )
        for side in (1, -1)
    )
    poses, places = _body(times, left, right, wave=False, shift_m=0.018 * np.sin(np.pi * times / 4))
    poses[:, JOINT_INDEX["head"], 1] += 0.12 * np.sin(np.pi * times / 4 + 0.6)
    return _closed(times, poses, places, "stands")


def t_pose() -> Motion:
    """Return the rest pose as a motion of one frame."""
    poses, places = np.zeros((1, JOINTS, 3)), np.array([[0.0, 0.94, 0.0]])
    return Motion(np.zeros(1), poses, places, None, ("built in: the T pose",), Wrap.LOOP, None, False)


BUILTIN: dict[str, Callable[[], Motion]] = {
    "walk-wave-turn": walk_wave_turn,
    "there-and-back": there_and_back,
    "idle": idle,
    "t-pose": t_pose,
}


def _closed(times: F64, poses: F64, places: F64, what: str) -> Motion:
    """Return a motion that loops, because its last frame equals its first. `what`: words for the note."""
    times = np.append(times, len(times) / RATE_HZ)
    poses, places = (np.concatenate([values, values[:1]]) for values in (poses, places))
    notes = (f"built in: {what}, {RATE_HZ} frames/s",)
    return Motion(times, poses, places, None, notes, Wrap.LOOP, BUILD.leg_m, False)


def _route(times: F64) -> tuple[F64, F64, F64]:
    return _along_z(times, START_Z_M, WALKS, TURNS)


def _far_route(times: F64) -> tuple[F64, F64, F64]:
    return _along_z(times, -FAR_M / 2, FAR_WALKS, FAR_TURNS)


def _along_z(times: F64, start_m: float, walks: Changes, turns: Changes) -> tuple[F64, F64, F64]:
    """Return (x, z, heading) at `times` (T,) of a route along z that begins at `start_m`, metres; x is 0."""
    z = start_m + sum(far * _eased((times - start) / (end - start)) for start, end, far in walks)
    heading = sum(angle * smooth_step((times - start) / (end - start)) for start, end, angle in turns)
    return np.zeros_like(times), np.asarray(z), np.asarray(heading)


def _eased(x: F64) -> F64:
    """Return the progress, 0 to 1, of a move over `x` from 0 to 1: constant speed, with a soft start and end.

    The soft start and the soft end each take 22 % of the time.
    """
    ramp = 0.22
    s = np.clip(x, 0.0, 1.0)
    speed = 1 / (1 - ramp)
    start, end = speed * s**2 / (2 * ramp), 1 - speed * (1 - s) ** 2 / (2 * ramp)
    middle = speed * (s - ramp / 2)
    return np.where(s < ramp, start, np.where(s > 1 - ramp, end, middle))


def _body(
    times: F64, left: FootTrack, right: FootTrack, wave: bool = True, shift_m: F64 | float = 0.0
) -> tuple[F64, F64]:
    """Return poses (T, 55, 3) and pelvis positions (T, 3) of a body on two feet. `shift_m`: shift to its left."""
    heading = blurred_heading(left, right)
    stride = blurred(_along(heading, left.ankle - right.ankle), 3)
    weight = blurred(left.load - right.load, 7)
    pace = blurred(np.abs(_along(heading, _velocity(left) + _velocity(right))) / 2, 8)
    pelvis_yaw = -0.22 * stride
    pelvis = about(1, heading + pelvis_yaw) @ about(2, 0.05 * weight)
    place = _pelvis_place(left, right, heading, pelvis, weight, shift_m)
    poses = np.zeros((len(times), JOINTS, 3))
    _set(poses, "pelvis", pelvis)
    for side, name, foot in ((1, "left", left), (-1, "right", right)):
        hip = place + (pelvis @ BUILD.side(BUILD.hip, side))
        for joint, turn in zip(("hip", "knee", "ankle"), solve_leg(BUILD, side, hip, pelvis, foot), strict=True):
            _set(poses, f"{name}_{joint}", turn)
        poses[:, JOINT_INDEX[f"{name}_foot"], 0] = -np.clip(foot.pitch, 0, 0.6)
    _trunk(poses, times, pelvis_yaw, weight, pace)
    _arms(poses, times, stride, wave)
    return poses, place


def blurred_heading(left: FootTrack, right: FootTrack) -> F64:
    """Return the heading (T,) of the pelvis, radians: midway between the feet's headings, smoothed.

    Over a cycle, the heading may change by whole turns.
    """
    sines, cosines = (f(left.heading) + f(right.heading) for f in (np.sin, np.cos))
    mean = np.unwrap(np.arctan2(sines, cosines))
    drift = np.linspace(0, round((mean[-1] - mean[0]) / (2 * np.pi)) * 2 * np.pi, len(mean), endpoint=False)
    return blurred(mean - drift, 6) + drift


def _velocity(foot: FootTrack) -> F64:
    return (np.roll(foot.ankle, -1, axis=0) - np.roll(foot.ankle, 1, axis=0)) * RATE_HZ / 2


def _along(heading: F64, vectors: F64) -> F64:
    return np.sin(heading) * vectors[:, 0] + np.cos(heading) * vectors[:, 2]


def _pelvis_place(
    left: FootTrack, right: FootTrack, heading: F64, pelvis: F64, weight: F64, shift_m: F64 | float
) -> F64:
    """Return pelvis positions (T, 3): between the feet, over the loaded foot, low enough for both legs to reach."""
    between = blurred((left.ankle + right.ankle) / 2, 7)
    aside = 0.028 * weight + shift_m
    place = between + np.column_stack([np.cos(heading) * aside, 0 * aside, -np.sin(heading) * aside])
    place[:, 0] += 0.02 * np.sin(heading)
    place[:, 2] += 0.02 * np.cos(heading)
    low = np.minimum(*(_height_within_reach(side, foot, place, pelvis) for side, foot in ((1, left), (-1, right))))
    place[:, 1] = blurred(np.min([np.roll(low, k) for k in range(-6, 7)], axis=0), 4)
    return place


def _height_within_reach(side: int, foot: FootTrack, place: F64, pelvis: F64) -> F64:
    """Return the greatest pelvis height (T,), metres, at which the leg reaches; `place` gives x and z."""
    hip = pelvis @ BUILD.side(BUILD.hip, side)
    flat = foot.ankle - place - hip
    level = np.hypot(flat[:, 0], flat[:, 2])
    return np.asarray(foot.ankle[:, 1] + np.sqrt((BUILD.leg_m * REACH) ** 2 - level**2) - hip[:, 1])


def _trunk(poses: F64, times: F64, pelvis_yaw: F64, weight: F64, pace: F64) -> None:
    """Set spine, neck and head in `poses`: shoulders turn against hips; the body leans with the pace and breathes."""
    breath = np.sin(2 * np.pi * times / (times[-1] + times[1]) * round(times[-1] / 3.6))
    for name, share in (("spine1", 0.25), ("spine2", 0.35), ("spine3", 0.4)):
        joint = poses[:, JOINT_INDEX[name]]
        joint[:, 1] = -1.9 * share * pelvis_yaw
        joint[:, 2] = -0.055 * share * weight
        joint[:, 0] = 0.05 * share * pace
    poses[:, JOINT_INDEX["spine3"], 0] -= 0.012 * breath
    poses[:, JOINT_INDEX["neck"], 0] = 0.02
    poses[:, JOINT_INDEX["head"], 1] = 0.9 * pelvis_yaw
    poses[:, JOINT_INDEX["head"], 0] = 0.01 * breath - 0.03 * pace


def _arms(poses: F64, times: F64, stride: F64, wave: bool) -> None:
    """Set arms and hands in `poses`: they swing against the legs; the right arm waves if `wave` is set."""
    lag = np.roll(stride, 3)
    start, raised, lower, down = WAVE_S
    rise, fall = smooth_step((times - start) / (raised - start)), smooth_step((times - lower) / (down - lower))
    up = (rise - fall) * wave
    for side, name in ((1, "left"), (-1, "right")):
        arm: tuple[F64, ...] = hanging_arm(side, 0.6 * side * lag)
        if side < 0 and wave:
            waving = waving_arm(np.sin(2 * np.pi * WAVES_PER_S * (times - raised)))
            arm = tuple(_between(low, high, up) for low, high in zip(arm, waving, strict=True))
        for joint, turn in zip(("shoulder", "elbow", "wrist"), arm, strict=True):
            _set(poses, f"{name}_{joint}", turn)
        poses[:, JOINT_INDEX[f"{name}_collar"], 2] = -0.06 * side
        first = JOINT_INDEX[f"{name}_index1"]
        open_hand = up if side < 0 else np.zeros_like(up)
        poses[:, first : first + 15] = relaxed_hands(side) * (1 - 0.75 * open_hand)[:, None, None]
    poses[:, JOINT_INDEX["right_collar"], 2] -= 0.18 * up


def _between(low: F64, high: F64, weight: F64) -> F64:
    return matrix_from_quat(slerp(quat_from_matrix(low), quat_from_matrix(high), weight))


def _set(poses: F64, joint: str, turn: F64) -> None:
    poses[:, JOINT_INDEX[joint]] = rotvec_from_matrix(turn)
