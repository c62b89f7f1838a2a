"""Walking on planned footprints: the tracks of the feet over a cycle, and the leg joints that reach them.

Rule: a foot that carries weight does not move, and the legs are solved to reach it, so that feet do not slide. All
times wrap around the cycle. Positions are in metres, Y up; headings are in radians about +Y, and 0 faces +Z.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from trilane.arrays import F64
from trilane.scene.rotations import about, normalised


@dataclass(frozen=True)
class Build:
    """Measures of the legs that walk, metres. Offsets are of the left side at rest, each from the joint before."""

    hip: tuple[float, float, float]
    knee: tuple[float, float, float]
    ankle: tuple[float, float, float]
    ankle_height: float
    ball: tuple[float, float, float]
    heel_behind: float
    feet_apart: float

    @property
    def leg_m(self) -> float:
        """Length from hip over knee to ankle."""
        return float(np.linalg.norm(self.knee) + np.linalg.norm(self.ankle))

    def side(self, offset: tuple[float, float, float], side: int) -> F64:
        """Return `offset` for side +1 (left) or -1 (right)."""
        return np.array([offset[0] * side, offset[1], offset[2]])


@dataclass(frozen=True)
class Swing:
    """The time of one foot (+1 left, -1 right) in the air, from `start_s` to `end_s`."""

    side: int
    start_s: float
    end_s: float


#: Function from times (T,) to x, z, heading, each (T,), at which the walker would stand.
Route = Callable[[F64], tuple[F64, F64, F64]]


@dataclass(frozen=True)
class FootTrack:
    """One foot over time.

    `ankle` (T, 3): place of the ankle. `heading` (T,): heading of the foot. `pitch` (T,): radians, positive with the
    heel up. `load` (T,): 1 on the ground, 0 in the air.
    """

    ankle: F64
    heading: F64
    pitch: F64
    load: F64


def smooth_step(x: F64) -> F64:
    """Map `x` from 0 to 1 with flat ends and flat slopes: 6x^5 - 15x^4 + 10x^3."""
    s = np.clip(x, 0.0, 1.0)
    return np.asarray(s * s * s * (s * (6 * s - 15) + 10))


def blurred(values: F64, sigma: float) -> F64:
    """Blur (T, ...) cyclically along time by a Gaussian, `sigma` in samples."""
    frequency = np.fft.rfftfreq(len(values)).reshape(-1, *[1] * (values.ndim - 1))
    gain = np.exp(-2 * (np.pi * sigma * frequency) ** 2)
    return np.fft.irfft(np.fft.rfft(values, axis=0) * gain, n=len(values), axis=0)


@dataclass(frozen=True)
class Walker:
    """Footprints from a route and a table of swings over a cycle of `period_s`."""

    build: Build
    route: Route
    swings: tuple[Swing, ...]
    period_s: float
    roll_s: float = 0.2
    plant_s: float = 0.1

    def foot(self, side: int, times_s: F64) -> FootTrack:
        """Return the track of one foot at `times_s` (T,)."""
        swings = sorted((s for s in self.swings if s.side == side), key=lambda s: s.start_s)
        tracks = [self._step(swings, k, times_s) for k in range(len(swings))]
        in_part = np.stack([inside for inside, _ in tracks])
        if not (in_part.sum(axis=0) == 1).all():
            raise ValueError("swings of one foot overlap")
        part = in_part.argmax(axis=0)
        columns = np.stack([table for _, table in tracks])[part, np.arange(len(times_s))]
        return FootTrack(columns[:, :3], columns[:, 3], columns[:, 4], columns[:, 5])

    def _step(self, swings: list[Swing], k: int, times_s: F64) -> tuple[NDArray[np.bool_], F64]:
        """Return the part of the cycle from the start of swing `k` to the start of the next one.

        It is which times are in it (T,), and a table (T, 6): ankle, heading, pitch, load.
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
        pitch = np.where(
            local < air,
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
        planted = self._ankle(np.array(new), pitch)
        in_air = local < air
        ankle = np.where(in_air[:, None], flying, planted)
        table = np.column_stack([ankle, heading, pitch, ~in_air])
        return local < until_next, table

    def _print(self, swing: Swing, after: Swing) -> tuple[float, float, float]:
        """Return the footprint between two swings: x and z of the point below the ankle, and heading."""
        stance = (after.start_s - swing.end_s) % self.period_s
        middle = np.array([(swing.end_s + stance / 2) % self.period_s])
        x, z, heading = (float(value[0]) for value in self.route(middle))
        aside = swing.side * self.build.feet_apart / 2
        return x + np.cos(heading) * aside, z - np.sin(heading) * aside, heading

    @staticmethod
    def _pitches(old: tuple[float, float, float], new: tuple[float, float, float]) -> tuple[float, float]:
        """Return the pitch at toe-off, heel up, and at heel strike, toes up; both grow with the stride."""
        ahead = np.array([np.sin(new[2]), np.cos(new[2])]) @ (np.array(new[:2]) - np.array(old[:2]))
        size = float(np.clip(ahead / 0.9, 0.0, 1.0))
        return 0.12 + 0.55 * size, -0.28 * size

    def _ankle(self, place: F64, pitch: F64) -> F64:
        """Return the ankle (T, 3) of a foot at `place` (x, z, heading) with `pitch` (T,), on its ball or heel."""
        turn = about(1, np.full(len(pitch), place[2])) @ about(0, pitch)
        flat = about(1, np.array(place[2]))
        ball = np.array(self.build.ball)
        heel = np.array([0.0, -self.build.ankle_height, -self.build.heel_behind])
        pivot = np.where((pitch > 0)[:, None], ball, heel)
        ground = np.array([place[0], self.build.ankle_height, place[1]])
        return ground + pivot @ flat.T - (turn @ pivot[..., None])[..., 0]


def solve_leg(build: Build, side: int, hip: F64, pelvis: F64, foot: FootTrack) -> tuple[F64, F64, F64]:
    """Return local turns (T, 3, 3) of hip, knee and ankle that put the ankle on its track.

    `build`: measures of the leg.
    `side`: +1 left, -1 right.
    `hip` (T, 3): place of the hip joint.
    `pelvis` (T, 3, 3): turn of the pelvis.
    `foot`: track of the foot. The leg is stretched towards an ankle out of reach.
    """
    thigh, shin = build.side(build.knee, side), build.side(build.ankle, side)
    to_ankle = foot.ankle - hip
    knee = about(0, _knee_angle(thigh, shin, np.linalg.norm(to_ankle, axis=1)))
    reach = thigh + knee @ shin
    lateral = (about(1, foot.heading)[:, :, 0] + pelvis[:, :, 0]) / 2
    turn = _frame(to_ankle, lateral) @ np.swapaxes(_frame(reach, np.array([1.0, 0.0, 0.0])), -1, -2)
    sole = about(1, foot.heading) @ about(0, foot.pitch)
    hip_local = np.swapaxes(pelvis, -1, -2) @ turn
    return hip_local, knee, np.swapaxes(turn @ knee, -1, -2) @ sole


def _knee_angle(thigh: F64, shin: F64, distance: F64) -> F64:
    """Return the flexion (T,) about +X at which |thigh + R shin| = distance: a cos + b sin = c."""
    a, b = thigh[1] * shin[1] + thigh[2] * shin[2], thigh[2] * shin[1] - thigh[1] * shin[2]
    c = (distance**2 - thigh @ thigh - shin @ shin) / 2 - thigh[0] * shin[0]
    return np.asarray(np.arctan2(b, a) + np.arccos(np.clip(c / np.hypot(a, b), -1.0, 1.0)))


def _frame(along: F64, lateral: F64) -> F64:
    """Return matrices (T, 3, 3) whose second column is `along` and whose first is nearest to `lateral`."""
    second = normalised(along)
    third = normalised(np.cross(np.broadcast_to(lateral, second.shape), second))
    return np.stack([np.cross(second, third), second, third], axis=-1)
