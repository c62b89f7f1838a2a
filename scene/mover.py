"""An avatar in the scene: its motion on the floor, at the avatar's place and heading.

The outermost vertices of a body touch the floor, not its joints; pose blend shapes are left out. The rule `sequence`
lifts the whole motion by one amount, so that jumps leave the floor. `frame` lifts each frame by its own amount, so that
the lowest point always touches the floor. `stance` is for a recording that says when its feet stand: standing feet are
on the floor, and other frames are lifted by the average lift of the standing frames.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from trilane.arrays import F32, F64
from trilane.body.body import ShapedBody
from trilane.body.joints import JOINT_INDEX, JOINT_NAMES, Skeleton
from trilane.scene.motion.motion import Motion, bracket, rest_leg_m, wrapped_time
from trilane.scene.rotations import about
from trilane.scene.schema import AvatarSpec

#: Number of skinning weights that are used per vertex: the largest ones.
WEIGHTS = 4
#: Number of frames whose heights are computed together; few enough that the arrays stay in the processor's cache.
FRAMES_AT_ONCE = 16
FEET = ("left_ankle", "right_ankle", "left_foot", "right_foot")
HEAD = ("head", "jaw", "left_eye", "right_eye")
#: Unit vectors (D, 3) in which each joint's outermost vertices are taken: the axes and the diagonals of a cube.
_SIGNS = [(x, y, z) for x in (-1, 0, 1) for y in (-1, 0, 1) for z in (-1, 0, 1) if abs(x) + abs(y) + abs(z) in (1, 3)]
DIRECTIONS: F64 = np.array(_SIGNS, dtype=np.float64) / np.linalg.norm(_SIGNS, axis=1, keepdims=True)


@dataclass(frozen=True)
class BodyOutline:
    """K vertices of a body that represent its outside.

    `points` (K, 4): positions at rest, metres, with a 1 appended.
    `joints`, `weights` (K, W): indices of the joints that move each vertex, and their weights.
    """

    points: F64
    joints: NDArray[np.intp]
    weights: F64

    def posed(self, matrices: F32) -> F64:
        """Return world positions (K, 3), metres, under skinning `matrices` (55, 3, 4)."""
        blend = np.einsum("kw,kwc->kc", self.weights, matrices.reshape(-1, 12)[self.joints])
        return np.asarray(np.einsum("kab,kb->ka", blend.reshape(-1, 3, 4), self.points))

    def lowest(self, height_rows: F32) -> F64:
        """Return the height (T,), metres, of the lowest point in each frame.

        `height_rows` (T, 55, 4): row 1, which gives y, of each skinning matrix.
        """
        parts = np.split(height_rows, range(FRAMES_AT_ONCE, len(height_rows), FRAMES_AT_ONCE))
        return np.concatenate([self._heights(rows).min(axis=1) for rows in parts])

    def _heights(self, rows: F32) -> F64:
        columns = range(self.weights.shape[1])
        blend = np.asarray(sum(self.weights[:, w, None] * rows[:, self.joints[:, w]] for w in columns))
        return np.asarray(np.einsum("tkb,kb->tk", blend, self.points))


def outline(body: ShapedBody, joints: Collection[str] = JOINT_NAMES) -> BodyOutline:
    """Return the outline of `body`: for each joint, the outermost vertex in each of DIRECTIONS.

    Only vertices that no other joint moves more count for a joint.
    `joints`: names of the joints whose vertices are taken.
    """
    weights, rest = body.body.weights, body.vertices.astype(np.float64)
    owner = weights.argmax(axis=1)
    picked: set[int] = set()
    for joint in np.unique(owner[np.isin(owner, [JOINT_INDEX[name] for name in joints])]):
        own = np.flatnonzero(owner == joint)
        picked.update(own[(rest[own] @ DIRECTIONS.T).argmax(axis=0)].tolist())
    index = np.array(sorted(picked))
    return _of(body, index)


def feet(body: ShapedBody) -> BodyOutline:
    """Return an outline of all vertices that ankles and toes move most, so that feet stand exactly on the floor."""
    return _of(body, np.flatnonzero(np.isin(body.body.weights.argmax(axis=1), [JOINT_INDEX[name] for name in FEET])))


def _of(body: ShapedBody, index: NDArray[np.intp]) -> BodyOutline:
    """Return the outline that consists of the vertices with the indices `index` (K,)."""
    weights, rest = body.body.weights[index], body.vertices[index].astype(np.float64)
    points = np.concatenate([rest, np.ones((len(index), 1))], axis=1)
    top = np.argsort(-weights, axis=1)[:, :WEIGHTS]
    largest = np.take_along_axis(weights, top, axis=1).astype(np.float64)
    return BodyOutline(points, top, largest / largest.sum(axis=1, keepdims=True))


Ground = Literal["auto", "sequence", "frame", "none"]
Rule = Literal["sequence", "frame", "stance", "none"]

#: Number of times per second of the motion at which the lowest point is computed.
SAMPLES_PER_S = 30
#: Most such times. With `stance` they cover 200 s; in longer motions, feet are less exactly on the floor.
MAX_SAMPLES: dict[Rule, int] = {"sequence": 600, "frame": 600, "stance": 6000}
#: With `sequence`, 5 % of the frames may go below the floor, so that one bad frame does not lift all others.
LOWEST_PERCENTILE = 5.0
#: With `stance`, greatest depth of the body below the floor, metres: its limbs may be longer than the recorded ones.
DEEPEST_M = 0.03


def ground_rule(motion: Motion, ground: Ground) -> Rule:
    """Return `ground`, or the rule that suits `motion` if `ground` is `auto`.

    The rule is `stance` when the motion says when its feet stand. Otherwise it is `sequence` when the pelvis's
    positions were recorded, and `frame` when they were not.
    """
    if ground != "auto":
        return ground
    if not motion.travels:
        return "frame"
    return "sequence" if motion.stance is None else "stance"


def floor_lift(
    motion: Motion, skeleton: Skeleton, shape: BodyOutline, shift: F64, scale: float, rule: Rule, soles: BodyOutline
) -> tuple[F64, F64]:
    """Return times (L,), seconds, and the lift (L,) of the body at these times, metres; linear between the times.

    `motion`: motion to put on the floor.
    `skeleton`: skeleton of the body that performs it.
    `shape`: outline of that body.
    `shift`, `scale`: as in `Mover`.
    `rule`: rule from `ground_rule`.
    `soles`: vertices of that body's feet.
    """
    if rule == "none":
        return np.zeros(1), np.zeros(1)
    dense = int(motion.duration_s * SAMPLES_PER_S) + 1
    times_s = np.linspace(0.0, motion.duration_s, min(max(len(motion.times_s), dense), MAX_SAMPLES[rule]))
    poses, pelvises = motion.sample_all(times_s)
    posed = (skeleton.pose(pose, pelvis * scale + shift) for pose, pelvis in zip(poses, pelvises, strict=True))
    # Copied, because the skeleton writes its next pose to the same buffer.
    heights = np.stack([one.matrices[:, 1].copy() for one in posed])
    lowest = shape.lowest(heights)
    if rule == "frame":
        return times_s, -lowest
    usual = -float(np.percentile(lowest, LOWEST_PERCENTILE))
    if rule != "stance" or motion.stance is None:
        return np.zeros(1), np.array([usual])
    stance, on_soles = np.interp(times_s, motion.times_s, motion.stance), soles.lowest(heights)
    if stance.any():
        usual = -float(np.average(on_soles, weights=stance))
    return times_s, np.maximum(usual + stance * (-on_soles - usual), -lowest - DEEPEST_M)


@dataclass(frozen=True)
class Mover:
    """A motion in its place in the scene.

    `world` (4, 4): transform from the motion's space to the scene.
    `scale`: factor on the pelvis's recorded positions, the ratio of the leg lengths.
    `shift` (3,): vector added to the scaled positions: minus the pelvis of the rest pose.
    `lift_times_s`, `lift_m` (L,): lift of the body onto the floor, metres, linear between these times.
    `notes`: what was decided, for people.
    """

    motion: Motion
    world: F64
    scale: float
    shift: F64
    lift_times_s: F64
    lift_m: F64
    notes: tuple[str, ...]

    def sample(self, t_s: float) -> tuple[F64, F64]:
        """Return the pose (55, 3), axis-angle, and the translation (3,), metres, at `t_s`, both before `world`."""
        pose, pelvis = self.motion.sample(t_s)
        translation = pelvis * self.scale + self.shift
        i, j, fraction = bracket(self.lift_times_s, wrapped_time(t_s, self.motion.duration_s, self.motion.wrap))
        translation[1] += self.lift_m[i] + (self.lift_m[j] - self.lift_m[i]) * fraction
        return pose, translation


def make_mover(spec: AvatarSpec, motion: Motion, body: ShapedBody) -> Mover:
    """Return the mover that puts `motion`, performed by `body`, on the floor at the position and heading of `spec`."""
    leg = rest_leg_m(body.joints)
    scale = leg / motion.leg_m if motion.leg_m else 1.0
    shift = -body.joints[0]
    rule = ground_rule(motion, spec.ground)
    skeleton = Skeleton(body.joints, body.body.parents)
    lift_times_s, lift_m = floor_lift(motion, skeleton, outline(body), shift, scale, rule, feet(body))
    world = np.eye(4)
    world[:3, :3] = about(1, np.radians(spec.heading_deg))
    world[:3, 3] = spec.position
    notes = [f"floor: {_GROUND_NOTES[rule]}"]
    if abs(scale - 1) > 0.01:
        notes.append(f"places scaled by {scale:.3f} for the avatar's legs")
    return Mover(motion, world, scale, shift, lift_times_s, lift_m, tuple(notes))


_GROUND_NOTES = {
    "frame": "the lowest point of the body touches it in every frame",
    "sequence": "the lowest point over the motion touches it",
    "stance": "feet that stand in the recording stand on it",
    "none": "heights as recorded",
}
