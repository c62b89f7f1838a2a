"""An avatar in the scene: its motion on the floor, at its place and heading.

Rule: a Mover answers any time with what the skeleton needs; it holds no state that changes.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from trilane.arrays import F64
from trilane.body.body import ShapedBody
from trilane.body.kinematics import Skeleton
from trilane.scene.floor import ground_rule, leg_length, lift, outline
from trilane.scene.motion.motion import Motion, bracket, wrapped_time
from trilane.scene.rotations import about
from trilane.scene.schema import AvatarSpec


@dataclass(frozen=True)
class Mover:
    """`world` (4, 4): from the motion's ground to the scene. `scale`: of the pelvis's places, by leg length.

    `shift` (3,): minus the rest pelvis. `lift_times_s` (L,) and `lift_m` (L,): grounding, linear between.
    """

    motion: Motion
    world: F64
    scale: float
    shift: F64
    lift_times_s: F64
    lift_m: F64
    notes: tuple[str, ...]

    def sample(self, t_s: float) -> tuple[F64, F64]:
        """Pose (55, 3) and translation (3,), in body space before `world`."""
        pose, pelvis = self.motion.sample(t_s)
        translation = pelvis * self.scale + self.shift
        i, j, fraction = bracket(self.lift_times_s, wrapped_time(t_s, self.motion.duration_s, self.motion.wrap))
        translation[1] += self.lift_m[i] + (self.lift_m[j] - self.lift_m[i]) * fraction
        return pose, translation


def make_mover(spec: AvatarSpec, motion: Motion, body: ShapedBody) -> Mover:
    """Ground `motion` for `body` and put it where `spec` says."""
    leg = leg_length(body.joints)
    scale = leg / motion.leg_m if motion.leg_m else 1.0
    shift = -body.joints[0]
    rule = ground_rule(motion, spec.ground)
    skeleton = Skeleton(body.joints, body.body.parents)
    times, metres = lift(motion, skeleton, outline(body), shift, scale, rule)
    world = np.eye(4)
    world[:3, :3] = about(1, np.radians(spec.heading_deg))
    world[:3, 3] = spec.position
    notes = [f"floor: {_GROUND_NOTES[rule]}"]
    if abs(scale - 1) > 0.01:
        notes.append(f"places scaled by {scale:.3f} for the avatar's legs")
    return Mover(motion, world, scale, shift, times, metres, tuple(notes))


_GROUND_NOTES = {
    "frame": "the lowest point of the body touches it in every frame",
    "sequence": "the lowest point over the motion touches it",
    "none": "heights as recorded",
}
